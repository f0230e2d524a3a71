"""Flights with single effects, and small ones for tests."""

import numpy as np

from schemas.simulation import CameraSimulation, SceneSimulation, SimulationConfig
from velfield.synthetic.camera import fold_radius
from velfield.synthetic.flight import Flight

FLAT = SceneSimulation(relief_m=0.0, building_height_m=0.0, tree_height_m=0.0)
"""A plane without relief, buildings and trees; vehicles still have a height."""

PINHOLE = CameraSimulation(lens_a=0.0, lens_offset_x_px=0.0, lens_offset_y_px=0.0, vibration_px=0.0, readout_s=0.0)
"""No lens distortion, no rolling shutter: raw to base is a homography."""


def homography_only(*, width: int = 2560, height: int = 1440, frames: int = 30, seed: int = 0) -> SimulationConfig:
    """Plane and pinhole camera: one homography a frame is exact."""
    return SimulationConfig(seed=seed, width=width, height=height, frames=frames, camera=PINHOLE, scene=FLAT)


def lens_only(
    a: float = 0.2, *, width: int = 1280, height: int = 960, frames: int = 10, seed: int = 0
) -> SimulationConfig:
    """Plane, radial distortion ``a`` with an offset centre, no rolling shutter."""
    camera = PINHOLE.model_copy(update={"lens_a": a, "lens_offset_x_px": 9.0, "lens_offset_y_px": -6.0})
    return SimulationConfig(seed=seed, width=width, height=height, frames=frames, camera=camera, scene=FLAT)


def lens_and_wobble(*, width: int = 1280, height: int = 960, frames: int = 30, seed: int = 0) -> SimulationConfig:
    """Plane, lens a = 0.2, rolling-shutter wobble of 4 px, 6 cycles a frame."""
    camera = CameraSimulation(lens_a=0.2, vibration_px=4.0, vibration_cycles=6.0)
    return SimulationConfig(seed=seed, width=width, height=height, frames=frames, camera=camera, scene=FLAT)


def two_term_lens(*, width: int = 2560, height: int = 1920, frames: int = 10, seed: int = 0) -> SimulationConfig:
    """A city under a lens that one term cannot describe, its centre up to 20 px off; both drawn by the seed.

    The corners are displaced by 5 to 25 % of the half-diagonal, of which the second term is at least a third.
    """
    rng = np.random.default_rng(seed)
    while True:
        first, second = rng.uniform(-0.1, 0.25), rng.uniform(-0.1, 0.15)
        shift = abs(first + second)
        if 0.05 <= shift <= 0.25 and abs(second) >= shift / 3 and fold_radius((first, second)) > 1.2:
            break
    off_px, angle = 20.0 * np.sqrt(rng.uniform()), rng.uniform(0.0, 2.0 * np.pi)
    camera = CameraSimulation(
        lens_terms=(round(first, 4), round(second, 4)),
        lens_offset_x_px=round(off_px * np.cos(angle), 2),
        lens_offset_y_px=round(off_px * np.sin(angle), 2),
    )
    return SimulationConfig(seed=seed, width=width, height=height, frames=frames, camera=camera)


def vibration_and_drift(*, width: int = 1280, height: int = 960, frames: int = 60, seed: int = 0) -> SimulationConfig:
    """Lens, 2 px of vibration at 14-29 Hz, drift, rotation and tilt, relief, buildings and trees."""
    camera = CameraSimulation(lens_a=0.15, vibration_px=2.0)
    return SimulationConfig(seed=seed, width=width, height=height, frames=frames, camera=camera)


def small_flight(*, frames: int = 12, width: int = 640, height: int = 480, seed: int = 0, **sections: object) -> Flight:
    """A small flight in memory for tests; ``sections`` (camera=..., scene=...) replace those of the configuration."""
    values: dict[str, object] = {"seed": seed, "frames": frames, "width": width, "height": height, **sections}
    return Flight(SimulationConfig.model_validate(values))
