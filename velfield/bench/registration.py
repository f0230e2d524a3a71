"""Registration of unseen simulated flights against the truth, beside stabilo on the same frames.

Each case is written as a user would have it and goes through the stages themselves, lens calibration included; stabilo
(one homography a frame) is given the same frames and the same base image, already undistorted by the true lens.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, GreyImage
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
from velfield.synthetic import cases, write_flight
from velfield.synthetic.score import RegistrationScore, score_registration
from velfield.synthetic.truth import Truth, load_truth
from velfield.synthetic.write import frame_name

Mapped = Callable[[int, FloatArray], FloatArray]

SAME_SENSOR = OtherSensorSimulation(same_sensor=True)
_SIFT_FEATURES = 4000
_MAX_PIXELS = 100_000_000


@dataclass(frozen=True)
class Case:
    """One kind of flight: its configuration by seed and number of frames, and what it is called."""

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
        Case("long", 1000, lambda seed, n: cases.vibration_and_drift(width=640, height=480, frames=n, seed=seed)),
    )
}
"""The cases: plane and pin-hole; lens and rows that wobble; vibration, drift and relief on another sensor's picture;
the same for 1000 small frames."""


@dataclass(frozen=True)
class Measured:
    """One method on one flight.

    Attributes
    ----------
    drift_px : how far the mean error moved from the first tenth of the frames to the last, base px.
    corner_px : greatest error of a frame's corners that lie on the base image, over all frames, base px.
    seconds_a_frame : of the method alone, reading of pictures left out for stabilo, left in for velfield.
    frames_registered, frames : how many it registered of how many.
    """

    case: str
    method: str
    seed: int
    mean_px: float
    p95_px: float
    jitter_px: float
    drift_px: float
    corner_px: float
    seconds_a_frame: float
    frames_registered: int
    frames: int

    def text(self) -> str:
        """One line of the table."""
        return (
            f"{self.case:<11} {self.method:<9} seed {self.seed:<6} mean {self.mean_px:7.3f}  p95 {self.p95_px:7.3f}  "
            f"jitter {self.jitter_px:6.3f}  drift {self.drift_px:6.3f}  worst corner {self.corner_px:7.2f} px  "
            f"{self.seconds_a_frame:5.2f} s a frame  {self.frames_registered}/{self.frames} frames"
        )


def bench_registration(
    folder: Path, case: Case, seed: int, *, frames: int | None = None, stabilo: bool = True
) -> list[Measured]:
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
    measured = []
    for method, run in (("velfield", _by_velfield), ("stabilo", _by_stabilo))[: 2 if stabilo else 1]:
        to_base, registered, seconds = run(flight, config, truth)
        score = score_registration(truth, to_base, registered)
        corner = _worst_corner(truth, to_base, registered)
        measured.append(_row(case.name, method, seed, score, corner, seconds, config.frames))
    return measured


def _row(
    case: str, method: str, seed: int, score: RegistrationScore, corner_px: float, seconds: float, frames: int
) -> Measured:
    return Measured(
        case=case,
        method=method,
        seed=seed,
        mean_px=score.mean_px,
        p95_px=score.p95_px,
        jitter_px=score.jitter_px,
        drift_px=score.drift_px,
        corner_px=corner_px,
        seconds_a_frame=seconds / frames,
        frames_registered=score.frames,
        frames=frames,
    )


def _worst_corner(truth: Truth, to_base: Mapped, frames: Sequence[int]) -> float:
    w, h = truth.camera.width - 1.0, truth.camera.height - 1.0
    corners = np.array([[0.0, 0.0], [w, 0.0], [0.0, h], [w, h]])
    misses = [np.hypot(*(to_base(frame, corners) - truth.to_base(frame, corners)).T) for frame in frames]
    return float(np.max(misses)) if misses else float("nan")


def medians(measured: Sequence[Measured]) -> list[str]:
    """Of each case and method, the median and the worst over its flights, a line each."""
    lines = []
    for case, method in dict.fromkeys((m.case, m.method) for m in measured):
        rows = [m for m in measured if (m.case, m.method) == (case, method)]
        told = [f"{case:<11} {method:<9} median (worst) of {len(rows)}:"]
        for name in ("mean_px", "p95_px", "jitter_px", "drift_px", "corner_px", "seconds_a_frame"):
            values = [getattr(row, name) for row in rows]
            told.append(f"{name} {np.median(values):.3f} ({max(values):.3f})")
        lines.append("  ".join(told))
    return lines


def register_flight(flight: Path, out: Path) -> tuple[Plan, float]:
    """Run the stages up to registration on a simulated flight; the plan, and registration's seconds."""
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


def _by_velfield(flight: Path, config: SimulationConfig, truth: Truth) -> tuple[Mapped, list[int], float]:
    plan, seconds = register_flight(flight, flight / "run")
    maps = FrameTransforms.open(plan.layout, plan.config)
    found = {
        int(source): transform
        for frame, source in enumerate(plan.indices)
        if (transform := maps.transform(frame)) is not None
    }
    return lambda frame, xy: found[frame].to_base(xy), sorted(found), seconds


def _by_stabilo(flight: Path, config: SimulationConfig, truth: Truth) -> tuple[Mapped, list[int], float]:
    """One homography a frame by SIFT and MAGSAC; a frame that it gives up on is left out."""
    stabilizer = _stabilizer()
    undistort = _undistortion(truth)
    stabilizer.set_ref_frame(_coloured(read_grey_image(flight / "base.png", _MAX_PIXELS)))
    found: dict[int, FloatArray] = {}
    seconds = 0.0
    for frame in range(config.frames):
        grey = read_grey_image(flight / "frames" / frame_name(frame, config), _MAX_PIXELS)
        straight = _coloured(np.asarray(cv2.remap(grey, *undistort, cv2.INTER_CUBIC), dtype=np.uint8))
        started = time.perf_counter()
        stabilizer.stabilize(straight)
        seconds += time.perf_counter() - started
        matrix = stabilizer.get_cur_trans_matrix()
        if matrix is not None:
            found[frame] = np.asarray(matrix, dtype=np.float64)

    def to_base(frame: int, xy_raw: FloatArray) -> FloatArray:
        return _by_homography(found[frame], truth.camera.undistort(as_points(xy_raw)))

    return to_base, sorted(found), seconds


def _stabilizer() -> Any:
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


def _undistortion(truth: Truth) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Maps for ``cv2.remap`` from a raw frame to one that a pin-hole would have taken."""
    h, w = truth.camera.height, truth.camera.width
    y, x = np.mgrid[0:h, 0:w].astype(np.float64)
    raw = truth.camera.distort(np.column_stack([x.ravel(), y.ravel()])).astype(np.float32).reshape(h, w, 2)
    return np.ascontiguousarray(raw[..., 0]), np.ascontiguousarray(raw[..., 1])


def _coloured(grey: GreyImage) -> GreyImage:
    return np.asarray(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), dtype=np.uint8)


def _by_homography(matrix: FloatArray, xy: FloatArray) -> FloatArray:
    mapped = np.column_stack([xy, np.ones(len(xy))]) @ matrix.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])
