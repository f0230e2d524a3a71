"""``velfield demo``: the whole job on a simulated clip."""

import shlex
from pathlib import Path

from flows.commands.start import own_command
from flows.options import DONE, INCOMPLETE, FrameSize, Quiet, Seed


def demo(
    *,
    out: Path = Path("velfield-demo"),
    frames: int = 120,
    size: FrameSize = "800x600",
    seed: Seed = 1,
    quiet: Quiet = False,
) -> int:
    """Simulate a drone clip, process it with nothing else given, analyse it, and compare it with its ground truth.

    Parameters
    ----------
    out
        Folder to write to.
    frames
        Number of frames.
    """
    from flows.commands.analyse import analyse
    from flows.commands.run import process
    from flows.commands.simulate import write_simulation
    from flows.launch import kernels_beside, prepare_process
    from schemas.job import Inputs, Job
    from velfield.pipeline.configuration import resolve_config
    from velfield.synthetic.clip import CLIP_NAME
    from velfield.synthetic.run_score import score_run

    prepare_process(verbose=False)
    flight, run = out / "flight", out / "run"
    with kernels_beside():
        # Ten frames a second: twice what a run uses, and two fifths of what a drone's clip takes to render.
        write_simulation(flight, frames=frames, size=size, seed=seed, quiet=quiet, clip="beside", fps=10.0)
        config = resolve_config(preset="fast")
        inputs = Inputs(source=str(flight / CLIP_NAME))
        status = process(Job(root=str(run), inputs=inputs, config=config), verbosity="quiet" if quiet else "normal")
    if status in (DONE, INCOMPLETE):
        analyse(run)
        print(score_run(run, flight, min_count=1).text())
        if not quiet:
            print(f"the map:    {own_command()} view {shlex.quote(str(run))}")
            print(f"the report: {run / 'analysis' / 'report.html'}")
            print(f"minutes of traffic: {own_command()} simulate MINUTES --tracks 6")
            print(f"your own clip: {own_command()} run VIDEO --out RUN")
    return status
