"""Oriented bounding boxes of moving objects, with their cast shadow removed.

A white car is a bright roof, a bonnet as grey as the road, and a black shadow; a black car is one dark blob as long as
car and shadow. Both are treated alike: the bounding box of all blobs of a group along its heading, less the shadow. Its
vector is constant over a flight and is estimated from cars that are brighter than the road.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.detection.motion.blobs import merge_blobs
from velfield.detection.motion.links import BlobGroups

_LENGTH_RANGE, _WIDTH_RANGE = (0.56, 1.5), (0.22, 0.75)
"""Size of a car, in typical lengths: 9-24 x 4-12 px where that is 16 px."""
_ASPECT_RANGE = (1.25, 4.5)
_MIN_FILL = 0.4
MAX_AXIS_OFFSET_RAD = float(np.radians(25.0))
_MIN_ELONGATION = 1.4  # the principal axis of rounder blobs is noise
_MIN_BRIGHT_AREA = 0.12  # of the squared car length: a bright part as large as a roof is a car's body, not a glint
_MIN_SHADOW_SAMPLES = 8
_MIN_RESULTANT_LENGTH = 0.8
"""Of the directions from bright body to dark part: less, and they do not agree on a shadow."""
_MAX_SHADOW_FRACTION = 0.5
_ALONG_WEIGHT = 0.1
_IRLS_ROUNDS = 20
_MIN_RESIDUAL_PX = 0.1


@dataclass(frozen=True)
class MovingObjects:
    """Oriented bounding boxes of the moving objects of one frame, one value an object.

    Attributes
    ----------
    x, y : float64 (n,)
        Centre of the box, working px.
    heading_rad : float64 (n,)
        Direction of motion, from +x towards +y.
    length, width : float64 (n,)
        Sides along and across the heading, px.
    speed : float64 (n,)
        px/s.
    fill : float64 (n,)
        Fraction of the box (shadow included) that is foreground.
    cxx, cxy, cyy : float64 (n,)
        Covariance of the pixels: of the bright part alone where that is a car's body, else of all, shadow included.
    bright : bool (n,)
        Whether the bright part alone is a car's body.
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
    bright: Mask

    def __len__(self) -> int:
        return len(self.x)

    @property
    def axis_offset_rad(self) -> FloatArray:
        """Angle between the principal axis of the pixels and the heading, [0, pi/2]."""
        axis = 0.5 * np.arctan2(2 * self.cxy, self.cxx - self.cyy)
        return np.asarray(np.abs(np.mod(axis - self.heading_rad + np.pi / 2, np.pi) - np.pi / 2), np.float64)

    @property
    def has_axis(self) -> Mask:
        """Whether the pixels are elongated enough for their principal axis to be meaningful."""
        trace, spread = self.cxx + self.cyy, np.hypot(self.cxx - self.cyy, 2 * self.cxy)
        return np.asarray(trace + spread > _MIN_ELONGATION**2 * (trace - spread), np.bool_)

    def select(self, chosen: Mask) -> "MovingObjects":
        """The chosen objects."""
        return MovingObjects(*(getattr(self, field.name)[chosen] for field in fields(self)))


def fit_boxes(groups: BlobGroups, *, car_length_px: float) -> MovingObjects:
    """Bounding box of each group along its heading, shadow included.

    Parameters
    ----------
    groups : BlobGroups
        Of the middle one of three frames.
    car_length_px : float
        A car's typical length, working px.
    """
    velocity = groups.velocity
    heading = np.arctan2(velocity[:, 1], velocity[:, 0])
    whole = merge_blobs(groups.blobs, groups.group, groups.count)
    light = merge_blobs(groups.blobs, groups.bright, groups.count)
    bright = light.area > _MIN_BRIGHT_AREA * car_length_px**2
    form = whole.replace_where(bright, light)
    low_u, high_u = _extent(groups, groups.group, heading)
    low_v, high_v = _extent(groups, groups.group, heading + np.pi / 2)
    mid_u, mid_v = (low_u + high_u) / 2, (low_v + high_v) / 2
    length, width = high_u - low_u, high_v - low_v
    c, s = np.cos(heading), np.sin(heading)
    return MovingObjects(
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


def sample_shadows(groups: BlobGroups, *, car_length_px: float) -> FloatArray:
    """Extent of each group with a bright body and a dark part beyond that body.

    Returns
    -------
    float64 (k, 5)
        Heading, rad; twice the offset from the centre of the bright part's box to that of the whole, along the heading
        and across it, px; offset from bright to dark part, x and y, px.
    """
    heading = np.arctan2(groups.velocity[:, 1], groups.velocity[:, 0])
    bright = merge_blobs(groups.blobs, groups.bright, groups.count)
    dark = merge_blobs(groups.blobs, groups.dark, groups.count)
    both = (bright.area > _MIN_BRIGHT_AREA * car_length_px**2) & (dark.area > 0)
    offsets = []
    for angle in (heading, heading + np.pi / 2):
        whole, body = _extent(groups, groups.group, angle), _extent(groups, groups.bright, angle)
        offsets.append(whole[0][both] + whole[1][both] - body[0][both] - body[1][both])
    return np.stack([heading[both], *offsets, (dark.x - bright.x)[both], (dark.y - bright.y)[both]], axis=1)


def fit_shadow_vector(samples: FloatArray) -> FloatArray:
    """Direction and extent of a car's shadow beyond the car, px, (2,); zero where the samples do not agree on one.

    Least absolute deviations, by iteratively reweighted least squares, over the offsets across the heading and, with
    little weight, along it: there a bonnet as grey as the road may lie between body and shadow.

    Parameters
    ----------
    samples : float64 (k, 5)
        From `sample_shadows`, all frames.
    """
    if len(samples) < _MIN_SHADOW_SAMPLES:
        return np.zeros(2)
    heading, along, across = samples[:, :3].T
    directions = samples[:, 3:] / np.maximum(np.hypot(*samples[:, 3:].T), 1e-9)[:, None]
    if np.hypot(*directions.mean(axis=0)) < _MIN_RESULTANT_LENGTH:
        return np.zeros(2)
    c, s = np.cos(heading), np.sin(heading)
    design = np.concatenate([np.stack([-s, c], axis=1), np.stack([c, s], axis=1)])
    measured = np.concatenate([across, along])
    prior_weight = np.concatenate([np.ones(len(samples)), np.full(len(samples), _ALONG_WEIGHT)])
    weight, shadow = prior_weight, np.zeros(2)
    for _ in range(_IRLS_ROUNDS):
        root = np.sqrt(weight)[:, None]
        shadow = np.linalg.lstsq(design * root, measured * root[:, 0], rcond=None)[0]
        weight = prior_weight / np.maximum(np.abs(design @ shadow - measured), _MIN_RESIDUAL_PX)
    return np.asarray(shadow, np.float64)


def remove_shadow(objects: MovingObjects, shadow: FloatArray) -> MovingObjects:
    """Remove the shadow from boxes: they become shorter and narrower, and shift towards the sun.

    Parameters
    ----------
    objects : MovingObjects
    shadow : float64 (2,)
        From `fit_shadow_vector`, px.
    """
    c, s = np.cos(objects.heading_rad), np.sin(objects.heading_rad)
    along, across = c * shadow[0] + s * shadow[1], c * shadow[1] - s * shadow[0]
    # At most half of a side: a car in another's shade, or under a cloud, casts none.
    along = np.clip(along, -_MAX_SHADOW_FRACTION * objects.length, _MAX_SHADOW_FRACTION * objects.length)
    across = np.clip(across, -_MAX_SHADOW_FRACTION * objects.width, _MAX_SHADOW_FRACTION * objects.width)
    x = objects.x - (c * along - s * across) / 2
    y = objects.y - (s * along + c * across) / 2
    length, width = objects.length - np.abs(along), objects.width - np.abs(across)
    # The covariance of car and shadow together is that of the car plus that of a segment as long as the shadow.
    smear = np.where(objects.bright, 0.0, 1 / 12)
    cxx, cyy = objects.cxx - smear * shadow[0] ** 2, objects.cyy - smear * shadow[1] ** 2
    cxy = objects.cxy - smear * shadow[0] * shadow[1]
    return replace(objects, x=x, y=y, length=length, width=width, cxx=cxx, cxy=cxy, cyy=cyy)


def has_car_size(objects: MovingObjects, *, car_length_px: float | None) -> Mask:
    """Which boxes are filled and, where a car's length is known, of a car's size, whatever their direction of motion.

    Parameters
    ----------
    objects : MovingObjects
    car_length_px : float or None
        A car's typical length, working px; None for any size.
    """
    passes = objects.fill >= _MIN_FILL
    if car_length_px is None:
        return np.asarray(passes, np.bool_)
    # In either direction: objects that move across their long axis are counted too, as evidence of parallax.
    long, short = np.maximum(objects.length, objects.width), np.minimum(objects.length, objects.width)
    passes &= (long >= _LENGTH_RANGE[0] * car_length_px) & (long <= _LENGTH_RANGE[1] * car_length_px)
    passes &= (short >= _WIDTH_RANGE[0] * car_length_px) & (short <= _WIDTH_RANGE[1] * car_length_px)
    return np.asarray(passes, np.bool_)


def moves_along_axis(objects: MovingObjects) -> Mask:
    """Which boxes move along their long axis, as cars do and the edges of roofs (parallax) do not."""
    aspect = objects.length / np.maximum(objects.width, 1e-9)
    elongated = (aspect >= _ASPECT_RANGE[0]) & (aspect <= _ASPECT_RANGE[1])
    return np.asarray(elongated & (~objects.has_axis | (objects.axis_offset_rad < MAX_AXIS_OFFSET_RAD)), np.bool_)


def _extent(groups: BlobGroups, group: IntArray, angle: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Minimum and maximum coordinate of each group's pixels along its own direction.

    Of pixel centres, not corners: blur and threshold have added half a pixel at either end.
    """
    pixels = groups.pixels
    which = group[pixels.blob]
    inside = which >= 0
    which = which[inside]
    coordinate = np.cos(angle)[which] * pixels.x[inside] + np.sin(angle)[which] * pixels.y[inside]
    low, high = np.full(groups.count, np.inf), np.full(groups.count, -np.inf)
    np.minimum.at(low, which, coordinate)
    np.maximum.at(high, which, coordinate)
    return low, high
