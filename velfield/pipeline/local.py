"""The whole job without Prefect, stage after stage: for benchmarks, and to have the kernels compiled.

    python -m velfield.pipeline.local

does a tiny job and throws it away: what numba compiles on the way is kept beside the modules, and a first real run that
is under way finds it there.
"""

import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path

from schemas.job import Inputs, Job
from schemas.simulation import SimulationConfig
from velfield.pipeline import graphs
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.plan import Plan, make_plan, write_flight_record
from velfield.pipeline.stages.field import field_groups, lay_out_field
from velfield.pipeline.stages.frames import lay_out_frames
from velfield.pipeline.stages.registration import lay_out_registration
from velfield.run.layout import STAGES

_LAY_OUT: dict[str, Callable[[Plan], None]] = {
    "frames": lay_out_frames,
    "registration": lay_out_registration,
    "field": lay_out_field,
}
_BY_FRAMES = {
    "frames": graphs.frames_graph,
    "registration": graphs.registration_graph,
    "detections": graphs.detections_graph,
    "tracklets": graphs.tracklets_graph,
}
_WHOLE = {
    "lens": graphs.lens_graph,
    "base": graphs.base_graph,
    "detector": graphs.detector_graph,
    "maps": graphs.maps_graph,
}
_TINY = SimulationConfig(frames=9, width=480, height=360, seed=3)
_QUICK = {"detection.rounds": 8, "detection.feature_pool": 40, "registration.key_points": 800, "gsd_m": 0.23}


def compute_stages(plan: Plan, stages: Iterable[str] = STAGES) -> None:
    """Compute stages one after another on this thread; what is finished is done again."""
    for stage in stages:
        if stage in _LAY_OUT:
            _LAY_OUT[stage](plan)
        for unit in _units(plan, stage):
            unit.compute(scheduler="synchronous")


def _units(plan: Plan, stage: str) -> list[graphs.Graph]:
    if stage in _BY_FRAMES:
        return [_BY_FRAMES[stage](plan, unit) for unit in plan.units]
    if stage in _WHOLE:
        return [_WHOLE[stage](plan)]
    if stage == "tracks":
        return [graphs.tracks_graph(plan, plan.units)]
    return [graphs.field_graph(plan, group) for group in field_groups(plan)]


def compile_kernels() -> None:
    """Do a tiny job on a simulated flight, from its first frame to its maps."""
    from velfield.synthetic import write_flight

    with tempfile.TemporaryDirectory(prefix="velfield-kernels-") as folder:
        flight = Path(folder) / "flight"
        write_flight(flight, _TINY)
        inputs = Inputs(
            source=str(flight / "frames"),
            timestamps=str(flight / "timestamps.csv"),
            base=str(flight / "base.png"),
            labels=str(flight / "labels.csv"),
        )
        config = resolve_config(preset="fast", overrides=_QUICK)
        plan = make_plan(Job(root=str(Path(folder) / "run"), inputs=inputs, config=config))
        write_flight_record(plan)
        compute_stages(plan)


if __name__ == "__main__":
    compile_kernels()
