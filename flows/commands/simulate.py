"""``velfield simulate``: a flight over a city whose truth is known."""

from pathlib import Path
from typing import Literal

from flows.commands.start import own_command
from flows.options import DONE, FrameSize, Quiet, Seed, parse_frame_size


def simulate(
    out: Path,
    /,
    *,
    frames: int = 300,
    size: FrameSize = "1280x960",
    seed: Seed = 0,
    clip: Literal["beside", "embedded"] | None = None,
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
    """
    write_simulation(out, frames=frames, size=size, seed=seed, quiet=quiet, clip=clip)
    if clip is not None:
        print(f"{out}: try  {own_command()} run {out}/DJI_0001.MP4 --out RUN")
        return DONE
    given = f"--timestamps {out}/timestamps.csv --base {out}/base.png --labels {out}/labels.csv --gsd-m 0.23"
    print(f"{out}: try  {own_command()} run {out}/frames {given} --out RUN")
    return DONE


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
    from schemas.simulation import SimulationConfig
    from velfield.pipeline.configuration import from_options
    from velfield.synthetic.write import write_flight

    width, height = parse_frame_size(size, "as 1280x960")
    console = Console("quiet" if quiet else "normal")
    options = {
        "frames": (f"--frames {frames}", frames),
        "width": (f"--size {size}", width),
        "height": (f"--size {size}", height),
        "seed": (f"--seed {seed}", seed),
    }
    config = from_options(SimulationConfig, options)
    config = config if clip is None else config.as_clip(clip, fps=fps)
    with console.stage("simulate", "simulate", frames) as progress:
        write_flight(out, config, lambda done, _total: progress.at_least(done))
    console.event("stage", f"simulated     {frames} frames of {width} x {height} px in {out}")
