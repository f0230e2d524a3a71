"""The ``velfield`` command. Imports nothing heavy until a command runs."""

import os
import shlex
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

from cyclopts import App, Argument, CycloptsError, MissingArgumentError, Parameter

from flows.commands.start import own_command
from flows.launch import limit_threads, use_writable_folders
from flows.options import Device, Preset, Settings, parse_frame_size
from flows.stopping import STOPPED, as_ctrl_c, leave
from velfield.errors import (
    CacheWarning,
    DeviceWarning,
    IneffectiveSettingWarning,
    InputError,
    StoreError,
)

if TYPE_CHECKING:
    from flows.console import Console, Verbosity
    from flows.runners import RunnerConfig
    from schemas.job import Inputs, Job
    from schemas.summary import RunSummary

DONE, BAD_INPUT, USAGE, INCOMPLETE = 0, 1, 2, 3
"""Exit statuses. 3: done, but frames were lost."""


def _version() -> str:
    from velfield.run.commits import code_version

    return code_version()


app = App(
    name="velfield",
    help="Aerial video of a city in, a probability distribution over vehicle velocity at every pixel of the map out.",
    version=_version,
    version_flags=["--version"],
    help_format="plaintext",  # Markdown takes a third of the time of --help
    suppress_keyboard_interrupt=False,  # it would end without a message, and leave child processes behind
)

# Each in a file of its own, imported when it runs.
app.command("flows.commands.init:init", name="init", help="Inspect a video and write a commented flight.yaml.")
app.command("flows.commands.config:config", name="config", help="Print the configuration of a run.")
app.command("flows.commands.view:view", name="view", help="Show a run's page in the browser.")
app.command("flows.commands.analyse:analyse", name="analyse", help="Lanes, turning counts, speeds, signals: a report.")
app.command("flows.commands.annotate:annotate", name="annotate", help="Label cars in the browser, as training data.")
app.command("flows.commands.train:train", name="train", help="Train a detector from labelled cars.")
app.command("flows.commands.export:export", name="export", help="Write a finished run in another format.")
app.command("flows.commands.lineage:lineage", name="lineage", help="Print the lineage of a run, or of a pixel.")
app.command("flows.commands.reprocess:reprocess", name="reprocess", help="Put a new base image under a finished run.")
app.command(
    "flows.commands.georeference:georeference", name="georeference", help="Georeference a run by control points."
)
app.command("flows.commands.serve:serve", name="serve", help="Process flights that arrive in a folder, with a UI.")
app.command("flows.commands.verify:verify", name="verify", help="Check the integrity of a run folder, or repair it.")
app.command("flows.commands.algebra:merge", name="merge", help="Add the fields of runs that share a grid, exactly.")
app.command("flows.commands.algebra:subtract", name="subtract", help="Subtract a field from a merged one, exactly.")
app.command("flows.commands.algebra:compare", name="compare", help="Map what changed between two fields.")
app.command("flows.commands.bench:bench", name="bench", help="Measure speed and accuracy against other programs.")

Quiet = Annotated[bool, Parameter(name=["--quiet", "-q"], negative=())]
Verbose = Annotated[bool, Parameter(name=["--verbose", "-v"], negative=())]
LogJson = Annotated[bool, Parameter(name="--log-json", negative=())]


@app.command
def run(
    source: Path | None = None,
    /,
    *more: Path,
    out: Path,
    tracks: Path | None = None,
    unit: Literal["m", "ft", "px", "deg"] | None = None,
    y_axis: Literal["up", "down"] | None = None,
    base: Path | None = None,
    gsd_m: float | None = None,
    labels: Path | None = None,
    detector: Path | None = None,
    detections: Path | None = None,
    timestamps: Path | None = None,
    telemetry: Path | None = None,
    fps: float | None = None,
    config: Path | None = None,
    preset: Preset | None = None,
    settings: Settings = (),
    every: str | None = None,
    start_s: float | None = None,
    stop_s: float | None = None,
    intervals: str | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    cluster: Path | None = None,
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
        Tracks of another program instead of a video: CSV or Parquet (geo-trax, highD and others), or SUMO's FCD. Field,
        maps and analysis are made of them.
    unit
        Unit of the columns x and y in `--tracks`, if their names do not give it.
    y_axis
        Direction of the y axis in `--tracks`: up (north, as in maps) or down (as in images).
    base
        Image whose pixels become the base pixels: GeoTIFF, PNG with world file, or plain.
        Default: built from the flight.
    gsd_m
        Ground sample distance, metres per base pixel. Default: from the base image's CRS, the drone's metadata or the
        lengths of the vehicles.
    labels
        Labelled cars to fine-tune the detector on (docs/detection.md#label-formats). Default: none.
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
    config
        flight.yaml with the flight's configuration.
    preset
        Set of defaults to start from.
    settings
        One parameter, as `section.key=value`; can be repeated.
    every
        Take every n-th frame; `auto`: the frames nearest to 0.2 s apart.
    start_s
        Skip frames before this time, seconds from the first frame.
    stop_s
        Skip frames from this time on, seconds from the first frame.
    intervals
        Also compute a field for each time interval: `15min`, `07:00-09:00,15:00-18:00`, or seconds `0-300,300-600`.
    workers
        Processes of a local cluster. Default: threads of this process.
    scheduler
        Address of a Dask scheduler.
    cluster
        File with the class of Dask clusters to use and its arguments; see `examples/cluster-*.yaml`.
    device
        Device that runs the network: cpu, cuda, or auto (default), which uses a GPU if there is one.
    plan
        Print what would be computed, and stop.
    quiet
        Print warnings only.
    verbose
        Print more detail.
    log_json
        Print lines of JSON instead of text.
    """
    from schemas.job import Inputs, Job
    from velfield.pipeline.configuration import resolve_config

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
    if tracks is not None or source is None:
        frames_only = {
            "VIDEO": source, "--labels": labels, "--detector": detector, "--detections": detections,
            "--timestamps": timestamps, "--telemetry": telemetry, "--device": device,
        }  # fmt: skip
        inputs = _tracks_inputs(tracks, base, [name for name, value in frames_only.items() if value is not None])
        job = Job(root=str(out), inputs=inputs, config=resolved)
        where = _runner(workers, scheduler, cluster)
        return _process_tracks(job, where, _verbosity(quiet, verbose, log_json), plan_only=plan)
    inputs = Inputs(
        source=str(_clip_list(source, more, out) if more else source),
        base=_text(base),
        labels=_text(labels),
        detector=_text(detector),
        detections=_text(detections),
        timestamps=_text(timestamps),
        telemetry=_text(telemetry),
    )
    job = Job(root=str(out), inputs=inputs, config=resolved)
    if plan:
        return _show_plan(job, _runner(workers, scheduler, cluster))
    where = _runner(workers, scheduler, cluster)
    return _process(job, runner=where, verbosity=_verbosity(quiet, verbose, log_json))


@app.command
def simulate(
    out: Path,
    /,
    *,
    frames: int = 300,
    size: str = "1280x960",
    seed: int = 0,
    clip: Literal["beside", "embedded"] | None = None,
    quiet: Quiet = False,
) -> int:
    """Simulate a flight over a city, with ground truth: writes frames/, timestamps.csv, base.png, labels.csv, truth/.

    Parameters
    ----------
    out
        Folder to write to.
    frames
        Number of frames.
    size
        Frame size, WxH in pixels.
    seed
        Seed of the city and the flight.
    clip
        Write a drone clip DJI_0001.MP4 (25 frames per second) instead of frames/, with its telemetry `beside` it, in
        a file DJI_0001.SRT, or `embedded` in the clip.
    quiet
        Print warnings only.
    """
    _simulate(out, frames=frames, size=size, seed=seed, quiet=quiet, clip=clip)
    if clip is not None:
        print(f"{out}: try  {own_command()} run {out}/DJI_0001.MP4 --out RUN")
        return DONE
    given = f"--timestamps {out}/timestamps.csv --base {out}/base.png --labels {out}/labels.csv --gsd-m 0.23"
    print(f"{out}: try  {own_command()} run {out}/frames {given} --out RUN")
    return DONE


@app.command
def demo(
    *,
    out: Path = Path("velfield-demo"),
    frames: int = 120,
    size: str = "800x600",
    seed: int = 1,
    quiet: Quiet = False,
) -> int:
    """Simulate a drone clip, process it with nothing else given, analyse it, and compare it with its ground truth.

    Parameters
    ----------
    out
        Folder to write to.
    frames
        Number of frames.
    size
        Frame size, WxH in pixels.
    seed
        Seed of the city and the flight.
    quiet
        Print warnings only.
    """
    from flows.commands.analyse import analyse
    from flows.launch import kernels_beside, prepare_process
    from schemas.job import Inputs, Job
    from velfield.pipeline.configuration import resolve_config
    from velfield.synthetic.clip import CLIP_NAME

    prepare_process(verbose=False)
    flight, run = out / "flight", out / "run"
    with kernels_beside():
        # Ten frames a second: twice what a run uses, and two fifths of what a drone's clip takes to render.
        _simulate(flight, frames=frames, size=size, seed=seed, quiet=quiet, clip="beside", fps=10.0)
        config = resolve_config(preset="fast")
        inputs = Inputs(source=str(flight / CLIP_NAME))
        status = _process(Job(root=str(run), inputs=inputs, config=config), verbosity="quiet" if quiet else "normal")
    if status in (DONE, INCOMPLETE):
        analyse(run)
        _score(run, flight)
        if not quiet:
            print(f"the map:    {own_command()} view {shlex.quote(str(run))}")
            print(f"the report: {run / 'analysis' / 'report.html'}")
            print(f"your own clip: {own_command()} run VIDEO --out RUN")
    return status


@app.command
def schema() -> int:
    """Print the JSON Schema of flight.yaml, for editors."""
    import json

    from schemas.flight import FlightConfig

    print(json.dumps(FlightConfig.model_json_schema(), indent=1))
    return DONE


def _simulate(
    out: Path,
    *,
    frames: int,
    size: str,
    seed: int,
    quiet: bool,
    clip: Literal["beside", "embedded"] | None = None,
    fps: float = 25.0,
) -> None:
    from flows.console import Console
    from schemas.simulation import SimulationConfig
    from velfield.synthetic import write_flight

    width, height = parse_frame_size(size, "as 1280x960")
    console = Console("quiet" if quiet else "normal")
    config = SimulationConfig(frames=frames, width=width, height=height, seed=seed)
    config = config if clip is None else config.as_clip(clip, fps=fps)
    with console.stage("simulate", "simulate", frames) as progress:
        write_flight(out, config, lambda done, _total: progress.at_least(done))
    console.event("stage", f"simulated     {frames} frames of {width} x {height} px in {out}")


def _score(run_folder: Path, flight: Path) -> None:
    from velfield.synthetic.run_score import score_run

    print(score_run(run_folder, flight, min_count=1).text())


def _tracks_inputs(tracks: Path | None, base: Path | None, frames_only: list[str]) -> "Inputs":
    """Inputs of a run of given tracks; ``frames_only``: options that were given and need frames."""
    from schemas.job import Inputs

    if tracks is None:
        raise InputError("no input; give a video, a folder of images, or --tracks FILE")
    if frames_only:
        raise InputError(f"--tracks cannot be combined with {', '.join(frames_only)}: tracks have no frames")
    return Inputs(source=str(tracks), base=_text(base))


def _runner(workers: int | None, scheduler: str | None, cluster: Path | None) -> "RunnerConfig":
    from flows.runners import RunnerConfig, check_scheduler, read_runner

    if sum(given is not None for given in (workers, scheduler, cluster)) > 1:
        raise InputError("--workers, --scheduler and --cluster exclude each other; give only one")
    if workers is not None and workers < 1:
        raise InputError(f"--workers {workers}: must be a positive integer; omit it to run in this process")
    if scheduler is not None:
        check_scheduler(scheduler)  # before the cluster's client, which would wait for it
    return read_runner(cluster) if cluster else RunnerConfig(workers=workers, scheduler=scheduler)


def _process(
    job: "Job",
    *,
    runner: "RunnerConfig | None" = None,
    verbosity: "Verbosity" = "normal",
) -> int:
    from velfield.pipeline.plan import check_inputs

    console = _prepare(verbosity)
    check_inputs(job)
    from flows.process_flight import run_flight
    from flows.runners import RunnerConfig

    summary = run_flight(job, runner or RunnerConfig(), console)
    return _conclude(summary, console)


def _prepare(verbosity: "Verbosity") -> "Console":
    """Set this process up for a run; its console."""
    from flows.launch import prepare_process
    from flows.stopping import stop_on_signals

    stop_on_signals()
    prepare_process(verbose=verbosity == "verbose")
    from flows.console import Console

    return Console(verbosity)


def _process_tracks(job: "Job", runner: "RunnerConfig", verbosity: "Verbosity", *, plan_only: bool) -> int:
    if plan_only:
        from velfield.pipeline.given_tracks.plan import describe_tracks

        print(describe_tracks(job))
        return DONE
    console = _prepare(verbosity)
    from flows.process_tracks import run_tracks

    summary = run_tracks(job, runner, console)
    from velfield.pipeline.analysis.analyse import analyse_run

    for line in analyse_run(Path(job.root)):
        console.result(line)
    return _conclude(summary, console)


def _conclude(summary: "RunSummary", console: "Console") -> int:
    from velfield.run.layout import is_remote, to_path

    root = to_path(summary.root)
    console.result(f"maps    {root / 'maps'}")
    console.result(f"report  {root / 'index.html'}")
    if is_remote(root):  # `velfield view` shows a folder of this machine
        console.result(f"page    aws s3 sync {shlex.quote(str(root))} RUN && {own_command()} view RUN")
    else:
        console.result(f"page    {own_command()} view {shlex.quote(str(root))}")
    if summary.complete:
        return DONE
    for line in (*summary.footage_lost, *summary.frames_lost[:10]):
        console.warn(line)
    lost_units = sum(len(stage.lost) for stage in summary.stages)
    absent = ", part of the recording is missing" if summary.footage_lost else ""
    console.warn(
        f"{summary.root}: done, but incomplete: {len(summary.frames_lost)} frames and {lost_units} units lost"
        f"{absent}; the report lists them"
    )
    return INCOMPLETE


def _show_plan(job: "Job", runner: "RunnerConfig") -> int:
    from flows.runners import parallel_units
    from velfield.pipeline.check_inputs import validate_inputs
    from velfield.pipeline.estimate import describe_plan
    from velfield.pipeline.plan import make_plan

    plan = make_plan(job)
    validate_inputs(plan)
    print(describe_plan(plan, parallel_units(runner)))
    return DONE


def _clip_list(source: Path, more: tuple[Path, ...], out: Path) -> Path:
    """The list of several clips, written into the run folder."""
    from velfield.run.layout import is_remote, to_path
    from velfield.sources.clips import CLIPS_SUFFIX, write_clip_list

    if is_remote(to_path(out)):
        raise InputError(
            f"{out}: several clips need a list on a local disk; write their paths, one per line, into "
            f"clips{CLIPS_SUFFIX} "
            "and run that file"
        )
    path = out / f"source{CLIPS_SUFFIX}"
    write_clip_list(path, (source, *more))
    return path


def _every(text: str | None) -> int | str | None:
    if text is None or text == "auto":
        return text
    if not text.isdigit() or int(text) < 1:
        raise InputError(f"--every {text}: must be a positive integer, or auto")
    return int(text)


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)


def _verbosity(quiet: bool, verbose: bool, log_json: bool) -> "Verbosity":
    if log_json:
        return "json"
    return "quiet" if quiet else "verbose" if verbose else "normal"


def _warn_of_settings_in_one_line() -> None:
    show = warnings.showwarning

    def showwarning(message: Warning | str, category: type[Warning], *where: Any, **options: Any) -> None:
        if issubclass(category, CacheWarning | IneffectiveSettingWarning | DeviceWarning):
            print(f"velfield: {message}", file=sys.stderr)
        else:
            show(message, category, *where, **options)

    warnings.showwarning = showwarning


def _start() -> int:
    from flows.commands.start import start

    return start(Path.cwd())


def _choices(argument: Argument | None) -> str:
    """Allowed values of an option, in parentheses; empty if it is not one of a set of words."""
    words = get_args(argument.hint) if argument is not None and get_origin(argument.hint) is Literal else ()
    return f" (one of {', '.join(words)})" if words else ""


def _explain_s3(error: Exception) -> str:
    if type(error).__name__ == "NoCredentialsError":
        return (
            "no credentials; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, or a profile (AWS_PROFILE), or give this "
            "machine a role"
        )
    return " ".join(str(error).split())  # no such server, an address that is none


def main() -> None:
    """Run the command; bad input is one clear line, never a traceback."""
    limit_threads()
    as_ctrl_c()
    _warn_of_settings_in_one_line()
    try:
        if not {"--help", "-h", "--version"} & set(sys.argv):
            use_writable_folders()
        options: dict[str, Any] = {"result_action": "return_value", "exit_on_error": False, "print_error": False}
        status = _start() if len(sys.argv) == 1 else app(sys.argv[1:], **options)
    except MissingArgumentError as error:
        chain, missing = " ".join(error.command_chain or ()), error.keyword
        name = f"value for {missing}" if missing else getattr(error.argument, "name", "")
        choices = "" if missing else _choices(error.argument)
        print(
            f"velfield: {chain}: {name} is missing{choices}; see `velfield {chain} --help`",
            file=sys.stderr,
        )
        status = USAGE
    except CycloptsError as error:  # the library's own message is a box of several lines
        print(f"velfield: {' '.join(str(error).split())} `velfield COMMAND --help` lists all", file=sys.stderr)
        status = USAGE
    except InputError as error:
        print(f"velfield: {error}", file=sys.stderr)
        status = BAD_INPUT
    except (BrokenPipeError, SystemExit) as error:  # the reader of our output has closed it: rich, of --help, exits
        if not isinstance(error, BrokenPipeError) and not isinstance(error.__context__, BrokenPipeError):
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = DONE
    except (StoreError, OSError) as error:  # a damaged run; a disk that is full, read-only or gone
        print(f"velfield: {' '.join(str(error).split())}", file=sys.stderr)
        status = BAD_INPUT
    except KeyboardInterrupt:
        leave(STOPPED)
    except Exception as error:
        if type(error).__module__.split(".")[0] not in ("botocore", "aiobotocore"):
            raise
        print(f"velfield: S3: {_explain_s3(error)}", file=sys.stderr)
        status = BAD_INPUT
    sys.exit(status)


if __name__ == "__main__":
    main()
