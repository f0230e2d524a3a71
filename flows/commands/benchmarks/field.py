"""``velfield bench field``: the kernel and bins with the best likelihood of held-out tracks."""

from pathlib import Path


def field(
    run_folder: Path | None = None,
    /,
    *,
    seed: int = 1,
    frames: int = 300,
    sigma: tuple[float, ...] = (0.35, 0.7, 1.4),
    width: tuple[float, ...] = (1.0, 2.0, 3.0),
) -> int:
    """Learn the field from every other track, judge it by the rest: beside one distribution and a Gaussian a pixel.

    Parameters
    ----------
    run_folder
        Run folder whose tracklets are used, with a known ground sample distance. Default: simulated traffic.
    seed
        City that is simulated.
    frames
        Length of that flight.
    sigma
        Kernels tried, m/s.
    width
        Bins tried, m/s.
    """
    from velfield.bench.field import sweep

    for line in sweep(run_folder, seed=seed, frames=frames, sigmas=sigma, widths=width):
        print(line, flush=True)
    return 0
