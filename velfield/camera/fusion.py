"""Fusion of the plumb-line and the multi-view estimate of the lens.

Their errors are independent: curved kerbs bias the plumb line, relief and rolling shutter the multi-view estimate. If
they agree within 3 sigma they are fused by inverse variance; if not, the plumb-line lens stays. If the plumb line found
no significant distortion, the multi-view estimate is accepted on strong evidence only: a distortion where there is none
is the worse error.
"""

from dataclasses import dataclass

import numpy as np

from schemas.camera import CameraRecord, OverlapEvidence
from velfield.camera.frame_pairs import FramePairs, ScaledLens, scale_distortion
from velfield.camera.lens import HarrisLens, lens_from_record, pinhole
from velfield.camera.multiview import MultiViewFit, fit_multiview
from velfield.camera.straighten import RadialLens

MIN_FRAMES, MIN_PAIRS = 5, 6
"""Fewer do not allow a jackknife over frames."""
AGREEMENT_SIGMAS = 3.0
"""Largest difference of the two estimates, in standard deviations of that difference."""
MIN_WEIGHT = 0.25
"""Smallest inverse-variance weight of the multi-view estimate for which the lens is changed."""
MAX_RESIDUAL = 1.5e-3
"""Residual of the multi-view fit, half-diagonals, above which the scene is not planar: roofs and trees, not a lens."""
NEW_DISTORTION_SIGMAS = 10.0
"""Significance of a distortion that the plumb line has no estimate of ..."""
CONFIRMED_SIGMAS = 4.0
"""... or this, if the plumb line's estimate, too uncertain to be accepted, is consistent with it."""
MIN_CV_GAIN = 0.03
"""Relative decrease of the cross-validated residual against the pinhole model that a new distortion needs; if both
estimates are significant and agree, any decrease suffices: row motion may dominate the residual."""
MAX_CV_LOSS = 0.02
"""Relative increase that a refined lens is allowed: that is noise."""
MIN_CORNER_PX = 2.0
"""Smallest displacement of an image corner by a distortion worth accepting."""

_MAX_RELATIVE_DIFFERENCE = 0.45  # of the distortion, as between the plumb line's own estimates
_MIN_AMOUNT = 0.005  # a plumb-line lens with less has no profile to refine
_CENTRE_SD = (0.005, 0.03)  # half-diagonals: limits of the prior of the centre


@dataclass(frozen=True)
class _Estimates:
    """Both estimates: the record by the plumb line, the multi-view fit, and the plumb line's (a, sd) if it has one."""

    record: CameraRecord
    evidence: OverlapEvidence
    family: ScaledLens
    fit: MultiViewFit
    plumb_line: tuple[float, float] | None

    def keep(self, reason: str) -> CameraRecord:
        """The record with its lens unchanged."""
        return _keep(self.record, self.evidence, f"{self.evidence.reason}{reason}")

    @property
    def fused(self) -> tuple[float, float]:
        """Amount and standard deviation by inverse variance of both; the multi-view estimate if it is the only one."""
        estimates = [(self.fit.amount, self.fit.amount_sd), *([self.plumb_line] if self.plumb_line else [])]
        amounts, deviations = np.array(estimates).T
        precision = deviations**-2
        return float(np.average(amounts, weights=precision)), float(precision.sum() ** -0.5)

    def accept(self, reason: str) -> CameraRecord:
        """The record with the lens of the fused amount."""
        amount, a_sd = self.fused
        evidence = self.evidence.model_copy(update={"used": True, "reason": f"{self.evidence.reason}{reason}"})
        record = self.record
        before = record.reason.removesuffix(", pinhole model kept")
        if not record.accepted:  # the residual and centre on record are those of the rejected plumb-line lens
            centre_sd_px = self.family.centre_sd * self.family.unit.half_diagonal_px
            record = record.model_copy(update={"residual_px": None, "centre_sd_px": (centre_sd_px, centre_sd_px)})
        update = {"lens": self._lens(amount).to_record(), "a_sd": a_sd, "overlap": evidence}
        return record.model_copy(update={**update, "accepted": True, "reason": f"{before}; then {evidence.reason}"})

    def corner_px(self, amount: float) -> float:
        """Displacement of the image corner by the lens of an amount."""
        corner = np.zeros((1, 2))
        return float(np.hypot(*(self._lens(amount).undistort_points(corner) - corner)[0]))

    @property
    def is_planar(self) -> bool:
        """Whether homographies explain the points well enough."""
        return not self.fit.fit_px > MAX_RESIDUAL * self.family.unit.half_diagonal_px

    def agrees(self, a: float, a_sd: float) -> bool:
        """Whether the multi-view estimate agrees with the plumb line's within both standard deviations."""
        return abs(self.fit.amount - a) <= AGREEMENT_SIGMAS * float(np.hypot(self.fit.amount_sd, a_sd))

    def _lens(self, amount: float) -> RadialLens:
        return self.family.lens(np.array([amount, 0.0, 0.0]))


def refine_lens(record: CameraRecord, pairs: FramePairs | None) -> CameraRecord:
    """The plumb line's record with the lens refined by frame pairs (None: none match), or unchanged, and the reason."""
    plumb_line = _plumb_line_estimate(record)
    evidence = _describe_pairs(pairs, plumb_line)
    if pairs is None or evidence.frames < MIN_FRAMES or evidence.pairs < MIN_PAIRS:
        counts = f"{evidence.pairs} pairs of {evidence.frames} frames match"
        return _keep(record, evidence, f"{counts}, {MIN_PAIRS} pairs of {MIN_FRAMES} frames needed")
    if not record.accepted:
        hole = pinhole((record.frame_height_px, record.frame_width_px))
        unit = HarrisLens(1.0, hole.centre_x_px, hole.centre_y_px, hole.half_diagonal_px)
        family = ScaledLens(unit, _CENTRE_SD[1])
        fit = fit_multiview(pairs, family, start=None, before=0.0)
        return _accept_new_distortion(_Estimates(record, _with_figures(evidence, fit), family, fit, plumb_line))
    if plumb_line is None or abs(plumb_line[0]) < _MIN_AMOUNT:
        return _keep(record, evidence, "the plumb line's distortion is too small to be refined")
    family = ScaledLens(scale_distortion(lens_from_record(record.lens), 1.0 / plumb_line[0]), _centre_sd(record))
    fit = fit_multiview(pairs, family, start=plumb_line[0], before=plumb_line[0])
    return _fuse(_Estimates(record, _with_figures(evidence, fit), family, fit, plumb_line), *plumb_line)


def _keep(record: CameraRecord, evidence: OverlapEvidence, reason: str) -> CameraRecord:
    return record.model_copy(update={"overlap": evidence.model_copy(update={"reason": reason})})


def _plumb_line_estimate(record: CameraRecord) -> tuple[float, float] | None:
    """The plumb line's distortion as Harris' a, and its inflated standard deviation."""
    harris = [row for row in record.candidates if row.model == "harris"]
    return (harris[0].parameters[0], record.a_sd) if harris and record.a_sd is not None else None


def _centre_sd(record: CameraRecord) -> float:
    if record.centre_sd_px is None:
        return _CENTRE_SD[1]
    return float(np.clip(np.mean(record.centre_sd_px) / record.lens.half_diagonal_px, *_CENTRE_SD))


def _describe_pairs(pairs: FramePairs | None, plumb_line: tuple[float, float] | None) -> OverlapEvidence:
    lines_a, lines_a_sd = plumb_line or (None, None)
    evidence = OverlapEvidence(reason="", lines_a=lines_a, lines_a_sd=lines_a_sd)
    if pairs is None:
        return evidence
    frames, points = len(np.unique(pairs.frames)), int(pairs.valid.sum())
    return evidence.model_copy(update={"pairs": len(pairs.frames), "frames": frames, "points": points})


def _with_figures(evidence: OverlapEvidence, fit: MultiViewFit) -> OverlapEvidence:
    estimate = f"a = {fit.amount:.3f} +- {fit.amount_sd:.3f}"
    figures = {
        "a": fit.amount,
        "a_sd": fit.amount_sd,
        "fit_px": fit.fit_px,
        "before_px": fit.before_px,
        "after_px": fit.after_px,
        "reason": f"multi-view {estimate} from {evidence.pairs} pairs of {evidence.frames} frames",
    }
    return evidence.model_copy(update=figures)


def _fuse(estimates: _Estimates, a: float, a_sd: float) -> CameraRecord:
    """Fuse the plumb line's lens with the multi-view estimate by inverse variance, or keep it."""
    fit = estimates.fit
    weight = fit.amount_sd**-2 / (fit.amount_sd**-2 + a_sd**-2)
    compared = f", plumb line {a:.3f} +- {a_sd:.3f}"
    if not estimates.is_planar:
        return estimates.keep(f"{compared}: residual {fit.fit_px:.1f} px, scene not planar, plumb-line lens kept")
    if not estimates.agrees(a, a_sd):
        return estimates.keep(f"{compared}: they disagree, plumb-line lens kept")
    if weight < MIN_WEIGHT:
        return estimates.keep(f"{compared}: camera positions too similar to refine it, plumb-line lens kept")
    if fit.after_px > (1.0 + MAX_CV_LOSS) * fit.before_px:
        return estimates.keep(f"{compared}: cross-validated residual not lower, plumb-line lens kept")
    return estimates.accept(f"{compared}: fused to {estimates.fused[0]:.3f}")


def _accept_new_distortion(estimates: _Estimates) -> CameraRecord:
    """Accept a distortion that the plumb line did not establish, on strong evidence only; else the pinhole model."""
    fit, amount, compared, gain = estimates.fit, estimates.fused[0], "", MIN_CV_GAIN
    sigmas = NEW_DISTORTION_SIGMAS if estimates.plumb_line is None else CONFIRMED_SIGMAS
    if not estimates.is_planar:
        return estimates.keep(f": residual {fit.fit_px:.1f} px, scene not planar, pinhole model kept")
    if abs(fit.amount) < sigmas * fit.amount_sd:
        return estimates.keep(f": below {sigmas:g} standard deviations, pinhole model kept")
    if estimates.plumb_line is not None:
        a, a_sd = estimates.plumb_line
        if abs(fit.amount - a) > _MAX_RELATIVE_DIFFERENCE * abs(fit.amount):
            return estimates.keep(f", plumb line {a:.3f}: they disagree, pinhole model kept")
        compared = f", plumb line {a:.3f} +- {a_sd:.3f}"
        confirmed = abs(a) >= CONFIRMED_SIGMAS * a_sd and estimates.agrees(a, a_sd)
        gain = 0.0 if confirmed else MIN_CV_GAIN
    if fit.after_px >= (1.0 - gain) * fit.before_px:
        return estimates.keep(f"{compared}: cross-validated residual not lower, pinhole model kept")
    if estimates.corner_px(amount) < MIN_CORNER_PX:
        return estimates.keep(f": less than {MIN_CORNER_PX:g} px at a corner, pinhole model kept")
    return estimates.accept(f"{compared}: a distortion of {amount:.3f} accepted")
