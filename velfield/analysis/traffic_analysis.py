"""`TrafficAnalysis`: every question about the tracks of one flight, each answer computed once."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from schemas.analysis import JunctionKind
from schemas.arrays import FloatArray, IntArray
from velfield.analysis.flow.conflicts import Conflict, find_conflicts
from velfield.analysis.flow.passings import LaneTraffic
from velfield.analysis.flow.speeds import (
    FreeFlow,
    PathArrays,
    Reduction,
    Station,
    free_flow,
    speed_profile,
    speed_reduction,
)
from velfield.analysis.flow.volume import LaneFlow, lane_flow
from velfield.analysis.intervals import Estimate
from velfield.analysis.lanes.find import find_lanes
from velfield.analysis.lanes.junctions import inside_hull
from velfield.analysis.lanes.model import LaneGraph
from velfield.analysis.movements.car_parks import CarPark, find_car_parks
from velfield.analysis.movements.cut_tracks import CutTracks, join_cut_tracks
from velfield.analysis.movements.gates import ArmNames
from velfield.analysis.movements.movements import JunctionMovements, find_movements
from velfield.analysis.movements.reversals import Reversal, find_circle_reversals, find_reversals, seen_whole_s
from velfield.analysis.movements.scene import OriginDestination, find_origins_destinations
from velfield.analysis.movements.time_slices import (
    SLICE_S,
    SliceCount,
    movements_by_slice,
    origins_by_slice,
    slice_edges,
)
from velfield.analysis.signals.cycles import JunctionSignal, Queue, find_signal
from velfield.analysis.signals.longest_queue import longest_queues
from velfield.analysis.signals.queues import Stops, Stream, find_approaches, find_stops, observe_stream
from velfield.analysis.trajectories import PathSamples, Trajectories, sample_paths
from velfield.analysis.unusual import DoubtfulPlace, Unusual, find_doubtful_places, find_unusual
from velfield.analysis.vehicle_classes import HEAVY, VehicleClasses

_THREADS = 2
"""Each needs memory of its own: of 100,000 tracks some GiB."""


@dataclass(frozen=True)
class TrafficAnalysis:
    """Answers from trajectories of vehicles that move; lengths in metres, times in seconds.

    Examples
    --------
    >>> from velfield.analysis.trajectories import make_trajectories
    >>> none = np.empty(0)
    >>> tracks = make_trajectories(none.astype(int), none.astype(int), none, none.reshape(0, 2), gsd_m=0.2)
    >>> TrafficAnalysis(tracks).signals
    {}
    """

    trajectories: Trajectories
    slice_s: float = SLICE_S
    """Counts by time are of slices so long."""
    parked: FloatArray | None = None
    """(n, 3) position, m, and axial orientation, rad, of parked vehicles; None: not known."""
    classes: VehicleClasses | None = None
    """Class of the vehicle of each trajectory; None: unknown."""
    arm_names: ArmNames = field(default_factory=ArmNames)
    """How the arms of junctions and of the scene are named."""

    @cached_property
    def samples(self) -> PathSamples:
        """Points along the tracks, 1 m apart."""
        return sample_paths(self.trajectories)

    def answer_all(self) -> None:
        """Compute the answers that take long beside each other: each is there when it is asked for."""
        shared = self.lane_traffic, self.cut_tracks  # what several of them read
        if len(shared[0].graph):
            shared[0].samples(0)
        groups = (
            ("movements", "reductions", "unusual", "scene"), ("conflicts",), ("free_flow",), ("streams", "signals"),
            ("flows",), ("_road_reversals", "doubtful_places"), ("car_parks",),
        )  # fmt: skip
        with ThreadPoolExecutor(_THREADS) as pool:
            list(pool.map(lambda names: [getattr(self, name) for name in names], groups))

    @property
    def window_s(self) -> tuple[float, float]:
        """First and last time of all tracks."""
        return self.trajectories.window_s

    @cached_property
    def lanes(self) -> LaneGraph:
        """The lane graph."""
        return find_lanes(self.trajectories, samples=self.samples)

    @cached_property
    def lane_traffic(self) -> LaneTraffic:
        """The samples by lane."""
        return LaneTraffic(self.lanes)

    @cached_property
    def movements(self) -> tuple[JunctionMovements, ...]:
        """Movements through each junction."""
        return find_movements(self.trajectories, self.lanes, cut_tracks=self.cut_tracks, names=self.arm_names)

    @cached_property
    def cut_tracks(self) -> CutTracks:
        """The tracks joined into vehicles."""
        return join_cut_tracks(self.trajectories)

    @cached_property
    def scene(self) -> OriginDestination | None:
        """Origins and destinations of the whole scene; None where no road enters it and leaves it."""
        return find_origins_destinations(self.trajectories, self.samples, self.lanes, self.cut_tracks, self.arm_names)

    @cached_property
    def car_parks(self) -> list[CarPark]:
        """Areas with parked vehicles, and the traffic through them; none where parked vehicles are not known."""
        if self.parked is None or not len(self.samples):
            return []
        return find_car_parks(self.parked[:, :2], self.parked[:, 2], self.samples, self.trajectories.duration_s)

    @cached_property
    def slice_edges_s(self) -> FloatArray:
        """Borders of the slices of time; none where the flight is no longer than two of them."""
        return slice_edges(*self.window_s, self.slice_s)

    @property
    def _slices(self) -> tuple[FloatArray, FloatArray]:
        """Their borders, and how long each is seen, s."""
        edges = self.slice_edges_s
        return edges, self.trajectories.observed_within(edges) if len(edges) else edges

    @cached_property
    def counts_by_time(self) -> list[SliceCount]:
        """Movements through each junction by slice of time."""
        return movements_by_slice(self.movements, *self._slices)

    @cached_property
    def scene_by_time(self) -> list[SliceCount]:
        """Vehicles from origins to destinations by slice of time."""
        return origins_by_slice(self.scene, *self._slices)

    @cached_property
    def reversals(self) -> list[Reversal]:
        """U-turns, by time."""
        at_circles = find_circle_reversals(self.movements, self.cut_tracks)
        return sorted([*self._road_reversals, *at_circles], key=lambda turn: turn.time_s)

    @cached_property
    def _road_reversals(self) -> list[Reversal]:
        return find_reversals(self.samples, self.lanes, position_sd_m=self.trajectories.position_sd_m)

    @cached_property
    def reversals_seen_s(self) -> float:
        """Time in which a U-turn may begin that is seen whole."""
        return seen_whole_s(self.reversals, self.trajectories.observed_s)

    @cached_property
    def stops(self) -> Stops:
        """Stops of vehicles, parked ones left out."""
        return find_stops(self.trajectories)

    @cached_property
    def streams(self) -> dict[int, list[Stream]]:
        """Stops and crossings of the approaches of each junction, by its number."""
        return {
            junction.number: [
                observe_stream(a, self.samples, self.stops, self.trajectories.length_m)
                for a in find_approaches(self.lanes, junction)
            ]
            for junction in self.lanes.junctions
        }

    @cached_property
    def signals(self) -> dict[int, JunctionSignal]:
        """The signal of each junction at which lanes cross, or of a roundabout, by its number.

        Where lanes only merge, vehicles stop in the rhythm of the signals around.
        """
        return {
            number: find_signal(number, streams, self.trajectories.observed_s, roundabout=kind == "roundabout")
            for number, streams in self.streams.items()
            if (kind := self.lanes.junctions[number].kind) in ("intersection", "roundabout", "crossing")
        }

    def is_signalised(self, junction: int) -> bool | None:
        """Whether a junction has a signal; None where that is not known."""
        signal = self.signals.get(junction)
        return signal.signalised if signal else False

    @cached_property
    def lane_queues(self) -> dict[int, Mapping[int, Queue | None]]:
        """The longest queue of each lane with vehicles that stand before a junction whose signal is known, by the
        junction's number and the lane's; None: not known."""
        return {
            number: longest_queues(self.streams[number], signal.streams)
            for number, signal in self.signals.items()
            if signal.signalised
        }

    def delay_is_partial(self, junction: int, arm: str) -> bool:
        """Whether vehicles that enter a junction by an arm wait out of view, too, or in a queue that is not known."""
        arm_of = self.movements[junction].gates.arms_in
        queues = self.lane_queues.get(junction, {}).items()
        return any(queue is None or queue.reaches_edge for lane, queue in queues if arm_of.get(lane) == arm)

    def junction_kind(self, junction: int) -> JunctionKind:
        """Kind of a junction: a crossing is an intersection where a signal, or how vehicles pass, shows one level."""
        found = self.lanes.junctions[junction]
        if found.kind != "crossing":
            return found.kind
        level = [c.xy_m for c in self.conflicts if c.kind == "crossing" and c.on_one_level]
        on_one = self.is_signalised(junction) or bool(inside_hull(np.array(level).reshape(-1, 2), found.hull_m).any())
        return "intersection" if on_one else "crossing"

    def ways_meet(self, junction: int) -> bool:
        """Whether vehicles choose their way at a junction, and wait for each other: not where lanes merge or part, or
        perhaps cross on two levels."""
        return self.junction_kind(junction) in ("intersection", "roundabout")

    def profile(self, lane: int) -> list[Station]:
        """Speeds along a lane."""
        return speed_profile(self.lane_traffic, lane)

    @cached_property
    def free_flow(self) -> list[FreeFlow]:
        """Free flow of each road."""
        return free_flow(self.lane_traffic, position_sd_m=self.trajectories.position_sd_m)

    @cached_property
    def reductions(self) -> list[Reduction]:
        """Speed reduction by each junction of the vehicles that enter it by each lane without stopping."""
        first = np.searchsorted(self.samples.track, np.arange(len(self.trajectories) + 1))
        arrays = PathArrays(first, self.samples.time_s, self.samples.speed_m_per_s)
        out = []
        for found in self.movements:
            lane = np.array([gate.lane for gate in found.gates.gates] + [-1])[found.passes.gate_in]
            for number in np.unique(lane[lane >= 0]):
                rows = lane == number
                passes = found.passes
                out.append(
                    speed_reduction(arrays, found.junction, int(number), passes.track[rows], passes.entry_s[rows])
                )
        return out

    @cached_property
    def flows(self) -> list[LaneFlow]:
        """Traffic of each lane."""
        lengths, observed = self.trajectories.length_m, self.trajectories.observed_s
        return [lane_flow(self.lane_traffic, lane.number, observed, lengths_m=lengths) for lane in self.lanes]

    @cached_property
    def conflicts(self) -> list[Conflict]:
        """Pairs of vehicles near in time."""
        if not len(self.lanes):
            return []
        signalised = [self.lanes.junctions[k].hull_m for k in self.signals if self.is_signalised(k)]
        return find_conflicts(
            self.trajectories, self.lane_traffic, vehicle=self.cut_tracks.vehicle, signalised_m=signalised
        )

    def heavy_share(self, tracks: IntArray) -> Estimate | None:
        """Share of lorries and buses among the vehicles of some tracks; None where it is not known."""
        return self.classes.estimate_shares(tracks)[HEAVY] if self.classes else None

    @cached_property
    def unusual(self) -> list[Unusual]:
        """Unusual tracks."""
        return find_unusual(self.trajectories, self.lanes, self.movements, samples=self.samples)

    @cached_property
    def doubtful_places(self) -> list[DoubtfulPlace]:
        """Places where tracks are unlikely to be vehicles."""
        return find_doubtful_places(self.trajectories)
