"""Sum of the fields of run folders, and how many vehicles in it were seen by two of them at the same time."""

from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

from schemas.flight import assumed_gsd_m
from velfield.analysis.shared_vehicles import MAX_OFFSET_S, find_shared_vehicles
from velfield.errors import count_text
from velfield.run.field_algebra import merge_fields
from velfield.run.run import Run, open_run


def merge_runs(roots: Sequence[Path], out: Path) -> list[str]:
    """Add the fields of run folders into a new folder, exactly (`velfield.run.field_algebra.merge_fields`).

    Returns
    -------
    list of str
        For people: which vehicles count twice, as two cameras saw them at the same time, or why that is not known.

    Raises
    ------
    InputError
        As of `merge_fields`.
    """
    merge_fields(roots, out)
    runs = [open_run(root) for root in roots]
    comparable = [run for run in runs if not run.made_from and run.start is not None]
    return [
        *(
            f"{run.layout.root} {'is itself a merged field' if run.made_from else 'has no clock'}: vehicles that it "
            "and another run saw at the same time count twice"
            for run in runs
            if run not in comparable
        ),
        *(line for pair in combinations(comparable, 2) for line in _shared_line(*pair)),
    ]


def _shared_line(first: Run, second: Run) -> list[str]:
    if first.start is None or second.start is None:
        return []
    names = [str(run.layout.root) for run in (first, second)]
    if first.start.is_utc != second.start.is_utc:
        return [
            f"the clocks of {names[0]} ({first.start.source}) and {names[1]} ({second.start.source}) cannot be "
            "compared, one is the camera's and one is UTC: vehicles that both saw at the same time count twice"
        ]
    ahead_s = second.start.clock_s - first.start.clock_s
    if max(0.0, ahead_s) > min(_duration_s(first), ahead_s + _duration_s(second)) + MAX_OFFSET_S:
        return []
    tables = [run.track_positions() for run in (first, second)]
    tables[0], tables[1] = (
        table.assign(time_s=table["time_s"] - run.times_s[0] + shift_s)
        for table, run, shift_s in zip(tables, (first, second), (0.0, ahead_s), strict=True)
    )
    shared = find_shared_vehicles(*tables, gsd_m=assumed_gsd_m(first.grid.gsd_m))
    counts = [table["track_id"].nunique() for table in tables]
    apart = f"; their clocks differ by {abs(shared.offset_s):.1f} s" if shared.offset_s else ""
    return [
        f"{count_text(shared.count, 'vehicle')} seen by {names[0]} and {names[1]} at the same time, counted twice, of "
        f"{counts[0]} and {counts[1]} tracks{apart}"
    ]


def _duration_s(run: Run) -> float:
    return float(run.times_s[-1] - run.times_s[0])
