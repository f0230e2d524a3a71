"""``velfield bench registration``: errors and time on simulated flights that nothing was tuned to, beside stabilo."""

from pathlib import Path

from velfield.errors import InputError


def registration(
    *,
    out: Path = Path("velfield-bench"),
    cases: tuple[str, ...] = ("homography", "wobble", "vibration"),
    seeds: tuple[int, ...] = (101, 102, 103, 104, 105),
    frames: int | None = None,
    stabilo: bool = True,
) -> int:
    """Register simulated flights of unseen seeds, and print the error against ground truth, median and worst.

    Parameters
    ----------
    out
        Folder for the flights and their runs; delete it afterwards.
    cases
        `homography`: plane, pinhole, 2560x1440; `wobble`: lens and rows that move by 4 px, 6 cycles a frame;
        `vibration`: lens, shake at 14-29 Hz, drift, turn, tilt, relief, base image of another sensor;
        `two_term_lens`: a lens of two terms whose centre is up to 20 px off, 2560x1920, base image of another sensor;
        `long`: the same, 640x480, for the drift over 1000 frames.
    seeds
        One flight each.
    frames
        Frames a flight. Default: 8, 12, 60, 10 and 1000.
    stabilo
        Register by stabilo too; without, velfield alone is measured, and stabilo need not be installed.
    """
    import cv2

    from velfield.bench.registration import CASES, bench_registration, summarise

    cv2.setNumThreads(1)  # as the runs themselves: one core each
    unknown = sorted(set(cases) - set(CASES))
    if unknown:
        raise InputError(f"--cases {' '.join(unknown)}: expected some of {', '.join(CASES)}")
    if frames is not None and frames < 2:
        raise InputError(f"--frames {frames}: expected 2 or more, to see jitter from one to the next")
    measured = []
    for case in cases:
        for seed in seeds:
            rows = bench_registration(out, CASES[case], seed, frames=frames, stabilo=stabilo)
            measured += rows
            print("\n".join(row.text() for row in rows), flush=True)
    print("\n".join(summarise(measured)))
    return 0
