"""Detections of a run of the kharkiv clip in the frame whose cars are marked by eye, tests/data/kharkiv_marks.csv.

velfield run FOLDER/kharkiv/drone.mp4 --gsd-m 0.426 --out RUN
python -m tests.benchmarks.marked_frame RUN
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

from velfield import open_run
from velfield.analysis.vehicles import SURE_SCORE
from velfield.run.run import Run

MARKS = Path(__file__).parents[1] / "data" / "kharkiv_marks.csv"
TIME_S = 90 / 25
"""Of the marked frame."""
_NEAR_PX = 5.0
"""Half a car's length."""


def main() -> None:
    """Judge, print."""
    parser = argparse.ArgumentParser()
    parser.add_argument("run", type=Path)
    run = open_run(parser.parse_args().run)
    found = run.detections()
    frame = int(found["frame"].iloc[(found["time_s"] - TIME_S).abs().argmin()])
    precision, recall = judge(run, frame, found[found["frame"] == frame])
    print(f"frame {frame}: precision {precision:.3f}, recall {recall['all']:.3f}")
    for name in ("moving", "standing"):
        print(f"{name:9} recall {recall[name]:.3f}")
    seen = run.track_positions().merge(run.vehicles()[["track_id", "state", "score"]], on="track_id")
    seen = seen[(seen["frame"] == frame) & (seen["source"] != "interpolated")]
    parked = seen["state"] == "parked"
    sure = seen["score"] >= SURE_SCORE
    for name, rows in (("move or wait", ~parked), ("stand, sure", parked & sure), ("stand, others", parked & ~sure)):
        print(f"tracks that {name}: precision {judge(run, frame, seen[rows])[0]:.3f} of {rows.sum()}")


def judge(run: Run, frame: int, found: pd.DataFrame) -> tuple[float, dict[str, float]]:
    """Precision of detections, or of tracks' positions, in the marked frame, and the fraction found of ``all`` marks
    and by their kind."""
    marks = pd.read_csv(MARKS)
    places = run.to_base(frame, marks[["x_px", "y_px"]].to_numpy(float))
    kind, unclear = marks["kind"].to_numpy(), (marks["kind"] == "unclear").to_numpy()
    radius = np.nan_to_num(marks["radius_px"].to_numpy(float), nan=_NEAR_PX)
    taken, wrong = np.zeros(len(marks), bool), 0
    for place in found.sort_values("score", ascending=False, kind="stable")[["x_px", "y_px"]].to_numpy():
        off = np.hypot(*(places - place).T)
        to_be_found = np.where(unclear | taken, np.inf, off)
        if to_be_found.min() <= _NEAR_PX:
            taken[to_be_found.argmin()] = True
        elif not (unclear & (off <= radius)).any():
            wrong += 1
    of_kind = {name: float(taken[kind == name].mean()) for name in ("moving", "standing")}
    return float(taken.sum() / (taken.sum() + wrong)), {"all": float(taken[~unclear].mean()), **of_kind}


if __name__ == "__main__":
    main()
