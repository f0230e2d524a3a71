"""Analyse tracks of another program: write them as a table, then let velfield find lanes and movements.

python examples/own_tracks.py OUT
"""

import subprocess
import sys
from pathlib import Path

import pandas as pd


def main(out: str) -> None:
    """Make a table of 30 vehicles that drive east, 6 s apart, and analyse it."""
    rows = [(n, 6 * n + t / 5, 10 * t / 5, 0.0) for n in range(30) for t in range(60)]
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(rows, columns=["track_id", "time_s", "x_m", "y_m"]).to_csv(folder / "tracks.csv", index=False)
    command = ["velfield", "analyse", "--tracks", str(folder / "tracks.csv"), "--out", str(folder / "analysis")]
    subprocess.run(command, check=True)


if __name__ == "__main__":
    main(sys.argv[1])
