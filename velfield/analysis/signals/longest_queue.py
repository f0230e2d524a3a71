"""The longest queue of each lane into a junction, at whatever time it stood: its green need not be known."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from schemas.arrays import FloatArray, IntArray
from velfield.analysis.signals.cycles import Queue, StreamSignal, queues
from velfield.analysis.signals.queues import Stream

_MIN_STOPPED = 2
"""A lane on which fewer stop has no queue."""


def longest_queues(streams: Sequence[Stream], signals: Sequence[StreamSignal]) -> Mapping[int, Queue | None]:
    """The longest queue by lane, of the lanes of a junction on which vehicles stand; None: it is not known.

    Parameters
    ----------
    signals
        Streams whose signal is known: the places where they stop are better known, too.
    """
    known = {one.stream.approach.lane: one for one in signals}
    out: dict[int, Queue | None] = {}
    counted: set[tuple[int, float]] = set()
    for stream in streams:
        lane = stream.approach.lane
        signal = known.get(lane)
        places = [signal.stream] if signal else [one for one in (stream, stream.upstream) if one]
        found = [queue for place in places if (queue := _longest_queue(place))]
        if found:
            longest = max(found, key=lambda queue: queue.vehicles.n)
            beyond = longest.reaches_edge or any(queue.reaches_edge for queue in (signal.queues if signal else ()))
            out[lane] = replace(longest, reaches_edge=beyond)
            counted.update(_stops(stream))
    for stream in streams:  # who stands on a lane that leads to several is in the queue of one of them
        others = {track for track, start in _stops(stream) - counted}
        if stream.approach.lane not in out and len(others) >= _MIN_STOPPED:
            out[stream.approach.lane] = None
    return out


def _stops(stream: Stream) -> set[tuple[int, float]]:
    return set(zip(stream.stop_track.tolist(), stream.stop_start_s.tolist(), strict=True))


def _longest_queue(stream: Stream) -> Queue | None:
    """The queue in which most vehicles were seen to stand at once; None: nobody stood at the stop line."""
    best, least = None, 0.0
    times, standing = _fullest(stream)
    for k in np.argsort(-standing, kind="stable"):
        if standing[k] <= least:
            break  # no queue has more vehicles than stand on the approach
        for queue in queues(stream, times[k : k + 1]):
            if queue.vehicles.n and (best is None or queue.vehicles.n > best.vehicles.n):
                best = queue
            least = max(least, queue.vehicles.low)
    return best and replace(best, vehicles=replace(best.vehicles, low=min(least, best.vehicles.value)))


def _fullest(stream: Stream) -> tuple[FloatArray, IntArray]:
    """Times (n,) between the last stop before one sets off and its start, and how many stand then."""
    starts, ends = np.sort(stream.stop_start_s), np.sort(stream.stop_seen_s)
    begun = np.searchsorted(starts, ends, side="right")
    first = np.diff(begun, prepend=0) > 0
    return (starts[begun[first] - 1] + ends[first]) / 2, (begun - np.arange(len(ends)))[first]
