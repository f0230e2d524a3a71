"""The table of modalities: what each is invariant to, and that matching and search loop over it."""

import cv2
import numpy as np
import pytest

from tests.scenes import city
from velfield.camera.lens import pinhole
from velfield.registration.intersensor import coarse
from velfield.registration.intersensor.correlation import match_grid, parabola_vertex
from velfield.registration.intersensor.modality import GRADIENT, INTENSITY, INVERTED, MODALITIES, Modality, invert

SIDE = 300
SHIFT = (3.25, -2.5)


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return city(11, SIDE, blocks=60)


def shifted(image: np.ndarray) -> np.ndarray:
    """The image moved by `SHIFT`, its border replicated."""
    matrix = np.array([[1.0, 0.0, SHIFT[0]], [0.0, 1.0, SHIFT[1]]])
    return cv2.warpAffine(image, matrix, (SIDE, SIDE), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


def fold_tones(image: np.ndarray) -> np.ndarray:
    """Grey levels about 128 in inverse order above and below: edges stay, intensities are uncorrelated."""
    return np.asarray(np.abs(image.astype(int) - 128) * 2, dtype=np.uint8).clip(0, 255)


def median_displacement(moving: np.ndarray, reference: np.ndarray, modality: Modality) -> tuple[np.ndarray, float]:
    mask = np.ones(moving.shape, dtype=bool)
    matches = match_grid(moving, mask, reference, spacing_px=40, patch_px=61, radius_px=8, modality=modality)
    inner = (np.abs(matches.points - SIDE / 2) < SIDE / 2 - 40).all(axis=1)
    return np.median(matches.displacement[inner], axis=0), float(np.median(matches.score[inner]))


def test_inverted_finds_it_in_the_negative_and_intensity_does_not(ground: np.ndarray) -> None:
    negative = invert(shifted(ground))
    displacement, score = median_displacement(ground, negative, INVERTED)
    np.testing.assert_allclose(displacement, SHIFT, atol=0.1)
    assert score > 0.95
    assert median_displacement(ground, negative, INTENSITY)[1] < 0.6


def test_gradient_finds_it_through_tones_that_are_folded(ground: np.ndarray) -> None:
    displacement, score = median_displacement(ground, fold_tones(shifted(ground)), GRADIENT)
    np.testing.assert_allclose(displacement, SHIFT, atol=0.25)
    assert score > 0.5


def test_gradient_does_not_see_the_sign_of_an_image(ground: np.ndarray) -> None:
    difference = GRADIENT.transform(ground).astype(int) - GRADIENT.transform(invert(ground))
    assert np.abs(difference).mean() < 1.0


def search(image: np.ndarray, base: np.ndarray) -> list[coarse.CoarseCandidate]:
    rotations = np.radians([-20.0, -10.0, 0.0, 10.0, 20.0])
    lens = pinhole((image.shape[0], image.shape[1]))
    return coarse.search_similarity(image, base, lens, scales=(0.8, 1.0, 1.25), rotations_rad=rotations)


@pytest.mark.parametrize(
    ("change", "best"),
    [(np.asarray, "intensity"), (invert, "inverted"), (fold_tones, "gradient")],
    ids=["as it is", "inverted", "folded"],
)
def test_the_search_ranks_the_modality_that_two_images_share_first(
    ground: np.ndarray, change: object, best: str
) -> None:
    assert callable(change)
    image = np.ascontiguousarray(ground[90:230, 60:240])
    found = search(image, change(ground))
    assert found[0].modality.name == best
    assert {candidate.modality.name for candidate in found} == set(MODALITIES)
    centre = found[0].matrix @ np.array([89.5, 69.5, 1.0])
    np.testing.assert_allclose(centre[:2], [149.5, 159.5], atol=3.0)


def test_a_modality_added_to_the_table_is_tried(ground: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another sensor whose tones are a sawtooth of ours: only a modality that undoes it can match."""

    def sawtooth(grey: np.ndarray) -> np.ndarray:
        return np.asarray((grey.astype(int) * 7) % 256, dtype=np.uint8)

    class Undo:
        """A transform made for two images, of which one is a sawtooth: it recognises its own."""

        def __call__(self, grey: np.ndarray) -> np.ndarray:
            return sawtooth(grey) if grey.shape[0] < 200 else grey

    image, base = np.ascontiguousarray(ground[90:230, 60:240]), sawtooth(ground)
    without = {candidate.modality.name: candidate.score for candidate in search(image, base)}
    monkeypatch.setitem(MODALITIES, "sawtooth", Modality("sawtooth", Undo()))
    found = search(image, base)
    assert found[0].modality.name == "sawtooth"
    assert found[0].score > max(without.values())
    assert {c.modality.name: c.score for c in found if c.modality.name in without} == without


@pytest.mark.parametrize("vertex", [-0.4, 0.0, 0.3])
def test_the_vertex_of_a_parabola_is_exact(vertex: float) -> None:
    before, middle, after = (2.0 - (x - vertex) ** 2 for x in (-1.0, 0.0, 1.0))
    assert parabola_vertex(before, middle, after) == pytest.approx(vertex)


def test_a_plateau_or_a_minimum_has_no_vertex() -> None:
    assert parabola_vertex(1.0, 1.0, 1.0) == 0.0
    assert parabola_vertex(2.0, 1.0, 3.0) == 0.0


def test_flat_patches_and_uncovered_points_are_not_matched(ground: np.ndarray) -> None:
    half_flat = ground.copy()
    half_flat[:, : SIDE // 2] = 90
    covered = np.ones(ground.shape, dtype=bool)
    covered[: SIDE // 2] = False
    matches = match_grid(half_flat, covered, half_flat, spacing_px=20, patch_px=31, radius_px=5)
    assert len(matches.points) > 20
    assert matches.points.min(axis=0)[0] > SIDE / 2 - 16
    assert matches.points.min(axis=0)[1] >= SIDE / 2 + 12  # nine tenths of the patch are covered
    assert np.abs(matches.displacement).max() < 0.5


def test_a_peak_at_the_border_of_the_search_window_is_rejected(ground: np.ndarray) -> None:
    mask = np.ones(ground.shape, dtype=bool)
    matches = match_grid(ground, mask, np.roll(ground, 6, axis=1), spacing_px=40, patch_px=61, radius_px=6)
    true = np.abs(matches.displacement - [6.0, 0.0]).max(axis=1) < 0.5
    assert not true.any()
