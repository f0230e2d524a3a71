"""Flows as a server runs them: parameters are JSON, each wraps the flow of a command."""

from contextlib import suppress
from itertools import count
from pathlib import Path

from prefect import flow, get_run_logger
from prefect.runtime import flow_run

from flows.artifacts import page_address
from flows.console import Console, print_with_time
from flows.launch import prepare_process
from flows.prefect_flows import end_state, refused
from flows.process_flight import run_flight
from flows.reprocess import run_reprocess
from flows.runners import RunnerConfig, read_runner
from schemas.summary import RunSummary
from velfield.errors import InputError, count_text, one_line
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.plan import OtherFlightError
from velfield.pipeline.watch import find_image, inputs_of, newest_image, run_folders, run_name
from velfield.run.layout import RunLayout, to_path


def _name_of_dropped() -> str:
    return Path(flow_run.parameters["source"]).name


def _name_of_reprocess() -> str:
    given = flow_run.parameters
    return f"{given.get('run') or 'all runs'} on {given.get('base') or 'the newest base image'}"


@flow(name="process-dropped-flight", flow_run_name=_name_of_dropped, persist_result=False)
def process_dropped(source: str, runs: str, cluster: str = "") -> object:
    """Process a flight that was dropped into the watched folder.

    Parameters
    ----------
    source
        A video, a folder of images, or a folder with `frames/` or a video, and beside it the optional inputs of
        `velfield run`: `base.*`, `labels.csv`, `timestamps.csv`, `detector.json`, `flight.yaml`.
    runs
        Folder of run folders, which may be on ``s3://``.
    cluster
        Cluster file, as for `velfield run --cluster`. Default: the threads of this process.
    """
    prepare_process(verbose=False)
    try:
        summary = _run_dropped(Path(source), Path(runs), _runner(cluster))
    except InputError as error:  # in the terminal too: else nothing there follows "has arrived"
        print_with_time(f"{Path(source).name} failed: {error}")
        return refused(error)
    except Exception as error:
        print_with_time(f"{Path(source).name} failed: {one_line(error)}")
        raise
    for line in summary.frames_lost:
        get_run_logger().warning(line)
    lost = "" if summary.complete else f", but {summary.loss}"
    report = RunLayout(Path(summary.root)).report
    _tell(f"{Path(source).name} is done{lost}: {page_address(report) or report.as_uri()}")
    return summary.root if summary.complete else end_state(summary)


@flow(name="reprocess-runs", flow_run_name=_name_of_reprocess, persist_result=False)
def reprocess_runs(runs: str, base_images: str, base: str = "", run: str = "", cluster: str = "") -> object:
    """Reprocess one run, or all, on a new base image; runs of another place are left unchanged.

    Parameters
    ----------
    runs
        Folder of run folders, which may be on ``s3://``.
    base_images
        Folder that base images arrive in; no other is read.
    base
        Name of the image. Default: the newest.
    run
        Name of the run. Default: all.
    cluster
        Cluster file. Default: the threads of this process.
    """
    prepare_process(verbose=False)
    try:
        return _reprocess(to_path(runs), Path(base_images), base, run, _runner(cluster))
    except InputError as error:
        print_with_time(f"reprocessing failed: {error}")
        return refused(error)


def _reprocess(runs: Path, base_images: Path, base: str, run: str, runner: RunnerConfig) -> list[str]:
    logger = get_run_logger()
    image = find_image(base_images, base) if base else newest_image(base_images)
    if image is None:
        logger.info("no base image has arrived in %s", base_images)
        return []
    results, made, unchanged = [], 0, 0
    for root in run_folders(runs, run):
        try:
            folder, summary = run_reprocess(root, image, runner=runner, console=Console("quiet"))
            results.append(str(folder))
            made += summary is not None
        except InputError as error:
            if run:
                raise
            unchanged += 1
            logger.warning("%s is unchanged: %s", root.name, error)
    text = f"{image.name}: {count_text(made, 'result')} made, {len(results) - made} already there, "
    text += f"{count_text(unchanged, 'run')} unchanged"
    _tell(text)
    return results


def _tell(text: str) -> None:
    """A line in the terminal and in the log of the flow run, where that of the runs that it started is not shown."""
    print_with_time(text)
    get_run_logger().info("%s", text)


def _runner(cluster: str) -> RunnerConfig:
    return read_runner(Path(cluster)) if cluster else RunnerConfig()


def _run_dropped(drop: Path, runs: Path, runner: RunnerConfig) -> RunSummary:
    """Process a flight in the folder of its name; with a number behind it where another flight of that name was there,
    as drones name the first clip of every card alike."""
    from schemas.job import Job

    inputs, config = inputs_of(drop)
    for number in count(1):
        name = run_name(drop) if number == 1 else f"{run_name(drop)}-{number}"
        job = Job(root=str(RunLayout(runs / name).root), inputs=inputs, config=resolve_config(file=config))
        with suppress(OtherFlightError):
            return run_flight(job, runner, Console("quiet"))
    raise AssertionError("the numbers do not end")
