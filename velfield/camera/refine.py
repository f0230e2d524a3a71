"""Whether and how control points refine the lens that the straight lines gave.

The two know nothing of each other: lines are bent by kerbs, control points by relief and by rows that move. Where they
agree, they are joined by inverse variance; where not, the lines' lens stays. Where the lines gave none, control points
may bring a distortion in, on strong evidence only: a distortion where there is none is the worse error.
"""

from dataclasses import dataclass

import numpy as np

from schemas.camera import CameraRecord, OverlapEvidence
from velfield.camera.lens import HarrisLens, lens_from_record, pinhole
from velfield.camera.overlap import LensLine, Overlap, OverlapFit, fit_overlap, scaled
from velfield.camera.straighten import AnyLens

LEAST_FRAMES, LEAST_PAIRS = 5, 6
"""Fewer say nothing of how far frames disagree."""
AGREEMENT_SIGMAS = 3.0
"""How far apart lines and control points may lie, in standard deviations of their difference."""
LEAST_SHARE = 0.25
"""Of the weight: control points that would have less change nothing."""
LARGEST_FIT = 1.5e-3
"""Usual miss, in half-diagonals, above which no plane explains the pairs: roofs and trees, not a lens."""
BRING_IN_SIGMAS = 10.0
"""A distortion that lines said nothing of, against its standard deviation ..."""
CONFIRMED_SIGMAS = 4.0
"""... or this, where the lines' own fit, too weak to be accepted, says the same."""
LEAST_GAIN = 0.03
"""Share by which control points of frames left out must miss less with it than with the pin-hole; where both stand as
far above none and agree, less by anything: rows that move may be most of what they miss by."""
MOST_LOSS = 0.02
"""Share by which they may miss more with a refined lens: that is noise."""
LEAST_CORNER_PX = 2.0
"""What a distortion must move a corner by to be worth it."""

_MAX_DISAGREEMENT = 0.45  # of the distortion, as between the lines' own estimates
_LEAST_AMOUNT = 0.005  # a lens of the lines with less has no shape to refine
_CENTRE_SD = (0.005, 0.03)  # half-diagonals: least and most of what is said of the lines' centre


@dataclass(frozen=True)
class _Case:
    """Both witnesses: what is on record, the control points' fit and, where lines have one, (a, its deviation)."""

    record: CameraRecord
    evidence: OverlapEvidence
    line: LensLine
    fit: OverlapFit
    lines: tuple[float, float] | None

    def kept(self, why: str) -> CameraRecord:
        """The lens as it was."""
        return _kept(self.record, self.evidence, f"{self.evidence.reason}{why}")

    @property
    def joined(self) -> tuple[float, float]:
        """Amount and deviation by inverse variance of both witnesses; the control points' where lines have none."""
        amounts, deviations = np.array([(self.fit.amount, self.fit.amount_sd), *([self.lines] if self.lines else [])]).T
        precision = deviations**-2
        return float(np.average(amounts, weights=precision)), float(precision.sum() ** -0.5)

    def changed(self, why: str) -> CameraRecord:
        """The lens of the amount that is joined."""
        amount, a_sd = self.joined
        evidence = self.evidence.model_copy(update={"used": True, "reason": f"{self.evidence.reason}{why}"})
        record = self.record
        reason = record.reason.removesuffix(", pin-hole kept")
        if not record.accepted:  # the lens is not the one that lines had on trial
            centre_sd_px = self.line.centre_sd * self.line.unit.half_diagonal_px
            record = record.model_copy(update={"residual_px": None, "centre_sd_px": (centre_sd_px, centre_sd_px)})
        found = {"lens": self._lens(amount).to_record(), "a_sd": a_sd, "overlap": evidence}
        return record.model_copy(update={**found, "accepted": True, "reason": f"{reason}; then {evidence.reason}"})

    def corner_px(self, amount: float) -> float:
        """How far a lens of that amount moves the picture's corner."""
        corner = np.zeros((1, 2))
        return float(np.hypot(*(self._lens(amount).undistort_points(corner) - corner)[0]))

    @property
    def relief(self) -> bool:
        """Whether the points miss by more than any plane explains."""
        return self.fit.fit_px > LARGEST_FIT * self.line.unit.half_diagonal_px

    def agrees(self, lines_a: float, lines_sd: float) -> bool:
        """Whether the control points say what the lines do, within both deviations."""
        return abs(self.fit.amount - lines_a) <= AGREEMENT_SIGMAS * float(np.hypot(self.fit.amount_sd, lines_sd))

    def _lens(self, amount: float) -> AnyLens:
        return self.line.lens(np.array([amount, 0.0, 0.0]))


def refine(record: CameraRecord, overlap: Overlap | None) -> CameraRecord:
    """The record with the lens refined, or left as it was, and the reason.

    Parameters
    ----------
    record
        What the straight lines gave.
    overlap
        Matched points of pairs of frames; none: no two frames match.
    """
    lines = _by_lines(record)
    evidence = _asked(overlap, lines)
    if overlap is None or evidence.frames < LEAST_FRAMES or evidence.pairs < LEAST_PAIRS:
        said = f"{evidence.pairs} pairs of {evidence.frames} frames match"
        return _kept(record, evidence, f"{said}, {LEAST_PAIRS} pairs of {LEAST_FRAMES} frames needed")
    if not record.accepted:
        hole = pinhole((record.frame_height_px, record.frame_width_px))
        unit = HarrisLens(1.0, hole.centre_x_px, hole.centre_y_px, hole.half_diagonal_px)
        line = LensLine(unit, _CENTRE_SD[1])
        fit = fit_overlap(overlap, line, start=None, before=0.0)
        return _brought_in(_Case(record, _told(evidence, fit), line, fit, lines))
    if lines is None or abs(lines[0]) < _LEAST_AMOUNT:
        return _kept(record, evidence, "the lines' distortion is too small to be refined")
    line = LensLine(scaled(lens_from_record(record.lens), 1.0 / lines[0]), _centre_sd(record))
    fit = fit_overlap(overlap, line, start=lines[0], before=lines[0])
    return _joined(_Case(record, _told(evidence, fit), line, fit, lines), *lines)


def _kept(record: CameraRecord, evidence: OverlapEvidence, reason: str) -> CameraRecord:
    return record.model_copy(update={"overlap": evidence.model_copy(update={"reason": reason})})


def _by_lines(record: CameraRecord) -> tuple[float, float] | None:
    """The lines' distortion as Harris' a, and its standard deviation with what lines do not know of themselves."""
    harris = [row for row in record.candidates if row.model == "harris"]
    return (harris[0].parameters[0], record.a_sd) if harris and record.a_sd is not None else None


def _centre_sd(record: CameraRecord) -> float:
    if record.centre_sd_px is None:
        return _CENTRE_SD[1]
    return float(np.clip(np.mean(record.centre_sd_px) / record.lens.half_diagonal_px, *_CENTRE_SD))


def _asked(overlap: Overlap | None, lines: tuple[float, float] | None) -> OverlapEvidence:
    lines_a, lines_a_sd = lines or (None, None)
    evidence = OverlapEvidence(reason="", lines_a=lines_a, lines_a_sd=lines_a_sd)
    if overlap is None:
        return evidence
    frames, points = len(np.unique(overlap.frames)), int(overlap.there.sum())
    return evidence.model_copy(update={"pairs": len(overlap.frames), "frames": frames, "points": points})


def _told(evidence: OverlapEvidence, fit: OverlapFit) -> OverlapEvidence:
    found = f"a = {fit.amount:.3f} +- {fit.amount_sd:.3f}"
    figures = {
        "a": fit.amount,
        "a_sd": fit.amount_sd,
        "fit_px": fit.fit_px,
        "before_px": fit.before_px,
        "after_px": fit.after_px,
        "reason": f"{found} by control points of {evidence.pairs} pairs of {evidence.frames} frames",
    }
    return evidence.model_copy(update=figures)


def _joined(case: _Case, lines_a: float, lines_sd: float) -> CameraRecord:
    """The lines' lens joined with the control points' by inverse variance, or kept."""
    fit = case.fit
    share = fit.amount_sd**-2 / (fit.amount_sd**-2 + lines_sd**-2)
    said = f", {lines_a:.3f} +- {lines_sd:.3f} by lines and their parallels"
    if case.relief:
        return case.kept(f"{said}: {fit.fit_px:.1f} px off any plane, the lines' lens kept")
    if not case.agrees(lines_a, lines_sd):
        return case.kept(f"{said}: they disagree, the lines' lens kept")
    if share < LEAST_SHARE:
        return case.kept(f"{said}: the frames differ too little in place to say more, the lines' lens kept")
    if fit.after_px > (1.0 + MOST_LOSS) * fit.before_px:
        return case.kept(f"{said}: frames left out do not show it, the lines' lens kept")
    return case.changed(f"{said}: joined to {case.joined[0]:.3f}")


def _brought_in(case: _Case) -> CameraRecord:
    """A distortion that lines did not bear out, on strong evidence only; else the pin-hole."""
    fit, value, said, gain = case.fit, case.joined[0], "", LEAST_GAIN
    needed = BRING_IN_SIGMAS if case.lines is None else CONFIRMED_SIGMAS
    if case.relief:
        return case.kept(f": {fit.fit_px:.1f} px off any plane, pin-hole kept")
    if abs(fit.amount) < needed * fit.amount_sd:
        return case.kept(f": below {needed:g} standard deviations, pin-hole kept")
    if case.lines is not None:
        lines_a, lines_sd = case.lines
        if abs(fit.amount - lines_a) > _MAX_DISAGREEMENT * abs(fit.amount):
            return case.kept(f", {lines_a:.3f} by lines: they disagree, pin-hole kept")
        said = f", {lines_a:.3f} +- {lines_sd:.3f} by lines and their parallels"
        sure = abs(lines_a) >= CONFIRMED_SIGMAS * lines_sd and case.agrees(lines_a, lines_sd)
        gain = 0.0 if sure else LEAST_GAIN
    if fit.after_px >= (1.0 - gain) * fit.before_px:
        return case.kept(f"{said}: frames left out do not show it, pin-hole kept")
    if case.corner_px(value) < LEAST_CORNER_PX:
        return case.kept(f": less than {LEAST_CORNER_PX:g} px at a corner, pin-hole kept")
    return case.changed(f"{said}: a distortion of {value:.3f} accepted")
