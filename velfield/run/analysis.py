"""`Run.analysis`: the analyses of `velfield.analysis` on the stored layers and tracks of a run, lengths in metres."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from schemas.flight import FieldConfig, assumed_gsd_m
from schemas.records import GridRecord
from velfield.analysis.bottlenecks import find_bottlenecks
from velfield.analysis.carriageways import find_carriageways
from velfield.analysis.lanes.find import MIN_TRACKS, find_lanes
from velfield.analysis.lanes.model import LaneGraph
from velfield.analysis.movements.gates import ArmNames
from velfield.analysis.regions import Regions
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.trajectories import TrackId, Trajectories, from_tracklets, moving
from velfield.analysis.vehicle_classes import VehicleClasses, find_classes
from velfield.field.segments import stationary_speed_px_per_s
from velfield.field.statistics import direction_rad
from velfield.run.frame_transforms import heading_deg, north_direction_rad

_GAP_S = 5.0
"""Longer from one frame to the next, and what passed between is not known."""


@dataclass(frozen=True)
class RunAnalysis:
    """Traffic analyses of one run.

    Positions and areas in the results are base pixels, speeds px/s (times ``grid.gsd_m``: m/s). Without a ground sample
    distance the metres of the parameters are converted by the paper's.

    Attributes
    ----------
    layer
        Returns a (y, x) layer of ``field.zarr`` by its name.
    tracklets
        Returns the tracklets of the run, with their tracks.
    grid, config
        Base pixels and configuration of the field.
    dimensions
        Returns the dimensions of the vehicles (`schemas.tables.DIMENSION_COLUMNS`).
    vehicles
        Returns the vehicles (`velfield.run.run.Run.vehicles`), of which some are parked.
    position_sd_m
        Standard deviation of a position along one axis, of tracks of another program.
    frame_times
        Returns the times (n,) of the registered frames, s; None: not known.
    source_ids
        Ids of the tracks in the user's file, by ``track_id``; None: they have no others.
    """

    layer: Callable[[str], NDArray[np.generic]]
    tracklets: Callable[[], pd.DataFrame]
    grid: GridRecord
    config: FieldConfig
    dimensions: Callable[[], pd.DataFrame]
    vehicles: Callable[[], pd.DataFrame]
    position_sd_m: float
    frame_times: Callable[[], FloatArray] | None
    source_ids: Mapping[int, TrackId] | None = None

    @cached_property
    def trajectories(self) -> Trajectories:
        """Tracks of vehicles that move, in metres."""
        made = from_tracklets(self.tracklets(), self.gsd_m)
        known = self._with_frames(replace(made, position_sd_m=self.position_sd_m, source_id=self.source_ids))
        return moving(known).with_lengths(self.dimensions())

    @cached_property
    def traffic(self) -> TrafficAnalysis:
        """Answers about lanes, movements, speeds, signals, flow and conflicts: what `velfield analyse` writes."""
        known = self.vehicles()
        columns = known.loc[known["state"] == "parked", ["x_px", "y_px", "orientation_rad"]]
        parked = columns.to_numpy(np.float64) * [self.gsd_m, self.gsd_m, 1.0]
        names = ArmNames(north_direction_rad(self.grid))
        return TrafficAnalysis(self.trajectories, parked=parked, classes=self._classes, arm_names=names)

    def _with_frames(self, tracks: Trajectories) -> Trajectories:
        """Tracks with the times that are seen: a road may be empty when the first frame is taken, and the last."""
        times = np.empty(0) if self.frame_times is None else self.frame_times()
        if not len(times):
            return replace(tracks, seen_s=tracks.window_s)  # of those that stand too
        before = np.flatnonzero(np.diff(times) > _GAP_S)
        gaps_s = np.column_stack([times[before], times[before + 1]])
        return replace(tracks, gaps_s=gaps_s, seen_s=(float(times[0]), float(times[-1])))

    @property
    def _classes(self) -> VehicleClasses | None:
        """Classes of the vehicles that move; None where the ground sample distance is not known."""
        if self.grid.gsd_m is None:
            return None
        table = self.dimensions().set_index("track_id").reindex(self.trajectories.track_id) * self.grid.gsd_m
        size, sd = (table[[f"length{k}_px", f"width{k}_px"]].to_numpy(np.float64) for k in ("", "_sd"))
        return find_classes(size, sd)

    def lanes(self, *, min_tracks: int = MIN_TRACKS) -> LaneGraph:
        """Lanes, their connections and junctions: `find_lanes`.

        Parameters
        ----------
        min_tracks
            Fewest tracks of a lane and of a connection.
        """
        return self.traffic.lanes if min_tracks == MIN_TRACKS else find_lanes(self.trajectories, min_tracks=min_tracks)

    def carriageways(self, *, min_count: int = 3, min_area_m2: float = 10.0) -> Regions:
        """Connected pixels of one direction of travel: `find_carriageways`.

        The table has ``speed_p50_px_per_s, speed_p85_px_per_s`` and ``heading_deg``, clockwise from north (from the
        image's top where north is unknown).

        Parameters
        ----------
        min_count
            Fewest tracks of a pixel.
        min_area_m2
            Smaller regions are dropped.
        """
        speeds = {name: self._float_layer(f"speed_{name}") for name in ("p50", "p85")}
        area = self._area_px(min_area_m2)
        found = find_carriageways(
            self._direction_rad, self._count, speeds_px_per_s=speeds, min_count=min_count, min_area_px=area
        )
        direction = found.table["direction_rad"].to_numpy(np.float64)
        return Regions(
            found.labels, found.table.assign(heading_deg=heading_deg(direction, north_direction_rad(self.grid)))
        )

    def bottlenecks(
        self, *, distance_m: float = 40.0, max_ratio: float = 0.6, min_count: int = 5, min_area_m2: float = 1.5
    ) -> Regions:
        """Regions where the median speed is much lower than upstream on the same carriageway: `find_bottlenecks`.

        Parameters
        ----------
        distance_m
            Distance upstream at which the speed is compared.
        max_ratio
            Largest ratio of the speed to that upstream.
        min_count
            Fewest tracks of a pixel.
        min_area_m2
            Smaller regions are dropped.
        """
        return find_bottlenecks(
            self._float_layer("speed_p50"),
            self._direction_rad,
            self._count,
            distance_px=distance_m / self.gsd_m,
            max_ratio=max_ratio,
            min_count=min_count,
            min_area_px=self._area_px(min_area_m2),
        )

    @cached_property
    def _direction_rad(self) -> FloatArray:
        velocity = np.stack([self._float_layer("modal_vx"), self._float_layer("modal_vy")], axis=-1)
        limit = stationary_speed_px_per_s(self.config, self.grid.gsd_m)
        return direction_rad(velocity, stationary_speed_px_per_s=limit)

    @cached_property
    def _count(self) -> NDArray[np.int32]:
        return np.asarray(self.layer("count"), np.int32)

    @property
    def gsd_m(self) -> float:
        """Metres a base pixel; the paper's where it is unknown."""
        return assumed_gsd_m(self.grid.gsd_m)

    def _area_px(self, area_m2: float) -> int:
        return max(1, round(area_m2 / self.gsd_m**2))

    def _float_layer(self, name: str) -> FloatArray:
        return np.asarray(self.layer(name), np.float64)
