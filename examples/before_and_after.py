"""Compare two flights over one place: figures and layers of what changed significantly, and a line for each quantity.

python examples/before_and_after.py BEFORE AFTER OUT
"""

import sys
from pathlib import Path

from velfield.pipeline.compare import compare_runs


def main(before: str, after: str, out: str) -> None:
    """Write the comparison and print its lines."""
    for line in compare_runs(Path(before), Path(after), Path(out)):
        print(line)


if __name__ == "__main__":
    main(*sys.argv[1:])
