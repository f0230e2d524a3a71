"""Faults of sources: each is flagged and the rest is read, or refused in one line: found, expected, what to do."""

import struct
import zlib
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from schemas.flight import FlightConfig, FramesConfig
from schemas.job import Inputs, Job
from tests.media import drifting, flip_bytes, ground, write_images, write_times, write_video
from velfield.errors import InputError
from velfield.pipeline.plan import make_plan
from velfield.sources.frame_measures import frame_quality
from velfield.sources.quality import (
    UNUSABLE,
    FrameFlag,
    describe_flags,
    flag_blurred,
    flag_outlier_frames,
)
from velfield.sources.source import iter_frames, probe
from velfield.sources.video.decoding import _grey

ALL = FramesConfig()
FPS = FramesConfig(fps=5)


@pytest.fixture(scope="module")
def frames():
    return list(drifting(60, 320, 240))


def assert_stops(path, match, frames=FPS, timestamps=None):
    """Assert that probing or reading stops with one line holding `match`, "found" or a reason, and a remedy."""
    with pytest.raises(InputError, match=match) as caught:
        probe_and_read(path, frames, timestamps)
    message = str(caught.value)
    assert "\n" not in message
    assert ";" in message, message


def probe_and_read(path, frames, timestamps):
    info = probe(path, frames=frames, timestamps=timestamps)
    return list(iter_frames(path, info, range(info.frame_count)))


def read_all(path, frames=ALL):
    info = probe(path, frames=frames)
    return info, list(iter_frames(path, info, range(info.frame_count)))


@pytest.mark.parametrize("suffix", [".mp4", ".ts", ".avi", ".mkv"])
def test_a_video_cut_in_half_gives_the_frames_there_are_with_a_warning(tmp_path, frames, suffix):
    faststart = {"movflags": "faststart"} if suffix == ".mp4" else None
    whole = write_video(tmp_path / f"whole{suffix}", frames, container_options=faststart)
    clean = {round(frame.time_s, 3): frame for frame in read_all(whole)[1]}
    cut = tmp_path / f"cut{suffix}"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    info, read = read_all(cut)
    assert 10 < info.frame_count < 50
    if suffix != ".ts":  # a transport stream declares neither frames nor seconds
        assert any("is truncated" in warning for warning in info.warnings), info.warnings
    for frame in read:
        same = np.array_equal(frame.grey, clean[round(frame.time_s, 3)].grey)
        assert same or frame.flags & (FrameFlag.SUSPECT | FrameFlag.UNREADABLE)
    assert sum(not frame.flags for frame in read) > 10


def test_an_mp4_that_lost_its_index_stops(tmp_path, frames):
    whole = write_video(tmp_path / "whole.mp4", frames)
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    assert_stops(cut, "could not be opened as video")


def test_a_video_cut_within_the_run_yields_its_lost_frames_as_unreadable(tmp_path, frames):
    path = write_video(tmp_path / "a.ts", frames)
    info = probe(path, frames=ALL)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    read = list(iter_frames(path, info, range(0, 60, 5)))
    assert [frame.source_index for frame in read] == list(range(0, 60, 5))
    assert read[-1].flags & FrameFlag.UNREADABLE
    assert (read[-1].name, read[-1].reason) == ("55", "the decoder returned no image")


def test_an_avi_that_repeats_images_is_no_truncated_one(tmp_path, frames):
    """A frame that came late leaves chunks without an image before it."""
    uneven = [0, 5, 10, 15, 25, 30, 45, 50]
    whole = write_video(tmp_path / "a.avi", frames[:8], codec="mpeg4", times=uneven)
    info, read = read_all(whole)
    assert info.warnings == ()
    assert info.times_s.tolist() == pytest.approx([k / 25 for k in uneven])
    assert [frame.flags for frame in read] == [0] * 8
    (tmp_path / "b.avi").write_bytes(whole.read_bytes()[: int(0.6 * whole.stat().st_size)])
    assert any("the file is truncated" in warning for warning in probe(tmp_path / "b.avi", frames=ALL).warnings)


@pytest.mark.parametrize(
    ("count", "kept", "options", "expected"),
    [
        (1, 1.0, {}, "1 frame to process, but a tracklet needs 3; give a longer recording"),
        (1, 1.0, {"every": 1, "stop_s": 9.0}, "1 frame to process, but a tracklet needs 3; give a longer recording"),
        (20, 0.1, {}, "3 frames read of 20 declared: the file is truncated, copy it again; set --every 1"),
        (20, 0.05, {}, "2 frames read of 20 declared: the file is truncated, copy it again; give a longer recording"),
        (20, 1.0, {"every": 15}, "2 frames to process, but a tracklet needs 3; set --every 1"),
        (
            20,
            1.0,
            {"every": 1, "stop_s": 0.05},
            "2 frames to process, but a tracklet needs 3; widen --start-s/--stop-s",
        ),
    ],
)
def test_too_few_frames_are_said_with_what_can_help(tmp_path, frames, count, kept, options, expected):
    whole = write_video(tmp_path / "a.avi", frames[:count], codec="mpeg4", key_interval=1)
    (tmp_path / "b.avi").write_bytes(whole.read_bytes()[: int(kept * whole.stat().st_size)])
    job = Job(
        root=str(tmp_path / "run"),
        inputs=Inputs(source=str(tmp_path / "b.avi")),
        config=FlightConfig(frames=FramesConfig(**options)),
    )
    with pytest.raises(InputError) as caught:
        make_plan(job)
    assert str(caught.value).startswith(f"{tmp_path / 'b.avi'}: ")
    assert str(caught.value).endswith(expected)


@pytest.mark.parametrize(
    ("suffix", "codec"), [(".mp4", "libx264"), (".ts", "libx264"), (".avi", "mpeg4"), (".mp4", "libx265")]
)
def test_no_wrong_frame_of_a_damaged_stretch_goes_unflagged(tmp_path, frames, suffix, codec):
    whole = write_video(tmp_path / f"a{suffix}", frames, codec=codec)
    clean = {round(frame.time_s, 3): frame.grey for frame in read_all(whole)[1]}
    for seed in range(3):
        damaged = flip_bytes(whole, tmp_path / f"d{seed}{suffix}", start=0.3, stop=0.45, count=30, seed=seed)
        _, read = read_all(damaged)
        wrong = [frame for frame in read if not np.array_equal(frame.grey, clean[round(frame.time_s, 3)])]
        assert wrong, seed
        assert [frame.source_index for frame in wrong if not frame.flags & UNUSABLE] == [], seed
        assert all(frame.reason for frame in read if frame.flags), seed


SOUND = {
    "intra refresh": ("libx264", "x264-params", "intra-refresh=1:keyint=10:bframes=0"),
    "open groups": ("libx264", "x264-params", "open-gop=1:keyint=12:bframes=3"),
    "pyramid": ("libx264", "x264-params", "keyint=30:bframes=5:b-pyramid=normal"),
    "HEVC, open groups": ("libx265", "x265-params", "open-gop=1:keyint=12:bframes=3:log-level=none"),
    "HEVC, intra refresh": ("libx265", "x265-params", "intra-refresh=1:keyint=10:bframes=0:log-level=none"),
}


@pytest.mark.parametrize("kind", SOUND)
def test_a_sound_stream_has_no_suspect_frame_however_it_is_coded_and_cut(tmp_path, frames, kind):
    """Frames asked for alone, in units, are to the bit those of a decoder that is left to itself."""
    codec, name, value = SOUND[kind]
    path = write_video(tmp_path / "a.mp4", frames, codec=codec, options={"preset": "veryfast", name: value})
    with av.open(str(path)) as container:
        plain = [_grey(frame) for frame in container.decode(video=0)]
    info = probe(path, frames=ALL)
    chosen = range(0, 60, 3)
    for size in (5, 20):
        read = [one for k in range(0, 20, size) for one in iter_frames(path, info, list(chosen)[k : k + size])]
        assert [(frame.source_index, frame.flags, frame.reason) for frame in read] == [(k, 0, "") for k in chosen]
        assert all(np.array_equal(frame.grey, plain[frame.source_index]) for frame in read)


def test_ten_bits_are_the_grey_levels_of_eight(tmp_path):
    ramp = np.tile(np.linspace(0, 255, 320).astype(np.uint8), (240, 1))
    deep = av.VideoFrame.from_ndarray(ramp, format="gray").reformat(format="yuv420p10le")
    flat = av.VideoFrame.from_ndarray(ramp, format="gray").reformat(format="yuv420p")
    assert np.abs(_grey(deep).astype(int) - _grey(flat)).max() <= 2
    assert np.abs(_grey(deep).astype(int) - ramp).max() <= 2


def test_frames_are_good_again_from_the_next_key_frame_on(tmp_path, frames):
    write_video(tmp_path / "a.mp4", frames, options={"preset": "veryfast", "x264-params": "scenecut=0"})
    damaged = flip_bytes(tmp_path / "a.mp4", tmp_path / "d.mp4", start=0.42, stop=0.44, count=30, seed=1)
    info, read = read_all(damaged)
    suspect = [frame.source_index for frame in read if frame.flags]
    keys = np.flatnonzero(info.key_frames)
    assert suspect
    assert suspect == list(range(suspect[0], suspect[-1] + 1))
    assert suspect[-1] + 1 in keys
    assert suspect[-1] < 40


def test_damage_is_flagged_alike_when_a_flight_is_read_in_pieces(tmp_path, frames):
    write_video(tmp_path / "a.mp4", frames)
    damaged = flip_bytes(tmp_path / "a.mp4", tmp_path / "d.mp4", start=0.3, stop=0.5, count=30, seed=3)
    info, whole = read_all(damaged)
    pieces = [frame for first in range(0, 60, 10) for frame in iter_frames(damaged, info, range(first, first + 10))]
    assert [bool(f.flags & UNUSABLE) for f in pieces] == [bool(f.flags & UNUSABLE) for f in whole]


def test_a_truncated_or_unreadable_image_is_flagged_and_the_rest_read(tmp_path, frames):
    names = write_images(tmp_path / "f", frames[:5], name="{}.jpg")
    for name, fraction in ((names[1], 0.5), (names[2], 0.01), (names[3], 0.0)):
        content = (tmp_path / "f" / name).read_bytes()
        (tmp_path / "f" / name).write_bytes(content[: int(fraction * len(content))])
    info, read = read_all(tmp_path / "f", FPS)
    unreadable = [bool(frame.flags & FrameFlag.UNREADABLE) for frame in read]
    assert unreadable == [False, True, True, True, False]
    assert not read[1].grey.any()
    assert "truncated" in read[1].reason
    assert any("2 of 5 images cannot be read" in warning for warning in info.warnings)


def test_a_png_with_flipped_bytes_is_flagged(tmp_path, frames):
    (name,) = write_images(tmp_path / "f", frames[:1])
    write_images(tmp_path / "f", frames[:2], name="g{}.png")
    flip_bytes(tmp_path / "f" / name, tmp_path / "f" / name, start=0.3, stop=0.8, count=5, seed=0)
    _, read = read_all(tmp_path / "f", FPS)
    assert [bool(frame.flags & FrameFlag.UNREADABLE) for frame in read] == [True, False, False]


def test_missing_duplicate_black_blurred_and_outlier_frames_are_flagged(tmp_path, frames):
    import cv2

    sequence = [frame.copy() for frame in frames[:9]]
    sequence[2] = sequence[1].copy()
    sequence[3] = np.zeros_like(sequence[3])
    sequence[5] = cv2.GaussianBlur(sequence[5], (0, 0), 6)
    sequence[7] = ground(320, 240, seed=99)
    write_images(tmp_path / "f", sequence)
    (tmp_path / "f" / "f9.png").unlink()
    side = write_times(tmp_path / "t.csv", [(f"f{i + 1}.png", 0.2 * i) for i in range(9)])
    info = probe(tmp_path / "f", frames=ALL, timestamps=side)
    assert any("1 frames of t.csv are not in f (f9.png)" in warning for warning in info.warnings)
    read = list(iter_frames(tmp_path / "f", info, range(8)))
    assert [describe_flags(frame.flags) for frame in read[:5]] == ["", "", "duplicate", "black", ""]
    assert [frame.reason for frame in read[2:4]] == ["the same image as the frame before", "black, or without detail"]
    quality = [frame_quality(frame.grey) for frame in [*read, *read[4:5]]]
    assert np.flatnonzero(flag_blurred(np.array([q.sharpness for q in quality]))).tolist() == [3, 5]
    assert np.flatnonzero(flag_outlier_frames(np.array([q.thumbnail for q in quality]))).tolist() == [3, 7]


def test_a_flight_cut_into_units_finds_the_same_duplicates(tmp_path, frames):
    write_images(tmp_path / "f", [frames[0], frames[1], frames[1], frames[2]])
    info, whole = read_all(tmp_path / "f", FPS)
    second = list(iter_frames(tmp_path / "f", info, [2, 3], after=1))
    assert [frame.flags for frame in second] == [frame.flags for frame in whole[2:]] == [int(FrameFlag.DUPLICATE), 0]


def test_permuted_times_are_sorted_with_a_warning(tmp_path, frames):
    names = write_images(tmp_path / "f", frames[:4])
    side = write_times(tmp_path / "t.csv", list(zip(names, [0.6, 0.0, 0.4, 0.2], strict=True)))
    info = probe(tmp_path / "f", frames=ALL, timestamps=side)
    assert info.names == ("f2.png", "f4.png", "f3.png", "f1.png")
    assert any("order of time" in warning for warning in info.warnings)


def test_equal_times_are_said_and_flagged(tmp_path, frames):
    names = write_images(tmp_path / "f", frames[:3])
    side = write_times(tmp_path / "t.csv", list(zip(names, [0.0, 0.2, 0.2], strict=True)))
    info = probe(tmp_path / "f", frames=ALL, timestamps=side)
    assert any("1 frames have the time of the frame before" in warning for warning in info.warnings)
    assert [frame.flags for frame in iter_frames(tmp_path / "f", info, range(3))] == [0, 0, int(FrameFlag.DUPLICATE)]


def test_a_folder_without_times_is_refused_with_what_to_give(tmp_path, frames):
    write_images(tmp_path / "f", frames[:2])
    assert_stops(tmp_path / "f", "give --timestamps CSV .* or --fps", ALL)


def test_time_stamps_that_contradict_the_container_stop(tmp_path, frames):
    path = write_video(tmp_path / "a.mp4", frames[:20])
    assert_stops(
        path, "by the video's own times", ALL, write_times(tmp_path / "t.csv", [(i, i * 0.05) for i in range(20)])
    )
    assert_stops(
        path, "found no time for 1 of 20", ALL, write_times(tmp_path / "u.csv", [(i, i * 0.04) for i in range(19)])
    )


@pytest.mark.parametrize(
    ("content", "match"),
    [
        ("frame,time_s\nf1.png,nan\n", "finite"),
        ("frame,time_s\nf1.png,soon\n", "finite"),
        ("frame,time_s\nf1.png,1\nf1.png,2\n", "a second time"),
        ("name,t\nf1.png,1\n", "expected time stamps as CSV"),
        ("frame,time_s\n", "no rows"),
        ("frame,time_s\nelsewhere.png,1\n", "none an image"),
    ],
)
def test_a_bad_time_stamps_file_stops(tmp_path, frames, content, match):
    write_images(tmp_path / "f", frames[:2])
    side = tmp_path / "t.csv"
    side.write_text(content)
    assert_stops(tmp_path / "f", match, ALL, side)


def test_rate_and_side_file_together_stop(tmp_path, frames):
    names = write_images(tmp_path / "f", frames[:2])
    assert_stops(
        tmp_path / "f",
        "exclude each other",
        FPS,
        write_times(tmp_path / "t.csv", [(n, i) for i, n in enumerate(names)]),
    )


def test_frames_that_change_size_stop_with_both_sizes(tmp_path, frames):
    write_images(tmp_path / "f", [*frames[:3], frames[3][:200, :300]])
    assert_stops(tmp_path / "f", "found f4.png of 300x200, expected 320x240")


def test_a_video_that_changes_size_stops_with_both_sizes(tmp_path, frames):
    first = write_video(tmp_path / "a.ts", frames[:20])
    second = write_video(tmp_path / "b.ts", [f[:128, :160] for f in frames[:20]], times=list(range(20, 40)))
    (tmp_path / "c.ts").write_bytes(first.read_bytes() + second.read_bytes())
    assert_stops(tmp_path / "c.ts", "of 160x128, expected 320x240")


def png_bomb(path: Path, width: int, height: int) -> Path:
    """A PNG of a gigapixel in a few kB: rows of zeros."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packed = zlib.compressobj(9)
    body = b"".join(packed.compress(bytes(1 << 20)) for _ in range(4)) + packed.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b""))
    return path


def test_a_gigapixel_in_a_few_kilobytes_is_refused(tmp_path):
    (tmp_path / "f").mkdir()
    png_bomb(tmp_path / "f" / "bomb.png", 40_000, 40_000)
    assert_stops(tmp_path / "f", "40000x40000 = 1600000000 px, expected at most 400000000")


def test_a_video_larger_than_the_limit_is_refused(tmp_path, frames):
    path = write_video(tmp_path / "a.mp4", frames[:2])
    assert_stops(path, "320x240 = 76800 px, expected at most 1000", FramesConfig(max_pixels=1000))


@pytest.mark.parametrize(
    "content",
    [
        b"#EXTM3U\n#EXT-X-TARGETDURATION:5\n#EXTINF:5,\nsecret.ts\n#EXT-X-ENDLIST\n",
        b"ffconcat version 1.0\nfile secret.ts\n",
        b"v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\n",
        b"",
        b"hello",
    ],
)
def test_playlists_and_other_files_are_no_videos(tmp_path, frames, content):
    write_video(tmp_path / "secret.ts", frames[:5])
    for name in ("a.mp4", "a.m3u8", "a.ts"):
        (tmp_path / name).write_bytes(content)
        assert_stops(tmp_path / name, "could not be opened as video|no video stream|no frames|no frame size")


def test_a_vrt_named_tif_is_refused(tmp_path, frames):
    write_images(tmp_path / "other", frames[:1])
    (tmp_path / "f").mkdir()
    (tmp_path / "f" / "a.tif").write_text(
        '<VRTDataset rasterXSize="320" rasterYSize="240"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
        f"<SourceFilename>{tmp_path / 'other' / 'f1.png'}</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
    )
    assert_stops(tmp_path / "f", "found a VRT")


def test_nothing_there_an_empty_folder_and_a_folder_of_videos_stop(tmp_path, frames):
    assert_stops(tmp_path / "none", "found no video or image folder")
    (tmp_path / "empty").mkdir()
    assert_stops(tmp_path / "empty", "found no images in the folder")
    write_video(tmp_path / "empty" / "b.mp4", frames[:5])
    assert_stops(tmp_path / "empty", "found no images in the folder.*; of the video in it: velfield run empty/b.mp4")
    write_images(tmp_path / "empty", frames[:1])
    assert_stops(tmp_path / "empty", "without times.*; of the video in it: velfield run empty/b.mp4", FramesConfig())
    assert_stops(next((tmp_path / "empty").glob("*.png")), "found one image.*; --base takes a base image")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    assert_stops(tmp_path / "loop", "found no video or image folder")


@pytest.mark.parametrize("level", [1.0, np.nan])
def test_a_float_image_of_one_level_is_read_and_is_black(tmp_path, level):
    Image.fromarray(np.full((8, 8), level, np.float32)).save(tmp_path / "a.tif")
    (read,) = iter_frames(tmp_path, probe(tmp_path, frames=FPS), [0])
    assert read.flags == FrameFlag.BLACK
    assert not read.grey.any()


def test_colours_of_another_space_are_no_frames(tmp_path):
    Image.frombytes("LAB", (8, 8), bytes(192)).save(tmp_path / "a.tif")
    (read,) = iter_frames(tmp_path, probe(tmp_path, frames=FPS), [0])
    assert read.flags == FrameFlag.UNREADABLE
    assert "expected grey or colour levels" in read.reason
