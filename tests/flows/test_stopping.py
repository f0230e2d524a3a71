"""A process that is killed leaves nothing running behind, and one that is stopped ends as it says."""

import os
import signal
import subprocess
import sys
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


_IS_STOPPED_IN_AN_EXEC = """if True:
    import time
    from flows.stopping import as_ctrl_c
    as_ctrl_c()
    try:
        exec("print('ready', flush=True); time.sleep(60)")  # as while a module with dataclasses is imported
    except KeyboardInterrupt:
        print("stopped")
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_an_interrupt_that_is_caught_leaves_the_status_alone(number: signal.Signals) -> None:
    command = [sys.executable, "-c", _IS_STOPPED_IN_AN_EXEC]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(number)
        assert process.stdout.read() == "stopped\n"
        assert process.wait(20) == 0
