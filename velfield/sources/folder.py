"""A folder of images as a source: natural order, times from a CSV or from a frame rate that the user gives."""

import re
from collections.abc import Generator
from pathlib import Path

import numpy as np

from schemas.arrays import FloatArray, IntArray
from schemas.flight import FramesConfig
from velfield.errors import InputError
from velfield.sources.frames import IMAGE_SUFFIXES, VIDEO_SUFFIXES, FootageLoss, SourceFrame, SourceInfo
from velfield.sources.images import check_size, describe_levels, folder_levels, image_size, read_grey_image
from velfield.sources.quality import FrameFlag
from velfield.sources.timestamps import read_timestamps

_DIGITS = re.compile(r"(\d+)")
_FEW = 5


def natural_key(name: str) -> tuple[tuple[int, int | str], ...]:
    """Sort key that puts numbers in order of value.

    Examples
    --------
    >>> sorted(["f10.png", "f9.png", "F1.png"], key=natural_key)
    ['F1.png', 'f9.png', 'f10.png']
    """
    parts = _DIGITS.split(name.casefold())
    return (*((0, int(part)) if part.isdecimal() else (1, part) for part in parts), (1, name))


def probe_folder(path: Path, *, frames: FramesConfig, timestamps: Path | None) -> SourceInfo:
    """Facts of a folder (`velfield.sources.source.probe`). Reads every image's header, no pixels."""
    names = list_images(path)
    names, times_s, warnings = _with_times(path, names, frames, timestamps)
    sizes, broken = _group_by_size(path, names, frames.max_pixels)
    if not sizes:
        raise InputError(
            f"{path.name}: found {len(names)} images, none of them readable, expected frames; {broken[0][1]}"
        )
    width, height = _common_size(path, sizes)
    if broken:
        warnings += (f"{len(broken)} of {len(names)} images cannot be read (first: {broken[0][1]})",)
    levels = folder_levels([path / name for name in sizes[width, height]], frames.max_pixels)
    if levels is not None:
        warnings += (describe_levels(levels),)
    return SourceInfo(
        kind="folder",
        width=width,
        height=height,
        frame_count=len(names),
        times_s=times_s,
        names=names,
        warnings=warnings,
        fps=frames.fps,
        max_pixels=frames.max_pixels,
        levels=levels,
    )


def list_images(path: Path) -> tuple[str, ...]:
    """Names of the images in a folder, naturally sorted; without hidden files (``._x.jpg`` of a Mac).

    Raises
    ------
    InputError
        There is none.
    """
    try:
        names = [entry.name for entry in path.iterdir() if entry.suffix.lower() in IMAGE_SUFFIXES]
    except OSError as error:
        raise InputError(f"{path.name}: the folder cannot be listed ({error.strerror}); check it") from None
    names = [name for name in names if not name.startswith(".")]
    if not names:
        raise InputError(
            f"{path.name}: found no images in the folder, expected {', '.join(IMAGE_SUFFIXES)}; "
            f"give the folder that holds them, or a video{_or_video(path)}"
        )
    return tuple(sorted(names, key=natural_key))


def _or_video(path: Path) -> str:
    """What to add where a folder of images was expected and a video lies in it."""
    videos = sorted(entry.name for entry in path.iterdir() if entry.suffix.lower() in VIDEO_SUFFIXES)
    return f"; of the video in it: velfield run {path.name}/{videos[0]}" if videos else ""


def iter_folder(path: Path, info: SourceInfo, indices: IntArray) -> Generator[SourceFrame, None, None]:
    """Read the images `indices`; one that cannot be read is yielded with the flag UNREADABLE."""
    for index in indices:
        yield _read(path, info, int(index))


def _read(path: Path, info: SourceInfo, index: int) -> SourceFrame:
    name = info.names[index]
    try:
        grey = read_grey_image(path / name, info.max_pixels, info.levels)
    except InputError as error:
        return info.frame(index, None, int(FrameFlag.UNREADABLE), str(error))
    if grey.shape != info.shape:
        raise InputError(
            f"{path.name}: found {name} of {grey.shape[1]}x{grey.shape[0]}, expected {info.width}x{info.height}; "
            "the folder has changed; start again"
        )
    return info.frame(index, grey)


def _with_times(
    path: Path, names: tuple[str, ...], frames: FramesConfig, timestamps: Path | None
) -> tuple[tuple[str, ...], FloatArray, tuple[str, ...]]:
    """Names and times in order of time, and notes on irregularities."""
    if timestamps is None:
        if frames.fps is None:
            raise InputError(
                f"{path.name}: found {len(names)} images without times, expected them from a side file or a rate; "
                f"give --timestamps CSV (frame,time_s) or --fps F{_or_video(path)}"
            )
        return names, np.arange(len(names)) / frames.fps, ()
    side = read_timestamps(timestamps)
    kept = tuple(name for name in names if name in side)
    if not kept:
        raise InputError(
            f"{timestamps.name}: found frames such as {next(iter(side))!r}, none an image of {path.name} "
            f"(such as {names[0]!r}), expected the images' file names as `frame`; fix them"
        )
    return _sorted_by_time(
        kept, np.array([side[name] for name in kept]), _unmatched_notes(path, timestamps, names, kept, side)
    )


def _unmatched_notes(
    path: Path, timestamps: Path, names: tuple[str, ...], kept: tuple[str, ...], side: dict[str, float]
) -> tuple[str, ...]:
    untimed = [name for name in names if name not in side]
    absent = sorted(set(side) - set(kept), key=natural_key)
    notes: tuple[str, ...] = ()
    if untimed:
        notes += (
            FootageLoss(f"{len(untimed)} of {len(names)} images have no time and are dropped ({_shorten(untimed)})"),
        )
    if absent:
        notes += (
            FootageLoss(f"{len(absent)} frames of {timestamps.name} are not in {path.name} ({_shorten(absent)})"),
        )
    return notes


def _sorted_by_time(
    names: tuple[str, ...], times_s: FloatArray, notes: tuple[str, ...]
) -> tuple[tuple[str, ...], FloatArray, tuple[str, ...]]:
    order = np.argsort(times_s, kind="stable")
    backwards = int(np.count_nonzero(np.diff(times_s) < 0))
    times_s = times_s[order]
    equal = int(np.count_nonzero(np.diff(times_s) == 0))
    if backwards:
        notes += (f"times run backwards {backwards} times in the order of names: frames are taken in order of time",)
    if equal:
        notes += (FootageLoss(f"{equal} frames have the time of the frame before and are dropped"),)
    return tuple(names[i] for i in order), times_s, notes


def _group_by_size(
    path: Path, names: tuple[str, ...], max_pixels: int
) -> tuple[dict[tuple[int, int], list[str]], list[tuple[str, str]]]:
    """Names by size, and the names of unreadable images with the reason; one too large is an error."""
    sizes: dict[tuple[int, int], list[str]] = {}
    broken: list[tuple[str, str]] = []
    for name in names:
        try:
            size = image_size(path / name, max_pixels=max(max_pixels, 2**62))
        except InputError as error:
            broken.append((name, str(error)))
            continue
        check_size(path / name, *size, max_pixels)
        sizes.setdefault(size, []).append(name)
    return sizes, broken


def _common_size(path: Path, sizes: dict[tuple[int, int], list[str]]) -> tuple[int, int]:
    size, usual = max(sizes.items(), key=lambda item: len(item[1]))
    if len(sizes) > 1:
        (width, height), odd = next((other, names) for other, names in sizes.items() if other != size)
        raise InputError(
            f"{path.name}: found {odd[0]} of {width}x{height}, expected {size[0]}x{size[1]} as {len(usual)} others; "
            "remove it: all frames must have one size"
        )
    return size


def _shorten(names: list[str]) -> str:
    return ", ".join(names[:_FEW]) + (", ..." if len(names) > _FEW else "")
