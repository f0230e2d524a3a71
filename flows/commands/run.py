"""``velfield run``: from a video, or tracks, to the maps."""

import shlex
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from flows.commands.start import own_command
from flows.options import (
    DONE,
    INCOMPLETE,
    Cluster,
    ConfigFile,
    Device,
    LogJson,
    Preset,
    Quiet,
    Scheduler,
    Settings,
    Verbose,
    Workers,
)
from schemas.job import Inputs, Job, absolute
from velfield.errors import InputError
from velfield.pipeline.configuration import resolve_config

if TYPE_CHECKING:
    from flows.console import Console, Verbosity
    from flows.runners import RunnerConfig
    from schemas.summary import RunSummary


def run(
    source: Path | None = None,
    /,
    *more: Path,
    out: Path,
    tracks: Path | None = None,
    unit: Literal["m", "ft", "cm", "mm", "px", "deg"] | None = None,
    y_axis: Literal["up", "down"] | None = None,
    base: Path | None = None,
    gsd_m: float | None = None,
    labels: Path | None = None,
    detector: Path | None = None,
    detections: Path | None = None,
    timestamps: Path | None = None,
    telemetry: Path | None = None,
    fps: float | None = None,
    config: ConfigFile = None,
    preset: Preset = None,
    settings: Settings = (),
    every: str | None = None,
    start_s: float | None = None,
    stop_s: float | None = None,
    intervals: str | None = None,
    workers: Workers = None,
    scheduler: Scheduler = None,
    cluster: Cluster = None,
    device: Device | None = None,
    plan: Annotated[bool, Parameter(negative=())] = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    log_json: LogJson = False,
) -> int:
    """Compute a velocity field from aerial video. Run the same command again to resume.

    Parameters
    ----------
    source
        Video file, or folder of images.
    more
        Additional clips of the same site, in time order: they give one map, with the times of the files.
    out
        Run folder: everything is written there.
    tracks
        Tracks of another program instead of a video: CSV or Parquet (geo-trax, highD and others), or SUMO's FCD.
        Field, maps and analysis are made of them.
    unit
        Unit of the columns x and y in `--tracks`, if their names do not give it.
    y_axis
        Direction of the y axis in `--tracks`: up (north, as in maps) or down (as in images).
    base
        Image whose pixels become the base pixels: GeoTIFF, PNG with world file, or plain.
        Default: built from the flight.
    gsd_m
        Ground sample distance, metres per base pixel.
        Default: from the base image's CRS, the drone's metadata or the lengths of the vehicles.
    labels
        Labelled cars to fine-tune the detector on: CSV, GeoJSON, YOLO, COCO, LabelMe, VIA. Default: none.
    detector
        A trained detector file, or a YOLO-type ONNX model. Default: the detector that comes with velfield.
    detections
        Boxes found by another program, instead of running a detector.
    timestamps
        CSV `frame,time_s` for a folder of images.
    telemetry
        Drone metadata: subtitles (.SRT) or MISB KLV (.klv). Default: the file next to the video, or the metadata in it.
    fps
        Frame rate of a folder of images without timestamps, or of `--tracks` that have no times.
    every
        Take every n-th frame; `auto`: the frames nearest to 0.2 s apart.
    start_s
        Skip frames before this time, seconds from the first frame.
    stop_s
        Skip frames from this time on, seconds from the first frame.
    intervals
        Also compute a field for each time interval: `15min`, `07:00-09:00,15:00-18:00`, or seconds `0-300,300-600`.
    device
        Device that runs the network: cpu, cuda, or auto (default), which uses a GPU if there is one.
    plan
        Print what would be computed, and stop.
    verbose
        Print more detail.
    log_json
        Print lines of JSON instead of text.
    """
    from flows.runners import choose_runner

    overrides = {
        "gsd_m": gsd_m,
        "frames.every": _every(every),
        "frames.fps": fps,
        "frames.start_s": start_s,
        "frames.stop_s": stop_s,
        "field.time_intervals": intervals,
        "work.device": device,
        "position_unit": unit,
        "position_y_axis": y_axis,
    }
    resolved = resolve_config(preset=preset, file=config, settings=settings, overrides=overrides)
    options = {
        "labels": labels, "detector": detector, "detections": detections, "timestamps": timestamps,
        "telemetry": telemetry,
    }  # fmt: skip
    given = {name: str(path) for name, path in options.items() if path is not None}
    path = tracks
    if tracks is not None or source is None:
        frames_only = ["VIDEO"] * (source is not None) + [f"--{name}" for name in given]
        _check_tracks(tracks, frames_only + ["--device"] * (device is not None))
    elif more:
        from velfield.pipeline.plan import write_clips

        path = write_clips(out, (source, *more))
    else:
        path = source
    inputs = Inputs(source=str(path), base=None if base is None else str(base), **given)
    job = Job(root=str(out), inputs=inputs, config=resolved)
    where, verbosity = choose_runner(workers, scheduler, cluster), _verbosity(quiet, verbose, log_json)
    if plan:
        print(_describe_plan(job, where, of_tracks=tracks is not None))
        return DONE
    status = process(job, runner=where, verbosity=verbosity, of_tracks=tracks is not None)
    if status in (DONE, INCOMPLETE) and tracks is None and _has_tracks(out):
        root = shlex.quote(absolute(str(out)))
        print(f"answers {own_command()} analyse {root}   (turning counts, queues, signals, speeds)")
    return status


def _has_tracks(out: Path) -> bool:
    """Whether a run found any track to analyse."""
    from velfield.run.commits import read_commits
    from velfield.run.layout import RunLayout, to_path

    return any(commit.counts.get("tracks", 0.0) > 0 for commit in read_commits(RunLayout(to_path(out)), "tracks"))


def _check_tracks(tracks: Path | None, frames_only: list[str]) -> None:
    """Refuse a run without frames that has no tracks, or options that were given and need frames."""
    if tracks is None:
        raise InputError("no input; give a video, a folder of images, or --tracks FILE")
    if frames_only:
        raise InputError(f"--tracks cannot be combined with {', '.join(frames_only)}: tracks have no frames")


def process(
    job: Job,
    *,
    runner: "RunnerConfig | None" = None,
    verbosity: "Verbosity" = "normal",
    of_tracks: bool = False,
) -> int:
    """Run a job on frames, or on tracks, whose analysis is made too; the exit status."""
    from flows.launch import prepare_process
    from flows.stopping import stop_on_signals
    from velfield.pipeline.plan import check_inputs

    stop_on_signals()
    prepare_process(verbose=verbosity == "verbose")
    from flows.console import Console

    console = Console(verbosity)
    if not of_tracks:
        check_inputs(job)
    _announce(job, console)
    from flows.process_flight import run_flight
    from flows.runners import RunnerConfig

    summary = run_flight(job, runner or RunnerConfig(), console, of_tracks=of_tracks)
    if of_tracks:
        from velfield.pipeline.analysis.analyse import analyse_run

        for line in analyse_run(Path(job.root)):
            console.result(line)
    return conclude(summary, console)


def _announce(job: Job, console: "Console") -> None:
    """The first line, before imports and inputs take their seconds."""
    console.event(
        "open", f"velfield {version('velfield')}: {job.inputs.source} into {job.root}, preset {job.config.preset}"
    )


_LISTED = 10
"""Lost frames that the terminal names; the report has all."""


def conclude(summary: "RunSummary", console: "Console") -> int:
    """Say where the results are and what was lost; the exit status."""
    from velfield.run.layout import is_remote, to_path

    root = to_path(summary.root)
    console.result(f"maps    {root / 'maps'}")
    if is_remote(root):  # `velfield view` shows a folder of this machine
        console.result(f"page    aws s3 sync {shlex.quote(str(root))} RUN && {own_command()} view RUN")
    else:
        console.result(f"page    {own_command()} view {shlex.quote(str(root))}")
    if summary.complete:
        return DONE
    for line in (*summary.footage_lost, *summary.frames_lost[:_LISTED]):
        console.warn(line)
    if (more := len(summary.frames_lost) - _LISTED) > 0:
        console.warn(f"and {more} more frames")
    console.warn(f"{summary.root}: done, but {summary.loss}; the report lists them")
    return INCOMPLETE


def _describe_plan(job: Job, runner: "RunnerConfig", *, of_tracks: bool) -> str:
    if of_tracks:
        from velfield.pipeline.given_tracks.plan import describe_tracks

        return describe_tracks(job)
    from flows.runners import parallel_units
    from velfield.pipeline.check_inputs import validate_inputs
    from velfield.pipeline.estimate import describe_plan
    from velfield.pipeline.plan import make_plan

    plan = make_plan(job)
    validate_inputs(plan)
    return describe_plan(plan, parallel_units(runner))


def _every(text: str | None) -> int | str | None:
    if text is None or text == "auto":
        return text
    if not text.isdigit() or int(text) < 1:
        raise InputError(f"--every {text}: must be a positive integer, or auto")
    return int(text)


def _verbosity(quiet: bool, verbose: bool, log_json: bool) -> "Verbosity":
    if log_json:
        return "json"
    return "quiet" if quiet else "verbose" if verbose else "normal"
