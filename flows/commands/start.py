"""``velfield`` alone: what to do next, by what lies in the working folder."""

import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

_MAX_ENTRIES, _SHOWN = 2000, 3


def own_command() -> str:
    """How to call this program from the same shell: by its name only where the shell finds it."""
    if shutil.which("velfield") is not None:
        return "velfield"
    program = Path(sys.argv[0])
    return shlex.quote(str(program)) if program.stem == "velfield" else f"{shlex.quote(sys.executable)} -m flows.cli"


def start(folder: Path) -> int:
    """Print the next steps; reads no file's content."""
    print("\n".join(next_steps(folder)))
    return 0


def next_steps(folder: Path) -> Iterator[str]:
    """Lines of what to do next."""
    from velfield.sources.frames import VIDEO_SUFFIXES

    yield "velfield: aerial video of a city in, a probability distribution over vehicle velocity at every pixel out.\n"
    entries = sorted(folder.iterdir())[:_MAX_ENTRIES]
    runs = [entry for entry in entries if (entry / "flight.json").is_file()]
    videos = [entry for entry in entries if entry.suffix.lower() in VIDEO_SUFFIXES and entry.is_file()]
    images = [entry for entry in entries if entry.is_dir() and entry not in runs and _has_images(entry)]
    yield from _of_runs(runs)
    yield from _of_videos(videos, {run.name for run in runs}, entries)
    for entry in images[:_SHOWN]:
        yield f"A folder of images, {entry.name}. They need times:"
        yield f"  velfield run {shlex.quote(entry.name)} --timestamps times.csv --out RUN   # or --fps 5\n"
    if not (runs or videos or images):
        yield "No video and no run in this folder. See it work, on a simulated flight (about a minute):"
        yield "  velfield demo\n"
        yield "Your own video, from a camera that looks down and stays over one place:"
        yield "  velfield run VIDEO --out RUN\n"
    yield "All commands: velfield --help; one of them: velfield run --help."


def _of_runs(runs: list[Path]) -> Iterator[str]:
    for run in runs[:_SHOWN]:
        name = shlex.quote(run.name)
        if not (run / "index.html").is_file():
            yield f"{run.name} is an unfinished run: repeat the command that started it to resume.\n"
            continue
        yield f"{run.name} is a finished run:"
        yield f"  velfield view {name}                              # its map, in the browser"
        yield f"  velfield analyse {name}                           # turning counts, queues, signals, speeds: a report"
        yield f"  velfield export {name} --format cog               # for a GIS; other formats: velfield export --help"
        yield f"  velfield georeference {name} --points points.csv  # georeference it by control points\n"


def _of_videos(videos: list[Path], runs: set[str], entries: list[Path]) -> Iterator[str]:
    subtitles = {entry.stem for entry in entries if entry.suffix.lower() in (".srt", ".klv")}
    new = [video for video in videos if f"{video.stem}-run" not in runs]
    for video in new[:_SHOWN]:
        known = video.stem in subtitles
        scale = "its telemetry file may give scale and north" if known else "add --gsd-m METRES if you know it"
        yield f"{video.name} is a video, {scale}:"
        yield f"  velfield run {shlex.quote(video.name)} --out {shlex.quote(video.stem + '-run')}"
        yield f"  velfield init {shlex.quote(video.name)}   # writes flight.yaml with every parameter, to change some\n"
    if len(new) > 1:
        names = " ".join(shlex.quote(video.name) for video in new[:_SHOWN])
        yield "Clips of one place, one after the other, make one map:"
        yield f"  velfield run {names} --out RUN\n"


def _has_images(folder: Path) -> bool:
    from velfield.sources.frames import IMAGE_SUFFIXES

    try:
        names = (entry.suffix.lower() for _, entry in zip(range(_MAX_ENTRIES), folder.iterdir(), strict=False))
        return sum(name in IMAGE_SUFFIXES for name in names) > 2
    except OSError:
        return False
