"""The lens refined by control points: as far as the flight lets them tell, and never where there is no lens."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from schemas.camera import CameraRecord, ModelEvidence
from schemas.job import Inputs, Job
from tests.scenes import by_homography, city, photograph, rms_after_homography, similarity
from velfield.camera.frame_pairs import FramePairs, ScaledLens
from velfield.camera.fusion import CONFIRMED_SIGMAS, MIN_CV_GAIN, refine_lens
from velfield.camera.lens import HarrisLens, lens_from_record, pinhole
from velfield.camera.multiview import MultiViewFit, fit_multiview
from velfield.camera.plumbline import SD_INFLATION, pinhole_record
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.local import compute_stages
from velfield.pipeline.plan import make_plan
from velfield.pipeline.stage import stages_before
from velfield.registration.pairing import match_frame_pairs

SHAPE = HEIGHT, WIDTH = 720, 960
MIDDLE = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
HALF = float(np.hypot(WIDTH, HEIGHT) / 2)
FOCAL = 1.25 * WIDTH
FRAMES, PAIRS, MATCHES = 10, 20, 100


def lens_of(a: float) -> HarrisLens:
    return HarrisLens(a, MIDDLE[0] + 6.0, MIDDLE[1] - 4.0, HALF)


class Pose:
    """A camera over the ground, ground and picture in the same pixels: its place, its turns, its rows' waves."""

    def __init__(self, how: str, share: float, rng: np.random.Generator) -> None:
        far = {"along": 0.6 * WIDTH, "turns": 60.0, "hangs": 2.0}[how]
        turn = {"along": 3.0, "turns": 75.0, "hangs": 0.1}[how]
        climb = rng.uniform(-1, 1) * (0.001 if how == "hangs" else 0.02)
        self.place = np.array([share * far, rng.uniform(-1, 1) * min(far, 60.0), -FOCAL * (1 + climb)])
        angles = np.radians([share * turn, *(rng.uniform(-1, 1, 2) * min(turn, 1.5))])
        self.rotation = np.eye(3)
        for angle, (p, q) in zip(angles, ((0, 1), (1, 2), (0, 2)), strict=True):
            about = np.eye(3)
            about[[p, q, p, q], [p, q, q, p]] = np.cos(angle), np.cos(angle), -np.sin(angle), np.sin(angle)
            self.rotation = self.rotation @ about
        self.cycles, self.phase = rng.uniform(1.4, 2.9), rng.uniform(0, 2 * np.pi, 2)

    def sees(self, ground: np.ndarray, lens: HarrisLens, bowl: float, hills: float, wobble_px: float) -> np.ndarray:
        """Raw px of ground points (n, 2); ``bowl``: how far it rises by a half-diagonal, as a share of the height;
        ``hills``: how high they are."""
        x, y = ground.T / HALF
        rise = -FOCAL * (bowl * (x**2 + y**2) + hills * np.cos(3.0 * x + 1.0) * np.cos(3.0 * y))
        ray = (np.column_stack([ground, rise]) - self.place) @ self.rotation
        straight = ray[:, :2] / ray[:, 2:] * FOCAL + MIDDLE
        raw = lens.distort_points(straight)
        for _ in range(5):
            wave = np.sin(2 * np.pi * self.cycles * raw[:, 1:] / HEIGHT + self.phase)
            raw = lens.distort_points(straight) + wobble_px * wave
        return raw


@cache
def flown(how: str, a: float, seed: int, bowl: float = 0.0, hills: float = 0.0, wobble_px: float = 2.0) -> FramePairs:
    """Matches with 0.3 px of noise, a fifth of them wrong, rows that move by 2 px."""
    rng = np.random.default_rng(seed)
    poses = [Pose(how, 2.0 * k / (FRAMES - 1) - 1.0, rng) for k in range(FRAMES)]
    pairs = [(i, j) for i in range(FRAMES) for j in range(i + 1, FRAMES) if j - i < 6]
    xy_i, xy_j, there = (np.zeros((PAIRS, MATCHES, 2)), np.zeros((PAIRS, MATCHES, 2)), np.zeros((PAIRS, MATCHES), bool))
    chosen = [pairs[k] for k in np.sort(rng.permutation(len(pairs))[:PAIRS])]
    for p, (i, j) in enumerate(chosen):
        ground = poses[i].place[:2] + rng.uniform(-0.8, 0.8, (8 * MATCHES, 2)) * (WIDTH, HEIGHT)
        seen = [poses[k].sees(ground, lens_of(a), bowl, hills, wobble_px) for k in (i, j)]
        both = np.all([((xy > 0) & (xy < (WIDTH, HEIGHT))).all(axis=1) for xy in seen], axis=0)
        found = [(xy + rng.normal(0, 0.3, xy.shape))[both][:MATCHES] for xy in seen]
        wrong = rng.random(len(found[1])) < 0.2
        found[1][wrong] += rng.uniform(-15, 15, (int(wrong.sum()), 2))
        there[p, : len(wrong)] = True
        xy_i[p], xy_j[p] = (np.vstack([xy, np.repeat(xy[:1], MATCHES - len(xy), axis=0)]) for xy in found)
    return FramePairs(SHAPE, np.array(chosen), xy_i, xy_j, there)


def fitted(overlap: FramePairs) -> MultiViewFit:
    """From nothing: the pin-hole, its centre in the middle."""
    return fit_multiview(overlap, ScaledLens(HarrisLens(1.0, *MIDDLE, HALF), 0.02), start=None, before=0.0)


def lined(a: float, a_sd: float, *, accepted: bool = True) -> CameraRecord:
    """A record of the straight lines: a distortion and its deviation, accepted or not."""
    return CameraRecord(
        lens=(lens_of(a) if accepted else pinhole(SHAPE)).to_record(),
        frame_width_px=WIDTH,
        frame_height_px=HEIGHT,
        accepted=accepted,
        reason="by lines",
        a_sd=SD_INFLATION * a_sd,
        centre_sd_px=(4.0, 4.0),
        candidates=(ModelEvidence(model="harris", parameters=(a, 0.0, 0.0), residual_px=0.2, heldout_px=0.2),),
    )


NOTHING_BY_LINES = pinhole_record(SHAPE, "3 straight edges in 12 frames, 30 needed")


def off_the_truth_px(record: CameraRecord, a: float) -> float:
    y, x = np.mgrid[0:HEIGHT:40, 0:WIDTH:40]
    points = np.column_stack([x.ravel(), y.ravel()]).astype(float)
    found = lens_from_record(record.lens).undistort_points(points)
    return rms_after_homography(found, lens_of(a).undistort_points(points))


@pytest.mark.parametrize(
    ("how", "a", "seed"), [("along", 0.05, 1), ("along", 0.3, 2), ("turns", 0.2, 3), ("turns", -0.1, 4)]
)
def test_a_camera_that_flies_along_or_turns_tells_its_distortion_within_its_uncertainty(
    how: str, a: float, seed: int
) -> None:
    fit = fitted(flown(how, a, seed))
    assert abs(fit.amount - a) < 0.012
    assert abs(fit.amount - a) < 3 * fit.amount_sd
    assert fit.amount_sd < 0.02


def test_the_ground_may_bulge_and_the_uncertainty_knows_it() -> None:
    for seed in (1, 2):
        fit = fitted(flown("along", 0.1, seed, bowl=0.003))
        assert abs(fit.amount - 0.1) < 3 * fit.amount_sd


def test_hills_widen_the_uncertainty() -> None:
    flat, hilly = (fitted(flown("along", 0.1, 1, hills=hills)) for hills in (0.0, 0.02))
    assert hilly.amount_sd > 1.5 * flat.amount_sd
    assert abs(hilly.amount - 0.1) < 2 * hilly.amount_sd


def test_a_camera_that_hangs_says_that_it_cannot_tell_and_changes_nothing() -> None:
    overlap, record = flown("hangs", 0.2, 1), lined(0.21, 0.003)
    refined = refine_lens(record, overlap)
    assert refined.overlap.a_sd > 0.05
    assert not refined.overlap.used
    assert refined.model_copy(update={"overlap": None}) == record
    assert "camera positions too similar" in refined.overlap.reason


def test_lines_and_control_points_that_agree_are_joined_nearer_to_the_truth() -> None:
    record = lined(0.22, 0.01)
    refined = refine_lens(record, flown("along", 0.2, 3))
    assert refined.overlap.used, refined.overlap.reason
    assert off_the_truth_px(refined, 0.2) < 0.5 * off_the_truth_px(record, 0.2)
    assert CameraRecord.model_validate_json(refined.model_dump_json()) == refined


def test_a_distortion_that_few_lines_only_hint_at_is_brought_in() -> None:
    refined = refine_lens(lined(0.052, 0.004, accepted=False), flown("along", 0.05, 4, wobble_px=0.5))
    assert refined.accepted, refined.overlap.reason
    assert off_the_truth_px(refined, 0.05) < 0.3


def test_where_rows_move_by_more_than_the_lens_both_witnesses_are_believed_if_both_are_sure() -> None:
    shaken = flown("along", 0.07, 11, wobble_px=4.0)
    found = fitted(shaken)
    assert (1.0 - MIN_CV_GAIN) * found.before_px < found.after_px < found.before_px
    refined = refine_lens(lined(0.072, 0.004, accepted=False), shaken)
    assert refined.accepted
    assert off_the_truth_px(refined, 0.07) < 0.3
    unsure = refine_lens(lined(0.072, 0.02, accepted=False), shaken)
    assert not unsure.accepted
    assert "cross-validated residual not lower" in unsure.overlap.reason


def test_a_distortion_that_lines_are_silent_of_is_brought_in_by_strong_evidence_alone() -> None:
    assert refine_lens(NOTHING_BY_LINES, flown("along", 0.3, 1)).accepted
    weak = refine_lens(NOTHING_BY_LINES, flown("along", 0.05, 1))
    assert not weak.accepted
    assert "below 10 standard deviations" in weak.overlap.reason


@pytest.mark.parametrize(("how", "seed"), [("along", 11), ("turns", 12), ("hangs", 13)])
def test_without_distortion_none_is_brought_in(how: str, seed: int) -> None:
    refined = refine_lens(NOTHING_BY_LINES, flown(how, 0.0, seed))
    assert not refined.accepted
    assert lens_from_record(refined.lens) == pinhole(SHAPE)
    assert abs(refined.overlap.a) < CONFIRMED_SIGMAS * refined.overlap.a_sd


def test_a_hollow_under_a_camera_that_hardly_moves_is_no_lens() -> None:
    for seed in (21, 22):
        refined = refine_lens(NOTHING_BY_LINES, flown("turns", 0.0, seed, bowl=0.02))
        assert not refined.accepted, refined.overlap


def test_matches_that_no_plane_explains_are_not_heard() -> None:
    overlap, rng = flown("along", 0.3, 1), np.random.default_rng(0)
    parallax = overlap.xy_j + rng.normal(0, 2.0, overlap.xy_j.shape)
    refined = refine_lens(NOTHING_BY_LINES, FramePairs(SHAPE, overlap.frames, overlap.xy_i, parallax, overlap.valid))
    assert not refined.accepted
    assert "scene not planar" in refined.overlap.reason


def test_the_same_matches_give_the_same_lens_however_linear_algebra_rounds() -> None:
    overlap = flown("turns", 0.2, 1)
    assert refine_lens(lined(0.22, 0.01), overlap) == refine_lens(lined(0.22, 0.01), overlap)
    rounded = replace(overlap, xy_i=overlap.xy_i * (1 + 1e-13))
    assert fitted(rounded) == fitted(overlap)


def test_the_paper_knows_straight_lines_alone() -> None:
    assert resolve_config().lens.refine == "auto"
    assert resolve_config(preset="paper").lens.refine == "never"


SMALL = (240, 320)


@pytest.fixture(scope="module")
def pictures() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Nine frames that go along, the fourth a copy of the third, and their maps to the ground."""
    ground, middle = city(5, 900), np.array([159.5, 119.5])
    views = [similarity(1.0, 3.0 * k, middle, np.array([300.0 + 15 * k, 400.0])) for k in range(8)]
    views.insert(3, views[2])
    seeds = [0, 1, 2, 2, 4, 5, 6, 7, 8]
    return [
        photograph(ground, view, pinhole(SMALL), SMALL, seed) for view, seed in zip(views, seeds, strict=True)
    ], views


def test_pairs_are_matched_where_they_see_the_same_and_no_pair_that_tells_nothing(
    pictures: tuple[list[np.ndarray], list[np.ndarray]],
) -> None:
    frames, views = pictures
    overlap = match_frame_pairs(frames)
    assert (2, 3) not in {tuple(pair) for pair in overlap.frames.tolist()}
    assert np.bincount(overlap.frames.ravel()).max() <= 6
    for (i, j), xy_i, xy_j, there in zip(overlap.frames, overlap.xy_i, overlap.xy_j, overlap.valid, strict=True):
        miss = by_homography(np.linalg.inv(views[j]) @ views[i], xy_i[there]) - xy_j[there]
        assert np.median(np.hypot(*miss.T)) < 0.5


def test_frames_of_different_places_give_no_pairs() -> None:
    assert match_frame_pairs([city(seed, 240) for seed in (1, 2)]) is None


def test_the_stage_asks_the_control_points_unless_told_not_to(
    pictures: tuple[list[np.ndarray], list[np.ndarray]], tmp_path: Path
) -> None:
    (tmp_path / "frames").mkdir()
    for number, frame in enumerate(pictures[0]):
        cv2.imwrite(str(tmp_path / "frames" / f"{number}.png"), frame)
    told = {}
    for refined in ("auto", "never"):
        quick = {"frames.fps": 5, "lens.frames": 5, "lens.max_edge_points": 3000}
        config = resolve_config(overrides=quick | {"lens.refine": refined})
        inputs = Inputs(source=str(tmp_path / "frames"))
        plan = make_plan(Job(root=str(tmp_path / refined), inputs=inputs, config=config))
        compute_stages(plan, stages_before("base"))
        told[refined] = CameraRecord.model_validate_json(plan.layout.camera.read_bytes())
    assert told["never"].overlap is None
    assert told["auto"].overlap.pairs > 5
    assert told["auto"].lens == told["never"].lens
