"""Write a run's field for a GIS: all layers as GeoTIFF, tracklets as GeoParquet.

python examples/field_to_gis.py RUN
"""

import sys

import rasterio

import velfield
from velfield.exports.export import export_run


def main(root: str) -> None:
    """Write both into the run's `exports/`; print the layers of the GeoTIFF."""
    run = velfield.open_run(root)
    layers, lines = export_run(run, "cog"), export_run(run, "geoparquet")
    with rasterio.open(layers) as image:
        print(f"{layers}: {', '.join(image.descriptions)}")
    print(lines)


if __name__ == "__main__":
    main(sys.argv[1])
