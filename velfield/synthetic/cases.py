"""Flights with single effects, and small ones for tests."""

from schemas.simulation import (
    CameraSimulation,
    OtherSensorSimulation,
    SceneSimulation,
    SimulationConfig,
    TimesSimulation,
    TrafficSimulation,
)
from velfield.synthetic.flight import Flight, simulate

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


def vibration_and_drift(*, width: int = 1280, height: int = 960, frames: int = 60, seed: int = 0) -> SimulationConfig:
    """Lens, 2 px of vibration at 14-29 Hz, drift, rotation and tilt, relief, buildings and trees."""
    camera = CameraSimulation(lens_a=0.15, vibration_px=2.0)
    return SimulationConfig(seed=seed, width=width, height=height, frames=frames, camera=camera)


def small_flight(*, frames: int = 12, width: int = 640, height: int = 480, seed: int = 0, **sections: object) -> Flight:
    """A small flight in memory for tests; ``sections`` (camera=..., scene=...) replace those of the configuration."""
    values: dict[str, object] = {"seed": seed, "frames": frames, "width": width, "height": height, **sections}
    return simulate(SimulationConfig.model_validate(values))


__all__ = [
    "FLAT",
    "PINHOLE",
    "CameraSimulation",
    "OtherSensorSimulation",
    "SceneSimulation",
    "TimesSimulation",
    "TrafficSimulation",
    "homography_only",
    "lens_and_wobble",
    "lens_only",
    "small_flight",
    "vibration_and_drift",
]
