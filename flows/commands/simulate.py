"""``velfield simulate``: a flight over a city whose truth is known."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from flows.commands.start import own_command
from flows.options import DONE, FrameSize, Quiet, Seed, parse_frame_size
from velfield.errors import InputError

if TYPE_CHECKING:
    from schemas.simulation import SimulationConfig


def simulate(
    out: Path,
    /,
    *,
    frames: int = 300,
    size: FrameSize = "1280x960",
    seed: Seed = 0,
    clip: Literal["beside", "embedded"] | None = None,
    tracks: float | None = None,
    quiet: Quiet = False,
) -> int:
    """Simulate a flight over a city, with ground truth: writes frames/, timestamps.csv, base.png, labels.csv, truth/.

    Parameters
    ----------
    out
        Folder to write to.
    frames
        Number of frames.
    clip
        Write a drone clip DJI_0001.MP4 (25 frames per second) instead of frames/.
        Its telemetry is `beside` it, in a file DJI_0001.SRT, or `embedded` in the clip.
    tracks
        Write no frames, but OUT/tracks.csv: what a tracker sees of the vehicles in so many minutes.
    """
    if tracks is not None:
        if clip is not None:
            raise InputError("--tracks writes no frames; leave out --clip")
        return _simulate_tracks(out, tracks, size, seed)
    write_simulation(out, frames=frames, size=size, seed=seed, quiet=quiet, clip=clip)
    if clip is not None:
        print(f"{out}: try  {own_command()} run {out}/DJI_0001.MP4 --out RUN")
        return DONE
    given = f"--timestamps {out}/timestamps.csv --base {out}/base.png --labels {out}/labels.csv --gsd-m 0.23"
    print(f"{out}: try  {own_command()} run {out}/frames {given} --out RUN")
    return DONE


def _simulate_tracks(out: Path, minutes: float, size: str, seed: int) -> int:
    from schemas.simulation import TimesSimulation
    from velfield.synthetic.write import write_tracks

    path, frames = out / "tracks.csv", round(minutes * 60 * TimesSimulation().fps)
    vehicles = write_tracks(path, _configure((f"--tracks {minutes:g}", frames), size, seed))
    print(f"{path}: {vehicles} vehicles")
    analysis = shlex.quote(str(out / "analysis"))
    print(f"try  {own_command()} analyse --tracks {shlex.quote(str(path))} --y-axis down --out {analysis}")
    return DONE


def _configure(frames: tuple[str, int], size: str, seed: int) -> "SimulationConfig":
    """``frames``: the option that gave their number, and the number."""
    from schemas.simulation import SimulationConfig
    from velfield.pipeline.configuration import from_options

    width, height = parse_frame_size(size, "as 1280x960")
    options = {
        "frames": frames,
        "width": (f"--size {size}", width),
        "height": (f"--size {size}", height),
        "seed": (f"--seed {seed}", seed),
    }
    return from_options(SimulationConfig, options)


def write_simulation(
    out: Path,
    *,
    frames: int,
    size: str,
    seed: int,
    quiet: bool,
    clip: Literal["beside", "embedded"] | None = None,
    fps: float = 25.0,
) -> None:
    """Write a simulated flight, or a clip of it, with progress."""
    from flows.console import Console
    from velfield.synthetic.write import write_flight

    config = _configure((f"--frames {frames}", frames), size, seed)
    config = config if clip is None else config.as_clip(clip, fps=fps)
    console = Console("quiet" if quiet else "normal")
    with console.stage("simulate", "simulate", frames) as progress:
        write_flight(out, config, lambda done, _total: progress.at_least(done))
    console.event("stage", f"simulated     {frames} frames of {config.width} x {config.height} px in {out}")
