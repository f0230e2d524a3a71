"""How often the warnings about footage are right: over sound flights, and over flights with one fault each.

python -m tests.benchmarks.footage_warnings [--seeds 651 652 ...] [--real FOLDER]

Each flight passes the stages up to registration. ``--real`` is the folder of real footage: its sound sets are those
that look straight down. The table counts the flights with a warning of each kind.
"""

import argparse
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from schemas.arrays import GreyImage
from schemas.job import Inputs, Job
from schemas.simulation import CameraSimulation, TimesSimulation
from tests.media import write_images, write_video
from velfield.errors import InputError
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.graphs import unit_graph
from velfield.pipeline.plan import make_plan, write_flight_record
from velfield.pipeline.stage import STAGES, stages_before
from velfield.pipeline.units import prepare_stage, stage_units
from velfield.sources.folder import list_images
from velfield.synthetic.cases import small_flight
from velfield.synthetic.flight import Flight

KINDS = {
    "blurred": "is blurred",
    "unlike its neighbours": "is unlike the frames around it",
    "suspect": "bitstream corrupt",
    "cut": "the picture changes completely",
    "dark": "the flight is dark",
    "fog": "as in fog",
    "oblique": "looks at the ground obliquely",
    "zoom": "the camera zoomed or changed its height",
    "turn": "turned to or from the horizon",
}
"""Each warning, and words of it."""
FRAMES, SIZE = 12, (640, 480)
Frames = Sequence[GreyImage]


def flight(seed: int, fps: float = 5.0, **camera: float) -> Flight:
    """A simulated flight of a city."""
    times = TimesSimulation(fps=fps, late_half_share=0, late_whole_share=0)
    width, height = SIZE
    return small_flight(
        frames=FRAMES, width=width, height=height, seed=seed, times=times, camera=CameraSimulation(**camera)
    )


def frames_of(seed: int, **settings: float) -> list[GreyImage]:
    """The flight's frames."""
    simulated = flight(seed, **settings)
    return [simulated.frame(k) for k in range(FRAMES)]


def _dark(seed: int) -> Frames:
    return [np.clip(6 + 0.1 * frame, 0, 255).astype(np.uint8) for frame in frames_of(seed)]


def _foggy(seed: int) -> Frames:
    frames = frames_of(seed)
    return [np.clip(150 + 0.1 * cv2.GaussianBlur(frame, (0, 0), 2), 0, 255).astype(np.uint8) for frame in frames]


def _cut(seed: int) -> Frames:
    return [*frames_of(seed)[:6], *frames_of(seed + 5000)[:6]]


def _one_blurred(seed: int) -> Frames:
    frames = frames_of(seed)
    return [*frames[:5], cv2.GaussianBlur(frames[5], (0, 0), 3), *frames[6:]]


def _one_foreign(seed: int) -> Frames:
    frames = frames_of(seed)
    return [*frames[:5], frames_of(seed + 5000)[0], *frames[6:]]


def _zoomed(seed: int) -> Frames:
    """The last third magnified by 1.3 about the middle."""
    width, height = SIZE
    matrix = np.array([[1.3, 0, -0.15 * width], [0, 1.3, -0.15 * height]])
    return [cv2.warpAffine(frame, matrix, SIZE) if k >= 8 else frame for k, frame in enumerate(frames_of(seed))]


def _turned(seed: int) -> Frames:
    """The last third seen 30 degrees away from the vertical."""
    width, height = SIZE
    focal, tilt = 1.25 * width, np.radians(30.0)
    camera = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    turn = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    matrix = camera @ turn @ np.linalg.inv(camera)
    shift = matrix @ np.array([width / 2, height / 2, 1.0])
    back = np.array([[1, 0, width / 2 - shift[0] / shift[2]], [0, 1, height / 2 - shift[1] / shift[2]], [0, 0, 1.0]])
    warped = back @ matrix
    return [cv2.warpPerspective(frame, warped, SIZE) if k >= 8 else frame for k, frame in enumerate(frames_of(seed))]


CASES: dict[str, tuple[Callable[[int], Frames], str]] = {
    "sound": (frames_of, ""),
    "sound, a video of 25 frames a second": (lambda seed: frames_of(seed, fps=25.0), ""),
    "night": (_dark, "dark"),
    "fog": (_foggy, "fog"),
    "a cut": (_cut, "cut"),
    "one blurred frame": (_one_blurred, "blurred"),
    "one foreign frame": (_one_foreign, "unlike its neighbours"),
    "zoom by 1.3": (_zoomed, "zoom"),
    "a turn by 30 degrees": (_turned, "turn"),
    "oblique by 40 degrees": (lambda seed: frames_of(seed, mean_tilt_deg=40.0), "oblique"),
}
"""Flights by seed, and the warning that belongs to them."""


def warnings_of(source: Path, folder: Path, *settings: str) -> list[str]:
    """All warnings of a flight up to its registration; the refusal where it is refused."""
    config = resolve_config(settings=["work.previews=false", *settings])
    found: list[str] = []
    try:
        plan = make_plan(Job(root=str(folder / "run"), inputs=Inputs(source=str(source)), config=config))
        found += plan.info.warnings
        write_flight_record(plan)
        for stage in STAGES:
            if stage.name in (*stages_before("registration"), "registration"):
                prepare_stage(plan, stage)
                for unit in stage_units(plan, stage):
                    found += unit_graph(plan, stage, unit).compute(scheduler="synchronous").warnings
    except InputError as error:
        found.append(f"refused: {error}")
    return found


def kinds_of(warnings: Sequence[str]) -> set[str]:
    """The kinds of these warnings; others by their first words."""
    found = set()
    for line in warnings:
        named = [kind for kind, words in KINDS.items() if words in line]
        found |= set(named) if named else {" ".join(line.split()[:6])}
    return found


def main() -> None:
    """Make each flight, run it, count its warnings."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, nargs="*", default=list(range(651, 661)))
    parser.add_argument("--cases", nargs="+", default=list(CASES))
    parser.add_argument("--real", type=Path, default=None)
    given = parser.parse_args()
    for name in given.cases if given.seeds else ():
        make, expected = CASES[name]
        counts: Counter[str] = Counter()
        for seed in given.seeds:
            with tempfile.TemporaryDirectory() as temporary:
                folder = Path(temporary)
                if "video" in name:
                    source, settings = write_video(folder / "v.mp4", list(make(seed))), ["frames.every=1"]
                else:
                    source, settings = folder / "frames", ["frames.every=1", "frames.fps=5"]
                    write_images(source, make(seed))
                counts.update(kinds_of(warnings_of(source, folder, *settings)))
        right = f"{counts.pop(expected, 0)} of {len(given.seeds)} told; " if expected else ""
        others = ", ".join(f"{kind} {count}" for kind, count in counts.most_common()) or "none"
        print(f"{name}: {right}other warnings over {len(given.seeds)} flights: {others}", flush=True)
    for name, paths in real_flights(given.real) if given.real else ():
        with tempfile.TemporaryDirectory() as temporary:
            source = paths[0] if len(paths) == 1 and paths[0].suffix == ".mp4" else Path(temporary) / "frames"
            if source.suffix != ".mp4":
                source.mkdir()
                for path in paths:
                    shutil.copy(path, source / path.name)
            settings = () if source.suffix == ".mp4" else ("frames.fps=5", "frames.every=1")
            print(f"{name}: {sorted(kinds_of(warnings_of(source, Path(temporary), *settings))) or 'none'}", flush=True)


def real_flights(folder: Path) -> list[tuple[str, list[Path]]]:
    """Videos, and images of one prefix in folders of at least three."""
    found = [(str(path.relative_to(folder)), [path]) for path in sorted(folder.rglob("*.mp4"))]
    for inner in sorted(path for path in folder.rglob("*") if path.is_dir()):
        try:
            names = list_images(inner)
        except InputError:
            continue
        groups: dict[str, list[Path]] = {}
        for name in names:
            groups.setdefault(name.rsplit("-", 1)[0] if "-" in name else "", []).append(inner / name)
        found += [
            (f"{inner.relative_to(folder)} {prefix}", paths) for prefix, paths in groups.items() if len(paths) > 2
        ]
    return found


if __name__ == "__main__":
    main()
