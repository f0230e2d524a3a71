"""Ask a finished run: where is traffic known, which way does it go, how fast is it at one pixel.

python examples/read_field.py RUN
"""

import sys

import numpy as np

import velfield


def main(root: str) -> None:
    """Print what the field of a run folder knows."""
    run = velfield.open_run(root)
    count = run.field.count()
    print(f"{int((count > 0).sum())} pixels known, the busiest seen by {int(count.max())} vehicles")
    if not count.any():
        return
    y, x = np.unravel_index(int(count.argmax()), count.shape)
    vx, vy = run.field.modal_velocity()[y, x]
    print(f"at ({x}, {y}): most often ({vx:.1f}, {vy:.1f}) px/s")
    print(f"all of it: {run.field.at(int(x), int(y))}")


if __name__ == "__main__":
    main(sys.argv[1])
