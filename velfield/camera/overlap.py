"""The lens from control points: ground that two frames see at different places of the picture.

A flat scene maps from frame to frame by a homography of undistorted pixels,

    raw pixel of i -> undistort -> homography -> shift by relief -> distort -> raw pixel of j

and no homography takes up a lens between places of the picture that it bends differently. Misses are taken in raw
pixels of j (undistorted ones a shrinking lens would win); every pair's homography is solved for inside, and what all
pairs share is found by Gauss-Newton steps with robust weights: vehicles and roofs are outliers. Shared are the amount
of distortion, its centre, and two things that could pass for a lens and do not average out over points:

- Rows that move (rolling shutter) bend a frame in all its pairs: slow waves in the row, of each frame.
- Ground that bulges moves, under a camera that shifts a little, as a distortion would: to first order a bowl and a
  barrel are the same. Bumps of the ground are fitted along, held flat by what is usual of ground only. A camera that
  hangs over one place cannot tell the two apart, and its uncertainty says so; one that flies along can.

The uncertainty is what frames disagree in, each left out with all its pairs, and what ground and centre may hide.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, IntArray
from velfield.camera.lens import HarrisLens, PolynomialLens
from velfield.camera.straighten import AnyLens, robust_weights

RELIEF_SD = 0.005
"""How far ground usually bulges from its plane by a picture's corner, as a share of the flight's height."""
ROW_SD_PX = 1.0
"""Usual amplitude of each wave of the rows."""
HEARD = 0.1
"""Share of the points that count as independent against that knowledge: misses of neighbours are alike."""

SYSTEMATIC = 0.05
"""Share of the points' usual miss that all of them may have in common, at worst just as a lens would."""

_ROUNDS = 10
_LEAST_STEP = 1e-4
_LARGEST_STEP = 0.1
_LEAST_SCALE_PX = 0.1
_WAVES = 14  # of the rows: half a cycle, one, one and a half, ...
_BUMP = 0.8  # half-diagonals: width and spacing of the ground's bumps
_MOST_BUMPS = 49
_BUMP_SD = 1.27 * RELIEF_SD  # such bumps bulge by RELIEF_SD at a corner
_NUDGE = 1e-4
_START_ERROR_PX = 6.0
_LEAST_CORNER = 1e-6  # of a homography's last element and determinant: below, it folds the picture
_FAR_PX = 1e3
_GRID = (-0.1, 0.0, 0.1, 0.25)
_TRIED_ROUNDS = 3
_HILLY_ROUNDS, _HILLY_STEPS = 4, 2
_HELDOUT_ROUNDS = 3


@dataclass(frozen=True)
class Overlap:
    """Matched points of pairs of frames, every pair padded to the same number.

    Attributes
    ----------
    frame_shape : (height, width), px.
    frames : (pairs, 2), numbers of the frames i and j.
    xy_i, xy_j : (pairs, n, 2), raw px.
    there : (pairs, n) bool, false where a place is padding.
    """

    frame_shape: tuple[int, int]
    frames: IntArray
    xy_i: FloatArray
    xy_j: FloatArray
    there: NDArray[np.bool_]

    def only(self, pairs: NDArray[np.bool_]) -> "Overlap":
        """The pairs of a mask (pairs,)."""
        return Overlap(self.frame_shape, self.frames[pairs], self.xy_i[pairs], self.xy_j[pairs], self.there[pairs])


@dataclass(frozen=True)
class LensLine:
    """Lenses of one shape that differ in amount and centre.

    Attributes
    ----------
    unit : the lens of amount 1, an amount being told in Harris' a.
    centre_sd : how far, in half-diagonals, the centre may lie from that of ``unit``.
    """

    unit: AnyLens
    centre_sd: float

    def lens(self, shared: FloatArray) -> AnyLens:
        """The lens of (amount, centre x, centre y, ...), the centre in half-diagonals from that of ``unit``."""
        return scaled(self.unit, float(shared[0]), (float(shared[1]), float(shared[2])))

    def normal(self, xy: FloatArray) -> FloatArray:
        """Pixels (..., 2) in half-diagonals about the centre."""
        return np.asarray((xy - (self.unit.centre_x_px, self.unit.centre_y_px)) / self.unit.half_diagonal_px)

    def pixels(self, normal: FloatArray) -> FloatArray:
        """The inverse of ``normal``."""
        return np.asarray(normal * self.unit.half_diagonal_px + (self.unit.centre_x_px, self.unit.centre_y_px))


def scaled(lens: AnyLens, share: float, centre: tuple[float, float] = (0.0, 0.0)) -> AnyLens:
    """The lens with its distortion times ``share`` and its centre moved by ``centre`` half-diagonals."""
    x = lens.centre_x_px + centre[0] * lens.half_diagonal_px
    y = lens.centre_y_px + centre[1] * lens.half_diagonal_px
    if isinstance(lens, HarrisLens):
        return replace(lens, a=lens.a * share, centre_x_px=x, centre_y_px=y)
    if isinstance(lens, PolynomialLens):
        coefficients = tuple(share * k for k in lens.coefficients)
        return replace(lens, coefficients=coefficients, centre_x_px=x, centre_y_px=y)
    return replace(lens, k=lens.k * share, centre_x_px=x, centre_y_px=y)


@dataclass(frozen=True)
class OverlapFit:
    """A fit of the lens to pairs of frames.

    Attributes
    ----------
    amount, amount_sd : of the distortion, in Harris' a.
    fit_px : usual miss (median over points, mean over pairs) of the fit, all that is shared fitted; raw px.
    before_px, after_px : usual miss of a frame's pairs after homographies alone, with the lens that was there before
        and with the one found without that frame.
    """

    amount: float
    amount_sd: float
    fit_px: float
    before_px: float
    after_px: float


@dataclass(frozen=True)
class _State:
    """Where a fit stands: what pairs share, and each pair's homography (pairs, 3, 3) of normalised pixels."""

    shared: FloatArray
    matrices: FloatArray


@dataclass(frozen=True)
class _Problem:
    """Pairs with, for each, the shift of its picture's middle (pairs, 2) and the ground's bumps at its points
    (pairs, n, bumps)."""

    overlap: Overlap
    line: LensLine
    bumps: FloatArray
    shift: FloatArray
    bump_sd: float = _BUMP_SD

    def only(self, pairs: NDArray[np.bool_]) -> "_Problem":
        return _Problem(self.overlap.only(pairs), self.line, self.bumps[pairs], self.shift[pairs], self.bump_sd)

    @cached_property
    def frame_count(self) -> int:
        return int(self.overlap.frames.max()) + 1

    @cached_property
    def waves(self) -> tuple[FloatArray, FloatArray]:
        """(pairs, n, waves) at the rows of i and of j."""
        height = self.overlap.frame_shape[0]
        cycle = np.pi * (1.0 + np.arange(_WAVES)) / height
        return tuple(np.cos((xy[..., 1:] + 0.5) * cycle) for xy in (self.overlap.xy_i, self.overlap.xy_j))  # type: ignore[return-value]

    @cached_property
    def precision(self) -> FloatArray:
        """(shared,) of what is known beforehand: nothing of the amount."""
        centre, bumps = np.full(2, self.line.centre_sd**-2), np.full(self.bumps.shape[2], self.bump_sd**-2)
        rows = np.full(self.frame_count * _WAVES * 2, ROW_SD_PX**-2)
        return np.concatenate([[1e-9], centre, bumps, rows])

    @cached_property
    def places(self) -> IntArray:
        """(pairs, m) of what each pair shares: the lens, the bumps, the waves of i, those of j."""
        first = 3 + self.bumps.shape[2]
        waves = np.arange(2 * _WAVES)
        rows = [first + 2 * _WAVES * self.overlap.frames[:, k, None] + waves for k in (0, 1)]
        common = np.broadcast_to(np.arange(first), (len(rows[0]), first))
        return np.concatenate([common, *rows], axis=1)

    def parts(self, shared: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The bumps' heights (bumps,) and the rows' waves (frames, waves, 2), px."""
        count = self.bumps.shape[2]
        return shared[3 : 3 + count], shared[3 + count :].reshape(self.frame_count, _WAVES, 2)

    def mapped(self, state: _State) -> FloatArray:
        """Where each pair's map takes the points of i, normalised undistorted, (pairs, n, 2)."""
        heights, rows = self.parts(state.shared)
        moved = self.overlap.xy_i - self.waves[0] @ rows[self.overlap.frames[:, 0]]
        straight = self.line.lens(state.shared).undistort_points(moved.reshape(-1, 2)).reshape(moved.shape)
        relief = (self.bumps @ heights)[..., None] * self.shift[:, None]
        return _by(state.matrices, self.line.normal(straight)) + relief

    def raw(self, shared: FloatArray, mapped: FloatArray) -> FloatArray:
        """Normalised undistorted points (pairs, n, 2) of j as raw px."""
        raw = self.line.lens(shared).distort_points(self.line.pixels(mapped).reshape(-1, 2)).reshape(mapped.shape)
        return np.asarray(raw + self.waves[1] @ self.parts(shared)[1][self.overlap.frames[:, 1]])

    def misses(self, state: _State) -> FloatArray:
        """(pairs, n, 2) raw px of j; NaN outside the lens's domain."""
        return np.asarray(self.overlap.xy_j - self.raw(state.shared, self.mapped(state)))


def _by(matrices: FloatArray, xy: FloatArray) -> FloatArray:
    """Points (pairs, n, 2) by (pairs, 3, 3)."""
    mapped = xy @ matrices[:, :, :2].transpose(0, 2, 1) + matrices[:, None, :, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(mapped[..., :2] / mapped[..., 2:])


def _finite(values: FloatArray) -> FloatArray:
    """Zero in place of what is beyond a lens's domain or a map's horizon: it says nothing."""
    return np.where(np.isfinite(values), values, 0.0)


def _distances(misses: FloatArray, there: NDArray[np.bool_]) -> FloatArray:
    """(pairs, n) px; NaN where a place is padding, far off where a point has no image."""
    distance = np.hypot(misses[..., 0], misses[..., 1])
    return np.where(there, np.where(np.isfinite(distance), distance, _FAR_PX), np.nan)


def _medians(misses: FloatArray, there: NDArray[np.bool_]) -> FloatArray:
    """Median miss of each pair (pairs,), px."""
    return np.asarray(np.nanmedian(_distances(misses, there), axis=1))


def _weights(misses: FloatArray, there: NDArray[np.bool_]) -> FloatArray:
    """Geman-McClure weights (pairs, n) over each pair's own variance, px^-2."""
    scale = np.maximum(_medians(misses, there)[:, None] / 1.1774, _LEAST_SCALE_PX)
    return _finite(robust_weights(_distances(misses, there), scale) / scale**2)


@dataclass(frozen=True)
class _Normal:
    """A linearised problem: of each pair, the information (pairs, m, m) and the pull (pairs, m) of what it shares with
    others, ``places`` (pairs, m) among all that is shared, homographies solved for; ``own`` (pairs, 8) and ``coupling``
    (pairs, 8, m) give the homographies after a step."""

    places: IntArray
    information: FloatArray
    pull: FloatArray
    own: FloatArray
    coupling: FloatArray

    def gathered(self, problem: _Problem, pairs: NDArray[np.bool_] | None = None) -> tuple[FloatArray, FloatArray]:
        """Normal matrix (s, s), what is known beforehand in it, and pull (s,) of all pairs or those of a mask."""
        kept = slice(None) if pairs is None else pairs
        places = self.places[kept]
        normal, pull = np.diag(problem.precision), np.zeros(len(problem.precision))
        np.add.at(normal, (places[:, :, None], places[:, None, :]), HEARD * self.information[kept])
        np.add.at(pull, places, HEARD * self.pull[kept])
        return normal, pull

    def step(self, problem: _Problem, shared: FloatArray, pairs: NDArray[np.bool_] | None = None) -> FloatArray:
        """The step (s,) of the shared from all pairs or those of a mask."""
        normal, pull = self.gathered(problem, pairs)
        return np.asarray(np.linalg.solve(normal, pull - problem.precision * shared))


def _linearised(problem: _Problem, state: _State) -> _Normal:
    misses = problem.misses(state)
    root = np.sqrt(_weights(misses, problem.overlap.there))[..., None, None]
    pairs = len(misses)
    bent = _bent(problem, state)
    own, shared = _own_jacobian(problem, state, bent), _shared_jacobian(problem, state, misses, bent)
    own, shared = (_finite(root * part).reshape(pairs, -1, part.shape[-1]) for part in (own, shared))
    wanted = _finite(root[..., 0] * misses).reshape(pairs, -1, 1)
    normal = own.transpose(0, 2, 1) @ own
    normal += 1e-9 * (1.0 + np.trace(normal, axis1=1, axis2=2)[:, None, None]) * np.eye(8)
    both = np.concatenate([shared, wanted], axis=2)
    crossed = own.transpose(0, 2, 1) @ both
    solved = np.linalg.solve(normal, crossed)
    left = shared.transpose(0, 2, 1) @ both - crossed[:, :, :-1].transpose(0, 2, 1) @ solved
    return _Normal(problem.places, left[:, :, :-1], left[:, :, -1], solved[:, :, -1], solved[:, :, :-1])


def _stepped(state: _State, normal: _Normal, step: FloatArray) -> _State:
    change = normal.own - (normal.coupling @ step[normal.places][..., None])[..., 0]
    change = np.concatenate([change, np.zeros((len(change), 1))], axis=1)
    return _State(state.shared + step, state.matrices + change.reshape(-1, 3, 3))


def _own_jacobian(problem: _Problem, state: _State, bent: FloatArray) -> FloatArray:
    """(pairs, n, 2, 8): raw px by the eight free elements of each pair's homography."""
    lens = problem.line.lens(state.shared)
    xy = problem.line.normal(lens.undistort_points(problem.overlap.xy_i.reshape(-1, 2))).reshape(
        *problem.bumps.shape[:2], 2
    )
    ones = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=2)
    mapped = _by(state.matrices, xy)
    over = ones / (ones @ state.matrices[:, 2, :, None])
    zero = np.zeros_like(over)
    x = np.concatenate([over, zero, -mapped[..., :1] * over[..., :2]], axis=2)
    y = np.concatenate([zero, over, -mapped[..., 1:] * over[..., :2]], axis=2)
    return np.asarray(bent @ np.stack([x, y], axis=2))


def _bent(problem: _Problem, state: _State) -> FloatArray:
    """(pairs, n, 2, 2): derivative of the distortion at each mapped point, raw px by normalised px."""
    here = problem.mapped(state)
    columns = []
    for step in (np.array([_NUDGE, 0.0]), np.array([0.0, _NUDGE])):
        ahead, behind = problem.raw(state.shared, here + step), problem.raw(state.shared, here - step)
        columns.append((ahead - behind) / (2.0 * _NUDGE))
    return np.stack(columns, axis=-1)


def _shared_jacobian(problem: _Problem, state: _State, misses: FloatArray, bent: FloatArray) -> FloatArray:
    """(pairs, n, 2, m): raw px by what a pair shares with others, see ``_Problem.places``."""
    columns = []
    for k in range(3):
        nudged = state.shared.copy()
        nudged[k] += _NUDGE
        columns.append((misses - problem.misses(replace(state, shared=nudged)))[..., None] / _NUDGE)
    relief = bent @ problem.shift[:, None, :, None]
    # Where row motion takes a point of i it takes that of j by the pair's turn and scale, much the same all over.
    turn = -state.matrices[:, None, :2, None, :2]
    of_i = turn * problem.waves[0][:, :, None, :, None]
    of_j = np.eye(2)[:, None, :] * problem.waves[1][:, :, None, :, None]
    rows = [part.reshape(*misses.shape, 2 * _WAVES) for part in (of_i, of_j)]
    return np.concatenate([*columns, relief * problem.bumps[:, :, None, :], *rows], axis=3)


def _homographies(overlap: Overlap, line: LensLine, amount: float) -> FloatArray:
    """(pairs, 3, 3), normalised px, by MAGSAC under the lens of that amount."""
    lens = line.lens(np.array([amount, 0.0, 0.0]))
    limit = _START_ERROR_PX / line.unit.half_diagonal_px
    matrices = []
    for xy_i, xy_j, there in zip(overlap.xy_i, overlap.xy_j, overlap.there, strict=True):
        source, target = (line.normal(lens.undistort_points(xy[there])) for xy in (xy_i, xy_j))
        matrix, _ = cv2.findHomography(source, target, cv2.USAC_MAGSAC, limit, maxIters=2000, confidence=0.999)
        sound = matrix is not None and abs(matrix[2, 2]) > _LEAST_CORNER and abs(np.linalg.det(matrix)) > _LEAST_CORNER
        matrices.append(matrix / matrix[2, 2] if sound else np.eye(3))
    return np.array(matrices, dtype=np.float64)


def _problem(overlap: Overlap, line: LensLine, matrices: FloatArray) -> _Problem:
    ground = _by(_places(overlap, matrices), line.normal(overlap.xy_i))
    inside = ground[overlap.there & np.isfinite(ground).all(axis=2)]
    low, high = np.percentile(inside, 1, axis=0), np.percentile(inside, 99, axis=0)
    spacing = _BUMP
    while np.prod(np.ceil((high - low) / spacing) + 1) > _MOST_BUMPS:  # a long flight: wider bumps
        spacing *= 1.1
    along = [_bumps(ground[..., k], float(low[k]), float(high[k]), spacing) for k in (0, 1)]
    bumps = (along[0][..., :, None] * along[1][..., None, :]).reshape(*ground.shape[:2], -1)
    shift = _by(matrices, np.zeros((len(matrices), 1, 2)))[:, 0]
    return _Problem(overlap, line, _finite(bumps), shift)


def _bumps(places: FloatArray, low: float, high: float, spacing: float) -> FloatArray:
    """(..., bumps): bell curves along one axis, evenly over the range and a little beyond."""
    count = int(np.ceil((high - low) / spacing)) + 1
    nodes = 0.5 * (low + high) + spacing * (np.arange(count) - 0.5 * (count - 1))
    return np.asarray(np.exp(-0.5 * ((places[..., None] - nodes) / spacing) ** 2))


def _places(overlap: Overlap, matrices: FloatArray) -> FloatArray:
    """(pairs, 3, 3) from each frame i to the frame in most pairs, joined by the fullest pairs; NaN: not joined."""
    frames, size = overlap.frames, overlap.there.sum(axis=1)
    placed: dict[int, FloatArray] = {int(np.argmax(np.bincount(frames.ravel()))): np.eye(3)}
    while edges := [p for p, (i, j) in enumerate(frames.tolist()) if (i in placed) != (j in placed)]:
        best = max(edges, key=lambda p: (size[p], -p))
        i, j = frames[best].tolist()
        if j in placed:
            placed[i] = placed[j] @ matrices[best]
        else:
            placed[j] = placed[i] @ np.linalg.inv(matrices[best])
    return np.array([placed.get(i, np.full((3, 3), np.nan)) for i in frames[:, 0].tolist()])


def fit_overlap(overlap: Overlap, line: LensLine, *, start: float | None, before: float) -> OverlapFit:
    """The amount of distortion that the pairs bear out.

    Parameters
    ----------
    overlap
        Matched points; at least two frames of each pair, wrong matches among them.
    line
        The lenses to choose from.
    start
        Amount to start from; none: a grid of them.
    before
        Amount of the lens that the found one is compared with.
    """
    problem, state = min(
        (_tried(overlap, line, amount) for amount in (_GRID if start is None else (start,))),
        key=lambda tried: _typical(tried[0].misses(tried[1]), overlap.there),
    )
    problem, state = _hilly(problem, _settled(problem, state, _ROUNDS))
    normal = _linearised(problem, state)
    misses = problem.misses(state)
    frames = np.unique(overlap.frames)
    without = [~(overlap.frames == frame).any(axis=1) for frame in frames]
    left_out = np.array([state.shared + normal.step(problem, state.shared, kept) for kept in without])
    disagreement = (len(frames) - 1) * float(np.var(left_out[:, 0]))
    fit_px = float(_medians(misses, overlap.there).mean())
    weight = float(_weights(misses, overlap.there).sum())
    before_px, after_px = _left_out(problem, state, left_out[:, :3], without, before)
    deviation = float(np.sqrt(disagreement + _hidden(problem, normal, weight, fit_px)))
    return OverlapFit(*(_told(value) for value in (float(state.shared[0]), deviation, fit_px, before_px, after_px)))


def _told(value: float) -> float:
    """To six digits: the last ones hang on how many threads linear algebra has, and a run's bits must not."""
    return float(f"{value:.6g}")


def _hidden(problem: _Problem, normal: _Normal, weight: float, fit_px: float) -> float:
    """Variance of the amount by what no leaving out of frames shows: the ground's shape, and misses all alike."""
    spread = np.linalg.inv(normal.gathered(problem)[0])[0]
    known = float(np.sum(spread[1:] ** 2 * problem.precision[1:]))
    told_px = np.sqrt(1.0 / (spread[0] * HEARD * weight))  # RMS miss by an amount of 1, all else fitted again
    return known + (SYSTEMATIC * fit_px / float(told_px)) ** 2


def _left_out(
    problem: _Problem, state: _State, lenses: FloatArray, without: Sequence[NDArray[np.bool_]], before: float
) -> tuple[float, float]:
    """Usual miss, px, with the lens before and with those (frames, 3) found without a frame, on that frame's pairs."""
    found = []
    for lens, kept in zip(lenses, without, strict=True):
        part, matrices = problem.only(~kept), state.matrices[~kept]
        found.append([_heldout(part, shape, matrices).mean() for shape in (np.array([before, 0.0, 0.0]), lens)])
    before_px, after_px = np.mean(found, axis=0)
    return float(before_px), float(after_px)


def _tried(overlap: Overlap, line: LensLine, amount: float) -> tuple[_Problem, _State]:
    """A few steps from one start."""
    matrices = _homographies(overlap, line, amount)
    problem = _problem(overlap, line, matrices)
    shared = np.zeros(len(problem.precision))
    shared[0] = amount
    return problem, _settled(problem, _State(shared, matrices), _TRIED_ROUNDS)


def _settled(problem: _Problem, state: _State, rounds: int) -> _State:
    for _ in range(rounds):
        normal = _linearised(problem, state)
        step = normal.step(problem, state.shared)
        step *= min(1.0, _LARGEST_STEP / max(abs(float(step[0])), 1e-12))
        state = _stepped(state, normal, step)
        if abs(float(step[0])) < _LEAST_STEP:
            break
    return state


def _hilly(problem: _Problem, state: _State) -> tuple[_Problem, _State]:
    """As much relief as the pairs show, where that is more than usual: by expectation and maximisation."""
    shown = slice(3, 3 + problem.bumps.shape[2])
    for _ in range(_HILLY_ROUNDS):
        normal = _linearised(problem, state).gathered(problem)[0]
        variance = np.mean(state.shared[shown] ** 2 + np.diag(np.linalg.inv(normal))[shown])
        problem = replace(problem, bump_sd=max(_BUMP_SD, float(np.sqrt(variance))))
        if problem.bump_sd == _BUMP_SD:
            break
        state = _settled(problem, state, _HILLY_STEPS)
    return problem, state


def _typical(misses: FloatArray, there: NDArray[np.bool_]) -> float:
    """Mean over pairs of the logarithm of the median miss: no pair's outliers decide."""
    return float(np.mean(np.log(np.maximum(_medians(misses, there), _LEAST_SCALE_PX))))


def _heldout(problem: _Problem, lens: FloatArray, matrices: FloatArray) -> FloatArray:
    """Median miss of each pair, raw px, under a lens and a homography of its own, nothing else."""
    shared = np.zeros(len(problem.precision))
    shared[:3] = lens
    state = _State(shared, matrices)
    for _ in range(_HELDOUT_ROUNDS):
        misses = problem.misses(state)
        weight = _weights(misses, problem.overlap.there)
        own = _finite(_own_jacobian(problem, state, _bent(problem, state))).reshape(len(misses), -1, 8)
        heard = own * np.repeat(weight, 2, axis=1)[..., None]
        normal = heard.transpose(0, 2, 1) @ own
        change = np.linalg.solve(
            normal + 1e-9 * (1.0 + np.trace(normal, axis1=1, axis2=2)[:, None, None]) * np.eye(8),
            heard.transpose(0, 2, 1) @ _finite(misses).reshape(len(misses), -1, 1),
        )
        change = np.concatenate([change[..., 0], np.zeros((len(change), 1))], axis=1)
        state = _State(shared, state.matrices + change.reshape(-1, 3, 3))
    return _medians(problem.misses(state), problem.overlap.there)
