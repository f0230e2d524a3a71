"""The detector of a flight: given, learnt from marked cars, or learnt from what moves; and the grid cars are looked
for on."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from schemas.records import WorkingRecord
from velfield.detection.cnn.self_training import network_of_motion
from velfield.detection.detector import Detector, load_detector, shipped_detector
from velfield.detection.evaluation import thinned_curve
from velfield.detection.motion.difference import MotionBackground, MotionFrame, motion_background
from velfield.detection.motion.evidence import MotionEvidence, evidence_of, neighbours
from velfield.detection.motion.labels import MotionLabels, choose_frames, labels_from_motion, working_scale
from velfield.detection.train import LabelledImage, train_detector
from velfield.errors import InputError
from velfield.pipeline.plan import Plan
from velfield.pipeline.progress import advance
from velfield.pipeline.result import Outcome
from velfield.pipeline.stages.external_detections import given_boxes
from velfield.pipeline.stages.labels import (
    base_px_per_raw_px,
    car_length_raw_px,
    labelled_images,
    marked_cars,
    odd_length,
)
from velfield.pipeline.stages.rectified_frames import WorkingGrid, write_background
from velfield.pipeline.stages.registration import usable_frames
from velfield.run.commits import write_atomically
from velfield.run.grid import read_grid
from velfield.run.stores import open_frames

_TRAINING_FRAMES, _NETWORK_FRAMES = 6, 12
_NETWORK_VEHICLES = 20
"""Of fewer that move the network would learn these ones."""
_EVIDENCE_BURSTS = 6
_MOST_FRAMES = 0.5
"""Share of the frames that another program's boxes are expected to be in."""


def make_detector(plan: Plan) -> Outcome:
    """Choose the working grid, make the background, and train or load the detector."""
    if plan.job.inputs.detections:
        return _from_detections(plan)
    if plan.job.inputs.detector:
        return _from_file(plan)
    if plan.job.inputs.labels:
        return _from_labels(plan)
    return _from_motion(plan)


def _from_file(plan: Plan) -> Outcome:
    """A detector trained before; the background of this flight, where it looks at the difference to one."""
    detector, scale = load_detector(Path(plan.job.inputs.detector or "")), _known_scale(plan)
    background = motion_background(_motion_frames(plan, scale)) if detector.uses_background else None
    return _finish(plan, detector, scale, "file", background=background)


def _from_detections(plan: Plan) -> Outcome:
    """Another program's boxes are taken; their size tells the working scale where ``--gsd-m`` does not."""
    boxes, scale = given_boxes(plan), _scale_of_gsd(plan)
    if scale is None:
        scale = _scale_of_length(plan, car_length_raw_px(boxes), base_px_per_raw_px(plan))
    outcome = _finish(plan, None, 1.0 if scale is None else scale, "detections")
    warnings = []
    if scale is None:
        usual = plan.config.detection.working_car_length_px
        told = "the size of a car is not known: found no --gsd-m and boxes without a length"
        warnings.append(f"{told}; taken for {usual:g} px, give one")
    named = int(np.isin(plan.indices, boxes["source_index"]).sum())
    if named < _MOST_FRAMES * plan.frame_count:
        told = f"--detections has boxes in {named} of the {plan.frame_count} frames worked on"
        warnings.append(f"{told}: the others count as free of cars; give boxes of all frames, or use it as --labels")
    unused = [f"--{name}" for name in ("labels", "detector") if getattr(plan.job.inputs, name)]
    if unused:
        warnings.append(f"--detections is given, so nothing is learnt or looked for: {' and '.join(unused)} not used")
    return Outcome(outcome.outputs, outcome.counts, outcome.notes, warnings)


def _scale_of_length(plan: Plan, length_raw_px: float, base_per_raw: float) -> float | None:
    """Working px a base px, from a car's usual length in raw px; none where that is not known."""
    if not np.isfinite(length_raw_px):
        return None
    return plan.config.detection.working_car_length_px / (length_raw_px * base_per_raw)


def _scale_of_gsd(plan: Plan) -> float | None:
    gsd_m = read_grid(plan.layout).gsd_m
    return None if gsd_m is None else working_scale(plan.config.detection, gsd_m)


def _known_scale(plan: Plan) -> float:
    scale = _scale_of_gsd(plan)
    if scale is None:
        raise InputError("the size of a car is not known: a detector file needs --gsd-m (metres a base pixel)")
    return scale


def _from_labels(plan: Plan) -> Outcome:
    labels = marked_cars(plan)
    base_per_raw = base_px_per_raw_px(plan)
    length_px = car_length_raw_px(labels.cars)
    scale = _scale_of_gsd(plan) or _scale_of_length(plan, length_px, base_per_raw)
    if scale is None:
        raise InputError(
            "the size of a car is not known: the labels have no length_px and --gsd-m is not given; give either"
        )
    source, work_per_raw = Path(plan.job.inputs.source), scale * base_per_raw
    samples = list(labelled_images(source, plan.info, labels, work_per_raw=work_per_raw))
    detector = train_detector(samples, plan.config.detection)
    outcome = _finish(plan, detector, scale, "labels", count=len(labels.cars))
    return replace(outcome, warnings=odd_length(length_px * base_per_raw, read_grid(plan.layout).gsd_m))


def _from_motion(plan: Plan) -> Outcome:
    known = _scale_of_gsd(plan)
    scale = known or 1.0
    frames = _motion_frames(plan, scale)
    background = motion_background(frames)
    wanted = plan.config.detection.working_car_length_px
    near_s = plan.config.tracking.max_interval_s
    labels = labels_from_motion(frames, background, car_length_px=wanted if known else None, max_interval_s=near_s)
    if known is None and labels.usable:
        scale = working_scale(plan.config.detection, None, labels, labels_scale=scale)
        frames = _motion_frames(plan, scale)
        background = motion_background(frames)
        labels = labels_from_motion(frames, background, car_length_px=wanted, max_interval_s=near_s)
    if not labels.usable:
        return _without_labels(plan, known, labels)
    detector = _by_motion(plan, frames, labels, background)
    return _finish(plan, detector, scale, "motion", count=labels.count, motion=labels, background=background)


def _by_motion(plan: Plan, frames: list[MotionFrame], labels: MotionLabels, background: MotionBackground) -> Detector:
    """A detector of cars that move: by their looks alone where these tell them, so that it finds what stands too.

    By the difference to the background what waits at a light for long, and is in the background, is not found: in a
    simulated city .79 of the cars that move at some time, .91 by their looks. Where looks do not tell them, the network
    that ships knows more of what stands; of few vehicles the boosted classifier makes more.
    """
    config = plan.config.detection
    samples = _samples(frames, labels, background, _TRAINING_FRAMES)
    shipped = shipped_detector()
    has_network = config.method == "network" and config.working_car_length_px == shipped.record.working_car_length_px
    if has_network:
        # What moves is hundreds of labels, of which the boosted classifier learns as much, and is four times as fast.
        config = config.model_copy(update={"method": "aligned"})
    if config.motion_channel == "auto":
        by_looks = train_detector(samples, config.model_copy(update={"motion_channel": "never"}))
        evidence = _evidence(plan, by_looks, frames, background)
        if evidence.tells_cars(_usual_score(by_looks)):
            return by_looks if config.threshold is not None else _judged(by_looks, evidence)
    if has_network and config.motion_channel != "never" and labels.vehicles >= _NETWORK_VEHICLES:
        learnt = network_of_motion(
            _samples(frames, labels, background, _NETWORK_FRAMES),
            shipped,
            _bursts(plan, frames),
            background.median,
            plan.config.detection,
            max_interval_s=plan.config.tracking.max_interval_s,
        )
        if learnt is not None:
            return learnt
    detector = train_detector(samples, config)
    if config.threshold is not None:
        return detector
    return _judged(detector, _evidence(plan, detector, frames, background))


def _usual_score(detector: Detector) -> float:
    """Half of the cars that were left out of training are liked better; without end where too few were."""
    curve = detector.curve
    if curve is None or not curve.recall or curve.recall[-1] < 0.5:
        return float("inf")
    return float(np.interp(0.5, curve.recall, curve.threshold))


def _evidence(
    plan: Plan, detector: Detector, frames: list[MotionFrame], background: MotionBackground
) -> MotionEvidence:
    median = background.median if detector.uses_background else None
    near_s = plan.config.tracking.max_interval_s
    return evidence_of(detector, _bursts(plan, frames), median, plan.config.detection, max_interval_s=near_s)


def _bursts(plan: Plan, frames: list[MotionFrame]) -> list[MotionFrame]:
    """Bursts of three frames, in which it shows how what is found moves."""
    chosen = neighbours([frame.time_s for frame in frames], _EVIDENCE_BURSTS, plan.config.tracking.max_interval_s)
    return [frames[k] for k in chosen]


def _judged(detector: Detector, evidence: MotionEvidence) -> Detector:
    """The detector with the threshold at which what it finds moves as cars do; as it is where too few move to tell."""
    if not np.isfinite(evidence.chosen):
        return detector
    told = "how detections in bursts of three frames move: along their axis, at one velocity, or not"
    curve = thinned_curve(evidence.precision, evidence.recall, evidence.threshold, evidence.at, told)
    return Detector(detector.record.model_copy(update={"threshold": evidence.chosen, "curve": curve}))


def _samples(
    frames: list[MotionFrame], labels: MotionLabels, background: MotionBackground, most: int
) -> list[LabelledImage]:
    """Labelled frames spread over the flight: more of them show the same cars on the same ground."""
    labelled = [pair for pair in zip(frames, labels.frames, strict=True) if pair[1].labelled and len(pair[1].cars)]
    chosen = np.unique(np.linspace(0, len(labelled) - 1, min(most, len(labelled))).round().astype(int))
    return [
        LabelledImage(
            image=frame.image,
            valid=frame.valid & background.valid,
            background=background.median,
            cars=found.cars,
            ignore=found.ignore,
            complete=False,
        )
        for frame, found in (labelled[k] for k in chosen)
    ]


def _without_labels(plan: Plan, scale: float | None, labels: MotionLabels) -> Outcome:
    """Neither marked cars nor enough that move: the shipped detector, said aloud, where a car's size is known."""
    told = "; ".join(labels.warnings)
    if scale is None:
        raise InputError(f"{told}; or give --gsd-m, so that the shipped detector can be used")
    outcome = _finish(plan, shipped_detector(), scale, "shipped", motion=labels)
    return Outcome(outcome.outputs, outcome.counts, outcome.notes, [f"{told}. The shipped detector is used"])


def _motion_frames(plan: Plan, scale: float) -> list[MotionFrame]:
    """Frames to take labels from, whole, on the working grid."""
    times_s = open_frames(plan.layout.frames).column("time_s")
    usable = np.flatnonzero(usable_frames(plan))
    if len(usable) < 3:
        raise InputError(f"{len(usable)} frames are registered, 3 or more needed; see the reasons above")
    chosen = [int(frame) for frame in usable[choose_frames(times_s[usable])]]
    working = WorkingGrid.open(plan, scale)
    frames = []
    for frame in chosen:
        seen = working.frame(frame, working.whole)
        if seen is not None:
            frames.append(MotionFrame(seen.image, seen.valid, float(times_s[frame])))
        advance("detector", 0)
    return frames


def _finish(
    plan: Plan,
    detector: Detector | None,
    scale: float,
    learnt_from: str,
    *,
    count: int = 0,
    motion: MotionLabels | None = None,
    background: MotionBackground | None = None,
) -> Outcome:
    """Write what detection needs: the detector, the working grid, the background where the detector looks at it."""
    layout, outputs, notes = plan.layout, [plan.layout.working], []
    if detector is not None:
        write_atomically(layout.detector, detector.record.model_dump_json().encode())
        outputs.append(layout.detector)
    if background is not None and detector is not None and detector.uses_background:
        write_background(layout, background)
        outputs.append(layout.background)
    if motion is not None and learnt_from == "motion":
        notes.append(
            f"{motion.count} labels of {motion.vehicles} vehicles from motion, purity {motion.purity:.0%}, "
            f"coherence {motion.coherence:.0%}"
        )
    record = WorkingRecord(
        scale=scale,
        learnt_from=learnt_from,
        has_background=layout.background in outputs,
        labels=count,
        purity=None if motion is None else motion.purity,
        coherence=None if motion is None else motion.coherence,
    )
    write_atomically(layout.working, record.model_dump_json(indent=1).encode())
    advance("detector")
    counts = {"labels": float(count), "working_scale": scale}
    if detector is not None:
        counts["threshold"] = detector.threshold
    return Outcome(outputs, counts, notes)
