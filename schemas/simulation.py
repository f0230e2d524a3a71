"""Configuration of a simulated flight: city, traffic, camera, and the other sensor's image, a parameter an effect.

An effect whose parameter is zero is exactly off: ``relief_m=0`` gives a plane, ``lens_a=0`` a pinhole camera.
"""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from schemas.model import Model


class TimesSimulation(Model):
    """Times of the frames: about ``fps``, some late by half a frame or a whole one."""

    fps: PositiveFloat = 5.0
    """Nominal frames a second. Paper: about 5."""
    late_half_share: NonNegativeFloat = Field(0.08, le=1)
    """Fraction of the intervals that are half a frame longer."""
    late_whole_share: NonNegativeFloat = Field(0.03, le=1)
    """Fraction of the intervals that are a whole frame longer."""
    jitter_s: NonNegativeFloat = Field(0.003, le=0.02)
    """Standard deviation of each interval, s; truncated at three of them."""


class CameraSimulation(Model):
    """A helicopter's camera: its motion and vibration, lens and rolling shutter."""

    focal_widths: PositiveFloat = 1.25
    """Focal length in widths of the frame. It determines the height of flight, and so the parallax of buildings."""
    scale: PositiveFloat = 1.0
    """Raw pixels a base pixel at the centre of the frame, on average."""
    heading_deg: float = 6.0
    """Mean rotation of the frame against the base image, deg, from +x towards +y."""
    drift_m: NonNegativeFloat = 8.0
    """Amplitude of the helicopter's horizontal drift, m."""
    climb_share: NonNegativeFloat = Field(0.02, lt=0.5)
    """Amplitude of its height, as a fraction of the height."""
    turn_deg: NonNegativeFloat = 3.0
    """Amplitude of the rotation about its mean heading, deg."""
    tilt_deg: NonNegativeFloat = 1.5
    """Amplitude of the tilt from the vertical, deg, about either axis."""
    mean_tilt_deg: NonNegativeFloat = Field(0.0, le=60)
    """Mean tilt from the vertical, deg: 0 looks straight down, 45 is the oblique view of a news helicopter."""
    motion_period_s: PositiveFloat = 40.0
    """Typical period of drift, climb, rotation and tilt, s."""
    lens_a: float = Field(0.10, gt=-0.9, lt=0.9)
    """Harris' radial distortion r_d = r / sqrt(1 + a r^2), r in half-diagonals."""
    lens_terms: Annotated[tuple[float, ...], Field(max_length=4)] = ()
    """In place of ``lens_a`` where given: k_1, k_2, ... of r = r_d (1 + k_1 r_d^2 + k_2 r_d^4 + ...), in
    half-diagonals. It must not fold within the frame."""
    lens_offset_x_px: float = 7.0
    """Offset of the distortion centre from the frame's centre to the right, px."""
    lens_offset_y_px: float = -5.0
    """Offset of the distortion centre from the frame's centre downwards, px."""
    readout_s: NonNegativeFloat = Field(0.1, le=0.19)
    """Time between the exposures of the first and the last row, s."""
    vibration_px: NonNegativeFloat = 1.5
    """Amplitude of the vibration of the image, undistorted px, in x and in y."""
    vibration_low_hz: PositiveFloat = 14.0
    """Lowest frequency of the vibration, Hz."""
    vibration_high_hz: PositiveFloat = 29.0
    """Highest frequency of the vibration, Hz."""
    vibration_cycles: PositiveFloat | None = None
    """Cycles a readout of a single sine, in place of the frequencies above."""
    optics_blur_px: NonNegativeFloat = 0.55
    """Standard deviation of the blur of optics and pixel, px."""
    motion_blur_px: NonNegativeFloat = 0.5
    """Largest standard deviation of motion blur, px; random for each frame, as its direction."""
    vignetting: NonNegativeFloat = Field(0.22, lt=1)
    """Fraction of the light lost in the corners."""
    exposure_share: NonNegativeFloat = Field(0.02, lt=0.5)
    """Relative standard deviation of each frame's exposure."""
    noise_grey: NonNegativeFloat = 2.0
    """Standard deviation of each pixel's noise, grey levels."""


class TrafficSimulation(Model):
    """Traffic: car following by the intelligent driver model, signals, gap acceptance at merges."""

    flow_veh_per_h: NonNegativeFloat = 900.0
    """Demand on each lane of an avenue, vehicles an hour."""
    speed_mean_km_per_h: PositiveFloat = 50.0
    """Mean of the drivers' desired speed on an avenue."""
    speed_sd_km_per_h: NonNegativeFloat = 5.0
    """Its standard deviation over drivers; truncated at two of them."""
    cycle_s: PositiveFloat = 60.0
    """Cycle time of the signals, s."""
    all_red_s: PositiveFloat = 2.5
    """All-red time between two greens, s."""
    turn_share: NonNegativeFloat = Field(0.15, le=1)
    """Fraction of drivers who turn where they can."""
    large_share: NonNegativeFloat = Field(0.05, le=1)
    """Fraction of lorries and buses."""
    car_length_m: PositiveFloat = Field(4.35, ge=3.5, le=5.5)
    """Median length of cars, m: places and decades differ."""
    warm_up_s: NonNegativeFloat = 90.0
    """Simulated time before the first frame, s."""


class SceneSimulation(Model):
    """Ground, buildings, trees and light of the city."""

    relief_m: NonNegativeFloat = 0.8
    """Amplitude of the ground's height, m."""
    relief_length_m: PositiveFloat = 180.0
    """Typical wavelength of the relief, m."""
    building_height_m: NonNegativeFloat = Field(14.0, le=25)
    """Height of the tallest buildings, m; 0: flat."""
    tree_height_m: NonNegativeFloat = Field(8.0, le=25)
    """Height of the tallest trees, m; 0: flat."""
    street_tree_share: NonNegativeFloat = Field(0, le=1)
    """Fraction of the kerbs under rows of trees whose crowns hang over the lanes; vehicles below are hidden or half
    hidden."""
    parked_share: NonNegativeFloat = Field(0.65, le=1)
    """Fraction of parking spaces that are occupied."""
    sun_azimuth_deg: float = 215.0
    """Direction of shadows, deg from +x towards +y."""
    sun_length: NonNegativeFloat = Field(0.7, le=2)
    """Length of a shadow per height; 0: no shadows."""
    texture: PositiveFloat = 1.0
    """Contrast of the ground's texture; 1: that of real asphalt, grass and roofs."""


class OtherSensorSimulation(Model):
    """The base image: the same ground by another sensor, on another day, without traffic."""

    blur_px: NonNegativeFloat = 0.8
    """Standard deviation of its blur, base px."""
    gamma: PositiveFloat = 0.75
    """Exponent of its tone curve, applied to grey in [0, 1]."""
    noise_grey: NonNegativeFloat = 2.5
    """Standard deviation of its noise, grey levels."""
    margin_px: PositiveInt = 24
    """Margin around the ground that the frames show, base px."""
    sun_azimuth_deg: float = 250.0
    """Direction of its shadows, deg from +x towards +y."""
    sun_length: NonNegativeFloat = Field(0.45, le=2)
    """Length of a shadow per height."""
    vegetation_shift_grey: float = 35.0
    """Grey levels by which vegetation is lighter in it."""
    same_sensor: bool = False
    """Tones and sun of the frames, as of an own base image; other parked cars nevertheless."""


class TelemetrySimulation(Model):
    """The telemetry of a clip (``clip``): where the city lies, and what a drone is off by over a whole flight."""

    longitude_deg: float = Field(36.25, ge=-180, le=180)
    """Longitude of the middle of the base image, deg."""
    latitude_deg: float = Field(50.0, ge=-80, le=84)
    """Latitude of the middle of the base image, deg."""
    north_deg: float = 20.0
    """Heading of the base image's top, deg clockwise from north."""
    height_sd_m: NonNegativeFloat = 0.8
    """Standard deviation of the barometer's drift, m."""
    height_sd_share: NonNegativeFloat = 0.005
    """Standard deviation of the barometer's scale, as a fraction of the height."""
    heading_sd_deg: NonNegativeFloat = 0.7
    """Standard deviation of the compass, deg."""
    position_sd_m: NonNegativeFloat = 1.5
    """Standard deviation of the satellites' position, east and north, m."""


class SimulationConfig(Model):
    """A simulated flight. The same configuration gives the same flight, bit by bit."""

    seed: NonNegativeInt = 0
    """Seed of all random streams."""
    frames: PositiveInt = 300
    """Number of frames."""
    width: PositiveInt = Field(1280, ge=64, le=8192)
    """Width of a frame, px."""
    height: PositiveInt = Field(960, ge=64, le=8192)
    """Height of a frame, px."""
    gsd_m: PositiveFloat = 0.23
    """Ground sample distance of the base image, m. Paper: 0.23."""
    labelled_frames: NonNegativeInt = 1
    """Number of frames, at equal distances from the first, that labels.csv labels completely."""
    picture_format: Literal["png", "jpg"] = "png"
    """File format of the frames."""
    jpeg_quality: PositiveInt = Field(95, le=100)
    """Quality of JPEG frames."""
    clip: Literal["none", "beside", "embedded"] = "none"
    """A drone's clip, ``DJI_0001.MP4``, in place of single frames; its telemetry in ``DJI_0001.SRT`` beside it, or in
    the clip as subtitles."""
    telemetry: TelemetrySimulation = TelemetrySimulation()
    times: TimesSimulation = TimesSimulation()
    camera: CameraSimulation = CameraSimulation()
    traffic: TrafficSimulation = TrafficSimulation()
    scene: SceneSimulation = SceneSimulation()
    base: OtherSensorSimulation = OtherSensorSimulation()

    def as_clip(self, clip: Literal["beside", "embedded"], *, fps: float = 25.0) -> "SimulationConfig":
        """The same flight by a drone: regular frames, a gimbal, a sensor that is read out in 25 ms."""
        regular = {"fps": fps, "late_half_share": 0.0, "late_whole_share": 0.0, "jitter_s": 0.0}
        times = self.times.model_copy(update=regular)
        drone = {"readout_s": 0.025, "vibration_px": 0.4, "tilt_deg": 0.6, "motion_blur_px": 0.2}
        camera = self.camera.model_copy(update=drone)
        return self.model_copy(update={"clip": clip, "times": times, "camera": camera})
