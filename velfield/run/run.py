"""`open_run`: one object over a run folder, the Python side of the contract of outputs."""

from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from schemas.arrays import FloatArray, GreyImage, IntArray, Mask, Points
from schemas.georeference import FlightStart
from schemas.records import FlightRecord, GridRecord
from schemas.tables import (
    DETECTION_COLUMNS,
    DIMENSION_COLUMNS,
    JOIN_COLUMNS,
    POSITION_SOURCES,
    TRACK_COLUMNS,
    TRACK_POSITION_COLUMNS,
)
from velfield.analysis.crossings import find_crossings, hysteresis_px
from velfield.analysis.trajectories import TrackId, read_ids
from velfield.analysis.vehicle_classes import add_dimensions
from velfield.analysis.vehicles import VEHICLE_COLUMNS, find_vehicles
from velfield.errors import InputError
from velfield.field.segments import SEGMENT_COLUMNS, Segments, require_gsd_m, segment_table
from velfield.field.view import VelocityField
from velfield.registration.warp import warp_to_base
from velfield.run.analysis import RunAnalysis
from velfield.run.commits import POSITION_SD_M, read_commits
from velfield.run.field_reader import IntervalField, open_field_intervals, open_velocity_field, source_runs
from velfield.run.flight_record import read_flight_record
from velfield.run.frame_transforms import FrameTransforms, read_base_image, read_georeference, read_grid
from velfield.run.layout import RunLayout, to_path
from velfield.run.stores import FieldStore, FrameStore, RegistrationStore
from velfield.run.tables import read_tables

_EACH_ONCE = {"shared_segment_weight": 1}
"""The preset `paper` weights segments that two tracklets share twice; counting vehicles does not."""


def open_run(root: str | Path) -> "Run":
    """Open a run folder for reading.

    Raises
    ------
    InputError
        The folder is not a run folder, or one of another format.
    """
    record = read_flight_record(to_path(root))
    return Run(RunLayout(to_path(root)), record)


class Run:
    """A run folder, read lazily: opening one reads no images and no tables.

    Frames are numbered as in ``frames.zarr``; points are (x, y), pixel (0, 0) being the centre of the top-left pixel.
    """

    def __init__(self, layout: RunLayout, record: FlightRecord) -> None:
        self.layout = layout
        self.record = record

    def __repr__(self) -> str:
        content = f"field of {', '.join(self.made_from)}" if self.made_from else f"{self.frames.count} frames"
        return f"Run({str(self.layout.root)!r}, {content})"

    @cached_property
    def made_from(self) -> tuple[str, ...]:
        """The runs of whose fields `velfield merge` or `subtract` made this folder; empty of a run with frames."""
        return source_runs(self.layout)

    def require_frames(self) -> None:
        """Refuse a folder that `velfield merge` or `subtract` made: it has a field and a base image, nothing else.

        Raises
        ------
        InputError
            It is one; the message names the runs to ask.
        """
        if self.made_from:
            raise InputError(
                f"{self.layout.root}: this field was computed from {' and '.join(self.made_from)} and has no frames "
                "or tracks; give one of these runs"
            )

    @cached_property
    def frames(self) -> FrameStore:
        """The frames: ``run.frames.read(frame)`` is (h, w) uint8."""
        self.require_frames()
        return FrameStore(self.layout.frames)

    @cached_property
    def registration(self) -> RegistrationStore:
        """Per-frame results of registration."""
        self.require_frames()
        return RegistrationStore(self.layout.registration)

    @cached_property
    def grid(self) -> GridRecord:
        """The grid of base pixels."""
        return read_grid(self.layout)

    @cached_property
    def frame_transforms(self) -> FrameTransforms:
        """Raw pixels <-> base pixels of each frame."""
        return FrameTransforms.open(self.layout, self.record.config)

    def rectified_frame(self, frame: int, *, scale: float = 1.0) -> tuple[GreyImage, Mask] | None:
        """A frame on the grid of the base image, ``scale`` px a base pixel: image (h, w) uint8 and where the frame
        covers it; None where it is not registered."""
        transform = self.frame_transforms.transform(frame)
        if transform is None:
            return None
        window = (0, 0, self.grid.width_px, self.grid.height_px)
        return warp_to_base(self.frames.read(frame), transform, window=window, scale=scale)

    @property
    def has_frames(self) -> bool:
        """Whether it was made of frames; False of tracks of another program, and of merged fields."""
        return not self.record.inputs.source.of_tracks and self.layout.frames.exists()

    @property
    def times_s(self) -> FloatArray:
        """(frames,) true times, s."""
        return self.frames.column("time_s")

    @property
    def registration_status(self) -> list[str]:
        """(frames,) ``ok``, ``failed:<reason>`` or ``skipped:<reason>``."""
        return self.registration.statuses()

    def to_base(self, frame: int, xy_raw: Points) -> Points:
        """Raw pixels of a frame -> base pixels, (n, 2) -> (n, 2).

        NaN rows where the frame is not registered, or no control points support the map (`position_sd_px`).

        Raises
        ------
        ValueError
            The points are not (n, 2).
        """
        xy = self._transform_points("to_base", frame, xy_raw)
        xy[np.isnan(self.position_sd_px(frame, xy_raw))] = np.nan
        return xy

    def to_raw(self, frame: int, xy_base: Points) -> Points:
        """Base pixels -> raw pixels of a frame, (n, 2) -> (n, 2).

        NaN rows where there is no such pixel, or no control points support the map (`position_sd_px`).

        Raises
        ------
        ValueError
            The points are not (n, 2).
        """
        xy = self._transform_points("to_raw", frame, xy_base)
        xy[np.isnan(self.position_sd_px(frame, xy))] = np.nan
        return xy

    @property
    def start(self) -> FlightStart | None:
        """When the first frame was taken, by subtitles, EXIF or the container's header; None where none has it."""
        record = read_georeference(self.layout)
        return None if record is None else record.start

    @property
    def gsd_m(self) -> float:
        """The ground sample distance, metres a base pixel.

        Raises
        ------
        InputError
            It is not known: then so are no metres and no km/h of this run.
        """
        return require_gsd_m(self.grid.gsd_m)

    def to_metres(self, xy_base: Points) -> Points:
        """Base pixels -> metres to the right of and below the top-left pixel's centre, (n, 2) -> (n, 2).

        Raises
        ------
        InputError
            The ground sample distance is not known.
        """
        return _points(xy_base) * self.gsd_m

    def position_sd_px(self, frame: int, xy_raw: Points) -> FloatArray:
        """Standard deviation of the base position of a frame's raw pixels, (n, 2) -> (n,) base px.

        NaN where the frame is not registered, and where no control points support its map: nothing is detected there.
        """
        return self.frame_transforms.position_sd_px(frame, _points(xy_raw))

    def _transform_points(self, direction: str, frame: int, xy: Points) -> Points:
        points = _points(xy)
        transform = self.frame_transforms.transform(frame)
        if transform is None:
            return np.full_like(points, np.nan)
        transformed: Points = getattr(transform, direction)(points)
        return transformed

    def detections(self, *, doubtful: bool = False) -> pd.DataFrame:
        """Detections, in base pixels: the columns of ``schemas.tables.DETECTION_COLUMNS``.

        Candidates below the score threshold are among them where a track confirms them.

        Parameters
        ----------
        doubtful
            With those of doubtful tracks (`vehicles`), and those of a low score that no track confirms.
        """
        found = self._all_detections(list(DETECTION_COLUMNS))
        if doubtful:
            return found
        apart = found["detection_id"].isin(self._detections_in(self.layout.doubtful_positions))
        return found[~apart].reset_index(drop=True)

    def _all_detections(self, names: list[str]) -> pd.DataFrame:
        self.require_frames()
        sure, weak = (
            read_tables(self.layout.unit_files(folder), DETECTION_COLUMNS, only=names)
            for folder in (self.layout.detections, self.layout.weak_detections)
        )
        seen = [self._detections_in(at) for at in (self.layout.track_positions, self.layout.doubtful_positions)]
        confirmed = weak[weak["detection_id"].isin(np.concatenate(seen))]
        return pd.concat([sure, confirmed]).sort_values("detection_id", ignore_index=True) if len(confirmed) else sure

    def _detections_in(self, positions: Path) -> IntArray:
        """Ids of the detections in a folder of positions."""
        table = read_tables(self.layout.unit_files(positions), TRACK_POSITION_COLUMNS, only=["detection_id"])
        return table["detection_id"].to_numpy(np.int64)

    def tracklets(self) -> pd.DataFrame:
        """All tracklets, in base pixels: the columns of ``schemas.tables.TRACK_COLUMNS``."""
        return self._tracklets_of(self.layout.tracks, TRACK_COLUMNS)

    def _tracklets_of(self, folder: Path, names: Iterable[str]) -> pd.DataFrame:
        """Some columns of the tracklets in a folder: all of them are much, of a long flight."""
        self.require_frames()
        return read_tables(self.layout.unit_files(folder), TRACK_COLUMNS, only=list(names))

    def vehicles(self, *, doubtful: bool = False) -> pd.DataFrame:
        """One row a track, by ``track_id``: when and where, its length, width and class, and whether it moves, waits in
        a lane or is parked: `find_vehicles`, `add_dimensions`.

        Parameters
        ----------
        doubtful
            With the rows of doubtful tracks, whose ``doubtful`` is true: things that stand far from vehicles, with a
            low score (`velfield.tracking.doubtful`).
        """
        gsd_m, layout = self.grid.gsd_m, self.layout
        folders = [layout.tracks, layout.doubtful] if doubtful else [layout.tracks]
        parts = [self._tracklets_of(folder, VEHICLE_COLUMNS) for folder in folders]
        seen = self._all_detections(["detection_id", "orientation_rad", "score"])
        vehicles = find_vehicles(pd.concat(parts, ignore_index=True), seen, gsd_m=gsd_m)
        vehicles = vehicles.assign(doubtful=~vehicles["track_id"].isin(parts[0]["track_id"]))
        return add_dimensions(vehicles, self._dimensions(), gsd_m)

    def _dimensions(self) -> pd.DataFrame:
        path = self.layout.dimensions
        return read_tables([path] if path.exists() else [], DIMENSION_COLUMNS)

    def track_positions(self) -> pd.DataFrame:
        """Where each track's vehicle was in each registered frame: ``schemas.tables.TRACK_POSITION_COLUMNS``.

        ``source`` distinguishes what is seen from what is inferred, by name (``POSITION_SOURCES``).
        """
        self.require_frames()
        table = read_tables(self.layout.unit_files(self.layout.track_positions), TRACK_POSITION_COLUMNS)
        return table.assign(source=pd.Categorical.from_codes(table["source"], pd.Index(POSITION_SOURCES)))

    @cached_property
    def source_ids(self) -> Mapping[int, TrackId] | None:
        """Ids of the tracks in the file that they were given in, by ``track_id``; None of a run with frames."""
        path = self.layout.source_ids
        if not path.exists():
            return None
        table = pd.read_csv(path, dtype={"track_id": np.int64, "source_id": str}, keep_default_na=False)
        return read_ids(table["track_id"].to_numpy(np.int64), table["source_id"].tolist())

    def with_source_ids(self, table: pd.DataFrame) -> pd.DataFrame:
        """A table with the `source_ids` as its ``track_id``, where there are such."""
        ids = self.source_ids
        return table if ids is None else table.assign(track_id=table["track_id"].map(ids))

    def joins(self) -> pd.DataFrame:
        """Joins of tracks over gaps, each with the probability that it is right: ``schemas.tables.JOIN_COLUMNS``."""
        return read_tables([self.layout.joins] if self.layout.joins.exists() else [], JOIN_COLUMNS)

    def segments(self) -> Segments:
        """Vehicles from one frame to the next, each once: by track and time (`velfield.field.segments`)."""
        config = self.record.config.field.model_copy(update=_EACH_ONCE)
        # The tracklets are unnamed, so that they are soon free.
        return segment_table(self._tracklets_of(self.layout.tracks, SEGMENT_COLUMNS), config)

    def crossings(self, start_xy: tuple[float, float], end_xy: tuple[float, float]) -> pd.DataFrame:
        """Crossings of the line between two base pixels by vehicles: `find_crossings`."""
        return find_crossings(self.segments(), start_xy, end_xy, hysteresis_px=hysteresis_px(self.grid.gsd_m))

    @cached_property
    def field(self) -> VelocityField:
        """The velocity field."""
        return open_velocity_field(self.layout)

    @cached_property
    def field_time_weighted(self) -> VelocityField:
        """The velocity field weighted by time: a vehicle counts for as long as it stays."""
        return open_velocity_field(self.layout, time_weighted=True)

    @cached_property
    def field_intervals(self) -> dict[str, IntervalField]:
        """Fields of time intervals by name, in their order; empty where none were configured (``--intervals``)."""
        return {found.name: found for found in open_field_intervals(self.layout)}

    @cached_property
    def analysis(self) -> RunAnalysis:
        """Traffic answers, carriageways and bottlenecks: ``run.analysis.traffic.signals``."""

        def layer(name: str) -> NDArray[np.generic]:
            return FieldStore(self.layout.field).layer(name)

        position_sd_m = max(
            (c.counts.get(POSITION_SD_M, 0.0) for c in read_commits(self.layout, "tracks")), default=0.0
        )
        return RunAnalysis(
            layer,
            self.tracklets,
            self.grid,
            self.record.config.field,
            self._dimensions,
            self.vehicles,
            position_sd_m,
            self._registered_s if self.has_frames else None,
            self.source_ids,
        )

    def _registered_s(self) -> FloatArray:
        """(n,) times of the frames that are registered, s: of others nothing is seen on the map."""
        ok = np.array([status == "ok" for status in self.registration_status], np.bool_)
        return np.asarray(self.times_s[ok])

    @cached_property
    def base_image(self) -> GreyImage:
        """The base image, (y, x) grey uint8."""
        return read_base_image(self.layout, self.record.config.frames)


def _points(xy: Points) -> Points:
    """Points as (n, 2); a single one may be (2,). ValueError: they have another shape."""
    points = np.asarray(xy, np.float64)
    if points.size and points.shape[-1] != 2:
        raise ValueError(f"found points of shape {points.shape}, expected (n, 2): x and y of each")
    return points.reshape(-1, 2)
