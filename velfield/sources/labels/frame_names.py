"""Frame of the source for an image that labels name.

An image of a folder is found by its file name or stem. A frame of a video has a number, which labelling tools write
into the name of the image: it is read only where one number can be meant.
"""

import re
from collections import defaultdict
from collections.abc import Iterable
from pathlib import PurePosixPath

import numpy as np

from velfield.errors import InputError
from velfield.sources.frames import SourceInfo

_SUFFIX = re.compile(r"\.(jpe?g|png|bmp|tiff?|webp|txt|json|xml)$", re.IGNORECASE)
_ROBOFLOW = re.compile(r"\.rf\.[0-9a-z]+$", re.IGNORECASE)
_OLD_SUFFIX = re.compile(r"[_-](jpe?g|png|bmp|tiff?|webp)$", re.IGNORECASE)
_UPLOAD = re.compile(r"^[0-9a-f]{8}-")
"""Label Studio puts it before the name of an uploaded image."""
_NUMBERED = re.compile(r"(?:^|[^a-z])(?:frame|frm|fr|f)[-_ #]*(?:no|nr|num|number)?[-_ #.]*(\d+)", re.IGNORECASE)
_CLOCK = re.compile(r"(?<!\d)(\d{1,2})([-_.:h])(\d{2})[-_.:m](\d{2})(?:[-_.,:s](\d{1,3}))?(?!\d)")
_SECONDS = re.compile(r"(?<![\d.])(\d+)(?:[.,](\d+))?\s?(ms|s|sec|seconds)(?![a-z0-9])", re.IGNORECASE)


def match_frames(images: Iterable[str], info: SourceInfo) -> tuple[dict[str, str], list[str]]:
    """The frames (names of `SourceInfo`) of those images that are of the source, and notes on what was assumed.

    Raises
    ------
    InputError
        A name that may mean several frames, or two images of one frame.
    """
    images = list(dict.fromkeys(images))
    found, notes = _of_video(images, info) if info.kind == "video" else (_of_folder(images, info), [])
    image_of: dict[str, str] = {}
    for image, frame in found.items():
        if frame in image_of:
            raise InputError(
                f"found the labelled images {image_of[frame]!r} and {image!r} of the one frame {frame}, expected each "
                "frame once; remove augmented or repeated images"
            )
        image_of[frame] = image
    return found, notes


def _stems(image: str) -> list[str]:
    """Stems that the image may have had before a labelling tool renamed it, the present one first."""
    stem = PurePosixPath(image.replace("\\", "/")).name
    while _SUFFIX.search(stem):
        stem = _SUFFIX.sub("", stem)
    plain = _OLD_SUFFIX.sub("", _ROBOFLOW.sub("", stem)) if _ROBOFLOW.search(stem) else stem
    return list(dict.fromkeys((stem, plain, _UPLOAD.sub("", plain))))


def _of_folder(images: list[str], info: SourceInfo) -> dict[str, str]:
    known, by_stem = set(info.names), defaultdict(list)
    for frame in info.names:
        by_stem[frame.rsplit(".", 1)[0]].append(frame)
    found = {}
    for image in images:
        file = image.replace("\\", "/").rsplit("/", 1)[-1]
        if file in known:
            found[image] = file
            continue
        alike = next((by_stem[stem] for stem in _stems(image) if stem in by_stem), [])
        if len(alike) > 1:
            raise InputError(
                f"found the images {alike[0]} and {alike[1]} of one stem, expected one for the labels of {file!r}; "
                "rename one, or use a CSV `frame,x_px,y_px`"
            )
        found |= {image: alike[0]} if alike else {}
    return found


def _of_video(images: list[str], info: SourceInfo) -> tuple[dict[str, str], list[str]]:
    clips = {part[0].replace("\\", "/").rsplit("/", 1)[-1]: part[1] for part in info.parts} or {"": info}
    first = dict(zip(clips, np.cumsum([0, *(clip.frame_count for clip in clips.values())])[:-1].tolist(), strict=True))
    of_clip: dict[str, dict[str, str]] = defaultdict(dict)
    for image in images:
        stem = _stems(image)[-1]
        clip = max((name for name in clips if stem.startswith(name.rsplit(".", 1)[0])), key=len, default=None)
        if clip is None:
            raise InputError(
                f"found labels of the image {image!r} for {len(clips)} clips, expected a name that begins with its "
                f"clip's, such as {next(iter(clips)).rsplit('.', 1)[0]}_frame12; rename it"
            )
        of_clip[clip][image] = stem[len(clip.rsplit(".", 1)[0]) :] if clip else stem
    found: dict[str, str] = {}
    notes: list[str] = []
    for clip, stems in of_clip.items():
        numbers, more = _frame_numbers(stems, clips[clip])
        names = set(clips[clip].names)
        inside = {image: str(number) for image, number in numbers.items() if str(number) in names}
        if clip:
            index_of = {name: index for index, name in enumerate(clips[clip].names)}
            inside = {image: info.names[first[clip] + index_of[name]] for image, name in inside.items()}
        found |= inside
        notes += more if inside else []
    return found, notes


def _frame_numbers(stems: dict[str, str], info: SourceInfo) -> tuple[dict[str, int], list[str]]:
    """0-based numbers of frames by the stems of images, and a note on how they were read."""
    times = {image: timed for image, stem in stems.items() if (timed := _time_s(stem)) is not None}
    if times and not all(_NUMBERED.search(stem) for stem in stems.values()):
        return _by_times(times, stems, info)
    numbers = _numbers(stems)
    last = int(info.names[-1])
    example = next(iter(numbers))
    if min(numbers.values()) >= 1 and max(numbers.values()) == last + 1:
        numbers = {image: number - 1 for image, number in numbers.items()}
        return numbers, [f"labelled images are counted from 1: {example!r} is frame {numbers[example]} of the video"]
    if all(stem.isdecimal() for stem in stems.values()):
        return numbers, []
    return numbers, [
        f"labelled images are counted from 0, as CVAT does: {example!r} is frame {numbers[example]} of the video "
        "(FFmpeg counts from 1)"
    ]


def _numbers(stems: dict[str, str]) -> dict[str, int]:
    named = {image: _NUMBERED.findall(stem) for image, stem in stems.items()}
    groups = {
        image: named[image] if len(named[image]) == 1 else re.findall(r"\d+", stem) for image, stem in stems.items()
    }
    if max(map(len, groups.values())) > 1:
        groups = _varying(groups)
    for image, found in groups.items():
        if len(found) != 1:
            what = "no number" if not found else f"the numbers {', '.join(found)}"
            raise InputError(
                f"found labels of the image {image!r} with {what} in its name, expected one: the video's 0-based frame "
                "number; rename it, such as frame_000012.png"
            )
    return {image: int(found[0]) for image, found in groups.items()}


def _varying(groups: dict[str, list[str]]) -> dict[str, list[str]]:
    """Keep only the numbers in each name that are not the same in all names: the others name the recording."""
    rows = list(groups.values())
    if len(rows) < 2 or len({len(row) for row in rows}) > 1:
        return groups
    varying = [k for k in range(len(rows[0])) if len({row[k] for row in rows}) > 1]
    return {image: [row[k] for k in varying] for image, row in groups.items()} if varying else groups


def _time_s(stem: str) -> tuple[float, float] | None:
    """A time in a name and its resolution, s."""
    if match := _SECONDS.search(stem):
        whole, fraction, unit = match[1], match[2] or "", match[3].lower()
        scale = 1e-3 if unit == "ms" else 1.0
        return float(f"{whole}.{fraction or 0}") * scale, 10.0 ** -len(fraction) * scale
    if match := _CLOCK.search(stem):
        digits = match[5] or ""
        seconds = 3600 * int(match[1]) + 60 * int(match[3]) + int(match[4])
        return seconds + float(f"0.{digits or 0}"), 10.0 ** -len(digits)
    return None


def _by_times(
    times: dict[str, tuple[float, float]], stems: dict[str, str], info: SourceInfo
) -> tuple[dict[str, int], list[str]]:
    since_s = info.times_s - info.times_s[0]
    step_s = float(np.median(np.diff(since_s))) if len(since_s) > 1 else 1.0
    found = {}
    for image in stems:
        at_s, resolution_s = times.get(image, (np.nan, np.inf))
        nearest = int(np.argmin(np.abs(since_s - at_s))) if np.isfinite(at_s) else 0
        if resolution_s > step_s / 2 or not abs(since_s[nearest] - at_s) <= step_s / 2 + resolution_s:
            raise InputError(
                f"found labels of the image {image!r}, whose name holds a time that is of no one frame (the video has "
                f"one every {step_s:.3g} s, for {since_s[-1]:.3f} s), expected the 0-based frame number; rename it"
            )
        found[image] = int(info.names[nearest])
    example = next(iter(found))
    return found, [f"labelled images are named by times: {example!r} is frame {found[example]} of the video"]
