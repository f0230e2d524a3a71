"""The base image of a run folder."""

from schemas.arrays import GreyImage
from schemas.flight import FramesConfig
from velfield.run.layout import RunLayout
from velfield.run.paths import local_copy


def read_base_image(layout: RunLayout, config: FramesConfig) -> GreyImage:
    """The base image, (y, x) grey uint8: the GeoTIFF where the run has one, else the PNG."""
    from velfield.sources.images import read_grey_image  # opening a run loads no rasterio

    path = layout.base_image_tif if layout.base_image_tif.exists() else layout.base_image
    with local_copy(path) as local:
        return read_grey_image(local, config.max_pixels)
