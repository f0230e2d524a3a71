"""How many files a reader opens who follows one frame from the video to the field."""

import sys
from pathlib import Path
from types import FrameType
from typing import Any

from schemas.job import Inputs, Job
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.graphs import unit_graph
from velfield.pipeline.plan import make_plan, write_flight_record
from velfield.pipeline.stage import STAGES
from velfield.pipeline.units import prepare_stage, stage_units

ROOT = Path(__file__).resolve().parents[2]
MAX_FILES = 57
ON_THE_WAY = ("frames", "quality", "registration", "detections", "tracklets", "tracks", "field")


def test_a_frame_passes_few_files(flight: Path, tmp_path: Path) -> None:
    """Files of which a function is called, the detector being there; its file is the one that ships."""
    seen: set[str] = set()
    compiling = 0  # where no cache of kernels is there, what builds their instructions is called too

    def note(frame: FrameType, event: str, _: Any) -> None:
        nonlocal compiling
        file = frame.f_code.co_filename
        if frame.f_code.co_name == "_compile_for_args" and event in ("call", "return"):
            compiling += 1 if event == "call" else -1
        if (
            event == "call"
            and not compiling
            and frame.f_code.co_name != "<module>"
            and file.startswith((f"{ROOT}/velfield", f"{ROOT}/sch"))
        ):
            seen.add(file.removeprefix(f"{ROOT}/"))

    detector = str(ROOT / "velfield" / "detection" / "shipped_detector.json")
    inputs = Inputs(source=str(flight / "frames"), timestamps=str(flight / "timestamps.csv"), detector=detector)
    config = resolve_config(overrides={"gsd_m": 0.23, "frames.stop_s": 1.0}, settings=["lens.refine=never"])
    plan = make_plan(Job(root=str(tmp_path / "run"), inputs=inputs, config=config))
    write_flight_record(plan)
    for stage in STAGES:
        prepare_stage(plan, stage)
        for unit in stage_units(plan, stage):
            graph = unit_graph(plan, stage, unit)
            sys.setprofile(note if stage.name in ON_THE_WAY else None)
            try:
                graph.compute(scheduler="synchronous")
            finally:
                sys.setprofile(None)
    assert "velfield/tracking/gates.py" in seen
    assert "velfield/field/accumulate.py" in seen
    assert len(seen) <= MAX_FILES, sorted(seen)
