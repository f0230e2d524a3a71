"""What a simulated flight is: the city, its traffic, its camera, the other sensor's picture; each effect has a number.

An effect whose number is zero is off, exactly: ``relief_m=0`` leaves a plane, ``lens_a=0`` a pin-hole.
"""

from typing import Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from schemas.model import Model


class TimesSimulation(Model):
    """When frames are taken: about ``fps``, some late by half a frame or a whole one."""

    fps: PositiveFloat = 5.0
    """Nominal frames a second. Paper: about 5."""
    late_half_share: NonNegativeFloat = Field(0.08, le=1)
    """Share of the intervals that are half a frame longer."""
    late_whole_share: NonNegativeFloat = Field(0.03, le=1)
    """Share of the intervals that are a whole frame longer."""
    jitter_s: NonNegativeFloat = Field(0.003, le=0.02)
    """Standard deviation of each interval besides, s; cut at three of them."""


class CameraSimulation(Model):
    """A helicopter's camera: where it hangs, how it shakes, what its lens and its rolling shutter do."""

    focal_widths: PositiveFloat = 1.25
    """Focal length in widths of the frame. It sets the height, and so how far tall things lean."""
    scale: PositiveFloat = 1.0
    """Raw pixels a base pixel at the middle of the frame, on average."""
    heading_deg: float = 6.0
    """Mean turn of the frame against the base image, deg, from +x towards +y."""
    drift_m: NonNegativeFloat = 8.0
    """How far the helicopter strays from its mean place, m."""
    climb_share: NonNegativeFloat = Field(0.02, lt=0.5)
    """How far its height strays, as a share of the height."""
    turn_deg: NonNegativeFloat = 3.0
    """How far the frame turns about its mean heading, deg."""
    tilt_deg: NonNegativeFloat = 1.5
    """How far the camera tilts from looking straight down, deg, about either axis."""
    motion_period_s: PositiveFloat = 40.0
    """Typical period of drift, climb, turn and tilt, s."""
    lens_a: float = Field(0.10, gt=-0.9, lt=0.9)
    """Harris' radial distortion r_d = r / sqrt(1 + a r^2), r in half-diagonals."""
    lens_offset_x_px: float = 7.0
    """Distortion centre right of the frame's middle, px."""
    lens_offset_y_px: float = -5.0
    """Distortion centre below the frame's middle, px."""
    readout_s: NonNegativeFloat = Field(0.1, le=0.19)
    """Time between the first row's exposure and the last one's, s."""
    vibration_px: NonNegativeFloat = 1.5
    """Amplitude of the shake of the picture, undistorted px, in x and in y."""
    vibration_low_hz: PositiveFloat = 14.0
    """Least frequency of the shake, Hz."""
    vibration_high_hz: PositiveFloat = 29.0
    """Greatest frequency of the shake, Hz."""
    vibration_cycles: PositiveFloat | None = None
    """Cycles a readout in place of the frequencies above: one pure tone."""
    optics_blur_px: NonNegativeFloat = 0.55
    """Standard deviation of the optics' and the pixel's blur, px."""
    motion_blur_px: NonNegativeFloat = 0.5
    """Greatest standard deviation of motion blur, px; drawn anew for each frame with a random direction."""
    vignetting: NonNegativeFloat = Field(0.22, lt=1)
    """Light lost in the corners, as a share."""
    exposure_share: NonNegativeFloat = Field(0.02, lt=0.5)
    """Standard deviation of each frame's exposure, as a share."""
    noise_grey: NonNegativeFloat = 2.0
    """Standard deviation of each pixel's noise, grey levels."""


class TrafficSimulation(Model):
    """Who drives: car-following after the intelligent driver model, signals, gaps accepted at merges."""

    flow_veh_per_h: NonNegativeFloat = 900.0
    """Vehicles that want to come in each hour on each lane of an avenue."""
    speed_mean_km_per_h: PositiveFloat = 50.0
    """Mean of the speed drivers want on an avenue."""
    speed_sd_km_per_h: NonNegativeFloat = 5.0
    """Its standard deviation over drivers; cut at two of them."""
    cycle_s: PositiveFloat = 60.0
    """Period of the signals, s."""
    all_red_s: PositiveFloat = 2.5
    """Time when all is red between two greens, s."""
    turn_share: NonNegativeFloat = Field(0.15, le=1)
    """Share of drivers who turn where they can."""
    large_share: NonNegativeFloat = Field(0.05, le=1)
    """Share of lorries and buses."""
    warm_up_s: NonNegativeFloat = 90.0
    """Traffic runs for this long before the first frame, s."""


class SceneSimulation(Model):
    """What stands and lies in the city."""

    relief_m: NonNegativeFloat = 0.8
    """The ground rises and falls by up to about this, m."""
    relief_length_m: PositiveFloat = 180.0
    """Typical length of the relief's waves, m."""
    building_height_m: NonNegativeFloat = Field(14.0, le=25)
    """Height of the tallest buildings, m; 0: no buildings, only their ground."""
    tree_height_m: NonNegativeFloat = Field(8.0, le=25)
    """Height of the tallest trees, m; 0: no trees."""
    parked_share: NonNegativeFloat = Field(0.65, le=1)
    """Share of parking places that are taken."""
    sun_azimuth_deg: float = 215.0
    """Where shadows point, deg from +x towards +y."""
    sun_length: NonNegativeFloat = Field(0.7, le=2)
    """Length of a shadow per height; 0: no shadows."""
    texture: PositiveFloat = 1.0
    """Contrast of the ground's grain and patches, 1: as asphalt, grass and roofs have it."""


class OtherSensorSimulation(Model):
    """The base image: the same place from another sensor, on another day, without the traffic."""

    blur_px: NonNegativeFloat = 0.8
    """Standard deviation of its blur, base px."""
    gamma: PositiveFloat = 0.75
    """Exponent of its tone curve, applied to grey in [0, 1]."""
    noise_grey: NonNegativeFloat = 2.5
    """Standard deviation of its noise, grey levels."""
    margin_px: PositiveInt = 24
    """How far it reaches beyond the ground that the frames show, base px."""
    sun_azimuth_deg: float = 250.0
    """Where its shadows point, deg from +x towards +y."""
    sun_length: NonNegativeFloat = Field(0.45, le=2)
    """Length of a shadow per height."""
    vegetation_shift_grey: float = 35.0
    """How much lighter it sees vegetation, grey levels."""
    same_sensor: bool = False
    """The frames' own tones and sun instead: what an own base image would be. Other parked cars all the same."""


class SimulationConfig(Model):
    """A simulated flight. The same configuration gives the same flight, to the bit."""

    seed: NonNegativeInt = 0
    """Seed of everything random."""
    frames: PositiveInt = 300
    """Number of frames."""
    width: PositiveInt = Field(1280, ge=64, le=8192)
    """Width of a frame, px."""
    height: PositiveInt = Field(960, ge=64, le=8192)
    """Height of a frame, px."""
    gsd_m: PositiveFloat = 0.23
    """Ground sample distance of the base image, m. Paper: 0.23."""
    labelled_frames: NonNegativeInt = 1
    """How many frames, spread over the flight from the first, labels.csv labels in full."""
    picture_format: Literal["png", "jpg"] = "png"
    """How frames are written."""
    jpeg_quality: PositiveInt = Field(95, le=100)
    """Quality of JPEG frames."""
    times: TimesSimulation = TimesSimulation()
    camera: CameraSimulation = CameraSimulation()
    traffic: TrafficSimulation = TrafficSimulation()
    scene: SceneSimulation = SceneSimulation()
    base: OtherSensorSimulation = OtherSensorSimulation()
