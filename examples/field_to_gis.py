"""Write a run's field for a GIS: all layers as GeoTIFF, tracklets as GeoParquet.

python examples/field_to_gis.py RUN
"""

import sys

import rasterio

import velfield
from velfield.exports.export import export_run
from velfield.sources.geo import ignore_missing_georeference


def main(root: str) -> None:
    """Write both into the run's `exports/`; print the layers of the GeoTIFF."""
    run = velfield.open_run(root)
    layers, lines = export_run(run, "cog"), export_run(run, "geoparquet")
    with ignore_missing_georeference(), rasterio.open(layers) as image:
        print(f"{layers}: {', '.join(image.descriptions)}")
    print(lines)


if __name__ == "__main__":
    main(sys.argv[1])
