"""``view/run.json``: what the viewer page must know before it reads the field's tiles."""

from typing import Any, Literal

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from schemas.model import Model

LayerKind = Literal["direction", "speed", "count", "angle", "share", "time", "plain", "change"]
"""How a layer is coloured and in what unit it is said."""


class ViewLayer(Model):
    """A layer that can be laid over the base image."""

    name: str
    title: str
    about: str
    """One sentence: what the numbers mean."""
    kind: LayerKind
    arrays: tuple[str, ...] = Field(min_length=1, max_length=2)
    """Arrays of ``field.zarr``: one, or the x and y components of a velocity."""
    units: str
    """Of what is stored."""
    top: float
    """Where the colours end, in stored units; of a change, on either side of zero."""
    highest: float
    """The greatest size of a value: what is above the top gets the last colour, and the legend says so."""
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


class ViewSegments(Model):
    """``view/segments.zarr``: vehicles from one frame to the next, sorted by passage and time."""

    count: NonNegativeInt
    passages: NonNegativeInt
    settle_px: PositiveFloat
    """Who crosses a line and comes back without going farther than this, has not crossed it."""
    reach_px: PositiveFloat
    """Who comes within this of a pixel has passed it: the half width of the band that the field counts."""


class ViewRecord(Model):
    """``view/run.json``."""

    width_px: PositiveInt
    height_px: PositiveInt
    gsd_m: PositiveFloat | None
    north_rad: float | None
    """Where north is in the picture, from +x towards +y (down)."""
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
    few: str = ""
    """What is to be said where hardly any pixel was passed by several vehicles."""
