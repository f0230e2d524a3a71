"""``velfield merge``, ``velfield subtract``, ``velfield compare``: algebra of fields on one grid."""

from pathlib import Path


def merge(*run_folders: Path, out: Path) -> int:
    """Add the fields of two or more run folders on one grid, exactly.

    A vehicle in two flights at the same time counts twice; their number is printed, if the runs have clocks.

    Parameters
    ----------
    run_folders
        The run folders.
    out
        New folder for the sum.
    """
    from velfield.pipeline.merge import merge_runs

    for line in merge_runs(run_folders, out):
        print(line)
    print(out / "field.zarr")
    return 0


def subtract(whole: Path, part: Path, /, *, out: Path) -> int:
    """Subtract a field from one that it was merged into, exactly.

    Parameters
    ----------
    whole
        Run folder or merged folder.
    part
        The field to subtract.
    out
        New folder for the difference.
    """
    from velfield.run.field_algebra import subtract_fields

    subtract_fields(whole, part, out)
    print(out / "field.zarr")
    return 0


def compare(before: Path, after: Path, /, *, out: Path | None = None, min_count: int = 5) -> int:
    """Map changes between two fields on one grid: direction, speed, volume, and their significance.

    Parameters
    ----------
    before
        Run folder of the earlier field.
    after
        Run folder of the later field.
    out
        Folder for the figures and layers. Default: `comparison/` in the later run's folder.
    min_count
        Smallest number of vehicles in both fields at a pixel, to compare direction and speed there.
    """
    from velfield.pipeline.compare import compare_runs

    for line in compare_runs(before, after, out or after / "comparison", min_count=min_count):
        print(line)
    return 0
