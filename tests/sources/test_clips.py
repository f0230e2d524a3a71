"""Several clips of one place are one source: one clock, gaps noted, frames of all."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from schemas.flight import FramesConfig
from tests.media import drifting, write_video
from velfield.errors import Failure, InputError
from velfield.sources.capture_times import read_flight_start
from velfield.sources.clips import clip_files, read_clips_telemetry, write_clip_list
from velfield.sources.selection import select_frames
from velfield.sources.source import check_source, iter_frames, probe

FRAMES = FramesConfig()


def clip(path: Path, start: str | None, *, frames: int = 10, width: int = 160, seed: int = 0) -> Path:
    """A clip of 25 frames a second with a creation time."""
    metadata = {} if start is None else {"creation_time": start}
    return write_video(path, list(drifting(frames, width=width, seed=seed)), metadata=metadata)


def joined(folder: Path, *clips: Path) -> Path:
    write_clip_list(folder / "x.clips", clips)
    return folder / "x.clips"


def test_clips_are_joined_by_their_creation_times(tmp_path: Path) -> None:
    late = clip(tmp_path / "a.mp4", "2026-05-04T10:20:00Z", seed=1)
    early = clip(tmp_path / "b.mp4", "2026-05-04T10:00:00Z", frames=15)
    path = joined(tmp_path, late, early)
    check_source(path)
    info = probe(path, frames=FRAMES)
    assert info.frame_count == 25
    assert info.times_s[:15] == pytest.approx(np.arange(15) / 25)
    assert info.times_s[15:] == pytest.approx(1200 + np.arange(10) / 25)
    assert info.names[0] == "b.mp4:0"
    assert info.names[15] == "a.mp4:0"
    assert any("a gap of 1199.4 s before a.mp4" in warning for warning in info.warnings)
    indices = select_frames(info.times_s, FRAMES)
    found = list(iter_frames(path, info, indices))
    assert [frame.source_index for frame in found] == indices.tolist()
    assert [frame.time_s for frame in found] == pytest.approx(info.times_s[indices])
    alone = probe(late, frames=FRAMES)
    (first,) = iter_frames(late, alone, [0])
    assert np.array_equal(next(iter(iter_frames(path, info, [15]))).grey, first.grey)


def test_the_drones_subtitles_win_over_creation_times(tmp_path: Path) -> None:
    clips = [clip(tmp_path / f"{name}.mp4", "2026-05-04T10:00:00Z") for name in "ab"]
    for path, moment in zip(clips, ("12:00:00.000", "12:00:05.500"), strict=True):
        cue = f"1\n00:00:00,000 --> 00:00:00,400\n2026-05-04 {moment}\n[rel_alt: 80.0 abs_alt: 90.0]\n"
        path.with_suffix(".SRT").write_text(cue)
    info = probe(joined(tmp_path, *clips), frames=FRAMES)
    assert info.times_s[10] == pytest.approx(5.5)
    telemetry = read_clips_telemetry(info)
    assert telemetry.time_s == pytest.approx([0.0, 5.5])
    assert telemetry.height_m.tolist() == [80.0, 80.0]
    assert len(clip_files(tmp_path / "x.clips")) == 4


def test_clips_without_times_follow_each_other_and_a_note_says_so(tmp_path: Path) -> None:
    clips = [clip(tmp_path / f"{name}.mp4", None) for name in "ab"]
    info = probe(joined(tmp_path, *clips), frames=FRAMES)
    assert info.times_s[10] == pytest.approx(60.36)
    assert any("do not all have a creation time" in warning for warning in info.warnings)
    assert isinstance(read_clips_telemetry(info), Failure)
    assert replace(info, parts=()).frame_count == 20


def test_clips_that_cannot_be_one_source_are_refused(tmp_path: Path) -> None:
    one = clip(tmp_path / "a.mp4", "2026-05-04T10:00:00Z")
    overlapping = clip(tmp_path / "b.mp4", "2026-05-04T10:00:00.2Z")
    with pytest.raises(InputError, match="velfield merge"):
        probe(joined(tmp_path, one, overlapping), frames=FRAMES)
    other = clip(tmp_path / "c.mp4", "2026-05-04T11:00:00Z", width=192)
    with pytest.raises(InputError, match="found frames of 192x120, expected 160x120"):
        probe(joined(tmp_path, one, other), frames=FRAMES)
    with pytest.raises(InputError, match="twice"):
        joined(tmp_path, one, one)
    with pytest.raises(InputError, match="folder"):
        joined(tmp_path, one, tmp_path)


def test_a_flight_starts_by_subtitles_else_by_the_header(tmp_path: Path) -> None:
    path = clip(tmp_path / "a.mp4", "2026-05-04T10:00:00Z")
    info = probe(path, frames=FRAMES)
    start = read_flight_start(path, info)
    assert (start.time, start.is_utc) == (datetime(2026, 5, 4, 10, tzinfo=UTC), True)
    cue = "1\n00:00:02,000 --> 00:00:02,400\n2026-05-04 12:00:05.500\n[rel_alt: 80.0 abs_alt: 90.0]\n"
    (tmp_path / "a.SRT").write_text(cue)
    start = read_flight_start(path, info)
    assert (start.time, start.is_utc) == (datetime(2026, 5, 4, 12, 0, 3, 500_000, tzinfo=UTC), False)
    assert start.source == "subtitles of a.mp4"
    (tmp_path / "b.SRT").write_text(cue.replace("05-04", "05-06"))
    given = read_flight_start(path, info, tmp_path / "b.SRT")
    assert given.time.day == 6
    bare = clip(tmp_path / "c.mp4", None)
    assert read_flight_start(bare, probe(bare, frames=FRAMES)) is None


def test_a_flight_of_images_starts_by_the_first_ones_exif(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x9003: "2024:05:01 12:00:00"})
    for name in ("000.jpg", "001.jpg"):
        Image.new("L", (64, 48), 90).save(tmp_path / name, exif=exif)
    start = read_flight_start(tmp_path, probe(tmp_path, frames=FramesConfig(fps=5)))
    assert (start.time, start.source, start.is_utc) == (datetime(2024, 5, 1, 12, tzinfo=UTC), "EXIF of 000.jpg", False)


def png_chunks(path: Path) -> list[bytes]:
    data, chunks, at = path.read_bytes(), [], 8
    while at < len(data):
        size = 12 + int.from_bytes(data[at : at + 4])
        chunks.append(data[at : at + size])
        at += size
    return chunks


@pytest.mark.parametrize("tags", ["EXIF", "EXIF behind the pixels", "XMP", "XMP behind the pixels"])
def test_a_flight_of_pngs_starts_by_their_tags(tags: str, tmp_path: Path) -> None:
    """ExifTool writes them behind the pixels, other programs before."""
    exif, info = Image.Exif(), PngInfo()
    if tags.startswith("EXIF"):
        exif[0x010F] = "maker"
        exif.get_ifd(0x8769).update({0x9003: "2024:05:01 12:00:00", 0x9291: "25"})
    else:
        info.add_itxt("XML:com.adobe.xmp", '<rdf:Description exif:DateTimeOriginal="2024-05-01T12:00:00.25+02:00"/>')
    for name in ("000.png", "001.png"):
        Image.new("L", (64, 48), 90).save(tmp_path / name, exif=exif, pnginfo=info)
        if "behind" in tags:
            chunks = sorted(png_chunks(tmp_path / name), key=lambda chunk: chunk[4:8] in (b"eXIf", b"iTXt", b"IEND"))
            ordered = sorted(chunks, key=lambda chunk: chunk[4:8] == b"IEND")
            assert [chunk[4:8] for chunk in ordered][1] == b"IDAT"
            (tmp_path / name).write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(ordered))
    start = read_flight_start(tmp_path, probe(tmp_path, frames=FramesConfig(fps=5)))
    assert start.time == datetime(2024, 5, 1, 12, 0, 0, 250_000, tzinfo=UTC)
    assert start.source == f"{tags[:4].strip()} of 000.png"


def test_a_png_whose_tags_are_damaged_has_no_start(tmp_path: Path) -> None:
    for name in ("000.png", "001.png"):
        Image.new("L", (64, 48), 90).save(tmp_path / name)
        *chunks, end = png_chunks(tmp_path / name)
        chunks += [(3).to_bytes(4) + b"eXIf" + b"MM\0" + bytes(4), (2**31).to_bytes(4) + b"iTXt" + b"XML"]
        (tmp_path / name).write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks) + end)
    assert read_flight_start(tmp_path, probe(tmp_path, frames=FramesConfig(fps=5))) is None
