"""``velfield analyse``: the traffic analysis of a run, or of another program's tracks."""

from pathlib import Path
from typing import Literal


def analyse(
    run_folder: Path | None = None,
    /,
    *,
    tracks: Path | None = None,
    out: Path | None = None,
    gsd_m: float | None = None,
    fps: float | None = None,
    unit: Literal["m", "ft", "cm", "mm", "px", "deg"] | None = None,
    y_axis: Literal["up", "down"] | None = None,
    slice_s: float = 300.0,
    speed_unit: Literal["km/h", "mph"] = "km/h",
    arm: tuple[str, ...] = (),
) -> int:
    """Lanes, turning counts, speeds, signals, flow, conflicts: write `analysis/` with a report.

    Parameters
    ----------
    run_folder
        The run folder.
    tracks
        Tracks of another program instead: CSV or Parquet (geo-trax, inD, NGSIM and others), or SUMO's FCD.
    out
        Folder for the report and tables, with `--tracks`.
    gsd_m
        Metres per pixel of `--tracks`, if they are in pixels.
    fps
        Frames per second of `--tracks`, if they have no times.
    unit
        Unit of the columns x and y in `--tracks`, if their names do not give it.
    y_axis
        Direction of the y axis in `--tracks`: up (north, as in maps) or down (as in images).
    slice_s
        Length of a time slice for counts, seconds; used if the flight is longer than two slices.
    speed_unit
        Unit of speeds in what is printed, the report, the tables and the workbook.
    arm
        Name of an arm in place of its direction: `3.W=Mill Road` of junction 3, `W=Mill Road` of a road into the scene.
        Repeatable.
    """
    from flows.launch import keep_memory
    from velfield.errors import InputError
    from velfield.pipeline.analysis.analyse import analyse_run, analyse_tracks

    keep_memory(large_arrays=True)
    unnamed = [one for one in arm if not all(part.strip() for part in one.partition("=")[::2])]
    if unnamed:
        raise InputError(f"--arm {unnamed[0]!r}: expected DIRECTION=NAME, as 3.W='Mill Road' or W='Mill Road'")
    arms = {key.strip(): name.strip() for key, _, name in (one.partition("=") for one in arm)}
    if (run_folder is None) == (tracks is None):
        raise InputError("give either a run folder or --tracks FILE")
    if tracks is None:
        lines = analyse_run(Path(run_folder or "."), slice_s=slice_s, speed_unit=speed_unit, arms=arms)
    elif out is None:
        raise InputError(f"--tracks {tracks}: --out is missing, the folder for the report and tables")
    else:
        lines = analyse_tracks(
            tracks,
            out,
            gsd_m=gsd_m,
            fps=fps,
            unit=unit,
            y_axis=y_axis,
            slice_s=slice_s,
            speed_unit=speed_unit,
            arms=arms,
        )
    for line in lines:
        print(line, flush=True)
    return 0
