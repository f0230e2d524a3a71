"""Add the fields of a day's flights over one place, on one grid, and say how much more of the map is known.

python examples/merge_a_day.py OUT RUN RUN ...
"""

import sys
from pathlib import Path

import velfield
from velfield.pipeline.merge import merge_runs


def main(out: str, *roots: str) -> None:
    """Write the merged folder; print what it knows beside what each flight knows."""
    for line in merge_runs([Path(root) for root in roots], Path(out)):
        print(line)
    for root in (*roots, out):
        count = velfield.open_run(root).field.count()
        print(f"{root}: {int((count >= 5).sum())} pixels with five vehicles or more, {int(count.max())} at the busiest")


if __name__ == "__main__":
    main(*sys.argv[1:])
