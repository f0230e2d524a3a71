"""``view/run.json``: what the viewer page must know before it reads the field's tiles."""

from typing import Any, Literal

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from schemas.model import Model

LayerKind = Literal["direction", "speed", "count", "angle", "fraction", "time", "plain", "change"]
"""How a layer is coloured, and in what unit it is shown."""


class ViewLayer(Model):
    """A layer that can be laid over the base image."""

    name: str
    title: str
    description: str
    """What the numbers mean, in a few short sentences."""
    kind: LayerKind
    arrays: tuple[str, ...] = Field(min_length=1, max_length=2)
    """Arrays of ``field.zarr``: one, or the x and y components of a velocity."""
    units: str
    """Units of the stored values."""
    colour_max: float
    """Value of the last colour, in stored units; of a change, on either side of zero."""
    data_max: float
    """Largest magnitude in the data: values above ``colour_max`` get the last colour, and the legend notes it."""
    main: bool = False
    """Whether it stands among the first in the list."""


class ViewArray(Model):
    """An array of a store: where its chunks are, so that none is asked for that is not there."""

    store: str
    """Path of the store in the run folder."""
    chunk: tuple[PositiveInt, PositiveInt]
    """(height, width) of a chunk, px."""
    stored: tuple[NonNegativeInt, ...]
    """Row, column, row, column ... of the chunks that are stored."""
    units: str = "1"
    metadata: dict[str, Any]
    """The array's own ``zarr.json``: the page asks for no other file before it reads a chunk."""


class ViewBase(Model):
    """The base image as JPEG tiles: ``base/<level>/<row>-<column>.jpg``, level k reduced 2^k times."""

    levels: PositiveInt
    tile: PositiveInt
    overlap: NonNegativeInt = 0
    """Pixels that a tile holds of its right and lower neighbours: without them a seam shows at fractional zooms."""


class ViewSegments(Model):
    """``view/segments.zarr``: vehicles from one frame to the next, sorted by track and time."""

    count: NonNegativeInt
    tracks: NonNegativeInt
    hysteresis_px: PositiveFloat
    """A vehicle that comes back over a line before it is this far from it has not crossed it."""
    band_radius_px: PositiveFloat
    """A vehicle within this distance of a pixel has passed it: half the width of the path that the field counts."""


class ViewReplay(Model):
    """``view/replay/<k>.bin``: positions of the vehicles, ``chunk_s`` seconds each (`velfield.viewer.replay`)."""

    chunk_s: PositiveFloat
    chunks: PositiveInt
    step_px: PositiveFloat
    """Unit of a stored position."""
    states: tuple[str, ...]
    """Names of the vehicles' states, by their number."""
    classes: tuple[str, ...] = ()
    """Names of the vehicles' classes, by their number less one."""


class ViewFlow(Model):
    """``view/flow.bin``: velocities drawn from the field, cell by cell (`velfield.viewer.flow`)."""

    cell_px: PositiveInt
    draws: PositiveInt


class ViewRecord(Model):
    """``view/run.json``."""

    width_px: PositiveInt
    height_px: PositiveInt
    gsd_m: PositiveFloat | None
    north_rad: float | None
    """Direction of north in the base image, from +x towards +y (down)."""
    stationary_speed_px_per_s: PositiveFloat
    first_time_s: float
    last_time_s: float
    bin_width_px_per_s: PositiveFloat
    bins: PositiveInt
    """Bins of either velocity axis."""
    base: ViewBase
    layers: tuple[ViewLayer, ...]
    arrays: dict[str, ViewArray]
    segments: ViewSegments
    replay: ViewReplay
    flow: ViewFlow
    vehicles_for_percentile: dict[int, PositiveInt]
    """Smallest number of vehicles of which the page shows a percentile of speed, by percentage: 15, 50, 85."""
    low_coverage_note: str = ""
    """A note for people where hardly any pixel was passed by several vehicles."""
