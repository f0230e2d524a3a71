"""SIGKILL at random moments: `make soak` runs this fifty times, the tests two: one of them SIGTERM.

python -m tests.kills [--kills 50]
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from flows.stopping import STOPPED
from tests.small_flight import digests, job, process

_RUN = """if True:
    import sys
    from flows.launch import limit_threads, prepare_process
    from flows.stopping import STOPPED, leave, stop_on_signals
    limit_threads()
    try:
        prepare_process(verbose=False)
        stop_on_signals()
        from pathlib import Path
        from tests.small_flight import job, process
        process(job(Path(sys.argv[1]), Path(sys.argv[2])))
    except KeyboardInterrupt:
        leave(STOPPED)
"""


def run_with_kills(flight: Path, root: Path, kills: int, seed: int) -> int:
    """A run of the small flight, killed so many times, each time a little after a random number of commits, then left.

    The last one gets SIGTERM and must end within seconds, the others are killed.

    Returns how many kills met a run that was under way.
    """
    rng = np.random.default_rng(seed)
    met = 0
    before = len(list(root.glob("commits/*/*.json")))
    for kill, commits in enumerate(np.sort(rng.integers(before, 20, kills))):
        with _started(flight, root) as child:
            while child.poll() is None and len(list(root.glob("commits/*/*.json"))) < commits:
                time.sleep(0.02)
            time.sleep(float(rng.uniform(0, 1.5)))
            met += child.poll() is None
            if child.poll() is None and kill == kills - 1:
                child.terminate()
                status = child.wait(30)
                # With 0 where it was done that moment, by the signal where the handler was not yet installed.
                assert status in (STOPPED, 0, -signal.SIGTERM), status
            elif child.poll() is None:
                os.killpg(child.pid, signal.SIGKILL)
    with _started(flight, root) as child:
        assert child.wait(600) == 0
    return met


def _started(flight: Path, root: Path) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-c", _RUN, str(flight), str(root)]
    checkout = str(Path(__file__).parents[1])  # named: a process that has set up Prefect leaves PYTHONSAFEPATH behind
    environment = {**os.environ, "PYTHONPATH": checkout}
    return subprocess.Popen(command, cwd=checkout, env=environment, start_new_session=True)


def main() -> None:
    """Kill until so many kills have met a run, five a run; check that all results are equal."""
    from flows.launch import prepare_process
    from schemas.simulation import SimulationConfig
    from tests.small_flight import FRAMES
    from velfield.synthetic.write import write_flight

    parser = argparse.ArgumentParser()
    parser.add_argument("--kills", type=int, default=50)
    wanted, met, rounds = parser.parse_args().kills, 0, 0
    prepare_process(verbose=False)
    folder = Path(tempfile.mkdtemp(prefix="velfield-kills-"))  # kept where a result differs, for inspection
    flight = folder / "flight"
    write_flight(flight, SimulationConfig(frames=FRAMES, width=640, height=480, seed=11))
    process(job(flight, folder / "whole"))
    whole = digests(folder / "whole")
    while met < wanted:
        root = folder / f"round-{rounds}"
        met += run_with_kills(flight, root, 5, rounds)
        after = digests(root)
        others = sorted(name for name in whole.keys() | after.keys() if whole.get(name) != after.get(name))
        assert not others, f"{root} differs from {folder / 'whole'} in {', '.join(others)}"
        rounds += 1
        print(f"{met} kills in {rounds} runs: all results equal", flush=True)
    shutil.rmtree(folder)


if __name__ == "__main__":
    main()
