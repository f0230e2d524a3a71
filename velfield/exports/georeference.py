"""Base pixels to ground coordinates: the base image's reference system, longitude and latitude, metres, headings."""

from dataclasses import dataclass

import numpy as np
from rasterio.crs import CRS
from rasterio.warp import transform

from schemas.arrays import FloatArray, Points
from schemas.records import GridRecord
from velfield.errors import InputError
from velfield.field.segments import require_gsd_m
from velfield.run.frame_transforms import heading_deg

MPS_TO_KMH = 3.6


@dataclass(frozen=True)
class Georeference:
    """Reference system and scale of the base image."""

    shape: tuple[int, int]
    """(h, w) of the base image."""
    crs_wkt: str | None = None
    affine: tuple[float, float, float, float, float, float] | None = None
    """Reference system, and (column, row) of pixel corners to its coordinates; None without one."""
    gsd_m: float | None = None
    """Metres a base pixel; None if unknown."""
    north_rad: float | None = None
    """Direction of true north, from +x towards +y (down), where it is known without a reference system, as by a drone's
    compass; else None."""

    @classmethod
    def from_grid(cls, grid: GridRecord) -> "Georeference":
        """Georeference of a run's base image."""
        return cls((grid.height_px, grid.width_px), grid.crs_wkt, grid.affine, grid.gsd_m, grid.north_rad)

    @property
    def has_crs(self) -> bool:
        """Whether base pixels have coordinates on earth."""
        return self.crs_wkt is not None and self.affine is not None

    def to_crs(self, xy_px: Points) -> Points:
        """(n, 2) base pixels to (n, 2) coordinates of the reference system.

        Raises
        ------
        InputError
            There is none.
        """
        if self.crs_wkt is None or self.affine is None:
            raise InputError(
                "the base image is not georeferenced, and this format needs coordinates; "
                "run `velfield georeference RUN`, or run with --base GEOTIFF, or export a format in pixels"
            )
        a, b, c, d, e, f = self.affine
        column, row = xy_px[:, 0] + 0.5, xy_px[:, 1] + 0.5  # our origin is a pixel's centre, theirs its corner
        return np.column_stack([a * column + b * row + c, d * column + e * row + f])

    def to_lonlat(self, xy_px: Points) -> Points:
        """(n, 2) base pixels to (n, 2) longitude and latitude on WGS 84, degrees."""
        xy = self.to_crs(xy_px)
        longitude, latitude = transform(CRS.from_wkt(self.crs_wkt), CRS.from_epsg(4326), xy[:, 0], xy[:, 1])
        return np.column_stack([longitude, latitude]).astype(np.float64)

    def to_metres(self, xy_px: Points) -> Points:
        """(n, 2) base pixels to (n, 2) metres to the right of the base image's lower left corner, and up from it.

        Raises
        ------
        InputError
            The ground sample distance is unknown.
        """
        gsd_m = require_gsd_m(self.gsd_m)
        return np.column_stack([xy_px[:, 0] + 0.5, self.shape[0] - 0.5 - xy_px[:, 1]]) * gsd_m

    @property
    def heading_from(self) -> str:
        """Where headings begin: ``north``, or ``top of the image`` where north is not known."""
        return "north" if self.has_crs or self.north_rad is not None else "top of the image"

    def heading_deg(self, xy_px: Points, velocity_px_per_s: Points) -> FloatArray:
        """Direction of travel, degrees clockwise from `heading_from`.

        Examples
        --------
        >>> up_right_down = np.array([[0.0, -1.0], [1.0, 0.0], [0.0, 1.0]])
        >>> Georeference((10, 10)).heading_deg(np.zeros((3, 2)), up_right_down).tolist()
        [0.0, 90.0, 180.0]
        """
        if not self.has_crs:
            return heading_deg(np.arctan2(velocity_px_per_s[:, 1], velocity_px_per_s[:, 0]), self.north_rad)
        speed = np.linalg.norm(velocity_px_per_s, axis=1, keepdims=True)
        step = np.divide(velocity_px_per_s, speed, out=np.zeros_like(velocity_px_per_s), where=speed > 0)
        here, there = self.to_lonlat(xy_px), self.to_lonlat(xy_px + step)
        east = (there[:, 0] - here[:, 0]) * np.cos(np.radians(here[:, 1]))
        return np.degrees(np.arctan2(east, there[:, 1] - here[:, 1])) % 360
