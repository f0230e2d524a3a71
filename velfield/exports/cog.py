"""Cloud-optimised GeoTIFF: layers of the field for any GIS, with names, units, NaN and the reference system."""

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rasterio.errors import NotGeoreferencedWarning
from rasterio.io import MemoryFile
from rasterio.shutil import copy
from rasterio.transform import Affine

from velfield.run.commits import write_atomically

Georeference = tuple[float, float, float, float, float, float]


def write_cog(
    path: Path,
    layers: Sequence[NDArray[np.generic]],
    *,
    names: Sequence[str],
    units: Sequence[str],
    crs_wkt: str | None = None,
    affine: Georeference | None = None,
) -> None:
    """Write layers of one type and shape (y, x) as bands of a cloud-optimised GeoTIFF.

    Parameters
    ----------
    names, units
        Of each band, as GIS shows them.
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
    with warnings.catch_warnings(), MemoryFile() as plain, MemoryFile() as optimised:
        # A run without a base image has no place on earth, and its layers are still wanted.
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with plain.open(**profile) as dataset:
            dataset.write(stack)
            for band, (name, unit) in enumerate(zip(names, units, strict=True), start=1):
                dataset.set_band_description(band, name)
                dataset.set_band_unit(band, unit)
        with plain.open() as dataset:
            copy(dataset, optimised.name, driver="COG", compress="DEFLATE", overview_resampling="nearest")
        write_atomically(path, bytes(optimised.read()))
