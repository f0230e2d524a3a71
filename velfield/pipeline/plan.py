"""What a run will do: its frames, its units, and the content key of every stage, known before any work is done."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from schemas.flight import FlightConfig
from schemas.job import Job
from schemas.records import FlightRecord, InputsRecord, SourceRecord
from velfield.errors import InputError
from velfield.field.time_intervals import TimeInterval, parse_time_intervals
from velfield.pipeline.version import STAGE_VERSIONS, code_version
from velfield.run.commits import content_key, digest_path, write_atomically
from velfield.run.layout import STAGES, RunLayout
from velfield.sources.source import SourceInfo, check_source, probe, select_frames

_MANY_GAPS = 0.3
"""Share of frames without a near one before them from which it is said."""
_LATE = 1.5
"""A frame may come late by half an interval."""
_BESIDES = ("base", "labels", "detector", "detections", "timestamps")
"""What may be given besides the source."""
_UNITS = ((256, 16), (4096, 64))
"""Up to so many frames, so many a unit: a short flight is cut finely enough for several workers ..."""
_LARGEST_UNIT = 256
"""... and a flight of hours stays below 3,000 task runs."""


@dataclass(frozen=True)
class Plan:
    """A run, resolved: picklable, small, and all that a worker is told besides a unit's number."""

    job: Job
    info: SourceInfo = field(repr=False)
    indices: NDArray[np.int64] = field(repr=False)
    """Source indices of the frames worked on, (frames,)."""
    inputs: InputsRecord
    keys: dict[str, str]
    """Content key of each stage."""

    @property
    def layout(self) -> RunLayout:
        return RunLayout(Path(self.job.root))

    @property
    def config(self) -> FlightConfig:
        return self.job.config

    @property
    def frame_count(self) -> int:
        return len(self.indices)

    @property
    def unit_frames(self) -> int:
        """Frames a unit: depends on the flight alone, never on the number of workers."""
        asked = self.config.work.unit_frames
        if asked != "auto":
            return asked
        return next((unit for frames, unit in _UNITS if self.frame_count <= frames), _LARGEST_UNIT)

    @property
    def units(self) -> list[range]:
        """Frames of each unit."""
        n, step = self.frame_count, self.unit_frames
        return [range(start, min(start + step, n)) for start in range(0, n, step)]

    @property
    def time_intervals(self) -> list[TimeInterval]:
        """Time intervals to accumulate a field for each, in their order; empty where none were asked for.

        Raises
        ------
        InputError
            The text that asks for them is not understood, or they overlap.
        """
        text, times_s = self.config.field.time_intervals, self.info.times_s[self.indices]
        return [] if text is None else parse_time_intervals(text, float(times_s[0]), float(times_s[-1]))

    def despite(self, lost: Sequence[str]) -> "Plan":
        """The plan for what comes after units were lost: under keys of its own.

        The next run does the lost units, and by its other keys does again what was made without them.
        """
        if not lost:
            return self
        keys = {stage: content_key(stage, 0, inputs=[key, *sorted(lost)]) for stage, key in self.keys.items()}
        return replace(self, keys=keys)

    def blocks(self, frames: range) -> list[range]:
        """A unit's frames cut into Dask blocks."""
        step = self.config.work.block_frames
        return [range(start, min(start + step, frames.stop)) for start in range(frames.start, frames.stop, step)]


def check_inputs(job: Job) -> None:
    """See at a glance that all that was given is there, before anything that takes long is started.

    Raises
    ------
    InputError
        The source cannot be opened, or another file that was given is not there.
    """
    check_source(job.inputs.source)
    _check_besides(job)


def _check_besides(job: Job) -> None:
    for name in _BESIDES:
        path = getattr(job.inputs, name)
        if path is not None and not Path(path).exists():
            raise InputError(f"--{name}: {path} is not there; give a path that exists")


def make_plan(job: Job) -> Plan:
    """Look at the inputs and resolve the run.

    Raises
    ------
    InputError
        The source cannot be read, has no times, or fewer than three frames are left to work on.
    """
    _check_besides(job)  # `probe` sees whether the source is there
    timestamps = Path(job.inputs.timestamps) if job.inputs.timestamps else None
    info = probe(Path(job.inputs.source), frames=job.config.frames, timestamps=timestamps)
    indices = select_frames(info.times_s, job.config.frames)
    if len(indices) < 3:
        raise InputError(
            f"{job.inputs.source}: {len(indices)} frames to work on, 3 or more needed for a tracklet; "
            "widen --start-s/--stop-s or lower --every"
        )
    info = replace(info, warnings=(*info.warnings, *_gaps(info.times_s[indices], job.config.tracking.max_interval_s)))
    inputs = _digest_inputs(job, info)
    plan = Plan(job=job.anywhere(), info=info, indices=indices, inputs=inputs, keys=stage_keys(job.config, inputs))
    _ = plan.time_intervals  # what cannot be is told now, not where the field is built
    return plan


def _gaps(times_s: NDArray[np.float64], max_interval_s: float) -> list[str]:
    gaps = np.diff(times_s)
    wide = gaps > max_interval_s
    if wide.mean() < _MANY_GAPS:
        return []
    return [
        f"{wide.mean():.0%} of the frames come more than {max_interval_s:g} s after the one before (median "
        f"{np.median(gaps):.2f} s), over which no car is followed: few tracklets or none; {widen_interval(gaps)}"
    ]


def widen_interval(gaps_s: NDArray[np.float64]) -> str:
    """What to do where the frames (gaps between them, s) come too far apart to follow a car."""
    enough = np.ceil(20 * _LATE * float(np.median(gaps_s))) / 20
    return (
        f"take frames closer together, or --set tracking.max_interval_s={enough:g} where traffic is thin (the farther "
        "apart, the more often one car is taken for another)"
    )


def _digest_inputs(job: Job, info: SourceInfo) -> InputsRecord:
    digests: dict[str, str | None] = {}
    for name in _BESIDES:
        path = getattr(job.inputs, name)
        digests[name] = digest_path(Path(path)) if path else None
    source = SourceRecord(
        path=job.inputs.source,
        kind=info.kind,
        digest=digest_path(Path(job.inputs.source)),
        width=info.width,
        height=info.height,
        frame_count=info.frame_count,
    )
    return InputsRecord(source=source, **digests)


def stage_keys(config: FlightConfig, inputs: InputsRecord) -> dict[str, str]:
    """Each stage's key holds the keys of the stages that it reads, and the parameters that it reads, no others."""
    keys: dict[str, str] = {}

    def key(stage: str, parameters: list[object], upstream: list[str], given: list[str | None] | None = None) -> None:
        keys[stage] = content_key(
            stage,
            STAGE_VERSIONS[stage],
            parameters=parameters,
            inputs=[*(keys[name] for name in upstream), *(given or [])],
        )

    # The unit's size decides where chains are seeded anew, so per-frame results belong to it.
    units = [config.work.unit_frames, config.work.block_frames]
    key("frames", [config.frames], [], [inputs.source.digest, inputs.timestamps])
    key("lens", [config.lens], ["frames"])
    key("base", [config.base, config.registration, config.gsd_m], ["lens"], [inputs.base, inputs.detections])
    key("registration", [config.registration, units], ["base"], [inputs.detections])
    key(
        "detector",
        [config.detection, config.tracking.max_interval_s],
        ["registration"],
        [inputs.labels, inputs.detector, inputs.detections],
    )
    key("detections", [config.detection], ["detector"])
    key("tracklets", [config.tracking], ["detections"])
    key("tracks", [], ["tracklets"])
    key("field", [config.field], ["tracks"])
    key("maps", [], ["field"])
    assert tuple(keys) == STAGES
    return keys


def changed_since(plan: Plan) -> list[str]:
    """What was given otherwise when the run folder was last worked on; none where it is new, or by another version."""
    if not plan.layout.flight.exists():
        return []
    try:
        old = FlightRecord.model_validate_json(plan.layout.flight.read_bytes())
    except ValidationError:
        return []  # that version's stages have other keys as well: all is done anew
    moved = old.inputs.source.model_copy(update={"path": plan.inputs.source.path})
    before = old.inputs.model_copy(update={"source": moved})
    inputs = [name for name in InputsRecord.model_fields if getattr(before, name) != getattr(plan.inputs, name)]
    return inputs + (["settings"] if old.config != plan.config else [])


def write_flight_record(plan: Plan) -> None:
    """Write ``flight.json``."""
    record = FlightRecord(
        code_version=code_version(), config=plan.config, inputs=plan.inputs, given=plan.job.inputs, keys=plan.keys
    )
    write_atomically(plan.layout.flight, record.model_dump_json(indent=1).encode())
