"""Turning counts as the workbook of counting firms: a sheet a junction, 15 minutes a row, approaches by L, T, R, U."""

import io
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import xlsxwriter
from numpy.lib.stride_tricks import sliding_window_view

from schemas.arrays import IntArray
from schemas.export import ExportOptions
from velfield.analysis.movements.movements import JunctionMovements
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.errors import InputError
from velfield.run.run import Run

FILE_NAME = "turning_counts.xlsx"
BIN_S = 900.0
TURN_LETTERS = {"left": "L", "straight": "T", "right": "R", "u-turn": "U"}
_BOUND = {"N": "SB", "NE": "SWB", "E": "WB", "SE": "NWB", "S": "NB", "SW": "NEB", "W": "EB", "NW": "SEB"}


def encode(run: Run, _path: Path, _options: ExportOptions) -> bytes:
    """See `velfield.exports.export.ExportModule`.

    Raises
    ------
    InputError
        No junction was found.
    """
    return turning_workbook(run.analysis.traffic)


def turning_workbook(analysis: TrafficAnalysis) -> bytes:
    """The workbook of all junctions at which movements were found."""
    junctions = [m for m in analysis.movements if m.movements]
    if not junctions:
        raise InputError("no junction with movements was found, so there are no turning counts")
    buffer = io.BytesIO()
    book = xlsxwriter.Workbook(buffer, {"in_memory": True})
    book.set_properties({"created": datetime(2000, 1, 1), "author": "velfield"})
    bold = book.add_format({"bold": True})
    for found in junctions:
        sheet = book.add_worksheet(f"junction {found.junction.number}")
        for number, row in enumerate(junction_rows(analysis, found)):
            sheet.write_row(number, 0, row, bold if number < 3 else None)
        sheet.freeze_panes(3, 1)
        sheet.set_column(0, 0, 34)
    book.close()
    return buffer.getvalue()


def bound(arm: str) -> str:
    """``SB`` of vehicles that enter by the arm ``N``; ``SB2`` of ``N2``.

    Examples
    --------
    >>> bound("N"), bound("W2")
    ('SB', 'EB2')
    """
    side = arm.rstrip("0123456789")
    return _BOUND.get(side, side) + arm[len(side) :]


def junction_rows(analysis: TrafficAnalysis, found: JunctionMovements) -> list[list[Any]]:
    """Rows of a junction's sheet: counts by 15 minutes, all, inferred, peak-hour factor, share of heavy vehicles.

    A vehicle counts when it enters. Those of cut tracks are not known by time, and stand in a row of their own.
    """
    begin, end = analysis.window_s
    bins = max(int(np.ceil((end - begin) / BIN_S)), 1)
    moves = sorted(found.movements, key=lambda m: (m.arm_in, list(TURN_LETTERS).index(m.turn), m.arm_out))
    counts = np.array([_entries(found, m.arm_in, m.arm_out, begin, bins) for m in moves])
    kind = analysis.junction_kind(found.junction.number)
    head = [f"{bound(m.arm_in)} {TURN_LETTERS[m.turn]}" for m in moves]
    rows: list[list[Any]] = [
        [f"Junction {found.junction.number} ({kind}); arms by where they lead to, {analysis.arm_names.legend}"],
        ["From arm, to arm", *(f"{m.arm_in} to {m.arm_out}" for m in moves)],
        ["From the start, min", *head, "All"],
    ]
    edges = np.linspace(begin, begin + bins * BIN_S, bins + 1)
    seen = analysis.trajectories.observed_within(edges)
    for k in range(bins):
        last = min((k + 1) * BIN_S, end - begin)
        unseen = "" if seen[k] > last - k * BIN_S - 1 else f", of which {seen[k] / 60:.1f} seen"
        rows.append(
            [f"{k * BIN_S / 60:.0f} to {last / 60:.1f}{unseen}", *counts[:, k].tolist(), int(counts[:, k].sum())]
        )
    rows.append(["Counted", *counts.sum(axis=1).tolist(), int(counts.sum())])
    inferred = [round(m.seen + m.inferred - n, 1) for m, n in zip(moves, counts.sum(axis=1).tolist(), strict=True)]
    rows.append(["Inferred of cut tracks", *inferred, round(sum(inferred), 1)])
    whole = np.where(seen > BIN_S - 1, counts, -1)
    factors = [peak_hour_factor(one) for one in [*whole, whole.sum(axis=0)]]
    if factors[-1] is None:
        rows.append(["Peak-hour factor", "too little data: an hour is needed"])
    else:
        rows.append(["Peak-hour factor", *factors])
    rows.append(["Heavy vehicles, %", *(_heavy_percent(analysis, found.tracks(m)) for m in moves)])
    return rows


def _entries(found: JunctionMovements, arm_in: str, arm_out: str, begin_s: float, bins: int) -> IntArray:
    """Vehicles of a movement by slice of 15 minutes."""
    name = np.array([found.gates.arms[gate.arm].name for gate in found.gates.gates] + [""])
    rows = (name[found.passes.gate_in] == arm_in) & (name[found.passes.gate_out] == arm_out)
    slot = ((found.passes.entry_s[rows] - begin_s) // BIN_S).astype(np.int64).clip(0, bins - 1)
    return np.bincount(slot, minlength=bins)


def peak_hour_factor(counts: IntArray) -> float | None:
    """The hour's vehicles over four times its busiest 15 minutes, in the busiest hour; None of less than an hour.

    Parameters
    ----------
    counts
        (n,) vehicles by 15 minutes; negative where they were not seen whole.

    Examples
    --------
    >>> peak_hour_factor(np.array([10, 20, 30, 20, 10])), peak_hour_factor(np.array([10, 20, -1, 20, 10]))
    (0.667, None)
    """
    hours = sliding_window_view(counts, 4) if len(counts) >= 4 else np.empty((0, 4))
    hours = hours[(hours >= 0).all(axis=1)]
    if not len(hours):
        return None
    hour = hours[int(hours.sum(axis=1).argmax())]
    return round(float(hour.sum() / (4 * hour.max())), 3) if hour.max() else None


def _heavy_percent(analysis: TrafficAnalysis, tracks: IntArray) -> float | str:
    share = analysis.heavy_share(tracks)
    return "not known" if share is None else round(100 * share.value, 1)
