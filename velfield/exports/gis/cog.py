"""Cloud-optimised GeoTIFF: layers of the field for GIS, with names, units, NaN and the reference system."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rasterio.io import MemoryFile
from rasterio.shutil import copy
from rasterio.transform import Affine

from schemas.export import ExportOptions
from velfield.run.commits import write_atomically
from velfield.run.run import Run
from velfield.run.stores import FieldStore
from velfield.sources.geo import ignore_missing_georeference

FILE_NAME = "field.tif"
AffineCoefficients = tuple[float, float, float, float, float, float]


def encode(run: Run, _path: Path, _options: ExportOptions) -> bytes:
    """All layers of the field as bands of float32, in SI units where metres are known: see `ExportModule`."""
    store, grid = FieldStore(run.layout.field), run.grid
    names = store.layer_names()
    units = [str(store.layer_attributes(name).get("units", "1")) for name in names]
    factors = [grid.gsd_m if grid.gsd_m and unit == "px s-1" else 1.0 for unit in units]
    return cog_bytes(
        [
            np.float32(factor) * store.layer(name).astype(np.float32)
            for name, factor in zip(names, factors, strict=True)
        ],
        names=names,
        units=["m s-1" if grid.gsd_m and unit == "px s-1" else unit for unit in units],
        crs_wkt=grid.crs_wkt,
        affine=grid.affine,
    )


def write_cog(
    path: Path,
    layers: Sequence[NDArray[np.generic]],
    *,
    names: Sequence[str],
    units: Sequence[str],
    crs_wkt: str | None = None,
    affine: AffineCoefficients | None = None,
) -> None:
    """Write a cloud-optimised GeoTIFF, whole or not at all: see `cog_bytes`."""
    write_atomically(path, cog_bytes(layers, names=names, units=units, crs_wkt=crs_wkt, affine=affine))


def cog_bytes(
    layers: Sequence[NDArray[np.generic]],
    *,
    names: Sequence[str],
    units: Sequence[str],
    crs_wkt: str | None = None,
    affine: AffineCoefficients | None = None,
) -> bytes:
    """Layers of one type and shape (y, x) as the bands of a cloud-optimised GeoTIFF.

    Parameters
    ----------
    names, units
        Name and unit of each band, as GIS shows them.
    crs_wkt, affine
        Reference system, and (column, row) of pixel corners to its coordinates; none: pixels.
    """
    stack = np.stack([np.asarray(layer) for layer in layers])
    nodata = np.nan if stack.dtype.kind == "f" else None
    profile = {
        "driver": "GTiff",
        "count": len(stack),
        "height": stack.shape[1],
        "width": stack.shape[2],
        "dtype": stack.dtype.name,
        "nodata": nodata,
    }
    if crs_wkt is not None and affine is not None:
        profile |= {"crs": crs_wkt, "transform": Affine(*affine)}
    with ignore_missing_georeference(), MemoryFile() as plain, MemoryFile() as optimised:
        # A run without a base image has no georeference; its layers are exported all the same.
        with plain.open(**profile) as dataset:
            dataset.write(stack)
            for band, (name, unit) in enumerate(zip(names, units, strict=True), start=1):
                dataset.set_band_description(band, name)
                dataset.set_band_unit(band, unit)
        with plain.open() as dataset:
            copy(dataset, optimised.name, driver="COG", compress="DEFLATE", overview_resampling="nearest")
        return bytes(optimised.read())
