"""From regions that go together to the car among them: its rectangle along the heading, its shadow taken off.

A white car is a bright roof, a grey bonnet that equals the road, and a black shadow; a black car is one dark region as
long as car and shadow. One rule serves both: the rectangle of all that moves together, less the shadow, whose direction
and length are the same all over a flight and are learnt from the cars that are brighter than the road.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, IntArray
from velfield.detection.motion.blobs import merged
from velfield.detection.motion.links import Groups

# A car's measures against the usual length: from 9-24 x 4-12 px where a car is 16 px long.
_LENGTHS = (0.56, 1.5)
_WIDTHS = (0.22, 0.75)
_ASPECTS = (1.25, 4.5)
_MIN_FILL = 0.4
MAX_AXIS_OFFSET_RAD = float(np.radians(25.0))
_MIN_ASPECT_OF_AXIS = 1.4  # rounder regions have no axis to speak of
_MIN_BRIGHT_AREA = 0.12  # of the squared car length: a bright part as large as a roof is a car's body, not a glint
_MIN_SHADOW_CARS = 8
_MIN_SHADOW_AGREEMENT = 0.8
_MAX_SHADOW_SHARE = 0.5
_TRUST_ALONG = 0.1
_FIT_ROUNDS = 20
_LEAST_RESIDUAL_PX = 0.1


@dataclass(frozen=True)
class Bodies:
    """Things that moved over three frames, one value a thing, of one frame.

    Attributes
    ----------
    x, y : float64 (n,)
        Centre of the rectangle, working px.
    heading_rad : float64 (n,)
        Direction of motion, from +x towards +y.
    length, width : float64 (n,)
        Rectangle along and across the heading, px.
    speed : float64 (n,)
        px/s.
    fill : float64 (n,)
        Share of the rectangle (before the shadow is taken off) that differs from the background.
    cxx, cxy, cyy : float64 (n,)
        Covariance of the regions' pixels: of the bright part alone where that is a body, else of all, shadow included.
    bright : bool (n,)
        Whether the bright part alone is a body.
    """

    x: FloatArray
    y: FloatArray
    heading_rad: FloatArray
    length: FloatArray
    width: FloatArray
    speed: FloatArray
    fill: FloatArray
    cxx: FloatArray
    cxy: FloatArray
    cyy: FloatArray
    bright: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.x)

    @property
    def axis_offset_rad(self) -> FloatArray:
        """Angle between the regions' own long axis and the heading, [0, pi/2]."""
        axis = 0.5 * np.arctan2(2 * self.cxy, self.cxx - self.cyy)
        return np.asarray(np.abs(np.mod(axis - self.heading_rad + np.pi / 2, np.pi) - np.pi / 2), np.float64)

    @property
    def has_axis(self) -> NDArray[np.bool_]:
        """Whether the regions are oblong enough for their long axis to mean something."""
        middle, spread = self.cxx + self.cyy, np.hypot(self.cxx - self.cyy, 2 * self.cxy)
        return np.asarray(middle + spread > _MIN_ASPECT_OF_AXIS**2 * (middle - spread), np.bool_)

    def take(self, chosen: NDArray[np.bool_]) -> "Bodies":
        """The chosen things."""
        return Bodies(*(getattr(self, field.name)[chosen] for field in fields(self)))


def bodies_of(groups: Groups, *, car_length_px: float) -> Bodies:
    """Rectangle of each group along its heading, shadow included.

    Parameters
    ----------
    groups : Groups
        Of the middle one of three frames.
    car_length_px : float
        A car's usual length, working px.
    """
    velocity = groups.velocity
    heading = np.arctan2(velocity[:, 1], velocity[:, 0])
    whole = merged(groups.blobs, groups.group, groups.count)
    light = merged(groups.blobs, groups.bright, groups.count)
    bright = light.area > _MIN_BRIGHT_AREA * car_length_px**2
    form = whole.choose(bright, light)
    low_u, high_u = _ends(groups, groups.group, heading)
    low_v, high_v = _ends(groups, groups.group, heading + np.pi / 2)
    mid_u, mid_v = (low_u + high_u) / 2, (low_v + high_v) / 2
    length, width = high_u - low_u, high_v - low_v
    c, s = np.cos(heading), np.sin(heading)
    return Bodies(
        x=c * mid_u - s * mid_v,
        y=s * mid_u + c * mid_v,
        heading_rad=heading,
        length=length,
        width=width,
        speed=np.hypot(velocity[:, 0], velocity[:, 1]),
        fill=whole.area / np.maximum(length * width, 1e-9),
        cxx=form.cxx,
        cxy=form.cxy,
        cyy=form.cyy,
        bright=bright,
    )


def shadow_samples(groups: Groups, *, car_length_px: float) -> FloatArray:
    """How each group with a bright body and a dark part reaches beyond that body.

    Returns
    -------
    float64 (k, 5)
        Heading, rad; twice the offset from the bright rectangle's centre to the whole's, along the heading and across
        it, px; offset from bright to dark part, x and y, px.
    """
    heading = np.arctan2(groups.velocity[:, 1], groups.velocity[:, 0])
    bright = merged(groups.blobs, groups.bright, groups.count)
    dark = merged(groups.blobs, groups.dark, groups.count)
    both = (bright.area > _MIN_BRIGHT_AREA * car_length_px**2) & (dark.area > 0)
    reach = []
    for angle in (heading, heading + np.pi / 2):
        whole, body = _ends(groups, groups.group, angle), _ends(groups, groups.bright, angle)
        reach.append(whole[0][both] + whole[1][both] - body[0][both] - body[1][both])
    return np.stack([heading[both], *reach, (dark.x - bright.x)[both], (dark.y - bright.y)[both]], axis=1)


def shadow_vector(samples: FloatArray) -> FloatArray:
    """Where a car's shadow lies and how far it reaches beyond the car, px, (2,); zero where the cars do not agree.

    Least absolute deviations over what the groups say across their heading, and, with little weight, along it: a
    bonnet as grey as the road lies there between body and shadow, so that this reach may be too long.

    Parameters
    ----------
    samples : float64 (k, 5)
        From `shadow_samples`, frames pooled.
    """
    if len(samples) < _MIN_SHADOW_CARS:
        return np.zeros(2)
    heading, along, across = samples[:, :3].T
    towards = samples[:, 3:] / np.maximum(np.hypot(*samples[:, 3:].T), 1e-9)[:, None]
    if np.hypot(*towards.mean(axis=0)) < _MIN_SHADOW_AGREEMENT:
        return np.zeros(2)
    c, s = np.cos(heading), np.sin(heading)
    design = np.concatenate([np.stack([-s, c], axis=1), np.stack([c, s], axis=1)])
    seen = np.concatenate([across, along])
    trust = np.concatenate([np.ones(len(samples)), np.full(len(samples), _TRUST_ALONG)])
    weight, shadow = trust, np.zeros(2)
    for _ in range(_FIT_ROUNDS):
        root = np.sqrt(weight)[:, None]
        shadow = np.linalg.lstsq(design * root, seen * root[:, 0], rcond=None)[0]
        weight = trust / np.maximum(np.abs(design @ shadow - seen), _LEAST_RESIDUAL_PX)
    return np.asarray(shadow, np.float64)


def without_shadow(bodies: Bodies, shadow: FloatArray) -> Bodies:
    """The rectangles less their shadow: shorter, narrower and moved towards the sun.

    Parameters
    ----------
    bodies : Bodies
    shadow : float64 (2,)
        From `shadow_vector`, px.
    """
    c, s = np.cos(bodies.heading_rad), np.sin(bodies.heading_rad)
    along, across = c * shadow[0] + s * shadow[1], c * shadow[1] - s * shadow[0]
    # Never more than half: a car in another's shade, or under a cloud, has none.
    along = np.clip(along, -_MAX_SHADOW_SHARE * bodies.length, _MAX_SHADOW_SHARE * bodies.length)
    across = np.clip(across, -_MAX_SHADOW_SHARE * bodies.width, _MAX_SHADOW_SHARE * bodies.width)
    x = bodies.x - (c * along - s * across) / 2
    y = bodies.y - (s * along + c * across) / 2
    length, width = bodies.length - np.abs(along), bodies.width - np.abs(across)
    # A body smeared along its shadow has the shadow's covariance on top of its own.
    smear = np.where(bodies.bright, 0.0, 1 / 12)
    cxx, cyy = bodies.cxx - smear * shadow[0] ** 2, bodies.cyy - smear * shadow[1] ** 2
    cxy = bodies.cxy - smear * shadow[0] * shadow[1]
    return replace(bodies, x=x, y=y, length=length, width=width, cxx=cxx, cxy=cxy, cyy=cyy)


def of_car_size(bodies: Bodies, *, car_length_px: float | None) -> NDArray[np.bool_]:
    """Which rectangles are full and, where a car's length is known, of its size; their axis is not looked at.

    Parameters
    ----------
    bodies : Bodies
    car_length_px : float or None
        A car's usual length, working px; none: any size.
    """
    good = bodies.fill >= _MIN_FILL
    if car_length_px is None:
        return np.asarray(good, np.bool_)
    # Whichever way it goes: what moves across its long axis must be counted too, for it tells roofs from cars.
    long, short = np.maximum(bodies.length, bodies.width), np.minimum(bodies.length, bodies.width)
    good &= (long >= _LENGTHS[0] * car_length_px) & (long <= _LENGTHS[1] * car_length_px)
    return np.asarray(good & (short >= _WIDTHS[0] * car_length_px) & (short <= _WIDTHS[1] * car_length_px), np.bool_)


def goes_lengthwise(bodies: Bodies) -> NDArray[np.bool_]:
    """Which rectangles move along their long axis, as cars do and the edges of roofs do not."""
    aspect = bodies.length / np.maximum(bodies.width, 1e-9)
    oblong = (aspect >= _ASPECTS[0]) & (aspect <= _ASPECTS[1])
    return np.asarray(oblong & (~bodies.has_axis | (bodies.axis_offset_rad < MAX_AXIS_OFFSET_RAD)), np.bool_)


def _ends(groups: Groups, group: IntArray, angle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least and greatest coordinate of each group's pixels along its own direction.

    Pixel centres, not corners: the half pixel at either end is what blur and threshold have added.
    """
    pixels = groups.pixels
    which = group[pixels.region]
    inside = which >= 0
    which = which[inside]
    place = np.cos(angle)[which] * pixels.x[inside] + np.sin(angle)[which] * pixels.y[inside]
    low, high = np.full(groups.count, np.inf), np.full(groups.count, -np.inf)
    np.minimum.at(low, which, place)
    np.maximum.at(high, which, place)
    return low, high
