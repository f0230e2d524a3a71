"""Lens calibration from the straight lines of the scene (paper: camera calibration, the plumb line).

1. Edge points of several frames, linked into smooth arcs (`edges`).
2. A grid of starts over the distortion, then a descent with the centre free: the least entropy of the lines' angles and
   distances (`entropy`). Without the grid the descent falls into false minima.
3. Arcs that one line explains are joined, and the lens fitted below the pixel by the lines' straightness (`lines`,
   `straighten`): Harris' model, the division model, polynomials of two and three terms, of which lines left out of the
   fit choose.
4. Families of parallels say by their directions what bows are too small to say (`parallels`).
5. The evidence: a city has kerbs that bend, and from few lines any lens can be had. A distortion is accepted where it
   lowers the entropy, stands well above its own uncertainty, comes out alike from arcs alone, from lines joined without
   a lens and from lines joined with it, and straightens most of the lines that it changes at all. Otherwise the
   pin-hole stays, and the reason is given.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from schemas.arrays import FloatArray, GreyImage
from schemas.camera import CameraRecord, ModelEvidence
from schemas.flight import LensConfig
from velfield.camera.edges import Arcs, find_arcs, pool_arcs
from velfield.camera.entropy import hough_entropy
from velfield.camera.lens import HarrisLens, pinhole
from velfield.camera.lines import LineSet, join_arcs, line_residuals, line_rms
from velfield.camera.parallels import refine_by_parallels
from velfield.camera.straighten import AnyLens, LensFamily, StraightFit, fit_lens, heldout_rms
from velfield.errors import InputError

MIN_LINES = 30
"""Fewer straight lines than this say nothing of a lens."""
MIN_GAIN_NATS = 0.03
"""Entropy that a lens must save. Cities through lenses without distortion: up to .03 by bent kerbs alone."""
MIN_SIGNIFICANCE = 5.0
"""Distortion against its standard deviation."""
MAX_DISAGREEMENT = 0.45
"""How far apart the estimates of the distortion may lie beyond their own uncertainty, in units of the distortion."""
STRONG_GAIN_NATS, STRONG_SIGNIFICANCE, STRONG_STRAIGHTER = 0.05, 10.0, 0.75
"""From here on in all three, arcs alone are heard for the sign only: every kerb that bends is among them, and where few
lines are long they overrate a lens (0.17 where the truth and the joined lines say 0.10). Real footage without
distortion stays below in at least two of the three."""
LINES_FACTOR = 3.0
"""The lines' standard deviation knows nothing of kerbs that bend alike: by straightness alone they err by up to five of
it on simulated flights, RMS three; with parallels by RMS two."""
MODEL_GAIN = 0.1
"""Share by which lines left out of the fit must lie straighter for a model with more terms."""

MIN_STRAIGHTER = 0.6
"""Share of the lines that the lens changes noticeably which it must straighten; of random bends, half."""

_MODELS = (("harris", 1), ("division", 1), ("polynomial", 2), ("polynomial", 3))  # the simplest first
_GRID_STEP = 0.05
_DISTANCE_BIN_PX = 2.0
_SEARCH_POINTS = 12_000
_MAX_TURN_RAD = 0.03
_ARC_SHARE, _LINE_SHARE = 0.012, 0.04  # of the diagonal: the shortest arc, the shortest line
_FOLDS = 4
_NOTICEABLE_PX = 0.05
_ALLOWED_SIGMAS = 2.0
_FARTHEST_CENTRE = 0.1  # half-diagonals from the middle: no lens, but a descent that ran away


@dataclass(frozen=True)
class CalibrationResult:
    """A lens and the evidence for it; ``lens`` is the pin-hole where ``accepted`` is false.

    Attributes
    ----------
    lens
        Harris, polynomial, or the pin-hole.
    accepted, reason
        Whether a distortion was borne out, and why, in one line.
    residual_px, residual_without_px
        RMS distance of edge points from their lines with and without the lens, raw px.
    a_sd, centre_sd_px
        Standard deviations of Harris' distortion, kerbs that bend alike allowed for, and of the centre, lines as the
        independent units.
    entropy_a, entropy_nats
        The grid of starts and the entropy there.
    candidates
        Each model tried, with its RMS on lines left out.
    """

    lens: AnyLens
    accepted: bool
    reason: str
    frame_shape: tuple[int, int]
    frames: int = 0
    lines: int = 0
    edge_points: int = 0
    residual_px: float | None = None
    residual_without_px: float | None = None
    a_sd: float | None = None
    centre_sd_px: tuple[float, float] | None = None
    entropy_a: tuple[float, ...] = ()
    entropy_nats: tuple[float, ...] = ()
    candidates: tuple[ModelEvidence, ...] = ()

    def to_record(self) -> CameraRecord:
        """The record that ``camera.json`` holds."""
        return CameraRecord(
            lens=self.lens.to_record(),
            frame_width_px=self.frame_shape[1],
            frame_height_px=self.frame_shape[0],
            accepted=self.accepted,
            reason=self.reason,
            residual_px=self.residual_px,
            residual_without_px=self.residual_without_px,
            a_sd=self.a_sd,
            centre_sd_px=self.centre_sd_px,
            frames=self.frames,
            lines=self.lines,
            edge_points=self.edge_points,
            entropy_a=self.entropy_a,
            entropy_nats=self.entropy_nats,
            candidates=self.candidates,
        )


@dataclass(frozen=True)
class _Scene:
    """What every step needs of the frames."""

    shape: tuple[int, int]
    arcs: Arcs
    angle_bins: int

    @property
    def pinhole(self) -> HarrisLens:
        return pinhole(self.shape)

    def family(self, name: str, terms: int) -> LensFamily:
        hole = self.pinhole
        return LensFamily(name, terms, (hole.centre_x_px, hole.centre_y_px), hole.half_diagonal_px)

    def entropy(self, lens: AnyLens, arcs: Arcs | None = None) -> float:
        return hough_entropy(arcs or self.arcs, lens, angle_bins=self.angle_bins, distance_bin_px=_DISTANCE_BIN_PX)

    def lines(self, lens: AnyLens, tolerance_px: float) -> LineSet:
        length = _LINE_SHARE * 2.0 * self.pinhole.half_diagonal_px
        return join_arcs(self.arcs, lens, tolerance_px=tolerance_px, max_turn_rad=_MAX_TURN_RAD, min_length_px=length)


def calibrate(frames: Sequence[GreyImage], config: LensConfig, seed: int = 0) -> CalibrationResult:
    """Estimate the lens from frames of one camera.

    Parameters
    ----------
    frames
        (h, w) uint8 grey frames, all of one size; a dozen spread over the flight is plenty.
    config
        The lens section of the flight's configuration.
    seed
        Seed of the split into lines fitted and lines left out.

    Returns
    -------
    CalibrationResult
        With the pin-hole, and the reason, where the evidence for a distortion is too small.

    Raises
    ------
    InputError
        No frames, or frames of different sizes.
    """
    shape = _common_shape(frames)
    if config.calibrate == "never":
        return CalibrationResult(pinhole(shape), False, "calibration is switched off", shape)
    scene = _Scene(shape, _pooled_arcs(frames, shape, config), config.angle_bins)
    found = scene.arcs.length_px.size
    if found < MIN_LINES:
        reason = f"{found} straight edges in {len(frames)} frames, {MIN_LINES} needed"
        return CalibrationResult(pinhole(shape), False, reason, shape, frames=len(frames))
    grid_a, grid_entropy, start = _search(scene, config.max_distortion)
    harris = _fit_harris(scene, start)
    if harris is None:
        reason = f"fewer than {MIN_LINES} lines long enough in {len(frames)} frames"
        return CalibrationResult(pinhole(shape), False, reason, shape, frames=len(frames))
    fits, chosen, lines, heldout = _choose_model(scene, harris, seed)
    bounded = 0 < int(np.argmin(grid_entropy)) < len(grid_a) - 1
    accepted, reason = _judge(scene, harris, fits[chosen], lines, bounded=bounded)
    accepted = accepted or config.calibrate == "always"
    for number in {0, chosen}:
        fits[number] = refine_by_parallels(fits[number], lines, seed)
    candidates = _evidence(scene, fits, lines, heldout)
    spread = np.sqrt(np.diag(fits[0].covariance))
    a_sd = LINES_FACTOR * float(spread[0])
    centre_sd = spread[-2:] * scene.pinhole.half_diagonal_px
    if accepted:
        reason += f"; with parallels, and allowing for kerbs that bend alike, {fits[0].parameters[0]:.3f} +- {a_sd:.3f}"
    return CalibrationResult(
        lens=fits[chosen].lens if accepted else scene.pinhole,
        accepted=accepted,
        reason=reason,
        frame_shape=shape,
        frames=len(frames),
        lines=lines.count,
        edge_points=int(lines.line.size),
        residual_px=fits[chosen].residual_px,
        residual_without_px=candidates[0].residual_px,
        a_sd=a_sd,
        centre_sd_px=(float(centre_sd[0]), float(centre_sd[1])),
        entropy_a=tuple(float(a) for a in grid_a),
        entropy_nats=tuple(float(value) for value in grid_entropy),
        candidates=candidates,
    )


def _common_shape(frames: Sequence[GreyImage]) -> tuple[int, int]:
    if not frames:
        raise InputError("no frame to calibrate the lens from; give at least one")
    height, width = frames[0].shape[:2]
    for number, frame in enumerate(frames):
        if frame.shape != (height, width):
            raise InputError(
                f"lens calibration: frame {number} has shape {frame.shape}, frame 0 {(height, width)}; "
                "all must be grey pictures of one size"
            )
    return height, width


def _pooled_arcs(frames: Sequence[GreyImage], shape: tuple[int, int], config: LensConfig) -> Arcs:
    half_diagonal = pinhole(shape).half_diagonal_px
    parts = [
        find_arcs(
            frame,
            frame=number,
            min_length_px=max(24.0, _ARC_SHARE * 2.0 * half_diagonal),
            max_curvature_per_px=2.0 / half_diagonal,
        )
        for number, frame in enumerate(frames)
    ]
    return pool_arcs(parts, max_points=config.max_edge_points)


def _search(scene: _Scene, max_distortion: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Grid of distortions, its entropies, and the parameters (a, x, y) of least entropy after a descent."""
    steps = max(1, round(max_distortion / _GRID_STEP))
    grid = np.linspace(-max_distortion, max_distortion, 2 * steps + 1)
    thinned = scene.arcs.every(max(1, scene.arcs.arc.size // _SEARCH_POINTS))
    family = scene.family("harris", 1)

    def entropy(parameters: FloatArray) -> float:
        return scene.entropy(family.lens(parameters), thinned)

    values = np.array([entropy(np.array([a, 0.0, 0.0])) for a in grid])
    start = np.array([grid[int(np.argmin(values))], 0.0, 0.0])
    # The simplex opens towards the pin-hole: the other way may leave the model's domain.
    towards = -1.0 if start[0] > 0 else 1.0
    simplex = start + np.array([[0, 0, 0], [0.03 * towards, 0, 0], [0, 0.01, 0], [0, 0, 0.01]])
    descent = minimize(
        entropy, start, method="Nelder-Mead", options={"initial_simplex": simplex, "maxfev": 60, "xatol": 1e-3}
    )
    best = np.asarray(descent.x, dtype=np.float64)
    wandered = float(np.hypot(best[1], best[2])) > _FARTHEST_CENTRE
    return grid, values, start if wandered else best


def _fit_harris(scene: _Scene, start: FloatArray) -> StraightFit | None:
    """Harris' model on joined lines, joined anew as the lens gets better; None where lines are too few."""
    family = scene.family("harris", 1)
    parameters, fit = start, None
    for tolerance_px in (3.0, 2.0):
        lines = scene.lines(family.lens(parameters), tolerance_px)
        if lines.count < MIN_LINES:
            return None
        fit = fit_lens(lines, family, parameters)
        parameters = fit.parameters
    return fit


def _choose_model(scene: _Scene, harris: StraightFit, seed: int) -> tuple[list[StraightFit], int, LineSet, list[float]]:
    """A fit of each model, the number of the simplest that lines left out of the fit do not tell from the best, the
    lines, and the usual RMS of those left out, px, without a lens and by each model."""
    a = float(harris.parameters[0])
    series = np.array([a / 2.0, 3.0 / 8.0 * a * a, 5.0 / 16.0 * a**3])
    centre = harris.parameters[1:]
    families = [scene.family(name, terms) for name, terms in _MODELS]
    starts = [harris.parameters, *(np.concatenate([series[: family.terms], centre]) for family in families[1:])]
    # All models are judged on one set of lines, joined under a middling one: lines joined under a model flatter it.
    division = fit_lens(scene.lines(harris.lens, 2.0), families[1], starts[1])
    lines = scene.lines(division.lens, 1.5)
    fits = [fit_lens(lines, family, start) for family, start in zip(families, starts, strict=True)]
    models = [(scene.family("harris", 0), np.zeros(3)), *((fit.family, fit.parameters) for fit in fits)]
    heldout = heldout_rms(lines, models, folds=_FOLDS, seed=seed)
    heldout = np.where(np.isfinite(heldout), heldout, np.inf)
    # A kerb that bends is no line under any model; let it not decide between them.
    straight = heldout.min(axis=0) < 3.0 * np.median(heldout.min(axis=0))
    typical = [float(np.sqrt(np.mean(row[straight] ** 2))) for row in heldout]
    chosen = 0
    for number in range(1, len(fits)):
        if typical[1 + number] < (1.0 - MODEL_GAIN) * typical[1 + chosen]:
            chosen = number
    return fits, chosen, lines, typical


def _evidence(
    scene: _Scene, fits: list[StraightFit], lines: LineSet, typical: list[float]
) -> tuple[ModelEvidence, ...]:
    without = float(np.sqrt(np.mean(line_rms(lines, line_residuals(lines, scene.pinhole)) ** 2)))
    rows = [ModelEvidence(model="none", parameters=(), residual_px=without, heldout_px=typical[0])]
    for fit, heldout in zip(fits, typical[1:], strict=True):
        name = fit.family.name if fit.family.terms == 1 else f"{fit.family.name}-{fit.family.terms}"
        rows.append(
            ModelEvidence(
                model=name,
                parameters=tuple(float(value) for value in fit.parameters),
                residual_px=fit.residual_px,
                heldout_px=min(heldout, 1e6),
            )
        )
    return tuple(rows)


def _judge(scene: _Scene, harris: StraightFit, best: StraightFit, lines: LineSet, *, bounded: bool) -> tuple[bool, str]:
    """Whether a distortion is better than none, and the one line that says why.

    ``bounded``: whether the entropy is least within the distortions that were searched. Where it falls to their end, as
    at a crossroads of bent kerbs, the evidence must be strong.
    """
    family = scene.family("harris", 1)
    alone = LineSet(scene.arcs.xy, scene.arcs.tangents, scene.arcs.arc, scene.arcs.frame)
    without = scene.lines(scene.pinhole, 2.0)
    fits = [harris, fit_lens(alone, family, harris.parameters)]
    if without.count >= MIN_LINES:
        fits.append(fit_lens(without, family, np.zeros(3)))
    estimates = np.array([fit.parameters[0] for fit in fits])
    deviations = np.array([float(np.sqrt(fit.covariance[0, 0])) for fit in fits])
    # Lines joined as straight with no lens speak against a lens if at all: their vote is the fair one.
    straighter, told = _vote(without, scene.pinhole, best.lens)
    a, sd = float(estimates[0]), float(deviations[0])
    gain = scene.entropy(scene.pinhole) - scene.entropy(best.lens)
    strong = gain >= STRONG_GAIN_NATS and abs(a) >= STRONG_SIGNIFICANCE * sd and straighter >= STRONG_STRAIGHTER * told
    apart = np.abs(estimates - a) - _ALLOWED_SIGMAS * deviations
    if strong and estimates[1] * a > 0:
        apart[1] = 0.0
    found = (
        f"a = {a:.3f} +- {sd:.3f} from {lines.count} lines, entropy {gain:+.3f} nats less than with none, "
        f"estimates {estimates.min():.3f} to {estimates.max():.3f}, {straighter} of {told} bent lines straighter"
    )
    if not (bounded or strong):
        return False, f"{found}: the entropy has no minimum within lens.max_distortion, pin-hole kept"
    if gain < MIN_GAIN_NATS:
        return False, f"{found}: less than {MIN_GAIN_NATS} nats gained, pin-hole kept"
    if abs(a) < MIN_SIGNIFICANCE * sd:
        return False, f"{found}: below {MIN_SIGNIFICANCE:g} standard deviations, pin-hole kept"
    if float(apart.max()) > MAX_DISAGREEMENT * abs(a):
        return False, f"{found}: they disagree, as with kerbs that bend, pin-hole kept"
    if straighter < MIN_STRAIGHTER * told:
        return False, f"{found}: {MIN_STRAIGHTER:.0%} needed, pin-hole kept"
    return True, f"{found}: {best.family.name} accepted"


def _vote(lines: LineSet, without: AnyLens, lens: AnyLens) -> tuple[int, int]:
    """Of the lines that a lens changes noticeably: how many it makes straighter, and how many there are."""
    rms = line_rms(lines, line_residuals(lines, lens))
    change = rms - line_rms(lines, line_residuals(lines, without))
    told = (np.abs(change) > _NOTICEABLE_PX) & np.isfinite(rms)
    return int(np.sum(change[told] < 0)), int(told.sum())
