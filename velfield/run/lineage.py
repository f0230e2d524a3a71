"""Provenance of a result from the run folder alone: stages and keys, or the data behind a pixel."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd

from schemas.arrays import Mask
from schemas.records import CommitRecord, RebaseRecord
from velfield.errors import InputError, count_text
from velfield.field.accumulate import accumulate_tile
from velfield.field.segments import SEGMENT_DTYPE, Segments, VelocityBins, band_radius_px, segment_table, tracks_in
from velfield.run.commits import read_commits
from velfield.run.frame_transforms import read_working
from velfield.run.run import Run


@dataclass(frozen=True)
class StageLineage:
    """One stage: its content key and the units that are finished."""

    name: str
    key: str
    units: int
    outputs: int
    code_versions: tuple[str, ...]


@dataclass(frozen=True)
class TrackLineage:
    """One vehicle that passed the pixel: its tracklets there, and their frames."""

    track_id: int
    tracklets: tuple[int, ...]
    frames: tuple[int, ...]


@dataclass(frozen=True)
class FrameLineage:
    """One frame behind the pixel."""

    frame: int
    source_index: int
    time_s: float
    heldout_px: float
    """RMS error of the control points held out of its registration, base px."""


@dataclass(frozen=True)
class PixelLineage:
    """The data behind one pixel of the field."""

    x: int
    y: int
    tracks: tuple[TrackLineage, ...]
    frames: tuple[FrameLineage, ...]


def stage_lineage(run: Run) -> list[StageLineage]:
    """The run's finished stages, in order."""
    found = []
    for stage in run.record.keys:
        records = read_commits(run.layout, stage)
        if records:
            outputs = sum(len(record.outputs) for record in records)
            versions = tuple(sorted({record.code_version for record in records}))
            found.append(StageLineage(stage, run.record.keys[stage], len(records), outputs, versions))
    return found


def pixel_lineage(run: Run, x: int, y: int) -> PixelLineage:
    """The vehicles, tracklets and frames behind a pixel: exactly those that the field counts there.

    Raises
    ------
    InputError
        The pixel is outside the base image.
    """
    width, height = run.grid.width_px, run.grid.height_px
    if not (0 <= x < width and 0 <= y < height):
        raise InputError(f"pixel ({x}, {y}) is outside the base image of {width} x {height} px")
    tracklets = run.tracklets()
    margin_px = (band_radius_px(run.record.config.field, run.grid.gsd_m) or 0.0) + 1.0
    # All tracklets of the tracks that come near: a shared segment's velocity is averaged along its track.
    near = tracks_in(tracklets, (x - margin_px, y - margin_px), (x + margin_px, y + margin_px))
    touching = _touching(run, tracklets[tracklets["track_id"].isin(near)], x, y)
    tracks = tuple(_tracks(tracklets, touching))
    return PixelLineage(x, y, tracks, _frames(run, sorted({f for track in tracks for f in track.frames})))


def _touching(run: Run, tracklets: pd.DataFrame, x: int, y: int) -> Segments:
    """Segments that the field's kernel counts at the pixel, each tested by itself."""
    config, gsd_m = run.record.config.field, run.grid.gsd_m
    segments = segment_table(tracklets, config) if len(tracklets) else np.empty(0, SEGMENT_DTYPE)
    bins, radius = VelocityBins.from_config(config, gsd_m), band_radius_px(config, gsd_m)
    touches = (
        [
            bool(accumulate_tile(one, origin_xy=(x, y), shape=(1, 1), bins=bins, radius_px=radius).count.any())
            for one in np.split(segments, len(segments))
        ]
        if len(segments)
        else []
    )
    return segments[np.array(touches, np.bool_)]


def _tracks(tracklets: pd.DataFrame, segments: Segments) -> Iterator[TrackLineage]:
    for track in np.unique(segments["track"]):
        mine = segments[segments["track"] == track]
        pairs = set(zip(mine["detection_0"].tolist(), mine["detection_1"].tolist(), strict=True))
        rows = tracklets[(tracklets["track_id"] == track) & _has_pair(tracklets, pairs)]
        frames = np.unique(rows[["frame_0", "frame_1", "frame_2"]].to_numpy())
        yield TrackLineage(int(track), tuple(map(int, rows["tracklet_id"])), tuple(map(int, frames)))


def _has_pair(tracklets: pd.DataFrame, pairs: set[tuple[int, int]]) -> Mask:
    ids = tracklets[[f"detection_id_{k}" for k in range(3)]].to_numpy()
    return np.array([(a, b) in pairs or (b, c) in pairs for a, b, c in ids.tolist()], np.bool_)


def _frames(run: Run, frames: list[int]) -> tuple[FrameLineage, ...]:
    index, times_s = run.frames.column("source_index"), run.times_s
    heldout = run.registration.column("heldout_px")
    return tuple(FrameLineage(f, int(index[f]), float(times_s[f]), float(heldout[f])) for f in frames)


def describe_detector(run: Run) -> str:
    """The detector in one line: its file's digest and its training data."""
    working = read_working(run.layout)
    if working.training_source == "detections":
        return f"external detections, digest {run.record.inputs.detections}"
    how = {
        "labels": f"trained on {working.labels} labelled cars (digest of the labels {run.record.inputs.labels})",
        "file": f"given as a file, digest {run.record.inputs.detector}",
        "shipped": "the shipped one",
    }[working.training_source]
    return f"detector.json, digest {_output(run, 'detector', 'detector.json')}, {how}"


def describe_base_image(run: Run) -> str:
    """The base image in one line: its source, and the error of the registration to it."""
    grid = run.grid
    name = (run.layout.base_image_tif if run.layout.base_image_tif.exists() else run.layout.base_image).name
    digest = _output(run, "base", f"base/{name}")
    source = {
        "flight": "built from the flight",
        "given": f"given, digest {run.record.inputs.base}",
        "tracks": "drawn from the tracks",
    }[grid.base_source]
    line = f"base/{name}, digest {digest}, {grid.width_px} x {grid.height_px} px, {source}"
    if grid.intersensor_error_px is not None:
        line += f"; registered to {grid.intersensor_error_px:.2f} px"
    if run.layout.rebased.exists():
        line += f"; {RebaseRecord.model_validate_json(run.layout.rebased.read_bytes()).text()}"
    return line


def _output(run: Run, stage: str, name: str) -> str:
    records: list[CommitRecord] = read_commits(run.layout, stage)
    return next((record.outputs[name] for record in records if name in record.outputs), "not recorded")


def describe_lineage(run: Run) -> str:
    """The run's stages and keys, as text."""
    source = run.record.inputs.source
    lines = [f"source        {source.path}, digest {source.digest}, {source.frame_count} frames"]
    lines += [
        f"{s.name:<14}{s.key}  units {s.units}, files {s.outputs}, velfield {', '.join(s.code_versions)}"
        for s in stage_lineage(run)
    ]
    return "\n".join([*lines, f"base image    {describe_base_image(run)}", f"detector      {describe_detector(run)}"])


def describe_pixel(run: Run, pixel: PixelLineage) -> str:
    """A pixel's lineage, as text."""
    vehicles, tracklets = len(pixel.tracks), sum(len(p.tracklets) for p in pixel.tracks)
    counts = ", ".join([count_text(vehicles, "vehicle track"), count_text(tracklets, "tracklet")])
    frames = count_text(len(pixel.frames), "frame")
    lines = [f"pixel ({pixel.x}, {pixel.y}): {counts} in {frames} of {run.record.inputs.source.path}"]
    for track in pixel.tracks:
        lines.append(f"track {track.track_id}: tracklets {', '.join(map(str, track.tracklets))}")
        lines.append(f"  in frames {', '.join(map(str, track.frames))}")
    if pixel.frames:
        lines.append("frame  source frame  time        hold-out error")
        lines += [
            f"{f.frame:>5}  {f.source_index:>12}  {f.time_s:>8.3f} s  {f.heldout_px:.2f} px" for f in pixel.frames
        ]
    return "\n".join([*lines, f"base image    {describe_base_image(run)}", f"detector      {describe_detector(run)}"])
