"""Several clips of one place as one source: one clock from the files' own times, gaps between them as they were.

Their list is a text file, a path a line, with the suffix ``.clips``; `velfield run A.mp4 B.mp4` writes it. A clip's
start is by the drone's telemetry where all clips have some, else by the containers' creation times; without either they
follow each other in the order given.
"""

from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from schemas.arrays import FloatArray, IntArray
from schemas.flight import FramesConfig
from velfield.errors import Failure, InputError
from velfield.sources.folder import natural_key
from velfield.sources.frames import SourceFrame, SourceInfo, local_path
from velfield.sources.telemetry.find import find_beside
from velfield.sources.telemetry.read import read_telemetry
from velfield.sources.telemetry.telemetry import QUANTITIES, Telemetry
from velfield.sources.video.corruption import libav_log
from velfield.sources.video.decoding import iter_video
from velfield.sources.video.packets import open_video
from velfield.sources.video.probe import probe_video

CLIPS_SUFFIX = ".clips"
_UNKNOWN_GAP_S = 60.0
"""Between clips without times: no track is followed over so long a gap."""
_NOTED_GAP_S = 1.0


def write_clip_list(path: Path, clips: Sequence[Path]) -> None:
    """Write the list of clips, with absolute paths.

    Raises
    ------
    InputError
        One does not exist, is a folder, or is there twice.
    """
    files = [local_path(clip, "video") for clip in clips]
    folders = [file.name for file in files if not file.is_file()]
    if folders:
        raise InputError(f"found the folder {folders[0]} among several clips, expected videos; give the folder alone")
    if len(set(files)) < len(files):
        raise InputError("the same clip is given twice; omit one")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{file}\n" for file in files), encoding="utf-8")


def read_clip_list(path: Path) -> list[Path]:
    """The clips of a list; relative paths count from the list's folder.

    Raises
    ------
    InputError
        It is empty, or one does not exist.
    """
    lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
    clips = [local_path(path.parent / line, "video") for line in lines if line and not line.startswith("#")]
    if not clips:
        raise InputError(f"{path.name}: found no clips, expected a path a line")
    return clips


def clip_files(path: Path) -> list[Path]:
    """All files that a list of clips stands for: the clips, and the subtitle files beside them."""
    clips = read_clip_list(path)
    return [*clips, *(beside for clip in clips if (beside := find_beside(clip)) is not None)]


def probe_clips(path: Path, *, frames: FramesConfig, timestamps: Path | None) -> SourceInfo:
    """Facts of a list of clips (`velfield.sources.source.probe`).

    Raises
    ------
    InputError
        A clip cannot be read, frames of several sizes, clips that overlap in time.
    """
    if timestamps is not None:
        raise InputError("--timestamps cannot be combined with several clips; omit it: the clips' own times are used")
    clips = read_clip_list(path)
    infos = [probe_video(clip, frames=frames, timestamps=None) for clip in clips]
    for clip, info in zip(clips, infos, strict=True):
        if info.shape != infos[0].shape:
            raise InputError(
                f"{clip.name}: found frames of {info.width}x{info.height}, expected {infos[0].width}x{infos[0].height} "
                f"as in {clips[0].name}; run it on its own, and `velfield merge` the fields"
            )
    starts_s, notes = _starts(clips, infos)
    order = np.argsort(starts_s, kind="stable")
    parts = tuple((str(clips[k]), infos[k], float(starts_s[k] - starts_s[order[0]])) for k in order)
    return _join(parts, notes)


def _join(parts: tuple[tuple[str, SourceInfo, float], ...], notes: tuple[str, ...]) -> SourceInfo:
    times: list[FloatArray] = []
    names, warnings, end_s = list[str](), [*notes], -np.inf
    for path, info, start_s in parts:
        name = Path(path).name
        times_s = info.times_s - info.times_s[0] + start_s
        if times_s[0] <= end_s:
            raise InputError(
                f"{name}: begins {end_s - times_s[0]:.1f} s before the previous clip ends, expected clips in time "
                "order; if they are of two cameras, run each with the same --base, and `velfield merge` the fields"
            )
        if times and times_s[0] - end_s > _NOTED_GAP_S:
            warnings.append(f"a gap of {times_s[0] - end_s:.1f} s before {name}: no vehicle is tracked across it")
        warnings += [type(warning)(f"{name}: {warning}") for warning in info.warnings]
        names += [f"{name}:{index}" for index in info.names]
        times.append(times_s)
        end_s = float(times_s[-1])
    first = parts[0][1]
    return SourceInfo(
        kind="video",
        width=first.width,
        height=first.height,
        frame_count=len(names),
        times_s=np.concatenate(times),
        names=tuple(names),
        warnings=tuple(warnings),
        max_pixels=first.max_pixels,
        parts=parts,
    )


def _starts(clips: Sequence[Path], infos: Sequence[SourceInfo]) -> tuple[FloatArray, tuple[str, ...]]:
    """When each clip began, s on one clock, and a note where that is not known."""
    for clock in (telemetry_clock, creation_clock):
        found = [clock(clip, info) for clip, info in zip(clips, infos, strict=True)]
        if all(start is not None for start in found):
            return np.array(found, np.float64), ()
    lasts = [float(info.times_s[-1] - info.times_s[0]) + _UNKNOWN_GAP_S for info in infos]
    note = (
        f"the clips do not all have a creation time: they are taken in the order given, {_UNKNOWN_GAP_S:g} s apart, so "
        "times of day are not known"
    )
    return np.concatenate([[0.0], np.cumsum(lasts)[:-1]]), (note,)


def telemetry_clock(clip: Path, info: SourceInfo) -> float | None:
    """The camera's clock at a video's first frame by its telemetry, s since 1970 as if it were set to UTC."""
    telemetry = read_telemetry(clip, info, find_beside(clip))
    return None if isinstance(telemetry, Failure) else first_clock(telemetry)


def first_clock(telemetry: Telemetry) -> float | None:
    """The camera's clock at the source's first frame, s since 1970; None where no record has it."""
    known = np.flatnonzero(np.isfinite(telemetry.clock_s))
    return float(telemetry.clock_s[known[0]] - telemetry.time_s[known[0]]) if len(known) else None


def creation_clock(clip: Path, _info: SourceInfo) -> float | None:
    """When a video began by its container's header, s since 1970; None where it is not there."""
    with libav_log(), open_video(clip) as container:
        text = container.metadata.get("creation_time", "")
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        return None
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return moment.timestamp() if moment.year > 1990 else None  # 1904 or 1970: a clock that was never set


def iter_clips(info: SourceInfo, indices: IntArray, then: IntArray) -> Generator[SourceFrame, None, None]:
    """Frames of all clips, by their indices in the joined source; ``then``: those that later calls ask for."""
    first = 0
    for path, part, start_s in info.parts:
        mine, later = (some[(some >= first) & (some < first + part.frame_count)] - first for some in (indices, then))
        shift_s = start_s - float(part.times_s[0])
        if len(mine):
            with closing(iter_video(Path(path), part, mine, later)) as frames:
                for frame in frames:
                    index = frame.source_index + first
                    yield replace(frame, source_index=index, name=info.names[index], time_s=frame.time_s + shift_s)
        first += part.frame_count


def read_clips_telemetry(info: SourceInfo) -> Telemetry | Failure:
    """The telemetry of all clips on their one clock; a failure where none of them has any."""
    records, read, failure = [], list[Telemetry](), Failure("no clip has telemetry")
    for path, part, start_s in info.parts:
        found = read_telemetry(Path(path), part, find_beside(Path(path)))
        if isinstance(found, Failure):
            failure = found
            continue
        read.append(found)
        columns = {name: getattr(found, name) for name in QUANTITIES}
        records += [
            (float(found.time_s[k] + start_s), {name: float(values[k]) for name, values in columns.items()})
            for k in range(len(found.time_s))
        ]
    if not records:
        return failure
    more = f" and {len(read) - 1} more" if len(read) > 1 else ""
    origin = sorted((telemetry.origin for telemetry in read), key=natural_key)[0]
    notes = [note for telemetry in read for note in telemetry.notes]
    height, is_utc = read[0].height, all(telemetry.is_utc for telemetry in read)
    return Telemetry.from_records(f"{origin}{more}", records, notes, height=height, is_utc=is_utc)
