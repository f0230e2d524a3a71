"""Benchmark of registration on simulated flights of unseen seeds against ground truth, with stabilo as a baseline.

Each flight is written to disk as a user would have it and processed by the pipeline's stages, including lens
calibration; stabilo (one homography per frame) gets the same frames and base image, undistorted by the true lens.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from schemas.arrays import Float32Array, FloatArray, GreyImage
from schemas.job import Inputs, Job
from schemas.simulation import OtherSensorSimulation, SimulationConfig
from velfield.errors import InputError
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import Plan, make_plan, write_flight_record
from velfield.pipeline.stage import stages_before
from velfield.registration.transforms import as_points
from velfield.run.frame_transforms import FrameTransforms
from velfield.sources.images import read_grey_image
from velfield.synthetic import cases
from velfield.synthetic.score import RegistrationScore, apply_homography, score_registration
from velfield.synthetic.truth import Truth, load_truth
from velfield.synthetic.write import frame_name, write_flight

PointMap = Callable[[int, FloatArray], FloatArray]

SAME_SENSOR = OtherSensorSimulation(same_sensor=True)
_SIFT_FEATURES = 4000
_MAX_PIXELS = 100_000_000


@dataclass(frozen=True)
class Case:
    """One kind of flight: its name, number of frames, and configuration by seed and number of frames."""

    name: str
    frames: int
    make: Callable[[int, int], SimulationConfig]


def _same_sensor(config: SimulationConfig) -> SimulationConfig:
    return config.model_copy(update={"base": SAME_SENSOR})


CASES = {
    case.name: case
    for case in (
        Case("homography", 8, lambda seed, n: _same_sensor(cases.homography_only(frames=n, seed=seed))),
        Case("wobble", 12, lambda seed, n: _same_sensor(cases.lens_and_wobble(frames=n, seed=seed))),
        Case("vibration", 60, lambda seed, n: cases.vibration_and_drift(frames=n, seed=seed)),
        Case("two_term_lens", 10, lambda seed, n: cases.two_term_lens(frames=n, seed=seed)),
        Case("long", 1000, lambda seed, n: cases.vibration_and_drift(width=640, height=480, frames=n, seed=seed)),
    )
}
"""The cases: plane and pinhole camera; lens and rolling shutter; vibration, drift and relief with another sensor's base
image; the same for 1000 small frames."""


@dataclass(frozen=True)
class Measurement:
    """One method on one flight."""

    case: str
    method: str
    seed: int
    score: RegistrationScore
    corner_px: float
    """Largest error of a frame's corners, over all frames, base px; of those that were answered."""
    seconds_a_frame: float
    """Computing time; reading of images is included for velfield, not for stabilo."""
    frames: int
    """Number of frames in total."""

    def text(self) -> str:
        """One line of the table."""
        one = self.score
        return (
            f"{self.case:<11} {self.method:<9} seed {self.seed:<6} mean {one.mean_px:7.3f}  p95 {one.p95_px:7.3f}  "
            f"jitter {one.jitter_px:6.3f}  drift {one.drift_px:6.3f}  worst corner {self.corner_px:7.2f} px  "
            f"answered {one.answered:.4f}  {self.seconds_a_frame:5.2f} s a frame  {one.frames}/{self.frames} frames"
        )


def bench_registration(
    folder: Path, case: Case, seed: int, *, frames: int | None = None, stabilo: bool = True
) -> list[Measurement]:
    """Simulate one flight into ``folder`` and register it by each method, or by velfield alone.

    Raises
    ------
    InputError
        stabilo is not installed.
    """
    flight = folder / f"{case.name}-{seed}"
    config = case.make(seed, frames or case.frames)
    write_flight(flight, config)
    truth = load_truth(flight)
    measurements = []
    for method, register in (("velfield", _run_velfield), ("stabilo", register_by_stabilo))[: 2 if stabilo else 1]:
        to_base, registered, seconds = register(flight, config, truth)
        score = score_registration(truth, to_base, registered, asked=range(config.frames))
        corner = _worst_corner(truth, to_base, registered)
        frames_s = seconds / config.frames
        measurements.append(Measurement(case.name, method, seed, score, corner, frames_s, config.frames))
    return measurements


def _worst_corner(truth: Truth, to_base: PointMap, frames: Sequence[int]) -> float:
    w, h = truth.camera.width - 1.0, truth.camera.height - 1.0
    corners = np.array([[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]])
    errors = [np.hypot(*(to_base(frame, corners) - truth.to_base(frame, corners)).T) for frame in frames]
    return float(np.nanmax(errors)) if errors and np.isfinite(errors).any() else float("nan")


def summarise(measurements: Sequence[Measurement]) -> list[str]:
    """Median and worst over the flights of each case and method, one line each."""
    lines = []
    for case, method in dict.fromkeys((m.case, m.method) for m in measurements):
        rows = [m for m in measurements if (m.case, m.method) == (case, method)]
        texts = [f"{case:<11} {method:<9} median (worst) of {len(rows)}:"]
        for name in ("mean_px", "p95_px", "jitter_px", "drift_px", "corner_px", "answered", "seconds_a_frame"):
            values = [getattr(row if hasattr(row, name) else row.score, name) for row in rows]
            worst = min(values) if name == "answered" else max(values)
            texts.append(f"{name} {np.median(values):.3f} ({worst:.3f})")
        lines.append("  ".join(texts))
    return lines


def register_flight(flight: Path, out: Path) -> tuple[Plan, float]:
    """Run the stages up to registration on a simulated flight; the plan, and the seconds of the registration stage."""
    job = Job(
        root=str(out),
        inputs=Inputs(
            source=str(flight / "frames"),
            timestamps=str(flight / "timestamps.csv"),
            base=str(flight / "base.png"),
        ),
        config=resolve_config(overrides={"gsd_m": load_truth(flight).gsd_m}),
    )
    plan = make_plan(job)
    write_flight_record(plan)
    compute_stages(plan, stages_before("registration"))
    started = time.perf_counter()
    compute_stages(plan, ("registration",))
    return plan, time.perf_counter() - started


def _run_velfield(flight: Path, config: SimulationConfig, truth: Truth) -> tuple[PointMap, list[int], float]:
    plan, seconds = register_flight(flight, flight / "run")
    maps = FrameTransforms.open(plan.layout, plan.config)
    transforms = {
        int(source): transform
        for frame, source in enumerate(plan.indices)
        if (transform := maps.transform(frame)) is not None
    }
    number = {int(source): frame for frame, source in enumerate(plan.indices)}

    def to_base(frame: int, xy_raw: FloatArray) -> FloatArray:
        supported = np.isfinite(maps.position_sd_px(number[frame], xy_raw))
        return np.where(supported[:, None], transforms[frame].to_base(xy_raw), np.nan)

    return to_base, sorted(transforms), seconds


def register_by_stabilo(flight: Path, config: SimulationConfig, truth: Truth) -> tuple[PointMap, list[int], float]:
    """One homography per frame by SIFT and MAGSAC; frames it cannot register are left out."""
    stabilizer = _make_stabilizer()
    undistort = _undistortion_maps(truth)
    stabilizer.set_ref_frame(_to_bgr(read_grey_image(flight / "base.png", _MAX_PIXELS)))
    transforms: dict[int, FloatArray] = {}
    seconds = 0.0
    for frame in range(config.frames):
        grey = read_grey_image(flight / "frames" / frame_name(frame, config), _MAX_PIXELS)
        undistorted = _to_bgr(np.asarray(cv2.remap(grey, *undistort, cv2.INTER_CUBIC), dtype=np.uint8))
        started = time.perf_counter()
        stabilizer.stabilize(undistorted)
        seconds += time.perf_counter() - started
        matrix = stabilizer.get_cur_trans_matrix()
        if matrix is not None:
            transforms[frame] = np.asarray(matrix, dtype=np.float64)

    def to_base(frame: int, xy_raw: FloatArray) -> FloatArray:
        return apply_homography(transforms[frame], truth.camera.undistort(as_points(xy_raw)))

    return to_base, sorted(transforms), seconds


def _make_stabilizer() -> Any:
    try:
        from stabilo import Stabilizer
    except ImportError:
        raise InputError(
            "stabilo is not installed, and the comparison needs it; `make bench` installs it, or: "
            "pip install --no-deps stabilo"
        ) from None
    return Stabilizer(
        detector_name="sift",
        max_features=_SIFT_FEATURES,
        filter_ratio=0.8,
        ransac_epipolar_threshold=1.0,
        downsample_ratio=1.0,
        clahe=False,
        mask_use=False,
    )


def _undistortion_maps(truth: Truth) -> tuple[Float32Array, Float32Array]:
    """Maps for ``cv2.remap`` from a raw frame to that of an ideal pinhole camera."""
    h, w = truth.camera.height, truth.camera.width
    y, x = np.mgrid[0:h, 0:w].astype(np.float64)
    raw = truth.camera.distort(np.column_stack([x.ravel(), y.ravel()])).astype(np.float32).reshape(h, w, 2)
    return np.ascontiguousarray(raw[..., 0]), np.ascontiguousarray(raw[..., 1])


def _to_bgr(grey: GreyImage) -> GreyImage:
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
