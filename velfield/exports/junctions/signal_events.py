"""Signals as a controller's event log with the Indiana enumerations, and its detectors: two CSV files, as ZIP.

The columns of ``events.csv`` are TimeStamp, DeviceId, EventId and Parameter, those of ``detectors.csv`` DeviceId,
Phase, Parameter and Function. A device is a junction. Greens are those of the cycle that was found; yellow is not seen,
and red begins where crossings of the stop line end. A detector lies at the stop line of each lane.
"""

from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pandas as pd

from schemas.arrays import FloatArray
from schemas.export import ExportOptions
from velfield.analysis.signals.cycles import JunctionSignal, StreamSignal, green_duration_s
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.errors import InputError
from velfield.exports.export import start_time, zip_bytes
from velfield.run.run import Run

FILE_NAME = "signal-events.zip"
GREEN, RED_CLEARANCE, DETECTOR_OFF, DETECTOR_ON = 1, 10, 81, 82
"""Phase begin green, phase begin red clearance, and a detector's ends, in the Indiana Traffic Signal Hi Resolution Data
Logger Enumerations."""
FUNCTIONS = ("Presence", "Yellow_Red")
_LEAST_M_PER_S = 1.0


def encode(run: Run, _path: Path, options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`; times count from `start_time`.

    Raises
    ------
    InputError
        No signal was found.
    """
    return event_archive(run.analysis.traffic, start_time(run, options))


def event_archive(analysis: TrafficAnalysis, start: datetime) -> bytes:
    """Both files of all signals, the first position at second 0 of the video."""
    found = {number: signal for number, signal in analysis.signals.items() if signal.signalised}
    if not found:
        raise InputError("no signal was found, so there are no signal events")
    events = pd.DataFrame(
        [row for number, signal in found.items() for row in _events(number, signal, analysis)],
        columns=["time_s", "DeviceId", "EventId", "Parameter"],
    ).sort_values("time_s", kind="stable")
    stamps = [start.replace(tzinfo=None) + timedelta(seconds=s) for s in events.pop("time_s")]
    events.insert(0, "TimeStamp", [stamp.isoformat(sep=" ", timespec="milliseconds") for stamp in stamps])
    detectors = pd.DataFrame(
        [
            (number, phase, stream.stream.approach.lane + 1, function)
            for number, signal in found.items()
            for phase, stream in _streams(signal)
            for function in FUNCTIONS
        ],
        columns=["DeviceId", "Phase", "Parameter", "Function"],
    )
    tables = {"events.csv": events, "detectors.csv": detectors}
    return zip_bytes({name: table.to_csv(index=False, lineterminator="\n") for name, table in tables.items()})


def _streams(signal: JunctionSignal) -> Iterator[tuple[int, StreamSignal]]:
    """Streams with the number of their phase, from 1 on."""
    for number, lanes in enumerate(signal.phases, start=1):
        yield from ((number, s) for s in signal.streams if s.stream.approach.lane in lanes)


def _events(device: int, signal: JunctionSignal, analysis: TrafficAnalysis) -> Iterator[tuple[float, int, int, int]]:
    """Events of a junction: time, device, event and parameter."""
    cycle_s = signal.cycle_s.value if signal.cycle_s else np.nan
    for phase in range(1, len(signal.phases) + 1):
        streams = [stream for number, stream in _streams(signal) if number == phase]
        green, lasts = streams[0].green_s, green_duration_s(streams, cycle_s)
        for kind, times in ((GREEN, green), (RED_CLEARANCE, green + lasts if lasts is not None else green[:0])):
            yield from ((t, device, kind, phase) for t in _seen(times, analysis))
    for _, stream in _streams(signal):
        s, channel = stream.stream, stream.stream.approach.lane + 1
        half_s = analysis.trajectories.length_m[s.cross_track] / 2 / np.maximum(s.cross_speed_m_per_s, _LEAST_M_PER_S)
        for kind, times in ((DETECTOR_ON, s.cross_time_s - half_s), (DETECTOR_OFF, s.cross_time_s + half_s)):
            yield from ((t, device, kind, channel) for t in times.tolist())


def _seen(times_s: FloatArray, analysis: TrafficAnalysis) -> list[float]:
    """Times at which the junction was filmed."""
    begin, end = analysis.trajectories.observed_s.T
    inside = (times_s[:, None] >= begin) & (times_s[:, None] <= end)
    return [float(t) for t in times_s[inside.any(axis=1)]]
