"""Flows as a server runs them: parameters are JSON, each wraps the flow of a command."""

from contextlib import suppress
from itertools import count
from pathlib import Path

from prefect import flow, get_run_logger

from flows.artifacts import page_address
from flows.console import Console, print_with_time
from flows.launch import prepare_process
from flows.prefect_flows import end_state
from flows.process_flight import run_flight
from flows.reprocess import run_reprocess
from flows.runners import RunnerConfig, read_runner
from schemas.summary import RunSummary
from velfield.errors import InputError, one_line
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.plan import OtherFlightError
from velfield.pipeline.watch import find_image, inputs_of, newest_image, run_folders, run_name
from velfield.run.layout import RunLayout, to_path


@flow(name="process-dropped-flight", flow_run_name="{source}", persist_result=False)
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
    except Exception as error:  # in the terminal too: else nothing there follows "has arrived"
        why = str(error) if isinstance(error, InputError) else one_line(error)
        print_with_time(f"{Path(source).name} failed: {why}")
        raise
    for line in summary.frames_lost:
        get_run_logger().warning(line)
    lost = "" if summary.complete else f", but {summary.loss}"
    report = RunLayout(Path(summary.root)).report
    print_with_time(f"{Path(source).name} is done{lost}: {page_address(report) or report.as_uri()}")
    return summary.root if summary.complete else end_state(summary)


@flow(name="reprocess-runs", flow_run_name="{base}", persist_result=False)
def reprocess_runs(runs: str, base_images: str, base: str = "", run: str = "", cluster: str = "") -> list[str]:
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
    logger = get_run_logger()
    image = find_image(Path(base_images), base) if base else newest_image(Path(base_images))
    if image is None:
        logger.info("no base image has arrived in %s", base_images)
        return []
    made, refused = [], []
    for root in run_folders(to_path(runs), run):
        try:
            folder, _ = run_reprocess(root, image, runner=_runner(cluster), console=Console("quiet"))
            made.append(str(folder))
        except InputError as error:
            if run:
                raise
            refused.append(root.name)
            logger.warning("%s is unchanged: %s", root.name, error)
    print_with_time(f"{image.name}: {len(made)} results made, {len(refused)} runs unchanged")
    logger.info("%s: %d results made, %d runs unchanged", image.name, len(made), len(refused))
    return made


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
