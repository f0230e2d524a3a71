"""Killed at random moments, resumed by the same command: the same bits, and no run that seems to run for ever."""

from pathlib import Path

import pytest

from tests.kills import run_with_kills
from tests.small_flight import digests
from velfield.run.layout import RunLayout
from velfield.run.results import link_shared_outputs

SEED = 0


def test_two_kills_and_the_same_bits(
    whole: Path, flight: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from prefect.client.orchestration import get_client
    from prefect.settings import PREFECT_API_URL

    monkeypatch.setenv("PREFECT_API_URL", str(PREFECT_API_URL.value()))  # the session's server: none of its own
    # Lens, base image and detector take longest and are one unit each: `make soak` kills those too.
    link_shared_outputs(RunLayout(whole), RunLayout(tmp_path / "run"), ("lens", "base", "detector"))
    print(f"seed {SEED}")
    met = run_with_kills(flight, tmp_path / "run", 2, seed=SEED)
    assert met == 2
    assert digests(tmp_path / "run") == digests(whole)
    with get_client(sync_client=True) as client:
        runs = client.read_flow_runs()
        states = [run.state_name for run in runs if run.parameters.get("run_folder") == str(tmp_path / "run")]
    # A kill in the first seconds leaves no flow run at all, one in the last a run that is done.
    assert set(states) == {"Completed", "Crashed"}
