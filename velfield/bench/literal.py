"""The paper's chain read literally, on a few frames: what it costs a frame beside this version's.

The preset `paper` does what the paper describes, but for its detector's response, which is summed at every second pixel
in 16 bits. Read literally, all rounds are summed at every pixel: by whole rows in a compiled loop, or by array
expressions, as one would write it first. Both are timed on a frame and put in the place of the preset's response.
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from schemas.job import Inputs, Job
from velfield.bench.detection import plain_response, random_stumps, row_response
from velfield.detection.registry import load_detector
from velfield.paper.detector import PaperDetector
from velfield.paper.response import dense_response
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import Plan, make_plan, write_flight_record
from velfield.pipeline.stage import STAGE, stages_before
from velfield.run.stores import open_frames

FRAMES = 4
_SETTINGS = {"gsd_m": 0.23, "registration.max_residual_px": 12.0}
"""A polyprojective model alone leaves more of a rolling shutter than a run would accept; here its cost counts."""
_FEW_ROUNDS = 10


@dataclass(frozen=True)
class LiteralChain:
    """Seconds of processor a frame: the preset's stages, and its detector's response three ways."""

    stages: dict[str, float]
    response: float
    response_rows: float
    response_arrays: float

    def text(self, ours_s: float) -> list[str]:
        """Lines for people; ``ours_s`` is this version's cost of the same stages a frame."""
        total = sum(self.stages.values())
        parts = ", ".join(f"{name} {seconds:.2f}" for name, seconds in self.stages.items())
        lines = [f"the paper's chain, s a frame and core: {parts}"]
        for name, response in (
            ("its response at every second pixel (preset paper)", self.response),
            ("at every pixel, compiled rows", self.response_rows),
            ("at every pixel, array expressions", self.response_arrays),
        ):
            chain = total - self.response + response
            lines.append(f"  {name}: {chain:.2f} s a frame; ours {ours_s:.2f} s: {chain / ours_s:.3g} times")
        return lines


def time_literal_chain(flight: Path, root: Path, stages: Iterable[str], frames: int = FRAMES) -> LiteralChain:
    """Run the preset `paper` on the first frames of a simulated flight, and time its stages and its response."""
    plan = _paper_plan(flight, root, frames)
    names = list(stages)
    seconds: dict[str, float] = {}
    for name in stages_before("tracks"):
        start = time.process_time()
        compute_stages(plan, [name])
        seconds[name] = time.process_time() - start
    assert set(names) <= set(STAGE)
    image = open_frames(plan.layout.frames).read(0)
    detector = load_detector(plan.layout.detector)
    assert isinstance(detector, PaperDetector), "the preset paper trains the paper's detector"
    stumps, bits = detector.stumps, detector.record.grey_bits
    few = random_stumps(_FEW_ROUNDS)
    share = len(stumps.rectangles) / len(few.rectangles)
    return LiteralChain(
        {name: seconds[name] / plan.frame_count for name in names},
        _seconds(lambda: dense_response(image, stumps, grey_bits=bits)),
        _seconds(lambda: row_response(image, stumps, bits)),
        share * _seconds(lambda: plain_response(image, few)),
    )


def _paper_plan(flight: Path, root: Path, frames: int) -> Plan:
    inputs = Inputs.from_simulated_flight(flight)
    config = resolve_config(preset="paper", overrides=_SETTINGS)
    whole = make_plan(Job(root=str(root), inputs=inputs, config=config))
    if frames < whole.frame_count:
        before_s, next_s = whole.info.times_s[whole.indices[frames - 1 : frames + 1]] - whole.info.times_s[0]
        config = resolve_config(preset="paper", overrides=_SETTINGS | {"frames.stop_s": float(before_s + next_s) / 2})
    plan = make_plan(Job(root=str(root), inputs=inputs, config=config))
    write_flight_record(plan)
    return plan


def _seconds(work: Callable[[], object]) -> float:
    """Processor time of the second call; the first one compiles."""
    work()
    start = time.process_time()
    work()
    return time.process_time() - start
