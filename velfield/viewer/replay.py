"""The tracks as the page replays them: ``view/replay/<k>.bin``, every vehicle's positions of ten seconds each.

Little-endian; n vehicles, m positions, one vehicle's after another's, in the order of time:

    uint32    n, m
    uint32    vehicle (n): its number, as ``track`` in segments.zarr
    uint32    first position (n)
    float32   time (m), s since the flight's first frame
    uint16    x (m), y (m), `position_step` px each, from the corner of the map
    uint8     state (n), of `STATES`; axis (n), axial orientation, 256ths of half a turn
    uint8     gap (m): 1 where nothing was seen of the vehicle until its next position
    uint8     class (n), of `CLASS_NAMES` from 1, 0 where it was not measured; its probability (n), per cent
    uint8     length (n), tenths of a metre, 0 where it is not known

A position before a chunk's start and one after its end belong to it too, so that each chunk shows all its time.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray, IntArray, Mask
from velfield.analysis.vehicle_classes import CLASS_NAMES
from velfield.analysis.vehicles import STATES
from velfield.field.segments import Segments

CHUNK_S = 10.0
_SAME_TIME_S = 1e-6
_STEPS = 65535


def position_step(width_px: int, height_px: int) -> float:
    """Unit of a stored position, px: a twentieth of a pixel in a map of 3000 px."""
    return max(width_px, height_px) / _STEPS


def chunk_count(duration_s: float) -> int:
    """Number of chunks of a flight; one at least."""
    return max(int(duration_s // CHUNK_S) + 1, 1)


@dataclass(frozen=True)
class Paths:
    """Positions of all vehicles, by vehicle and time: (m,) each."""

    vehicle: IntArray
    """Its number."""
    time_s: FloatArray
    x_px: FloatArray
    y_px: FloatArray
    """When and where, base pixels."""
    gap: Mask
    """Whether nothing was seen of it until its next position."""

    def take(self, rows: IntArray | Mask) -> "Paths":
        """Some of the positions."""
        return Paths(self.vehicle[rows], self.time_s[rows], self.x_px[rows], self.y_px[rows], self.gap[rows])


def vehicle_paths(segments: Segments, parked: Mask) -> Paths:
    """The positions of the segments, each once.

    Parameters
    ----------
    segments
        By track and time.
    parked
        (tracks,) bool, by the order of track ids: these stand at the median of their positions.
    """
    number = np.unique(segments["track"], return_inverse=True)[1].astype(np.int64)
    end_s = segments["start_s"] + segments["duration_s"]
    last = np.append(number[1:] != number[:-1], True)[: len(number)]
    broken = np.append(segments["start_s"][1:] - end_s[:-1] > _SAME_TIME_S, False)[: len(number)] & ~last
    repeats = 1 + (last | broken)
    row = np.repeat(np.arange(len(number)), repeats)
    is_end = np.concatenate([[False], row[1:] == row[:-1]])[: len(row)]
    paths = Paths(
        number[row],
        np.where(is_end, end_s[row], segments["start_s"][row]),
        np.where(is_end, segments["x1_px"][row], segments["x0_px"][row]),
        np.where(is_end, segments["y1_px"][row], segments["y0_px"][row]),
        is_end & broken[row],
    )
    return _still(paths, parked)


def _still(paths: Paths, parked: Mask) -> Paths:
    """First and last position of what is parked, at the median: its jitter is that of registration."""
    still = parked[paths.vehicle] if len(paths.vehicle) else np.zeros(0, bool)
    for name in ("x_px", "y_px"):
        values = getattr(paths, name)
        median = pd.Series(values[still]).groupby(paths.vehicle[still]).transform("median")
        values[still] = median.to_numpy(np.float64)
    changes = np.diff(paths.vehicle, prepend=-1, append=-1) != 0
    return paths.take(changes[:-1] | changes[1:] | ~still)


def replay_chunks(
    paths: Paths, vehicles: pd.DataFrame, *, first_time_s: float, duration_s: float, step_px: float
) -> Iterator[bytes]:
    """The chunks in the order of time.

    Parameters
    ----------
    vehicles
        `find_vehicles` and `add_dimensions`, a row a track, in the order of track ids.
    """
    time_s = paths.time_s - first_time_s
    begins = np.flatnonzero(paths.vehicle[1:] == paths.vehicle[:-1])  # positions with another after them
    count = chunk_count(duration_s)
    first = np.clip(time_s[begins] // CHUNK_S, 0, count - 1).astype(np.int64)
    final = np.clip(time_s[begins + 1] // CHUNK_S, 0, count - 1).astype(np.int64)
    each = final - first + 1
    begin = np.repeat(begins, each)
    chunk = np.repeat(first, each) + np.arange(len(begin)) - np.repeat(np.cumsum(each) - each, each)
    order = np.argsort(chunk, kind="stable")
    bounds = np.searchsorted(chunk[order], np.arange(count + 1))
    state = pd.Categorical(vehicles["state"], STATES).codes.astype(np.uint8)
    axis = np.nan_to_num(vehicles["orientation_rad"].to_numpy(np.float64))
    classes = pd.Categorical(vehicles["vehicle_class"], CLASS_NAMES).codes + 1
    measured = [classes, 100 * vehicles["class_probability"], 10 * vehicles["length_m"]]
    looks = np.column_stack(
        [
            state,
            np.floor(axis / np.pi * 256).clip(0, 255).astype(np.uint8),
            *(np.rint(np.nan_to_num(np.asarray(of, np.float64))).clip(0, 255).astype(np.uint8) for of in measured),
        ]
    )
    for k in range(count):
        mine = begin[order[bounds[k] : bounds[k + 1]]]
        rows = np.union1d(mine, mine + 1)
        yield _encode(paths.take(rows), time_s[rows], looks, step_px)


def _encode(paths: Paths, time_s: FloatArray, looks: IntArray, step_px: float) -> bytes:
    vehicle, first = np.unique(paths.vehicle, return_index=True)
    place = [np.rint((value + 0.5) / step_px).clip(0, _STEPS) for value in (paths.x_px, paths.y_px)]
    parts = [
        np.array([len(vehicle), len(time_s)], "<u4"),
        vehicle.astype("<u4"),
        first.astype("<u4"),
        time_s.astype("<f4"),
        *(value.astype("<u2") for value in place),
        looks[vehicle, 0],
        looks[vehicle, 1],
        paths.gap.astype(np.uint8),
        *looks[vehicle, 2:].T,
    ]
    return b"".join(part.tobytes() for part in parts)
