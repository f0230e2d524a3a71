"""The plan of a run: its frames, its units, and the content key of every stage, known before any work is done."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from schemas.flight import FlightConfig, FramesConfig
from schemas.job import Inputs, Job
from schemas.records import FlightRecord, InputsRecord, SourceRecord
from velfield.errors import InputError, count_text
from velfield.field.time_intervals import TimeInterval, parse_time_intervals
from velfield.pipeline.stage import stage_keys
from velfield.run.commits import code_version, content_key, digest_bytes, digest_path, sealed_json, write_atomically
from velfield.run.flight_record import check_format, read_flight_record
from velfield.run.layout import RunLayout, is_remote, to_path
from velfield.sources.clips import CLIPS_SUFFIX, clip_files, read_clip_list, write_clip_list
from velfield.sources.frames import FootageLoss, SourceInfo, local_path
from velfield.sources.selection import select_frames
from velfield.sources.source import check_source, probe
from velfield.sources.telemetry.find import find_beside

_MANY_GAPS = 0.3
"""Fraction of frames without a near one before them from which a warning is given."""
_NAMED = 3
"""Names of files that a message lists."""
_LATE = 1.5
"""A frame may come late by half an interval."""
LONG_MPX = 1200.0
"""Frames times megapixels of a long flight: two minutes of two processors."""
OPTIONAL_INPUTS = tuple(name for name in Inputs.model_fields if name != "source")
_ONE_UNIT = 16
"""Up to so many frames are one unit."""
_UNITS = ((256, 32), (4096, 64))
"""Up to so many frames, so many a unit: a short flight is cut finely enough for several workers, but the first frame of
each unit is registered by its keypoints, at five times the cost of the others; ..."""
_LARGEST_UNIT = 256
"""... and a flight of hours stays below 3,000 units. These are upper limits: units are cut evenly,
and an even number of them, so that no core of two idles over a last short one."""


@dataclass(frozen=True)
class Plan:
    """A run, resolved: picklable, small, and all that a worker needs besides the unit."""

    job: Job
    info: SourceInfo = field(repr=False)
    indices: NDArray[np.int64] = field(repr=False)
    """Source indices of the frames that are processed, (frames,)."""
    inputs: InputsRecord
    keys: dict[str, str]
    """Content key of each stage."""
    lost: tuple[str, ...] = ()
    """Units that failed, ``stage unit`` each: what was there of them is not read."""
    reduction: int = 1
    """Frames are processed at one in so many of the source pixels along either axis: in a preview of large ones."""

    @property
    def frame_shape(self) -> tuple[int, int]:
        """Shape (h, w) of a frame as it is processed."""
        return self.info.height // self.reduction, self.info.width // self.reduction

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
    def is_long(self) -> bool:
        """Whether a flight takes so long that previews, early checks, and seconds that save memory are worth it."""
        return self.frame_count * self.info.width * self.info.height / 1e6 >= LONG_MPX

    @property
    def is_of_frames_alone(self) -> bool:
        """Whether nothing is given that is in pixels of a frame, has a scale of its own, or takes training."""
        given = self.job.inputs
        return not (given.base or given.labels or given.detector or given.detections)

    @property
    def unit_frames(self) -> int:
        """Frames a unit: depends on the flight alone, never on the number of workers."""
        setting = self.config.work.unit_frames
        if setting != "auto":
            return setting
        largest = next((unit for frames, unit in _UNITS if self.frame_count <= frames), _LARGEST_UNIT)
        if self.frame_count <= _ONE_UNIT:
            return _ONE_UNIT
        units = 2 * -(-self.frame_count // (2 * largest))
        even = -(-self.frame_count // units)
        # Of whole blocks where that leaves no shorter one: a block that is cut searches one frame more as a whole, but
        # of two units on two processors the longer one decides.
        blocks = -(-even // self.config.work.block_frames) * self.config.work.block_frames
        last = self.frame_count - (units - 1) * blocks
        return blocks if blocks <= largest and 10 * last > 9 * blocks else even

    @property
    def units(self) -> list[range]:
        """Frames of each unit."""
        n, step = self.frame_count, self.unit_frames
        return [range(start, min(start + step, n)) for start in range(0, n, step)]

    @property
    def time_intervals(self) -> list[TimeInterval]:
        """Time intervals to accumulate a field for each, in their order; empty where none are set.

        Raises
        ------
        InputError
            The setting cannot be parsed, or they overlap.
        """
        text, times_s = self.config.field.time_intervals, self.info.times_s[self.indices]
        return [] if text is None else parse_time_intervals(text, float(times_s[0]), float(times_s[-1]))

    def with_lost_units(self, lost: Sequence[str]) -> "Plan":
        """The plan of the stages after one of which units failed: under keys of their own.

        The next run computes the lost units, and by its other keys computes again what was made without them.
        """
        if not lost:
            return self
        keys = {stage: content_key(stage, 0, inputs=[key, *sorted(lost)]) for stage, key in self.keys.items()}
        return replace(self, keys=keys, lost=(*self.lost, *lost))


def job_of(layout: RunLayout, record: FlightRecord) -> Job:
    """The job that made a run.

    Raises
    ------
    InputError
        The run has no record of its inputs.
    """
    if record.given is None:
        raise InputError(f"{layout.root} has no record of its inputs; run `velfield run` on it again")
    return Job(root=str(layout.root), inputs=record.given, config=record.config)


def check_inputs(job: Job) -> None:
    """Check that all inputs exist, before anything that takes long is started.

    Raises
    ------
    InputError
        The source cannot be opened, another input does not exist, or the folder is not for a run (`check_folder`).
    """
    check_folder(Path(job.root))
    check_source(job.inputs.source)
    _check_optional_inputs(job)


def check_folder(root: Path) -> None:
    """See that results can be written into a folder: it is a run's of this format, empty, not there, or on S3.

    Raises
    ------
    InputError
        It holds a run of another format, or other things, among which results would be written.
    """
    check_format(root)
    found = RunLayout(root).foreign_names()
    if found:
        more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
        raise InputError(
            f"{root} is not empty and no run folder: it holds {', '.join(found[:_NAMED])}{more}; give another --out, "
            "or move these away"
        )


def _check_optional_inputs(job: Job) -> None:
    for name in OPTIONAL_INPUTS:
        path = getattr(job.inputs, name)
        if path is not None and not Path(path).exists():
            raise InputError(f"--{name} {path}: no such file; check the path")


def make_plan(job: Job) -> Plan:
    """Probe the inputs and resolve the run.

    Raises
    ------
    InputError
        The source cannot be read, has no times, or fewer than three frames are left; or the folder holds another
        flight.
    """
    check_folder(Path(job.root))
    job = _with_telemetry(job)
    _check_optional_inputs(job)  # `probe` checks the source
    timestamps = Path(job.inputs.timestamps) if job.inputs.timestamps else None
    info = probe(Path(job.inputs.source), frames=job.config.frames, timestamps=timestamps)
    indices = select_frames(info.times_s, job.config.frames)
    if len(indices) < 3:
        raise InputError(f"{job.inputs.source}: {_too_few(job.config.frames, info, len(indices))}")
    info = replace(info, warnings=(*info.warnings, *_gaps(info.times_s[indices], job.config.tracking.max_interval_s)))
    inputs = _digest_inputs(job, info)
    plan = Plan(job=job.anywhere(), info=info, indices=indices, inputs=inputs, keys=stage_keys(job.config, inputs))
    _ = plan.time_intervals  # refuses impossible intervals now, not where the field is built
    check_same_flight(plan)
    return plan


def _too_few(frames: FramesConfig, info: SourceInfo, count: int) -> str:
    """Message that ``count`` frames are too few, with what the source lacks and the options that can help."""
    lost = [warning for warning in info.warnings if isinstance(warning, FootageLoss)]
    remedies = []
    if info.frame_count >= 3 and (frames.start_s is not None or frames.stop_s is not None):
        remedies.append("widen --start-s/--stop-s")
    if info.frame_count >= 3 and frames.every != 1:
        remedies.append("set --every 1")
    found = f"{count_text(count, 'frame')} to process, but a tracklet needs 3"
    return "; ".join((found, *lost, " or ".join(remedies or ["give a longer recording"])))


def _with_telemetry(job: Job) -> Job:
    """The job with the telemetry beside its video, where none is given."""
    beside = find_beside(Path(job.inputs.source)) if job.inputs.telemetry is None else None
    if beside is None:
        return job
    return job.model_copy(update={"inputs": job.inputs.model_copy(update={"telemetry": str(beside)})})


def _gaps(times_s: NDArray[np.float64], max_interval_s: float) -> list[str]:
    gaps = np.diff(times_s)
    wide = gaps > max_interval_s
    if wide.mean() < _MANY_GAPS:
        return []
    return [
        f"{wide.mean():.0%} of the frames come more than {max_interval_s:g} s after the one before (median "
        f"{np.median(gaps):.2f} s), too far apart to link detections: few tracklets or none; {widen_interval(gaps)}"
    ]


def widen_interval(gaps_s: NDArray[np.float64]) -> str:
    """The remedy where the frames (gaps between them, s) are too far apart to link detections."""
    enough = np.ceil(20 * _LATE * float(np.median(gaps_s))) / 20
    return (
        f"take frames closer together, or --set tracking.max_interval_s={enough:g} where traffic is sparse (the "
        "farther apart, the more wrong links)"
    )


def _digest_inputs(job: Job, info: SourceInfo) -> InputsRecord:
    digests: dict[str, str | None] = {}
    for name in OPTIONAL_INPUTS:
        path = getattr(job.inputs, name)
        digests[name] = digest_path(Path(path)) if path else None
        described = Path(path).with_suffix(".yaml") if name == "detector" and path else None
        if described is not None and described != Path(path) and described.is_file():  # beside an ONNX model
            digests[name] = f"{digests[name]} {digest_path(described)}"
    source = SourceRecord(
        path=job.inputs.source,
        kind=info.kind,
        digest=_digest_source(Path(job.inputs.source), info),
        width=info.width,
        height=info.height,
        frame_count=info.frame_count,
    )
    return InputsRecord(source=source, **digests)


def _digest_source(path: Path, info: SourceInfo) -> str:
    """Digest of a source; of several clips, of theirs: where they lie does not matter."""
    if not info.parts:
        return digest_path(path)
    return digest_bytes(" ".join(map(digest_path, clip_files(path))).encode())


def _last_run(plan: Plan) -> FlightRecord | None:
    """The record of the last run in this folder; None if it is new, or of another format: everything is recomputed."""
    try:
        return read_flight_record(plan.layout.root) if plan.layout.flight.exists() else None
    except InputError:
        return None


def dropped_inputs(plan: Plan) -> list[str]:
    """A line for each optional input that the last run in this folder was given and this one is not."""
    last = _last_run(plan)
    before = last and last.given
    instead = {"base": "the base image is built from the flight", "labels": "cars are not labelled"}
    return [
        f"--{name} {path} was given to the run before in {plan.layout.root} and is not given now"
        f"{': ' + instead[name] if name in instead else ''}; give it again to keep those results"
        for name in OPTIONAL_INPUTS
        if before is not None and (path := getattr(before, name)) and not getattr(plan.job.inputs, name)
    ]


def check_same_flight(plan: Plan) -> None:
    """See that the folder holds no other flight, whose results would be overwritten.

    The same file with other content, such as a folder of frames that grows, and the same content elsewhere are the same
    flight.

    Raises
    ------
    InputError
        It does.
    """
    old = _last_run(plan)
    if old is None or old.given is None or old.inputs.source.digest == plan.inputs.source.digest:
        return
    if old.given.source != plan.job.inputs.source:
        raise _other_flight(plan.layout.root, old.given.source, plan.job.inputs.source)


def write_clips(root: Path, clips: Sequence[Path]) -> Path:
    """Write the list of several clips of one flight, the source of its run, into the run folder; the list's path.

    The list has one name in all runs, so `check_same_flight` cannot distinguish their flights: the folder holds the
    same flight if the run before had one of the clips too.

    Raises
    ------
    InputError
        The folder is on S3, holds another flight or other things, or a clip cannot be in a list.
    """
    if is_remote(to_path(root)):
        raise InputError(
            f"{root}: several clips need a list on a local disk; write their paths, one per line, into "
            f"clips{CLIPS_SUFFIX} and run that file"
        )
    check_folder(root)
    path = RunLayout(root).clips
    before = set[Path]()
    if RunLayout(root).flight.exists():
        with suppress(InputError, FileNotFoundError):  # of one file, or of clips that are gone
            before = set(read_clip_list(path))
    if before and before.isdisjoint(local_path(clip, "video") for clip in clips):
        raise _other_flight(root, "other clips", " and ".join(clip.name for clip in clips))
    write_clip_list(path, clips)
    return path


class OtherFlightError(InputError):
    """The folder holds the run of another flight."""


def _other_flight(root: Path, before: str, now: str) -> OtherFlightError:
    return OtherFlightError(
        f"{root} holds the run of {before}, which that of {now} would overwrite; give another --out, or remove the "
        "folder first"
    )


def changed_since(plan: Plan) -> list[str]:
    """Inputs and settings that changed since the last run in this folder; none if it is new or of another format."""
    old = _last_run(plan)
    if old is None:
        return []
    moved = old.inputs.source.model_copy(update={"path": plan.inputs.source.path})
    before = old.inputs.model_copy(update={"source": moved})
    inputs = [name for name in InputsRecord.model_fields if getattr(before, name) != getattr(plan.inputs, name)]
    return inputs + (["settings"] if old.config != plan.config else [])


def write_flight_record(plan: Plan) -> None:
    """Write ``flight.json``."""
    record = FlightRecord(
        code_version=code_version(), config=plan.config, inputs=plan.inputs, given=plan.job.inputs, keys=plan.keys
    )
    write_atomically(plan.layout.flight, sealed_json(record))
