"""``base/georeference.json``: scale, north and place of the base image, where each is from, and how sure."""

from datetime import UTC, datetime
from typing import Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveInt

from schemas.model import Model
from schemas.scale import ScaleChoice

Affine = tuple[float, float, float, float, float, float]
PlaceSource = Literal["control_points", "base", "metadata"]


class ControlPoint(Model):
    """A ground control point: a pixel of the base image and its coordinates."""

    x_px: float
    y_px: float
    x: float
    """Longitude in degrees or the first coordinate of the reference system."""
    y: float
    """Latitude in degrees or the second coordinate of the reference system."""
    name: str = ""


class PointResidual(Model):
    """How far a control point is from where the fit puts it, m."""

    residual_m: NonNegativeFloat
    left_out_m: NonNegativeFloat | None = None
    """The same with the point left out of the fit; None where too few are left."""


class ControlPointsRecord(Model):
    """``base/control_points.json``: ground control points, and the fit of the map to them."""

    points: tuple[ControlPoint, ...]
    epsg: PositiveInt
    """EPSG code of the points' coordinates as they were given; 4326: longitude and latitude."""
    model: Literal["similarity", "affine"]
    crs_wkt: str
    """Reference system of the map."""
    affine: Affine
    """Base pixel (column, row) -> its coordinates, corner convention."""
    gsd_m: float
    gsd_sd_m: NonNegativeFloat
    north_sd_deg: NonNegativeFloat
    residuals: tuple[PointResidual, ...]
    rms_m: NonNegativeFloat
    left_out_rms_m: NonNegativeFloat | None = None
    base_digest: str
    """Digest of the base image that the pixels belong to."""
    degrees_of_freedom: NonNegativeInt = 0

    def text(self) -> str:
        """The fit in one line."""
        left_out = "" if self.left_out_rms_m is None else f", {self.left_out_rms_m:.2f} m at points left out"
        return f"{len(self.points)} control points, {self.model}: residual {self.rms_m:.2f} m{left_out}"


class MarkedPoint(Model):
    """A control point on the georeferencing page, its coordinates as they were typed."""

    x_px: float = Field(allow_inf_nan=False)
    y_px: float = Field(allow_inf_nan=False)
    coordinates: str = Field(max_length=200)


class MarkedPoints(Model):
    """Control points that the georeferencing page sends."""

    points: tuple[MarkedPoint, ...] = Field(max_length=10_000)
    order: Literal["longitude_latitude", "latitude_longitude", "x_y"]
    epsg: int | None = Field(None, gt=0, lt=2**31)
    """EPSG code of x, y; not read with longitude and latitude."""


class MarkedPlace(Model):
    """A place that was clicked on the user's own map; coordinates are asked for as the page's points have them."""

    longitude: float = Field(ge=-180, le=180)
    latitude: float = Field(ge=-90, le=90)
    order: Literal["longitude_latitude", "latitude_longitude", "x_y"]
    epsg: int | None = Field(None, gt=0, lt=2**31)


class FlightStart(Model):
    """When the first frame was taken, by a clock that the camera wrote."""

    clock_s: float
    """s since 1970, as if the clock were set to UTC."""
    source: str
    """Where it was read, for people."""
    is_utc: bool
    """Whether the clock is UTC by its format; a camera's own clock mostly shows local time."""

    @property
    def time(self) -> datetime:
        """The clock as if it were set to UTC."""
        return datetime.fromtimestamp(self.clock_s, UTC)

    def text(self) -> str:
        """Date, time and whose clock it is by."""
        return f"{self.time:%Y-%m-%d %H:%M} {'UTC' if self.is_utc else 'by the camera clock'}"


class GeoreferenceRecord(Model):
    """Scale, north and place of the map, as far as they are known."""

    scale: ScaleChoice = ScaleChoice()
    telemetry: str = ""
    """Where the camera's telemetry was read, or why there is none."""
    start: FlightStart | None = None
    north_rad: float | None = None
    """Direction of true north in the base image, from +x towards +y (down)."""
    north_sd_deg: NonNegativeFloat | None = None
    place_source: PlaceSource | None = None
    position_sd_m: NonNegativeFloat | None = None
    crs_wkt: str | None = None
    affine: Affine | None = None
    """Base pixel (column, row) -> CRS coordinates, GDAL's corner convention, as rasterio's ``Affine``."""
    remarks: tuple[str, ...] = ()
    """Contradictions between the sources, one line each."""
