"""The parts of reading a video, each alone: time stamps, corruption in decoding order."""

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.media import ground
from velfield.errors import InputError
from velfield.sources.frames import SourceInfo
from velfield.sources.video.corruption import BlockArtifactDetector, CorruptionTracker
from velfield.sources.video.decoding import _entry_points, _TimestampIndex
from velfield.sources.video.packets import Packets, closed_key_frames, drop_timestamp_outliers

PATH, MS = Path("flight.mp4"), Fraction(1, 1000)


@dataclass
class FakePacket:
    """The part of a PyAV packet that `CorruptionTracker` reads."""

    pts: int | None
    is_keyframe: bool = False
    size: int = 1


def packets(pts: np.ndarray, key: np.ndarray | None = None, stamps: str = "pts") -> Packets:
    return Packets(pts, np.zeros(len(pts), np.bool_) if key is None else key, stamps, ())


@given(st.integers(0, 59), st.sampled_from([-9e6, 9e6]))
def test_one_time_stamp_far_from_its_neighbours_is_dropped(place: int, offset: float) -> None:
    pts = np.arange(60, dtype=np.int64) * 40
    spoilt = pts.copy()
    spoilt[place] += int(offset)
    kept, notes = drop_timestamp_outliers(PATH, packets(spoilt), MS)
    assert kept.pts.tolist() == np.delete(pts, place).tolist()
    assert notes == ("1 frames have times far from their neighbours' (corrupt): dropped",)


def test_a_gap_in_a_recording_is_no_outlier() -> None:
    pts = np.r_[np.arange(30), 10_000 + np.arange(30)].astype(np.int64) * 40
    kept, notes = drop_timestamp_outliers(PATH, packets(pts), MS)
    assert kept.pts.tolist() == pts.tolist()
    assert notes == ()


def test_two_recordings_in_one_file_are_refused() -> None:
    pts = np.r_[100_000 + np.arange(30), np.arange(30)].astype(np.int64) * 40
    with pytest.raises(
        InputError, match=r"timestamps jump back 40\d\d\.\d s at frame 30, expected one recording per file"
    ):
        drop_timestamp_outliers(PATH, packets(pts), MS)


@pytest.mark.parametrize("stamps", ["dts", "none"])
def test_times_that_identify_no_frames_are_left_as_they_are(stamps: str) -> None:
    pts = np.array([0, 40, 9_000_000, 120], np.int64)
    assert drop_timestamp_outliers(PATH, packets(pts, stamps=stamps), MS)[0].pts.tolist() == pts.tolist()


def test_a_group_that_a_later_frame_is_presented_before_is_open() -> None:
    """Decoding order I0 P2 B1 | I5 B4 P6: frame 4 refers across the second key frame."""
    key = np.array([True, False, False, True, False, False])
    closed = closed_key_frames(packets(np.array([0, 2, 1, 5, 4, 6]), key))
    assert closed.tolist() == [True, False, False, False, False, False]


def test_a_frame_is_found_by_its_time_stamp_and_equal_ones_by_order() -> None:
    info = SourceInfo("video", 8, 8, 4, np.zeros(4), ("0", "1", "2", "3"), pts=np.array([0, 40, 40, 80]))
    index = _TimestampIndex(info)
    assert [index.of_frame(FakePacket(pts)) for pts in (0, 40, 40, 80, 60, None)] == [0, 1, 2, 3, None, None]
    assert [index.of_packet(FakePacket(pts)) for pts in (40, 0, 40)] == [1, 0, 1]
    assert index.of_packet(FakePacket(40, size=0)) is None
    unstamped = _TimestampIndex(SourceInfo("video", 8, 8, 2, np.zeros(2), ("0", "1")))
    assert [unstamped.of_frame(FakePacket(None)) for _ in range(3)] == [0, 1, None]


def test_decoding_starts_at_the_last_key_frame_and_of_open_groups_at_the_one_before() -> None:
    keys = np.isin(np.arange(50), [0, 10, 20, 30, 40])
    info = SourceInfo("video", 8, 8, 50, np.arange(50.0), tuple(map(str, range(50))), key_frames=keys, entries=keys)
    assert _entry_points(info, 35) == [30, 20, 10, 0]
    assert _entry_points(info, 3) == [0]
    open_groups = SourceInfo("video", 8, 8, 50, info.times_s, info.names, key_frames=keys, entries=keys & False)
    assert _entry_points(open_groups, 35) == [20, 10, 0]


def tracked(groups: int = 3, length: int = 10, **options: bool) -> CorruptionTracker:
    """A tracker that was fed ``groups`` groups of ``length`` frames."""
    tracker = CorruptionTracker(**options)
    for index in range(groups * length):
        tracker.feed(FakePacket(index, is_keyframe=index % length == 0), index)
    return tracker


def suspects(tracker: CorruptionTracker, count: int = 30) -> list[int]:
    return [index for index in range(count) if tracker.is_suspect(index)]


def test_an_error_makes_the_rest_of_its_group_suspect_from_four_packets_before() -> None:
    tracker = CorruptionTracker()
    for index in range(30):
        tracker.feed(FakePacket(index, is_keyframe=index % 10 == 0), index)
        if index == 16:
            tracker.mark("concealing 4 errors")
    assert suspects(tracker) == list(range(12, 20))
    assert tracker.last_error == "concealing 4 errors"


def test_a_frame_marked_as_corrupt_and_a_lost_one_affect_their_group_alone() -> None:
    tracker = tracked()
    tracker.mark_frame(25)
    assert suspects(tracker) == list(range(21, 30))
    lost = tracked()
    lost.mark_lost(13)
    assert suspects(lost) == list(range(10, 20))  # from four packets before
    assert lost.last_error == "a frame was lost"


def test_artefacts_on_a_key_frame_are_the_repair_of_a_corrupt_group() -> None:
    tracker = tracked()
    tracker.mark_frame(15)
    tracker.mark_artifacts(20)
    assert suspects(tracker) == list(range(11, 20))
    fresh = tracked()
    fresh.mark_artifacts(20)
    assert suspects(fresh) == list(range(10, 30)), "either group may be the corrupt one"


def test_where_frames_are_known_by_order_alone_all_that_follow_an_error_are_suspect() -> None:
    tracker = tracked(lasting=True)
    assert suspects(tracker) == []
    tracker.mark_frame(25)
    assert suspects(tracker) == list(range(30))


def test_a_decoder_that_starts_midway_may_release_frames_it_never_had() -> None:
    for midway, expected in ((True, []), (False, list(range(10)))):
        tracker = CorruptionTracker(midway=midway)
        for index in range(10):
            tracker.feed(FakePacket(index, is_keyframe=index == 0), index)
            if index == 1:
                tracker.mark("mmco: unref short failure")
        assert suspects(tracker, 10) == expected


def test_with_gradual_refresh_a_group_refers_to_the_one_before_and_the_first_to_none() -> None:
    tracker = tracked()
    tracker.mark_frame(15)
    tracker.note_key_frame(is_intra=False)
    assert suspects(tracker) == list(range(11, 30))


def test_frames_before_the_first_key_frame_are_suspect() -> None:
    tracker = CorruptionTracker()
    for index in range(12):
        tracker.feed(FakePacket(index, is_keyframe=index == 5), index)
    assert suspects(tracker, 12) == list(range(5))
    assert tracker.last_error == "no key frame before it"


def scene_with_blocks(blocks: int, shift: int = 0) -> np.ndarray:
    image = ground(480, 320, seed=1)[:, shift : shift + 400].copy()
    rng = np.random.default_rng(5)
    for _ in range(blocks):
        y, x = rng.integers(0, 18) * 16, rng.integers(1, 23) * 16
        image[y : y + 16, x : x + 16] = rng.integers(0, 256)
    return image


def test_blocks_out_of_nowhere_are_artefacts_and_a_moving_camera_is_none() -> None:
    detector = BlockArtifactDetector()
    assert [detector.feed(scene_with_blocks(0, shift)) for shift in range(8)] == [()] * 8
    assert detector.feed(scene_with_blocks(60, 8)) == (0,)
    assert detector.feed(scene_with_blocks(0, 9)) == (0,), "the repair changes as many blocks"
    assert detector.feed(scene_with_blocks(0, 10)) == ()


def test_the_first_frames_are_judged_by_those_that_follow() -> None:
    detector = BlockArtifactDetector()
    blocks = [0, 0, 60, 0, 0, 0, 0]
    assert [detector.feed(scene_with_blocks(n, shift)) for shift, n in enumerate(blocks)] == [*[()] * 5, (2, 3), ()]


def test_a_busy_road_has_as_many_new_blocks_in_every_frame() -> None:
    """187 cars that move by 12 px a frame have 50 of them: the first frames of a sound video were left out."""
    rng, detector = np.random.default_rng(0), BlockArtifactDetector()
    frames = []
    for _ in range(12):
        image = scene_with_blocks(0)
        for y, x in zip(rng.integers(0, 18, 60) * 16, rng.integers(1, 23, 60) * 16, strict=True):
            image[y : y + 16, x : x + 16] = rng.integers(0, 256)
        frames.append(image)
    assert [detector.feed(frame) for frame in frames] == [()] * 12


def test_a_change_of_brightness_is_no_artefact_and_a_change_of_size_starts_again() -> None:
    detector = BlockArtifactDetector()
    image = scene_with_blocks(0)
    assert not any(detector.feed(image) for _ in range(7))
    assert not detector.feed(np.clip(image.astype(int) + 25, 0, 255).astype(np.uint8))
    assert not detector.feed(scene_with_blocks(60)[:200])
