"""Videos and image folders: the frames and times that went in come out, whatever the container does to them."""

import os
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from schemas.flight import FramesConfig
from tests.media import drifting, write_images, write_times, write_video
from velfield.errors import InputError
from velfield.parallel import for_each_behind
from velfield.sources.frames import SourceFrame
from velfield.sources.quality import FrameFlag
from velfield.sources.selection import select_frames
from velfield.sources.source import iter_frames, probe
from velfield.sources.video import pauses

ALL = FramesConfig()


def mean_difference(first, second):
    return float(np.abs(first.astype(float) - second).mean())


@pytest.fixture(scope="module")
def frames():
    return list(drifting(30))


@pytest.mark.parametrize(
    ("suffix", "codec", "options"),
    [
        (".mp4", "libx264", None),
        (".mp4", "libx264", {"x264-params": "open-gop=1:keyint=12:bframes=3"}),
        (".mkv", "libx264", None),
        (".ts", "libx264", None),
        (".avi", "mpeg4", {"bf": "2"}),
        (".mov", "libx265", {"x265-params": "log-level=none"}),
        (".mpg", "mpeg2video", None),
        (".mkv", "ffv1", {}),
    ],
)
def test_every_container_gives_each_frame_with_its_time(tmp_path, frames, suffix, codec, options):
    path = write_video(tmp_path / f"flight{suffix}", frames, codec=codec, options=options)
    info = probe(path, frames=ALL)
    assert (info.kind, info.width, info.height, info.frame_count) == ("video", 160, 120, 30)
    np.testing.assert_allclose(np.diff(info.times_s), 0.04, atol=2e-3)
    read = list(iter_frames(path, info, range(30)))
    assert [frame.source_index for frame in read] == list(range(30))
    assert [frame.flags for frame in read] == [0] * 30, [frame.reason for frame in read if frame.flags]
    nearest = [int(np.argmin([mean_difference(frame.grey, truth) for truth in frames])) for frame in read]
    assert nearest == list(range(30))


def test_times_of_a_variable_rate_video_are_the_containers_own(tmp_path, frames):
    ticks = np.cumsum([0, 33, 41, 33, 200, 17, 33, 40, 1000, 33]).tolist()
    path = write_video(tmp_path / "vfr.mp4", frames[:10], times=ticks, time_base=Fraction(1, 1000))
    info = probe(path, frames=ALL)
    np.testing.assert_allclose(info.times_s - info.times_s[0], np.array(ticks) / 1000, atol=1e-9)


def test_times_equal_the_decoders_to_the_bit(tmp_path, frames):
    path = write_video(tmp_path / "late.ts", frames, times=[100 + i for i in range(30)])
    with av.open(str(path)) as container:
        decoded = [float(frame.pts * frame.time_base) for frame in container.decode(video=0)]
    assert probe(path, frames=ALL).times_s.tolist() == decoded


@pytest.mark.parametrize("suffix", [".mp4", ".mkv", ".ts", ".avi"])
@pytest.mark.parametrize(
    "options", [{}, {"x264-params": "open-gop=1:keyint=7:bframes=2"}, {"x264-params": "intra-refresh=1"}]
)
def test_a_flight_read_in_pieces_equals_the_whole(tmp_path, frames, suffix, options):
    path = write_video(tmp_path / f"flight{suffix}", frames, key_interval=7, options={"preset": "veryfast", **options})
    info = probe(path, frames=ALL)
    whole = list(iter_frames(path, info, range(30)))
    for first in (1, 6, 7, 8, 15, 29):
        pieces = list(iter_frames(path, info, range(first, 30, 4), after=first - 1))
        assert [piece.source_index for piece in pieces] == list(range(first, 30, 4))
        for piece in pieces:
            assert piece.flags == whole[piece.source_index].flags
            assert np.array_equal(piece.grey, whole[piece.source_index].grey)


def in_pieces(indices):
    """Pieces of eight, as units read them: each with the frame before, and the frames that others will read."""
    for first in range(0, len(indices), 8):
        yield {
            "indices": indices[first : first + 8],
            "after": indices[first - 1] if first else None,
            "then": indices[first + 8 :],
        }


def test_pieces_far_behind_a_key_frame_are_read_by_one_decoder(tmp_path):
    path = write_video(tmp_path / "long.mp4", list(drifting(150)), key_interval=150)
    info, indices = probe(path, frames=ALL), np.arange(0, 150, 3)
    whole = list(iter_frames(path, info, indices))
    parts = in_pieces(indices)
    read = [frame for _ in range(2) for frame in iter_frames(path, info, **next(parts))]
    # of a file that nobody could open any more; what is behind the key frame is there
    state, content = path.stat(), bytearray(path.read_bytes())
    content[:400] = bytes(400)
    path.write_bytes(content)
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))
    read += [frame for part in parts for frame in iter_frames(path, info, **part)]
    assert [frame.source_index for frame in read] == indices.tolist()
    assert all(np.array_equal(a.grey, b.grey) and a.flags == b.flags for a, b in zip(read, whole, strict=True))


@pytest.mark.parametrize("key_interval", [10, 60, 150])
def test_pieces_read_by_several_threads_equal_the_whole(tmp_path, key_interval):
    path = write_video(tmp_path / "long.mp4", list(drifting(150)), key_interval=key_interval)
    info, indices = probe(path, frames=ALL), np.arange(0, 150, 2)
    whole = list(iter_frames(path, info, indices))
    with ThreadPoolExecutor(3) as pool:
        pieces = list(pool.map(lambda part: list(iter_frames(path, info, **part)), in_pieces(indices)))
    read = [frame for piece in pieces for frame in piece]
    assert [frame.source_index for frame in read] == indices.tolist()
    assert all(np.array_equal(a.grey, b.grey) and a.flags == b.flags for a, b in zip(read, whole, strict=True))


def test_a_piece_that_is_given_up_lets_the_next_one_begin(tmp_path):
    path = write_video(tmp_path / "long.mp4", list(drifting(100)), key_interval=100)
    info = probe(path, frames=ALL)
    first, second, *_ = in_pieces(np.arange(40, 100))
    given_up = iter_frames(path, info, **first)
    next(given_up)
    with ThreadPoolExecutor(1) as pool:
        waits = pool.submit(lambda: list(iter_frames(path, info, **second)))
        time.sleep(0.5)
        assert not waits.done()
        given_up.close()
        read = waits.result(timeout=60)
    assert [frame.source_index for frame in read] == list(range(48, 56))
    # and another choice of frames does not get the decoder that waits behind these
    other = list(iter_frames(path, info, np.arange(56, 66, 2), after=55))
    assert [frame.source_index for frame in other] == list(range(56, 66, 2))


@pytest.mark.parametrize("taken", [False, True])
def test_a_decoder_that_nobody_takes_is_closed(monkeypatch, taken):
    monkeypatch.setattr(pauses, "_KEPT_S", 0.2)
    closed = []

    def decode():
        try:
            yield from range(10)
        finally:
            closed.append(True)

    decoder, file = decode(), (Path("a.mp4"), 1, 1)
    next(decoder)
    last = SourceFrame(5, "5", 0.2, np.zeros((2, 2), np.uint8), 0, "")
    waiting = pauses.Pauses()
    waiting.announce(file, 5)
    waiting.end(file, 5, pauses.Pause(file, last, np.array([7, 9]), decoder))
    assert waiting.take(file, np.array([5, 8, 9])) is None
    assert (waiting.take(file, np.array([5, 7, 9])) is not None) if taken else True
    time.sleep(1.0)
    assert closed == ([] if taken else [True])
    assert waiting.take(file, np.array([5, 7, 9])) is None


def test_frames_that_cannot_be_kept_leave_the_next_piece_to_others(tmp_path):
    path = write_video(tmp_path / "long.mp4", list(drifting(100)), key_interval=100)
    info = probe(path, frames=ALL)
    first, second, *_ = in_pieces(np.arange(40, 100))

    def fail(_frame):
        raise OSError("No space left on device")

    with pytest.raises(OSError, match="No space") as error, closing(iter_frames(path, info, **first)) as read:
        for_each_behind(fail, read)
    assert error.value.__traceback__ is not None  # which holds all that was under way
    with ThreadPoolExecutor(1) as pool:
        later = pool.submit(lambda: list(iter_frames(path, info, **second))).result(timeout=60)
    assert [frame.source_index for frame in later] == list(range(48, 56))


def test_limited_range_video_comes_out_in_the_full_range(tmp_path):
    ramp = np.tile(np.linspace(16, 235, 160).round().astype(np.uint8), (120, 1))
    frame = av.VideoFrame(160, 120, "yuv420p")
    frame.planes[0].update(np.pad(ramp, ((0, 0), (0, frame.planes[0].line_size - 160))).tobytes())
    for plane in frame.planes[1:]:
        plane.update(bytes([128]) * plane.buffer_size)
    with av.open(str(tmp_path / "ramp.mkv"), "w") as container:
        stream = container.add_stream("ffv1", rate=25)
        stream.width, stream.height, stream.pix_fmt = 160, 120, "yuv420p"
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    info = probe(tmp_path / "ramp.mkv", frames=ALL)
    (read,) = iter_frames(tmp_path / "ramp.mkv", info, [0])
    assert (read.grey.min(), read.grey.max()) == (0, 255)


def test_a_video_without_times_wants_a_rate_or_a_side_file(tmp_path, frames):
    path = write_video(tmp_path / "raw.h264", frames)
    with pytest.raises(InputError, match="give --timestamps or --fps"):
        probe(path, frames=ALL)
    info = probe(path, frames=FramesConfig(fps=10))
    np.testing.assert_allclose(info.times_s, np.arange(30) / 10)
    read = list(iter_frames(path, info, [0, 11, 29]))
    assert [frame.flags for frame in read] == [0, 0, 0]
    assert all(mean_difference(frame.grey, frames[frame.source_index]) < 6 for frame in read)


def test_a_rate_is_not_used_where_the_container_has_times(tmp_path, frames):
    info = probe(write_video(tmp_path / "a.mp4", frames), frames=FramesConfig(fps=10))
    assert info.times_s[1] == pytest.approx(0.04)
    assert any("--fps is not used" in warning for warning in info.warnings)


def test_a_side_file_that_agrees_gives_the_times_of_a_video(tmp_path, frames):
    path = write_video(tmp_path / "a.mp4", frames)
    side = write_times(tmp_path / "t.csv", [(i, 1000.0 + i * 0.0401) for i in range(30)])
    assert probe(path, frames=ALL, timestamps=side).times_s[3] == pytest.approx(1000.1203)


def test_a_folder_is_read_in_natural_order_with_its_side_files_times(tmp_path, frames):
    names = write_images(tmp_path / "frames", frames[:12])
    (tmp_path / "frames" / "._f1.png").write_bytes(b"resource fork")
    (tmp_path / "frames" / "notes.txt").write_text("not an image")
    side = write_times(tmp_path / "t.csv", [(name, 5 + 0.2 * i) for i, name in enumerate(names)])
    info = probe(tmp_path / "frames", frames=ALL, timestamps=side)
    assert info.names == tuple(names)
    assert info.names[9] == "f10.png"
    np.testing.assert_allclose(info.times_s, 5 + 0.2 * np.arange(12))
    read = list(iter_frames(tmp_path / "frames", info, [0, 9]))
    assert np.array_equal(read[1].grey, frames[9])


def test_images_are_read_as_stored_whatever_exif_says(tmp_path, frames):
    exif = Image.Exif()
    exif[0x0112] = 6  # turn by a quarter
    (tmp_path / "frames").mkdir()
    Image.fromarray(frames[0]).save(tmp_path / "frames" / "a.jpg", exif=exif, quality=95)
    info = probe(tmp_path / "frames", frames=FramesConfig(fps=1))
    (read,) = iter_frames(tmp_path / "frames", info, [0])
    assert read.grey.shape == (120, 160)
    assert mean_difference(read.grey, frames[0]) < 4


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "P", "LA", "I;16", "1", "CMYK"])
def test_images_of_every_usual_mode_become_grey(tmp_path, frames, mode):
    path = tmp_path / ("a.jpg" if mode == "CMYK" else "a.png")
    if mode == "I;16":
        Image.fromarray(frames[0].astype(np.uint16) * 257).save(path)
    else:
        Image.fromarray(frames[0]).convert("RGB").convert(mode).save(path)
    info = probe(tmp_path, frames=FramesConfig(fps=1))
    (read,) = iter_frames(tmp_path, info, [0])
    assert read.grey.dtype == np.uint8
    assert mean_difference(read.grey, frames[0]) < (130 if mode == "1" else 20)


def test_auto_takes_the_frames_nearest_to_the_interval():
    assert select_frames(np.arange(100) / 25, ALL)[:3].tolist() == [0, 5, 10]
    assert np.unique(np.diff(select_frames(np.arange(100) / 24, ALL))).tolist() == [5]
    assert np.unique(np.diff(select_frames(np.arange(100) / 30000 * 1001, ALL))).tolist() == [6]
    assert select_frames(np.arange(10) / 2.0, ALL).tolist() == list(range(10))
    gap = np.r_[np.arange(20) * 0.04, 5 + np.arange(20) * 0.04]
    assert select_frames(gap, ALL).tolist() == [0, 5, 10, 15, 19, 20, 25, 30, 35]


def test_start_and_stop_count_from_the_first_frame_and_stop_is_left_out():
    times = 100 + np.arange(10) * 0.1
    config = FramesConfig(every=2, start_s=0.3, stop_s=0.8)
    assert select_frames(times, config).tolist() == [3, 5, 7]


@given(
    st.lists(st.floats(0, 100), min_size=1, max_size=60).map(sorted),
    st.one_of(st.just("auto"), st.integers(1, 7)),
    st.floats(0.01, 5),
)
def test_chosen_times_always_ascend_so_no_interval_is_zero(times, every, interval):
    chosen = select_frames(np.array(times), FramesConfig(every=every, target_interval_s=interval))
    assert chosen.size >= 1
    assert np.all(np.diff(np.array(times)[chosen]) > 0)
    assert np.all(np.diff(chosen) > 0)


@pytest.mark.footage
def test_kharkiv_has_177_frames_of_the_containers_times(footage):
    path: Path = footage("kharkiv") / "drone.mp4"
    info = probe(path, frames=ALL)
    assert (info.width, info.height, info.frame_count, info.warnings) == (1920, 1080, 177, ())
    chosen = select_frames(info.times_s, ALL)
    assert chosen.tolist() == list(range(0, 177, 5))
    read = list(iter_frames(path, info, chosen[:3]))
    assert [FrameFlag(frame.flags) for frame in read] == [FrameFlag(0)] * 3
