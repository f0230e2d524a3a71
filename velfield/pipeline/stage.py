"""The stages of a run: the one table that everything else derives from.

Their order, what each one reads (and so its content key), how it is cut into units of work, its functions, and the line
that it prints when it is done. The plan, the Dask graphs, the Prefect flow, the benchmarks, ``velfield verify`` and the
estimate ask this table; a new stage is an entry here and a module in ``velfield/pipeline/stages``.

Functions are named, ``module:function``, and resolved where a unit is computed, so that neither the command line nor
the plan imports anything heavy.
"""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from operator import attrgetter
from pkgutil import resolve_name
from typing import Any

from pydantic import BaseModel

from schemas.flight import FlightConfig
from schemas.records import InputsRecord, SourceRecord
from velfield.run.commits import content_key

_STAGES = "velfield.pipeline.stages"
Counts = Mapping[str, float]


class Cut(Enum):
    """How a stage is cut into units; a unit has a commit record, and is retried or lost as a whole."""

    WHOLE = "one unit"
    BY_FRAMES = "a unit a range of frames"
    BY_TILES = "a unit a group of tiles of the map"


class NewBase(Enum):
    """Treatment of a stage when a finished run is mapped onto a new base image (`velfield reprocess`)."""

    SHARED = "its outputs are shared with the run before, apart from those in base/"
    COUNTS = "only its counts are kept, in its commit records"
    MAPPED = "its outputs are mapped, by the function `Stage.remap`"
    COMPUTED = "it is computed as in any run"


@dataclass(frozen=True)
class Line:
    """A stage's line in the terminal, filled with its counts, and when it applies."""

    text: str
    when: Callable[[Counts], bool] = lambda counts: True


@dataclass(frozen=True)
class Stage:
    """One stage."""

    name: str
    """Of its commit records, and wherever a program reads it."""
    version: int
    """To be raised when its results change."""
    label: str
    """For people."""
    lines: tuple[Line, ...]
    """Of its summary; the first that applies is printed."""
    unit: str
    """Function ``(plan, *part, *blocks) -> StageResult``; ``part`` is the unit's frames or group of tiles, none where
    the stage is whole; ``blocks`` are the results of the stage's blocks, where it has any."""
    block: str | None = None
    """Function ``(plan, frames) -> Any`` of a few frames: the costly part of a unit, and the parallel one."""
    tiles: str | None = None
    """Function ``(plan) -> groups`` of a stage that is cut by tiles."""
    prepare: str | None = None
    """Function ``(plan) -> None`` that creates the stage's store before its units fill it."""
    store: str | None = None
    """The store's path in the run folder."""
    after: tuple[str, ...] = ()
    """Stages that it reads."""
    inputs: tuple[str, ...] = ()
    """Of the inputs (`schemas.records.InputsRecord`), those that it reads."""
    config: tuple[str, ...] = ()
    """Of the configuration (`schemas.flight.FlightConfig`), the sections and keys that it reads."""
    unread: tuple[str, ...] = ()
    """Keys of those sections that it does not read."""
    cut: Cut = Cut.WHOLE
    """How it is cut; a unit of frames is lost with the same unit of a stage that it reads."""
    new_workers: bool = False
    """In a long flight its workers start without what earlier stages left in theirs: its memory grows with the flight,
    whose tables it reads as a whole, or is the most that any takes."""
    new_base: NewBase = NewBase.COMPUTED
    remap: str | None = None
    """What `velfield reprocess` makes of it; ``remap`` is ``(plan, *part, rebase) -> StageResult``."""
    from_tracks: str | None = None
    """Function ``(plan) -> StageResult`` in place of ``unit``, where tracks are given and no frames: it writes what the
    stages before would have."""

    @property
    def essential(self) -> bool:
        """Whether nothing can follow without it: of a stage that is cut by frames units may fail."""
        return self.cut is not Cut.BY_FRAMES

    def settings(self, config: FlightConfig) -> dict[str, object]:
        """The settings that it reads, by their dotted names."""
        found: dict[str, object] = {}
        for name in self.config:
            value = attrgetter(name)(config)
            if isinstance(value, BaseModel):
                found |= {f"{name}.{key}": one for key, one in value.model_dump(mode="json").items()}
            else:
                found[name] = value
        return {name: value for name, value in found.items() if name not in self.unread}


_OF_TRACKS = ("tracking.max_gap_s", "tracking.max_stationary_gap_s", "tracking.max_hidden_gap_s", "tracking.doubt")
STAGES: tuple[Stage, ...] = (
    # Decode, measure and write each frame.
    Stage(
        name="frames",
        version=5,
        label="frames",
        lines=(Line("{usable:.0f} of {frames:frame} read"),),
        prepare=f"{_STAGES}.frames:create_frame_store",
        unit=f"{_STAGES}.frames:read_unit",
        store="frames.zarr",
        inputs=("source", "timestamps"),
        config=("frames", "work.unit_frames"),
        cut=Cut.BY_FRAMES,
        new_base=NewBase.SHARED,
    ),
    # Flag blurred frames and outliers by their neighbours.
    Stage(
        name="quality",
        version=3,
        label="frame quality",
        lines=(
            Line("every frame is usable", lambda counts: not counts.get("flagged")),
            Line(
                "{usable:frame} usable, {flagged:.0f} flagged: {blurred:.0f} blurred, {outliers:.0f} unlike their "
                "neighbours",
            ),
        ),
        unit=f"{_STAGES}.frames:flag_frames",
        after=("frames",),
        new_base=NewBase.SHARED,
    ),
    # Calibrate from edge points and control points of frames spread over the flight.
    Stage(
        name="lens",
        version=12,
        label="lens",
        lines=(
            Line("no distortion was established; pinhole model used", lambda counts: not counts.get("corner_px")),
            Line(
                "distortion of {corner_px:.1f} px at the corners, straight lines to {residual_px:.2f} px",
                lambda counts: "residual_px" in counts,
            ),
            Line("distortion of {corner_px:.1f} px at the corners"),
        ),
        unit=f"{_STAGES}.lens:calibrate_flight",
        after=("frames", "quality"),
        config=("lens",),
        new_base=NewBase.SHARED,
    ),
    # Spread frames registered to the sharpest, and their median; or the registration of a given image.
    Stage(
        name="base",
        version=21,
        label="base image",
        lines=(
            Line(
                "base image {width:.0f} x {height:.0f} px as given, hold-out registration error "
                "{intersensor_error_px:.2f} px",
                lambda counts: "intersensor_error_px" in counts,
            ),
            Line("base image {width:.0f} x {height:.0f} px from {frames:frame}"),
        ),
        unit=f"{_STAGES}.base_image:build_base",
        after=("frames", "lens"),
        inputs=("base", "detections"),
        config=("base", "registration"),
        new_base=NewBase.MAPPED,
        remap=f"{_STAGES}.rebase:rebase_image",
    ),
    # The chain over the unit's frames.
    Stage(
        name="registration",
        version=20,
        label="registration",
        lines=(Line("{registered:.0f} of {frames:frame} registered, hold-out registration error {heldout_px:.2f} px"),),
        prepare=f"{_STAGES}.registration:create_registration_store",
        unit=f"{_STAGES}.registration:register_unit",
        store="registration.zarr",
        after=("frames", "base"),
        inputs=("detections",),
        # The unit's size decides where chains start from the base image again, so per-frame results depend on it.
        config=("registration", "work.unit_frames"),
        cut=Cut.BY_FRAMES,
        new_base=NewBase.SHARED,
    ),
    # Scale, north and place of the base image: by its own reference system, --gsd-m, control points and telemetry.
    Stage(
        name="georeference",
        version=4,
        label="georeference",
        lines=(
            Line("{gsd_m:.4g} m a pixel by control points", lambda counts: bool(counts.get("by_control_points"))),
            Line("{gsd_m:.4g} m a pixel by the base image", lambda counts: bool(counts.get("by_base"))),
            Line("{gsd_m:.4g} m a pixel as given", lambda counts: bool(counts.get("by_given"))),
            Line("{gsd_m:.4g} m a pixel by the drone's metadata", lambda counts: bool(counts.get("by_metadata"))),
            Line("{gsd_m:.2g} m a pixel by the size of cars", lambda counts: bool(counts.get("by_vehicles"))),
            Line("the scale is not known yet: it will be estimated by the lengths of vehicles"),
        ),
        unit=f"{_STAGES}.georeference:georeference_run",
        after=("frames", "base", "registration"),
        inputs=("telemetry",),
        config=("gsd_m",),
        new_base=NewBase.MAPPED,
        remap=f"{_STAGES}.rebase:rebase_georeference",
    ),
    # The shipped detector, one that is fine-tuned on labelled frames, or a given one.
    Stage(
        name="detector",
        version=31,
        label="detector",
        lines=(
            Line("skipped: external detections", lambda counts: bool(counts) and "threshold" not in counts),
            Line("used as it is", lambda counts: counts.get("labels") == 0),
            Line("trained on {labels:labelled car}"),
        ),
        unit=f"{_STAGES}.detector:make_detector",
        after=("registration", "georeference"),
        inputs=("labels", "detector", "detections"),
        config=("detection", "tracking.max_interval_s"),
        unread=("detection.full_frame_every",),
        new_base=NewBase.SHARED,
    ),
    # Cars of each block, then one table with their crops.
    Stage(
        name="detections",
        version=24,
        label="detections",
        lines=(
            Line(
                "{cars:detection} of vehicles in {frames:frame}; {searched:.0%} of their area was searched",
                lambda counts: "searched" in counts,
            ),
            Line("{cars:detection} of vehicles in {frames:frame}"),
        ),
        block=f"{_STAGES}.detections:detect_block",
        unit=f"{_STAGES}.detections:write_detections",
        after=("registration", "detector"),
        config=("detection",),
        cut=Cut.BY_FRAMES,
        new_workers=True,
        new_base=NewBase.MAPPED,
        remap=f"{_STAGES}.rebase:rebase_detections",
    ),
    # Windows of three frames that start in the unit; they reach 2 * max_interval_s behind it.
    Stage(
        name="tracklets",
        version=6,
        label="tracklets",
        lines=(Line("{tracklets:tracklet} over three frames"),),
        unit=f"{_STAGES}.tracklets:link_unit",
        after=("detections",),
        config=("tracking",),
        unread=_OF_TRACKS,
        cut=Cut.BY_FRAMES,
        new_base=NewBase.COUNTS,
    ),
    # Tracklets of all units that belong to one vehicle.
    Stage(
        name="tracks",
        version=19,
        label="tracks",
        lines=(
            Line(
                "{tracks:track}; set aside as no vehicles: {doubtful:doubtful track}, {lone:detection} in no track",
                lambda counts: "lone" in counts and bool(counts["doubtful"] + counts["lone"]),
            ),
            Line("{tracks:track}"),
        ),
        unit=f"{_STAGES}.tracks:chain_tracks",
        after=("tracklets",),
        config=_OF_TRACKS,
        new_workers=True,
        new_base=NewBase.MAPPED,
        remap=f"{_STAGES}.rebase:rebase_tracks",
        from_tracks="velfield.pipeline.given_tracks.write:write_given_tracks",
    ),
    # Scale, north and place again, with the lengths of the vehicles.
    Stage(
        name="scale",
        version=3,
        label="scale",
        lines=(
            Line(
                "{gsd_m:.3g} m a pixel by the lengths of {vehicles:vehicle}",
                lambda counts: "by_vehicles" in counts,
            ),
            Line(
                "{gsd_m:.4g} m a pixel; by the lengths of {vehicles:vehicle} {vehicle_gsd_m:.3g}",
                lambda counts: "gsd_m" in counts and "vehicle_gsd_m" in counts,
            ),
            Line("{gsd_m:.4g} m a pixel; too few vehicles to check it", lambda counts: "gsd_m" in counts),
            Line("{vehicles:vehicle}: too few to know the scale: speeds in px/s; give --gsd-m"),
        ),
        unit=f"{_STAGES}.scale:scale_run",
        after=("georeference", "tracks"),
        inputs=("telemetry",),
        config=("gsd_m",),
        new_base=NewBase.MAPPED,
        remap=f"{_STAGES}.rebase:rebase_scale",
    ),
    # The velocity histogram of a block of tiles, from the segments that reach it.
    Stage(
        name="field",
        version=4,
        label="field",
        lines=(Line("{pixels:pixel} passed by vehicles, {pixels_5:.0f} of them by 5 or more"),),
        prepare=f"{_STAGES}.field:create_field_stores",
        tiles=f"{_STAGES}.field:field_blocks",
        unit=f"{_STAGES}.field:accumulate_block",
        store="field.zarr",
        after=("tracks", "scale"),
        config=("field",),
        cut=Cut.BY_TILES,
    ),
    # Figures, layers for GIS, the data of the viewer.
    Stage(
        name="maps",
        version=6,
        label="maps",
        lines=(
            Line(
                "{maps:map}; tracks that move: {moving:.0f}, that wait in a lane: {stopped:.0f}, that stand throughout "
                "(vehicles by their looks alone): {parked:.0f}"
            ),
        ),
        unit=f"{_STAGES}.maps:make_maps",
        after=("field",),
        new_workers=True,
    ),
)
"""The stages in the order of the work."""

STAGE: Mapping[str, Stage] = {stage.name: stage for stage in STAGES}
"""The stages by name."""


def stages_before(name: str) -> list[str]:
    """Names of the stages before one, in the order of the work.

    Examples
    --------
    >>> stages_before("base")
    ['frames', 'quality', 'lens']
    """
    names = list(STAGE)
    return names[: names.index(name)]


FIELD_STAGES = tuple(name for name in STAGE if name not in stages_before("tracklets"))
"""Stages that a preview computes from the finished units: from tracklets to maps."""


def resolve(function: str) -> Callable[..., Any]:
    """The function that the table names."""
    found: Callable[..., Any] = resolve_name(function)
    return found


def load_stages() -> None:
    """Import what the stages need: a second of a worker's time, which has nothing to do while a run is planned."""
    for stage in STAGES:
        for path in (stage.unit, stage.block):
            if path is not None:
                resolve(path)


def load_kernels() -> int:
    """Load all that numba's cache has of the kernels of the modules that are imported; returns their number.

    A kernel is loaded when it is called first, in a hundredth of a second; threads that need it wait for each other.
    """
    from numba.core.caching import FunctionCache
    from numba.core.dispatcher import Dispatcher

    modules = [module for name, module in list(sys.modules.items()) if name.split(".")[0] == "velfield"]
    values = [one for module in modules for one in list(vars(module).values())]  # others may be importing
    kernels: dict[int, Any] = {id(one): one for one in values if isinstance(one, Dispatcher)}
    count = 0
    for kernel in kernels.values():
        cache: Any = getattr(kernel, "_cache", None)  # numba has no public way to ask what it holds
        if isinstance(cache, FunctionCache):
            processor = kernel.targetctx.codegen().magic_tuple()
            for signature, compiled_for, _ in cache._cache_file._load_index():
                if compiled_for == processor:  # what is of another one would be compiled again
                    kernel.compile(signature)
                    count += 1
    return count


def stage_keys(config: FlightConfig, inputs: InputsRecord) -> dict[str, str]:
    """Each stage's content key: of the stages, the inputs and the settings that it reads, and of its version."""
    keys: dict[str, str] = {}
    for stage in STAGES:
        read = (getattr(inputs, name) for name in stage.inputs)
        digests = [one.digest if isinstance(one, SourceRecord) else one for one in read]
        keys[stage.name] = content_key(
            stage.name,
            stage.version,
            parameters=[stage.settings(config)],
            inputs=[*(keys[name] for name in stage.after), *digests],
        )
    return keys
