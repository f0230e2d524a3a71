"""Lens calibration from the straight lines of the scene (paper: camera calibration, the plumb line).

1. Edge points of several frames are linked into smooth arcs (`edges`), and the entropy of their angles and distances
   (`entropy`) is minimised: a grid over the distortion, without which the descent after it ends in local minima.
2. Collinear arcs are merged (`lines`) and the lens is fitted to subpixel accuracy by the straightness of the lines
   (`straighten`): Harris' model, the division model, polynomials of two and three terms, selected by cross-validation.
3. The fit is refined by the vanishing points of families of parallel lines (`vanishing_points`).
4. The distortion is tested for significance (`_decide`), because cities have curved kerbs and few lines fit any lens.
   Otherwise the pinhole model is kept, and the reason is given.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from schemas.arrays import FloatArray, GreyImage
from schemas.camera import CameraRecord, ModelEvidence
from schemas.flight import LensConfig
from velfield.camera.edges import Arcs, detect_and_pool_arcs
from velfield.camera.entropy import hough_entropy
from velfield.camera.lens import HarrisLens, pinhole
from velfield.camera.lines import LineSet, line_residuals, line_rms, merge_collinear_arcs
from velfield.camera.straighten import LensFamily, PlumbLineFit, RadialLens, cv_rms, fit_lens
from velfield.camera.vanishing_points import refine_by_vanishing_points
from velfield.errors import InputError
from velfield.parallel import parallel_map

MIN_LINES = 30
"""Smallest number of straight lines."""
MIN_GAIN_NATS = 0.03
"""Smallest decrease of the entropy by a lens. Curved kerbs of cities without distortion: up to 0.03."""
MIN_SIGNIFICANCE = 5.0
"""Smallest distortion in its standard deviations."""
MAX_DISAGREEMENT = 0.45
"""Largest difference of the estimates of the distortion beyond their own uncertainty, relative to the distortion."""
STRONG_GAIN_NATS, STRONG_SIGNIFICANCE, STRONG_STRAIGHTENED_FRACTION = 0.05, 10.0, 0.75
"""If all three are reached, the estimate by unmerged arcs must agree in sign only: they include every curved kerb, and
where few lines are long they overestimate the distortion (0.17 for a true 0.10). Real footage without distortion stays
below in at least two of the three."""
SD_INFLATION = 3.0
"""Factor on the standard deviation by lines, which does not include systematically curved kerbs: on simulated flights
the errors are up to five of it, RMS three, by straightness alone, and RMS two with vanishing points."""
MIN_MODEL_GAIN = 0.1
"""Relative decrease of the cross-validated residual for which a model with more terms is chosen."""

MIN_STRAIGHTENED_FRACTION = 0.6
"""Smallest fraction straightened of the lines that the lens changes by more than 0.05 px; by chance it is half."""

_MODELS = (("harris", 1), ("division", 1), ("polynomial", 2), ("polynomial", 3))  # the simplest first
_GRID_STEP = 0.05
_DISTANCE_BIN_PX = 2.0
_SEARCH_POINTS = 12_000
_MAX_ANGLE_RAD = 0.03
_LINE_FRACTION = 0.04  # of the diagonal: the shortest line
_FOLDS = 4
_MIN_CHANGE_PX = 0.05
_ALLOWED_SIGMAS = 2.0
_COMPARED_RADIUS = 0.8  # half-diagonals: within it lie most lines
_MAX_CENTRE_OFFSET = 0.1  # half-diagonals from the middle: beyond it the descent has diverged


@dataclass(frozen=True)
class _EdgeData:
    """The arcs of all frames, with what each step derives from them."""

    shape: tuple[int, int]
    arcs: Arcs
    angle_bins: int

    @property
    def pinhole(self) -> HarrisLens:
        return pinhole(self.shape)

    def family(self, name: str, terms: int) -> LensFamily:
        lens = self.pinhole
        return LensFamily(name, terms, (lens.centre_x_px, lens.centre_y_px), lens.half_diagonal_px)

    def entropy(self, lens: RadialLens, arcs: Arcs | None = None) -> float:
        return hough_entropy(arcs or self.arcs, lens, angle_bins=self.angle_bins, distance_bin_px=_DISTANCE_BIN_PX)

    def lines(self, lens: RadialLens, tolerance_px: float) -> LineSet:
        length = _LINE_FRACTION * 2.0 * self.pinhole.half_diagonal_px
        return merge_collinear_arcs(
            self.arcs, lens, tolerance_px=tolerance_px, max_angle_rad=_MAX_ANGLE_RAD, min_length_px=length
        )


def calibrate(frames: Sequence[GreyImage], config: LensConfig) -> CameraRecord:
    """Estimate the lens from grey frames (h, w) uint8 of one camera, of which a dozen spread over the flight suffice.

    The record has the pinhole model, and the reason, if no distortion is significant.

    Raises
    ------
    InputError
        No frames, or frames of different sizes.
    """
    shape = _common_shape(frames)
    data = _EdgeData(shape, detect_and_pool_arcs(frames, max_points=config.max_edge_points), config.angle_bins)
    count = data.arcs.length_px.size
    if count < MIN_LINES:
        reason = f"{count} straight edges in {len(frames)} frames, {MIN_LINES} needed"
        return pinhole_record(shape, reason, len(frames))
    grid_a, grid_entropy, start = _search_distortion(data, config.max_distortion)
    harris = _fit_harris(data, start)
    if harris is None:
        reason = f"fewer than {MIN_LINES} lines of sufficient length in {len(frames)} frames"
        return pinhole_record(shape, reason, len(frames))
    fits, selected, lines, cv_px = _select_model(data, harris)
    bounded = 0 < int(np.argmin(grid_entropy)) < len(grid_a) - 1
    accepted, reason = _decide(data, harris, fits[selected], lines, bounded=bounded)
    accepted = accepted or config.calibrate == "always"
    for number in {0, selected}:
        fits[number] = refine_by_vanishing_points(fits[number], lines)
    candidates = _model_evidence(data, fits, lines, cv_px)
    spread = np.sqrt(np.diag(fits[0].covariance))
    a_sd = SD_INFLATION * float(spread[0])
    centre_sd = spread[-2:] * data.pinhole.half_diagonal_px
    if accepted:
        reason += f"; refined by vanishing points {fits[0].parameters[0]:.3f} +- {a_sd:.3f}"
    return CameraRecord(
        lens=(fits[selected].lens if accepted else data.pinhole).to_record(),
        frame_width_px=shape[1],
        frame_height_px=shape[0],
        accepted=accepted,
        reason=reason,
        residual_px=fits[selected].residual_px,
        residual_without_px=candidates[0].residual_px,
        a_sd=a_sd,
        centre_sd_px=(float(centre_sd[0]), float(centre_sd[1])),
        frames=len(frames),
        lines=lines.count,
        edge_points=int(lines.line.size),
        entropy_a=tuple(float(a) for a in grid_a),
        entropy_nats=tuple(float(value) for value in grid_entropy),
        candidates=candidates,
    )


def pinhole_record(shape: tuple[int, int], reason: str, frames: int = 0) -> CameraRecord:
    """The record of the pinhole model for frames of (height, width)."""
    return CameraRecord(
        lens=pinhole(shape).to_record(),
        frame_width_px=shape[1],
        frame_height_px=shape[0],
        accepted=False,
        reason=reason,
        frames=frames,
    )


def _common_shape(frames: Sequence[GreyImage]) -> tuple[int, int]:
    if not frames:
        raise InputError("no frame to calibrate the lens from; give at least one")
    height, width = frames[0].shape[:2]
    for number, frame in enumerate(frames):
        if frame.shape != (height, width):
            raise InputError(
                f"lens calibration: frame {number} has shape {frame.shape}, frame 0 {(height, width)}; "
                "all must be grey images of one size"
            )
    return height, width


def _search_distortion(data: _EdgeData, max_distortion: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Grid of distortions, its entropies, and the parameters (a, x, y) of minimum entropy after a descent."""
    steps = max(1, round(max_distortion / _GRID_STEP))
    grid = np.linspace(-max_distortion, max_distortion, 2 * steps + 1)
    thinned = data.arcs.subsample(max(1, data.arcs.arc.size // _SEARCH_POINTS))
    family = data.family("harris", 1)

    def entropy(parameters: FloatArray) -> float:
        return data.entropy(family.lens(parameters), thinned)

    values = np.array(parallel_map(lambda a: entropy(np.array([a, 0.0, 0.0])), grid))
    start = np.array([grid[int(np.argmin(values))], 0.0, 0.0])
    # The initial simplex opens towards zero distortion: the other direction may leave the model's domain.
    towards = -1.0 if start[0] > 0 else 1.0
    simplex = start + np.array([[0, 0, 0], [0.03 * towards, 0, 0], [0, 0.01, 0], [0, 0, 0.01]])
    descent = minimize(
        entropy, start, method="Nelder-Mead", options={"initial_simplex": simplex, "maxfev": 60, "xatol": 1e-3}
    )
    best = np.asarray(descent.x, dtype=np.float64)
    diverged = float(np.hypot(best[1], best[2])) > _MAX_CENTRE_OFFSET
    return grid, values, start if diverged else best


def _fit_harris(data: _EdgeData, start: FloatArray) -> PlumbLineFit | None:
    """Fit Harris' model to merged lines, merged again under the better lens; None if there are too few lines."""
    family = data.family("harris", 1)
    parameters, fit = start, None
    for tolerance_px in (3.0, 2.0):
        lines = data.lines(family.lens(parameters), tolerance_px)
        if lines.count < MIN_LINES:
            return None
        fit = fit_lens(lines, family, parameters)
        parameters = fit.parameters
    return fit


def _select_model(data: _EdgeData, harris: PlumbLineFit) -> tuple[list[PlumbLineFit], int, LineSet, list[float]]:
    """Fit each model; select the simplest that cross-validation cannot distinguish from the best.

    Returns the fits, the index of the selected one, the lines, and the cross-validated RMS, px, without a lens and of
    each model.
    """
    a = float(harris.parameters[0])
    series = np.array([a / 2.0, 3.0 / 8.0 * a * a, 5.0 / 16.0 * a**3])
    centre = harris.parameters[1:]
    families = [data.family(name, terms) for name, terms in _MODELS]
    starts = [harris.parameters, *(np.concatenate([series[: family.terms], centre]) for family in families[1:])]
    # All models are compared on one set of lines, merged under one of them: lines merged under a model favour it.
    division = fit_lens(data.lines(harris.lens, 2.0), families[1], starts[1])
    lines = data.lines(division.lens, 1.5)
    fits = parallel_map(lambda model: fit_lens(lines, *model), zip(families, starts, strict=True))
    models = [(data.family("harris", 0), np.zeros(3)), *((fit.family, fit.parameters) for fit in fits)]
    rms = cv_rms(lines, models, folds=_FOLDS)
    rms = np.where(np.isfinite(rms), rms, np.inf)
    # Curved kerbs are straight under no model and must not decide between them.
    straight = rms.min(axis=0) < 3.0 * np.median(rms.min(axis=0))
    cv_px = [float(np.sqrt(np.mean(row[straight] ** 2))) for row in rms]
    selected = 0
    for number in range(1, len(fits)):
        if cv_px[1 + number] < (1.0 - MIN_MODEL_GAIN) * cv_px[1 + selected]:
            selected = number
    return fits, selected, lines, cv_px


def _model_evidence(
    data: _EdgeData, fits: list[PlumbLineFit], lines: LineSet, cv_px: list[float]
) -> tuple[ModelEvidence, ...]:
    by_pinhole = float(np.sqrt(np.mean(line_rms(lines, line_residuals(lines, data.pinhole)) ** 2)))
    rows = [ModelEvidence(model="none", parameters=(), residual_px=by_pinhole, heldout_px=cv_px[0])]
    for fit, model_cv_px in zip(fits, cv_px[1:], strict=True):
        name = fit.family.name if fit.family.terms == 1 else f"{fit.family.name}-{fit.family.terms}"
        rows.append(
            ModelEvidence(
                model=name,
                parameters=tuple(float(value) for value in fit.parameters),
                residual_px=fit.residual_px,
                heldout_px=min(model_cv_px, 1e6),
            )
        )
    return tuple(rows)


def _decide(
    data: _EdgeData, harris: PlumbLineFit, best: PlumbLineFit, lines: LineSet, *, bounded: bool
) -> tuple[bool, str]:
    """Whether the distortion is significant, and the reason in one line.

    ``bounded``: whether the entropy has its minimum inside the searched range. If it falls to the end of the range, as
    at a crossroads of curved kerbs, the evidence must be strong.
    """
    compared = harris if best.family.terms == 1 else best
    unmerged = LineSet(data.arcs.xy, data.arcs.tangents, data.arcs.arc, data.arcs.frame)
    by_pinhole = data.lines(data.pinhole, 2.0)
    fits = [compared, fit_lens(unmerged, compared.family, compared.parameters)]
    if by_pinhole.count >= MIN_LINES:
        fits.append(fit_lens(by_pinhole, compared.family, np.zeros(compared.parameters.size)))
    estimates, deviations = (np.array(values) for values in zip(*(harris_amount(fit) for fit in fits), strict=True))
    # Lines merged as straight under the pinhole model are biased against a lens if at all.
    straightened, changed = _straightened_fraction(by_pinhole, data.pinhole, best.lens)
    a, sd = float(estimates[0]), float(deviations[0])
    gain = data.entropy(data.pinhole) - data.entropy(best.lens)
    significant = gain >= STRONG_GAIN_NATS and abs(a) >= STRONG_SIGNIFICANCE * sd
    strong = significant and straightened >= STRONG_STRAIGHTENED_FRACTION * changed
    excess = np.abs(estimates - a) - _ALLOWED_SIGMAS * deviations
    if strong and estimates[1] * a > 0:
        excess[1] = 0.0
    evidence = (
        f"a = {a:.3f} +- {sd:.3f} from {lines.count} lines, entropy lower by {gain:.3f} nats, estimates "
        f"{estimates.min():.3f} to {estimates.max():.3f}, {straightened} of {changed} changed lines straighter"
    )
    if not (bounded or strong):
        return False, f"{evidence}: the entropy has no minimum within lens.max_distortion, pinhole model kept"
    if gain < MIN_GAIN_NATS:
        return False, f"{evidence}: less than {MIN_GAIN_NATS} nats gained, pinhole model kept"
    if abs(a) < MIN_SIGNIFICANCE * sd:
        return False, f"{evidence}: below {MIN_SIGNIFICANCE:g} standard deviations, pinhole model kept"
    if float(excess.max()) > MAX_DISAGREEMENT * abs(a):
        return False, f"{evidence}: they disagree, as with curved kerbs, pinhole model kept"
    if straightened < MIN_STRAIGHTENED_FRACTION * changed:
        return False, f"{evidence}: {MIN_STRAIGHTENED_FRACTION:.0%} needed, pinhole model kept"
    return True, f"{evidence}: {best.family.name} accepted"


def harris_amount(fit: PlumbLineFit) -> tuple[float, float]:
    """Distortion as Harris' a, and its standard deviation.

    For a lens of several terms, the a of the Harris lens with the same displacement at `_COMPARED_RADIUS`: if one term
    cannot describe the lens, its fitted value depends on where the lines happen to lie.
    """
    if fit.family.name == "harris":
        return float(fit.parameters[0]), float(np.sqrt(fit.covariance[0, 0]))

    def amount(parameters: FloatArray) -> float:
        unit = replace(fit.family, middle=(0.0, 0.0), half_diagonal_px=1.0).lens(np.append(parameters[:-2], (0.0, 0.0)))
        radius = float(unit.undistort_points(np.array([[_COMPARED_RADIUS, 0.0]]))[0, 0])
        return (1.0 - (_COMPARED_RADIUS / radius) ** 2) / _COMPARED_RADIUS**2

    value = amount(fit.parameters)
    steps = 1e-5 * np.eye(fit.parameters.size)[: fit.family.terms]
    slope = np.array([(amount(fit.parameters + step) - value) / 1e-5 for step in steps])
    terms = slice(0, fit.family.terms)
    return value, float(np.sqrt(slope @ fit.covariance[terms, terms] @ slope))


def _straightened_fraction(lines: LineSet, by_pinhole: RadialLens, lens: RadialLens) -> tuple[int, int]:
    """The fraction as counts: lines that a lens straightens, of those whose RMS it changes by more than 0.05 px."""
    rms = line_rms(lines, line_residuals(lines, lens))
    change = rms - line_rms(lines, line_residuals(lines, by_pinhole))
    changed = (np.abs(change) > _MIN_CHANGE_PX) & np.isfinite(rms)
    return int(np.sum(change[changed] < 0)), int(changed.sum())
