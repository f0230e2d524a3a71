"""A process that is killed leaves nothing running behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

_STARTS_A_CHILD = """if True:
    import subprocess, sys, time
    from flows.stopping import end_children_when_killed
    end_children_when_killed()
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], start_new_session=True)
    print(child.pid, flush=True)
    {then}
"""


@pytest.mark.parametrize("kill", [True, False], ids=["killed", "ended"])
def test_what_a_process_started_ends_with_it(kill: bool) -> None:
    checkout = str(Path(__file__).parents[2])
    with subprocess.Popen(
        [sys.executable, "-c", _STARTS_A_CHILD.format(then="time.sleep(60)" if kill else "pass")],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": checkout},
        text=True,
    ) as process:
        child = psutil.Process(int(process.stdout.readline()))
        with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"]) as bystander:
            try:
                if kill:
                    process.send_signal(signal.SIGKILL)
                _, alive = psutil.wait_procs([child], timeout=20)
                assert alive == []
                assert bystander.poll() is None
            finally:
                bystander.kill()


def test_ctrl_c_is_answered(tmp_path: Path) -> None:
    flight = str(tmp_path / "flight")
    command = [sys.executable, "-m", "flows.cli", "simulate", flight, "--frames", "500", "--size", "640x480"]
    checkout = str(Path(__file__).parents[2])
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, env={**os.environ, "PYTHONPATH": checkout}, text=True
    ) as process:
        deadline = time.monotonic() + 60
        while not list(tmp_path.glob("flight/frames/*")) and time.monotonic() < deadline:
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        _, text = process.communicate(timeout=60)
    assert process.returncode == 130
    assert text.strip().splitlines()[-1] == "velfield: stopped"
