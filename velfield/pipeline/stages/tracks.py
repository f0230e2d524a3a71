"""Tracks of the whole flight: tracklets that share detections, chained, gaps closed; and the vehicles' dimensions."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from threading import Lock

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray, IntArray, Mask
from schemas.flight import assumed_gsd_m
from schemas.tables import DETECTION_COLUMNS, DIMENSION_COLUMNS, JOIN_COLUMNS, TRACK_POSITION_COLUMNS, TRACKLET_COLUMNS
from velfield.detection.registry import load_detector
from velfield.parallel import parallel_map, usable_processors
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import StageResult, advance
from velfield.pipeline.stages.registration import spread_usable_frames, usable_frames
from velfield.pipeline.stages.tracklets import (
    UnitDetections,
    among,
    explain_no_tracklets,
    has_lost_detections,
    linkable_frames,
    read_chosen,
    tables_of_units,
    tracklet_files,
)
from velfield.run.frame_transforms import FrameTransforms, read_tracking_gsd
from velfield.run.layout import RunLayout
from velfield.run.stores import FrameStore
from velfield.run.tables import empty_table, read_arrays, read_tables, write_table, write_tracks
from velfield.tracking.association import LinkedTriples, tracklet_table, window_frames
from velfield.tracking.dimensions import STRIP_SHAPE, looks, sample_tracks
from velfield.tracking.doubles import find_doubles, find_split_tracks
from velfield.tracking.doubtful import find_doubtful, find_lone
from velfield.tracking.gates import Limits, triples_pass
from velfield.tracking.join_costs import GapLimits, TrackEnds
from velfield.tracking.joins import END_COLUMNS, EndContext, assign_tracks, find_ends
from velfield.tracking.positions import IDS, TrackFrames, Triples, all_positions, find_triples, keep_surest
from velfield.tracking.recovery import Candidates, recover_tracks
from velfield.tracking.strips import (
    StripSums,
    along_headings,
    certain_length,
    mean_grey,
    measure_tracks,
)

_MIDDLE = ["frame_1", "time_1_s", "x_1_px", "y_1_px"]
_BORDER_M, _BORDER_S = 5.0, 0.6
"""A vehicle that would be outside the frame after so many metres and seconds has left it."""
_CONFIDENCE = 0.95
"""Confidence of a tracklet that only its track confirms: at least this fraction was right in simulated flights."""
_HIDDEN_S = 1.5
"""A track that ends so shortly before the last frame, or begins so shortly after the first, did not vanish."""
_NO_SIZES = np.empty((0, 4)), np.empty(0, np.int64)
_VIEWS = 40
"""Frames by which is judged how many show a place."""
_AT_ONCE = 4
"""Threads, each of which holds what is stored of one unit's detections."""


def chain_tracks(plan: Plan) -> StageResult:
    """Give every tracklet the track that it belongs to: reads a few columns of all units, writes unit by unit."""
    sources, layout = tracklet_files(plan), plan.layout
    tracklets = read_tables(sources, TRACKLET_COLUMNS, only=[*IDS, *_MIDDLE, *END_COLUMNS])
    ids, chain = np.unique(assign_tracks(tracklets[IDS].to_numpy(np.int64)), return_inverse=True)
    strips = sum_strips(plan, tracklets.assign(track_id=ids[chain]))
    gsd_m = assumed_gsd_m(read_tracking_gsd(layout))
    starts, ends = find_ends(tracklets, chain, len(ids), gsd_m)
    candidates = read_candidates(plan, tracklets, gsd_m)
    context = find_context(plan, ends, starts, strips)
    found = recover_tracks(ids, ends, starts, _gap_limits(plan), context, candidates)
    flight = TrackFrames(FrameStore(layout.frames).column("time_s"), linkable_frames(plan))
    positions = all_positions(tracklets.assign(track_id=found.tracks[chain]), found, candidates, gsd_m, flight)
    first_frame = np.array(tracklets["frame_0"])
    del tracklets, candidates, context  # what follows needs no more of them, and they are large
    whole = find_split_tracks(positions, gsd_m)
    if len(whole):
        positions = keep_surest(_join_parts(positions, whole))
        found = replace(found, tracks=_rename_parts(found.tracks, whole), joins=_join_parts(found.joins, whole))
    doubles = find_doubles(positions, mean_grey(strips, found.tracks), gsd_m)
    positions = _without(positions, doubles)
    doubtful, sure_scores = np.empty(0, np.int64), None
    if plan.config.tracking.doubt and _has_network(layout):
        seen = positions[positions["source"] < 2]
        scores = mean_scores(plan, seen)
        doubtful = find_doubtful(seen, scores, gsd_m, partial(_count_views, plan, int(flight.usable.sum())))
        sure_scores = scores.drop(doubtful)
        del seen
    apart = positions[positions["track_id"].isin(doubtful)].reset_index(drop=True)
    positions = _without(positions, doubtful)
    dimensions = measure_tracks(strips, found.tracks)
    del strips
    triples = find_triples(positions, flight, plan.config.tracking.max_interval_s)
    track = found.tracks[chain]
    output = _Output(
        plan, first_frame, track, positions, apart, flight, triples, np.unique(triples.ids), doubles, sure_scores
    )
    count = min(usable_processors(), _AT_ONCE, len(plan.units))
    runs = np.array_split(np.arange(len(plan.units)), max(count, 1))
    parts = parallel_map(output.write, [run for run in runs if len(run)])
    written = [path for paths, _, _ in parts for path in paths]
    recovered, lone = sum(number for _, number, _ in parts), sum(number for _, _, number in parts)
    for folder in (layout.tracks, layout.track_positions, layout.doubtful, layout.doubtful_positions):
        for stale in set(layout.unit_files(folder)) - set(written):
            stale.unlink()  # of an earlier plan with more units
    for path, table, columns in (
        (layout.dimensions, dimensions, DIMENSION_COLUMNS),
        (layout.joins, found.joins, JOIN_COLUMNS),
    ):
        write_table(path, _without(table, np.concatenate([doubles, doubtful])), columns)
        written.append(path)
    advance("tracks")
    warnings = [] if len(track) else [explain_no_tracklets(plan)]
    kept = track[~among(track, doubles) & ~among(track, doubtful)]
    counts = {
        "tracklets": float(len(kept) + recovered),
        "recovered": float(recovered),
        "tracks": float(len(np.unique(kept))),
        "doubtful": float(len(doubtful)),
        "lone": float(lone),
    }
    return StageResult(written, counts, warnings=warnings)


def _rename_parts(track_id: IntArray, whole: pd.Series) -> IntArray:
    """The ids of tracks, those of parts by the whole's."""
    named = pd.Series(track_id)
    return named.map(whole).fillna(named).to_numpy(np.int64)


def _join_parts(table: pd.DataFrame, whole: pd.Series) -> pd.DataFrame:
    """A table with parts of tracks under the id of the whole."""
    return table.assign(track_id=_rename_parts(table["track_id"].to_numpy(np.int64), whole))


def _without(table: pd.DataFrame, doubles: IntArray) -> pd.DataFrame:
    return table[~table["track_id"].isin(doubles)].reset_index(drop=True)


def read_candidates(plan: Plan, tracklets: pd.DataFrame, metres: float) -> Candidates:
    """Detections in no tracklet, and weak candidates, of the whole flight."""
    names = ["detection_id", "frame", "time_s", "x_px", "y_px", "orientation_rad"]
    used = np.unique(tracklets[IDS].to_numpy(np.int64))

    def read(path: Path) -> pd.DataFrame:
        table = read_tables([path], DETECTION_COLUMNS, only=names)
        return table[~among(table["detection_id"].to_numpy(np.int64), used)]

    parts = parallel_map(read, _detection_files(plan), at_most=_AT_ONCE)
    table = pd.concat(parts) if parts else empty_table({name: DETECTION_COLUMNS[name] for name in names})
    table = table.sort_values(["frame", "detection_id"], ignore_index=True)
    return Candidates(
        detection_id=table["detection_id"].to_numpy(np.int64),
        frame=table["frame"].to_numpy(np.int64),
        time_s=table["time_s"].to_numpy(np.float64),
        position_m=table[["x_px", "y_px"]].to_numpy(np.float64) * metres,
        axis_rad=table["orientation_rad"].to_numpy(np.float64),
    )


def _has_network(layout: RunLayout) -> bool:
    """Whether the scores are those of the network: `find_doubtful` was set on these."""
    return layout.detector.exists() and load_detector(layout.detector).method == "cnn"


def mean_scores(plan: Plan, seen: pd.DataFrame) -> pd.Series:
    """Mean score of each track's detections, ``track_id, detection_id``, by ``track_id``."""
    seen = seen[["track_id", "detection_id"]].sort_values("detection_id")
    ids, track = seen["detection_id"].to_numpy(np.int64), seen["track_id"].to_numpy(np.int64)

    def read(path: Path) -> pd.DataFrame:
        table = read_tables([path], DETECTION_COLUMNS, only=["detection_id", "score"])
        table = table[among(table["detection_id"].to_numpy(np.int64), ids)]
        of_track = track[np.searchsorted(ids, table["detection_id"].to_numpy(np.int64))]
        return table["score"].astype(np.float64).groupby(of_track).agg(["sum", "size"])

    sums = parallel_map(read, _detection_files(plan), at_most=_AT_ONCE)
    total = pd.concat(sums).groupby(level=0).sum() if sums else pd.DataFrame({"sum": [], "size": []})
    return total["sum"] / total["size"]


def _detection_files(plan: Plan) -> list[Path]:
    """The files of detections and of weak candidates that are there, unit by unit."""
    layout = plan.layout
    folders = layout.detections, layout.weak_detections
    paths = [layout.unit_file(folder, unit) for unit in range(len(plan.units)) for folder in folders]
    return [path for path in paths if path.exists()]


def recovered_tracklets(
    plan: Plan, frames: range, triples: Triples, flight: TrackFrames, units: Mapping[int, UnitDetections]
) -> pd.DataFrame:
    """Tracklets (`TRACKLET_COLUMNS`) of the triples of a unit's frames that pass the gates; ``units``, what is read of
    the units that `_window` needs, with the triples' detections."""
    if not len(triples.frame):
        return empty_table(TRACKLET_COLUMNS)
    config, window = plan.config.tracking, _window(plan, frames, flight)
    found = tables_of_units(plan, window, flight.times_s, flight.usable, units)
    tables = [one for one in found if one.registered]
    index = {one.frame: k for k, one in enumerate(tables)}
    start = np.array([index[frame] for frame in triples.frame])
    limits = Limits.from_config(config, read_tracking_gsd(plan.layout))
    windows = []
    for at in np.unique(start).tolist():
        ids = triples.ids[start == at]
        places = np.stack([np.searchsorted(tables[at + k].detection_id, ids[:, k]) for k in range(3)], axis=1)
        first_of, middle, last = (tables[at + k].states(limits).take(places[:, k]) for k in range(3))
        places = places[triples_pass((first_of, middle, last), limits)]
        nothing = np.full((len(places), 2), np.nan)
        windows.append(LinkedTriples(at, places, nothing, np.full(len(places), _CONFIDENCE)))
    made, _ = tracklet_table(tables, windows, limits, refine=config.refine)
    track = pd.Series(triples.track_id, index=triples.ids[:, 1])
    return made.assign(track_id=track.reindex(made["tracklet_id"]).to_numpy())


def _window(plan: Plan, frames: range, flight: TrackFrames) -> range:
    """Frames that the triples of a unit reach."""
    return window_frames(list(flight.usable), list(flight.times_s), frames, plan.config.tracking.max_interval_s)


@dataclass(frozen=True)
class _Output:
    """Writes the tables of units.

    ``first_frame`` and ``track`` (n,) of the tracklets of all units, by frame; ``positions`` by frame, without
    the tracks that are ``doubles``, those that are ``doubtful`` ``apart``; ``triples``, and the ``ids`` (m,) of their
    detections, ascending; ``sure_scores``, the mean score of the other tracks, if doubt is asked for.
    """

    plan: Plan
    first_frame: IntArray
    track: IntArray
    positions: pd.DataFrame
    apart: pd.DataFrame
    flight: TrackFrames
    triples: Triples
    ids: IntArray
    doubles: IntArray
    sure_scores: pd.Series | None

    @cached_property
    def doubtful(self) -> IntArray:
        """Tracks that are set apart, ascending."""
        return np.unique(self.apart["track_id"].to_numpy(np.int64))

    def write(self, units: IntArray) -> tuple[list[Path], int, int]:
        """The files of consecutive units, how many tracklets in them only tracks confirm, and detections no track.

        Data read from a unit are kept only until the next one is written: units can be long.
        """
        written, recovered, lone = [], 0, 0
        kept: dict[int, UnitDetections] = {}
        for unit in units.tolist():
            kept = {k: one for k, one in kept.items() if k >= unit}
            paths, number = self._write_tracklets(unit, kept)
            written += paths
            recovered += number
            paths, number = self._write_positions(unit)
            written += paths
            lone += number
        return written, recovered, lone

    def _write_tracklets(self, unit: int, kept: dict[int, UnitDetections]) -> tuple[list[Path], int]:
        layout = self.plan.layout
        written, recovered = [], 0
        path = layout.unit_file(layout.tracklets, unit)
        if path.exists():
            table = read_tables([path], TRACKLET_COLUMNS).assign(recovered=False)
            begin = np.searchsorted(self.first_frame, self.plan.units[unit].start)
            table["track_id"] = self.track[begin : begin + len(table)]
            table = _without(table, self.doubles)
            is_doubtful = among(table["track_id"].to_numpy(np.int64), self.doubtful)
            written.append(layout.unit_file(layout.doubtful, unit))
            write_tracks(written[-1], table[is_doubtful].reset_index(drop=True))
            table = table[~is_doubtful]
            more = self._recovered(unit, kept)
            recovered = len(more)
            table = pd.concat([table, more.assign(recovered=True)], ignore_index=True)
            table = table.sort_values(["frame_0", "tracklet_id"], kind="stable", ignore_index=True)
            written.append(layout.tracks / path.name)
            write_tracks(written[-1], table)
        return written, recovered

    def _write_positions(self, unit: int) -> tuple[list[Path], int]:
        layout, frames = self.plan.layout, self.plan.units[unit]
        sure, apart = (
            table[slice(*np.searchsorted(table["frame"].to_numpy(), [frames.start, frames.stop]))]
            for table in (self.positions, self.apart)
        )
        lone = self._lone(unit, pd.concat([sure, apart]))
        written = [layout.unit_file(folder, unit) for folder in (layout.track_positions, layout.doubtful_positions)]
        for path, table in zip(written, (sure, pd.concat([apart, lone])), strict=True):
            write_table(path, table, TRACK_POSITION_COLUMNS)
        return written, len(lone)

    def _lone(self, unit: int, in_tracks: pd.DataFrame) -> pd.DataFrame:
        """Detections of a unit that are doubtful as no track has them, with -1 for one."""
        path = self.plan.layout.unit_file(self.plan.layout.detections, unit)
        if self.sure_scores is None or not path.exists():
            return empty_table(TRACK_POSITION_COLUMNS)
        names = ["detection_id", "frame", "time_s", "x_px", "y_px", "score"]
        detections = read_tables([path], DETECTION_COLUMNS, only=names)
        return find_lone(detections, in_tracks[in_tracks["source"] < 2], self.sure_scores).assign(track_id=-1, source=0)

    def _recovered(self, unit: int, kept: dict[int, UnitDetections]) -> pd.DataFrame:
        plan, frames = self.plan, self.plan.units[unit]
        of_unit = self.triples.frame // plan.unit_frames
        mine = self.triples.take(np.flatnonzero(of_unit == unit))
        if len(mine.frame):
            last = (_window(plan, frames, self.flight).stop - 1) // plan.unit_frames
            for one in range(unit, last + 1):
                if one not in kept and not has_lost_detections(plan, one):
                    kept[one] = read_chosen(plan, one, self.ids)
        return recovered_tracklets(plan, frames, mine, self.flight, kept)


def _gap_limits(plan: Plan) -> GapLimits:
    c = plan.config.tracking
    return GapLimits(c.max_gap_s, c.max_stationary_gap_s, c.max_hidden_gap_s, c.stationary_speed_m_per_s)


def sum_strips(plan: Plan, tracklets: pd.DataFrame) -> StripSums:
    """Read the strips and the sizes that stand for each chain, unit by unit, as all strips together take much space."""
    ids, chosen = sample_tracks(tracklets)
    numbers, chains = chosen["detection_id"].to_numpy(), chosen["track"].to_numpy()
    heading, whys = chosen["heading_rad"].to_numpy(), [chosen[name].to_numpy() for name in ("spread", "start", "end")]
    total, count = np.zeros((3, len(ids), *STRIP_SHAPE), np.float32), np.zeros((3, len(ids)), np.int64)
    lock = Lock()

    def add(path: Path) -> tuple[FloatArray, IntArray]:
        table = read_tables([path], DETECTION_COLUMNS, only=["detection_id", "orientation_rad"])
        patches = read_arrays(path.with_suffix(".patches.npz"), only=["strips", "sizes", "working_scale"])
        here = np.flatnonzero(among(numbers, table["detection_id"].to_numpy()))
        at, chain = np.searchsorted(table["detection_id"].to_numpy(), numbers[here]), chains[here]
        strips = along_headings(patches["strips"][at], table["orientation_rad"].to_numpy(np.float64)[at], heading[here])
        with lock:  # whole numbers and halves: sums are exact, in whatever order
            for which, why in enumerate(whys):
                rows = why[here]
                np.add.at(total[which], chain[rows], strips[rows])
                np.add.at(count[which], chain[rows], 1)
        sizes, spread = patches["sizes"][at].astype(np.float64), whys[0][here]
        sizes[:, :2] /= float(patches["working_scale"])
        spread &= np.isfinite(sizes).all(axis=1)
        return sizes[spread], chain[spread]

    found = parallel_map(add, _detection_files(plan), at_most=_AT_ONCE)
    sizes, chain = (np.concatenate([none, *(part[k] for part in found)]) for k, none in enumerate(_NO_SIZES))
    return StripSums(ids, total, count, sizes, chain)


def find_context(plan: Plan, ends: TrackEnds, starts: TrackEnds, strips: StripSums) -> EndContext:
    """Places where chains end and start, and their appearance there."""
    metres = assumed_gsd_m(read_tracking_gsd(plan.layout))
    maps = FrameTransforms.open(plan.layout, plan.config)
    times_s = FrameStore(plan.layout.frames).column("time_s")[usable_frames(plan)]
    first_s, last_s = (times_s[0], times_s[-1]) if len(times_s) else (0.0, 0.0)
    return EndContext(
        _stays_inside(maps, ends, 1, metres) & (last_s - ends.time_s > _HIDDEN_S),
        _stays_inside(maps, starts, -1, metres) & (starts.time_s - first_s > _HIDDEN_S),
        looks(strips.mean(2)),
        looks(strips.mean(1)),
        certain_length(strips) * metres,
    )


def _count_views(plan: Plan, count: int, xy_px: FloatArray) -> FloatArray:
    """About how many of so many frames show each position (n, 2), base px: by some, spread over the flight."""
    maps, frames = FrameTransforms.open(plan.layout, plan.config), spread_usable_frames(plan, _VIEWS)
    shown = np.zeros(len(xy_px))
    for frame in frames:
        transform = maps.transform(frame)
        assert transform is not None, "a usable frame is registered"
        shown += _is_inside(maps, transform.to_raw(xy_px))
    return shown * count / max(len(frames), 1)


def _is_inside(maps: FrameTransforms, raw: FloatArray) -> Mask:
    """Whether raw positions (..., 2) lie in a frame."""
    return np.asarray(((raw >= 0) & (raw <= [maps.width - 1, maps.height - 1])).all(axis=-1))


def _stays_inside(maps: FrameTransforms, ends: TrackEnds, sign: int, metres: float) -> Mask:
    """Whether vehicles stay inside the frame where they go, or come from, and a little to any side."""
    velocity = sign * ends.velocity_m_per_s
    direction = velocity / np.maximum(ends.speed_m_per_s, 1e-9)[:, None]
    sides = [0.5 * _BORDER_M * np.array(side) for side in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
    ahead = ends.position_m + velocity * _BORDER_S + direction * _BORDER_M
    places = np.stack([ahead, *(ends.position_m + side for side in sides)]) / metres
    inside = np.zeros(len(ends.frame), bool)
    for frame in np.unique(ends.frame):
        rows, transform = np.flatnonzero(ends.frame == frame), maps.transform(int(frame))
        if transform is not None:
            raw = transform.to_raw(places[:, rows].reshape(-1, 2)).reshape(len(places), len(rows), 2)
            inside[rows] = _is_inside(maps, raw).all(axis=0)
    return inside
