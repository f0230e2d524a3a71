"""The decisions of the fusion, branch by branch: what the multi-view estimate says is given."""

import numpy as np
import pytest

from schemas.camera import CameraRecord, ModelEvidence
from velfield.camera import fusion
from velfield.camera.frame_pairs import FramePairs, ScaledLens
from velfield.camera.fusion import MAX_RESIDUAL, refine_lens
from velfield.camera.lens import HarrisLens, lens_from_record, pinhole
from velfield.camera.multiview import MultiViewFit
from velfield.camera.plumbline import pinhole_record
from velfield.pipeline.stages.lens import _notes

SHAPE = (480, 640)
HALF = 400.0


def pairs(frames: int = 6) -> FramePairs:
    """A chain of frames, each paired with the next and the one after; the points do not matter here."""
    numbers = np.array([(i, j) for i in range(frames) for j in (i + 1, i + 2) if j < frames])
    points = np.zeros((len(numbers), 3, 2))
    return FramePairs(SHAPE, numbers, points, points, np.ones((len(numbers), 3), bool))


def record(a: float | None, a_sd: float = 0.01, *, accepted: bool = True) -> CameraRecord:
    """A record of the plumb line: distortion ``a`` and its inflated deviation; None: no estimate at all."""
    lens = HarrisLens(a or 0.0, 320.0, 239.0, HALF) if accepted else pinhole(SHAPE)
    row = ModelEvidence(model="harris", parameters=(a or 0.0, 0.0, 0.0), residual_px=0.2, heldout_px=0.2)
    return CameraRecord(
        lens=lens.to_record(),
        frame_width_px=SHAPE[1],
        frame_height_px=SHAPE[0],
        accepted=accepted,
        reason="plumb line" if accepted else "too few lines, pinhole model kept",
        a_sd=None if a is None else a_sd,
        residual_px=0.2,
        centre_sd_px=(3.0, 3.0),
        candidates=() if a is None else (row,),
    )


def says(monkeypatch: pytest.MonkeyPatch, amount: float, sd: float, **figures: float) -> list[ScaledLens]:
    """Make the multi-view fit return this; the families it was asked for are appended to the list."""
    fit = MultiViewFit(amount, sd, **({"fit_px": 0.3, "before_px": 1.0, "after_px": 0.5} | figures))
    asked: list[ScaledLens] = []

    def fit_multiview(pairs: FramePairs, family: ScaledLens, *, start: float | None, before: float) -> MultiViewFit:
        asked.append(family)
        return fit

    monkeypatch.setattr(fusion, "fit_multiview", fit_multiview)
    return asked


def reason(refined: CameraRecord) -> str:
    return refined.overlap.reason


def test_estimates_that_agree_are_fused_by_inverse_variance(monkeypatch: pytest.MonkeyPatch) -> None:
    families = says(monkeypatch, 0.22, 0.01)
    refined = refine_lens(record(0.2, 0.01), pairs())
    lens = lens_from_record(refined.lens)
    assert isinstance(lens, HarrisLens)
    assert lens.a == pytest.approx(0.21)
    assert (lens.centre_x_px, lens.centre_y_px) == (320.0, 239.0)
    assert refined.a_sd == pytest.approx(0.01 / np.sqrt(2))
    assert "fused to 0.210" in reason(refined)
    assert refined.reason.startswith("plumb line; then multi-view a = 0.220 +- 0.010 from 9 pairs of 6 frames")
    (note,) = _notes(refined)
    assert note == "the lens distortion was refined by frames that show the same ground at different places"
    never = "lens.calibrate is never: pinhole model used"
    assert _notes(pinhole_record((480, 640), never)) == [never]
    assert families[0].lens(np.array([0.2, 0.0, 0.0])) == lens_from_record(record(0.2).lens)


@pytest.mark.parametrize(
    ("amount", "sd", "figures", "why"),
    [
        (0.27, 0.01, {}, "they disagree"),
        (0.2, 0.03, {}, "camera positions too similar"),
        (0.2, 0.01, {"after_px": 1.03}, "cross-validated residual not lower"),
        (0.2, 0.01, {"fit_px": 1.01 * MAX_RESIDUAL * HALF}, "scene not planar"),
    ],
)
def test_else_the_plumb_line_lens_is_kept(
    monkeypatch: pytest.MonkeyPatch, amount: float, sd: float, figures: dict[str, float], why: str
) -> None:
    says(monkeypatch, amount, sd, **figures)
    before = record(0.2, 0.01)
    refined = refine_lens(before, pairs())
    assert why in reason(refined)
    assert reason(refined).endswith("plumb-line lens kept")
    assert refined.model_copy(update={"overlap": None}) == before
    assert not refined.overlap.used
    assert (refined.overlap.a, refined.overlap.lines_a) == (amount, 0.2)


def test_a_small_loss_is_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    says(monkeypatch, 0.2, 0.01, after_px=1.019)
    assert refine_lens(record(0.2, 0.01), pairs()).overlap.used


def test_a_plumb_line_lens_without_a_profile_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not says(monkeypatch, 0.2, 0.01)
    assert "too small to be refined" in reason(refine_lens(record(0.004), pairs()))


@pytest.mark.parametrize(
    ("a", "amount", "sd", "figures", "accepted", "why"),
    [
        (None, 0.2, 0.019, {}, True, "a distortion of 0.200 accepted"),
        (None, 0.2, 0.021, {}, False, "below 10 standard deviations"),
        (None, 0.2, 0.01, {"after_px": 0.98}, False, "cross-validated residual not lower"),
        (None, 0.2, 0.01, {"fit_px": 5.0}, False, "scene not planar"),
        (None, 0.002, 0.0001, {}, False, "less than 2 px at a corner"),
        (0.18, 0.2, 0.04, {"after_px": 0.9}, True, "plumb line 0.180 +- 0.010: a distortion of"),
        (0.18, 0.2, 0.06, {}, False, "below 4 standard deviations"),
        (0.1, 0.2, 0.01, {}, False, "they disagree"),
        (0.2, 0.2, 0.01, {"after_px": 0.999}, True, "accepted"),  # both significant: any decrease suffices
        (0.2, 0.2, 0.01, {"after_px": 1.0}, False, "cross-validated residual not lower"),
    ],
)
def test_a_new_distortion_needs_strong_evidence(
    monkeypatch: pytest.MonkeyPatch,
    a: float | None,
    amount: float,
    sd: float,
    figures: dict[str, float],
    accepted: bool,
    why: str,
) -> None:
    says(monkeypatch, amount, sd, **figures)
    refined = refine_lens(record(a, accepted=False), pairs())
    assert why in reason(refined)
    assert refined.accepted is accepted
    if accepted:
        assert refined.residual_px is None  # that of the rejected plumb-line lens
        assert "pinhole model kept" not in refined.reason
    else:
        assert reason(refined).endswith("pinhole model kept")
        assert lens_from_record(refined.lens) == pinhole(SHAPE)


def test_the_centre_of_a_new_distortion_is_that_of_the_image(monkeypatch: pytest.MonkeyPatch) -> None:
    families = says(monkeypatch, 0.2, 0.01)
    refined = refine_lens(record(None, accepted=False), pairs())
    lens = lens_from_record(refined.lens)
    assert (lens.centre_x_px, lens.centre_y_px) == (319.5, 239.5)
    assert refined.centre_sd_px == pytest.approx((0.03 * HALF, 0.03 * HALF))
    assert families[0].centre_sd == 0.03


@pytest.mark.parametrize("given", [None, pairs(4)])
def test_too_few_frames_or_pairs_are_not_fitted(monkeypatch: pytest.MonkeyPatch, given: FramePairs | None) -> None:
    families = says(monkeypatch, 0.2, 0.01)
    refined = refine_lens(record(0.2), given)
    assert not families
    assert "6 pairs of 5 frames needed" in reason(refined)
