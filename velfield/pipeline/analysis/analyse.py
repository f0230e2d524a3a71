"""`analyse_run`, `analyse_tracks`: answers from the tracks of a run, or of another program, written into a folder."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np

from schemas.analysis import AnalysisColumn, AnalysisRecord, AnalysisTable, QuestionRecord
from schemas.arrays import GreyImage
from schemas.export import SpeedUnit
from schemas.flight import PAPER_GSD_M, FlightConfig, FramesConfig
from velfield.analysis.answers import explain_none, find_answers
from velfield.analysis.movements.gates import ArmNames
from velfield.analysis.movements.time_slices import SLICE_S
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.analysis.trajectories import make_trajectories, moving, read_ids
from velfield.analysis.vehicle_classes import find_classes
from velfield.errors import InputError
from velfield.exports.georeference import Georeference
from velfield.pipeline.analysis.clips import Frames, unusual_clips
from velfield.pipeline.analysis.lanes_record import lanes_geojson, lanes_record, map_names
from velfield.pipeline.analysis.tables import all_tables
from velfield.pipeline.analysis.workbook import workbook_bytes
from velfield.pipeline.given_tracks.load import SIZE_SD_M, load_tracks
from velfield.report.traffic.diagrams import traffic_diagrams
from velfield.report.traffic.first_page import first_page
from velfield.report.traffic.report import report_html, report_pdf
from velfield.run.commits import code_version, read_commits, record_analysis, write_atomically, write_record
from velfield.run.flight_record import read_flight_record, source_name
from velfield.run.frame_transforms import read_georeference
from velfield.run.layout import RunLayout, remove_tree, to_path
from velfield.run.lock import locked
from velfield.run.run import Run, open_run
from velfield.sources.tracks.formats import Unit, YAxis

TRACKS = "tracks"
"""The stage whose results are analysed."""
MAX_LINES = 12


def analyse_run(
    run_folder: Path,
    *,
    slice_s: float = SLICE_S,
    speed_unit: SpeedUnit = "km/h",
    arms: Mapping[str, str] | None = None,
) -> Iterator[str]:
    """Analyse the tracks of a run and write ``analysis/`` into its folder; a line for people on each question.

    Parameters
    ----------
    arms
        The user's names of arms (`velfield.analysis.movements.gates.ArmNames`).

    Raises
    ------
    InputError
        The folder is not a run folder, its tracks are not computed, another process writes into it, or there is no such
        arm.
    """
    _check_slice(slice_s)
    run = open_run(run_folder)
    run.require_frames()
    with locked(run.layout):
        yield from _stale_lines(run.layout)
        if run.grid.gsd_m is None:
            yield (
                f"warning     the size of a pixel of {run.layout.root} is not known: speeds and lengths are those of "
                f"the paper's {PAPER_GSD_M} m a pixel, and wrong by as much as that is; counts hold. Run the flight "
                "again with --gsd-m"
            )
        traffic = run.analysis.traffic
        yield from write_analysis(
            replace(traffic, slice_s=slice_s, arm_names=replace(traffic.arm_names, given=arms or {})),
            run.layout.analysis,
            Georeference.from_grid(run.grid),
            about=_about(run),
            gsd_known=run.grid.gsd_m is not None,
            picture=run.base_image,
            frames=_frames(run),
            speed_unit=speed_unit,
        )
        record_analysis(run.layout, slice_s=slice_s)


def _about(run: Run) -> str:
    """The source, when it was filmed, and the scale with its interval."""
    source, place = run.record.inputs.source, read_georeference(run.layout)
    known = (place.start, place.scale.used) if place else ()
    return ", ".join([source_name(source.path, source.kind), *(one.text() for one in known if one is not None)])


def _frames(run: Run) -> Frames | None:
    """The frames of a run; None of one that was made of tracks."""
    if not run.has_frames:
        return None
    return Frames(run.times_s, run.frames.read, run.frame_transforms.transform)


def _stale_lines(layout: RunLayout) -> Iterator[str]:
    """A line where the tracks are of other settings, or inputs, than the run's latest."""
    record, commits = read_flight_record(layout.root), read_commits(layout, TRACKS)
    if not commits:
        raise InputError(
            f"{layout.root}: the run has no tracks yet; finish it by running the same `velfield run` command again"
        )
    key = record.keys.get(TRACKS)
    if key is not None and any(commit.key != key for commit in commits):
        yield (
            f"warning     the tracks in {layout.root} are older than its settings, or units were lost before them: "
            "these answers are of the earlier tracks; run `velfield run` with this folder to the end"
        )


def analyse_tracks(
    path: Path,
    out: Path,
    *,
    gsd_m: float | None,
    fps: float | None,
    unit: Unit | None,
    y_axis: YAxis | None,
    slice_s: float = SLICE_S,
    speed_unit: SpeedUnit = "km/h",
    arms: Mapping[str, str] | None = None,
) -> Iterator[str]:
    """Analyse the tracks of another program and write the answers into ``out``.

    Raises
    ------
    InputError
        As `load_tracks`, or there is no such arm.
    """
    _check_slice(slice_s)
    config = FlightConfig(gsd_m=gsd_m, position_unit=unit, position_y_axis=y_axis, frames=FramesConfig(fps=fps))
    given = load_tracks(path, config)
    yield from (f"tracks      {note}" for note in given.notes)
    table = given.table
    ids, frames = table["track_id"].to_numpy(np.int64), table["frame"].to_numpy(np.int64)
    time_s = table["time_s"].to_numpy(np.float64)
    made = make_trajectories(ids, frames, time_s, given.xy_m, gsd_m=given.gsd_m, position_sd_m=given.position_sd_m)
    source_id = read_ids(given.names.index.to_numpy(np.int64), given.names.tolist())
    made = replace(made, seen_s=made.window_s, source_id=source_id)  # the time with those that stand
    tracks = moving(
        replace(made, measured_length_m=given.sizes_m(made.track_id)[:, 0]) if "length_m" in table else made
    )
    sizes_m = given.sizes_m(tracks.track_id)
    classes = find_classes(sizes_m, np.where(np.isfinite(sizes_m), SIZE_SD_M, np.nan)) if len(tracks) else None
    georeference = Georeference(given.shape, given.crs_wkt, given.affine, given.gsd_m, given.north_rad)
    yield from write_analysis(
        TrafficAnalysis(tracks, slice_s, classes=classes, arm_names=ArmNames(given.north_rad, arms or {})),
        to_path(out),
        georeference,
        about=path.name,
        gsd_known=True,
        picture=None,
        speed_unit=speed_unit,
    )


def _check_slice(slice_s: float) -> None:
    if not slice_s > 0:
        raise InputError(f"--slice-s {slice_s:g}: must be a positive number of seconds")


def _check_names(analysis: TrafficAnalysis) -> None:
    """Refuse a name of the user's for an arm that there is not, or that another arm of the place has."""
    given = analysis.arm_names.given
    places = {f"{found.junction.number}.": found.gates.arms for found in analysis.movements}
    places[""] = analysis.scene.arms if analysis.scene else ()
    for place, arms in places.items():
        names = [arm.name for arm in arms]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise InputError(f"--arm: two arms would be {twice[0]!r}; give each arm a name of its own")
        given = {key: name for key, name in given.items() if not (key.startswith(place) and name in names)}
    if given:
        unnamed = replace(analysis, arm_names=replace(analysis.arm_names, given={}))
        known = [f"{m.junction.number}.{arm.name}" for m in unnamed.movements for arm in m.gates.arms]
        known += [arm.name for arm in unnamed.scene.arms] if unnamed.scene else []
        raise InputError(f"--arm {next(iter(given))}: there is no such arm; there are {', '.join(known) or 'none'}")


def write_analysis(
    analysis: TrafficAnalysis,
    out: Path,
    georeference: Georeference,
    *,
    about: str,
    gsd_known: bool,
    picture: GreyImage | None,
    frames: Frames | None = None,
    speed_unit: SpeedUnit = "km/h",
) -> Iterator[str]:
    """Write lanes, tables, report and workbook, and strips of pictures of unusual tracks; a line on each."""
    analysis.answer_all()
    _check_names(analysis)
    gsd_m = analysis.trajectories.gsd_m
    lanes = lanes_record(analysis, speed_unit)
    write_record(out / "lanes.json", lanes, indent=None)
    write_atomically(out / "lanes.geojson", lanes_geojson(lanes, georeference).encode())
    clips = dict(unusual_clips(analysis, frames)) if frames else {}
    remove_tree(out / "clips")  # of an earlier analysis
    for number, data in clips.items():
        write_atomically(out / clip_name(number), data)
    page = first_page(analysis, unit=speed_unit)
    record = AnalysisRecord(
        code_version=code_version(),
        about=about,
        gsd_m=gsd_m,
        gsd_known=gsd_known,
        duration_s=round(analysis.trajectories.duration_s, 3),
        tracks=len(analysis.trajectories),
        seen=page.seen,
        directions=analysis.arm_names.legend,
        names=tuple(map_names(analysis)),
        answers=tuple(QuestionRecord(question=question, lines=lines) for question, lines in page.sections),
        tables=tuple(
            _with_clips(_explain_empty(table, analysis), clips) for table in all_tables(analysis, unit=speed_unit)
        ),
    )
    write_record(out / "analysis.json", record, indent=None)
    yield from answer_lines(analysis, unit=speed_unit)
    diagrams = list(traffic_diagrams(analysis, picture, unit=speed_unit))
    write_atomically(out / "report.html", report_html(record, page, diagrams, clips).encode())
    write_atomically(out / "report.pdf", report_pdf(record, page, diagrams))
    yield f"report      {out / 'report.html'}; to print: {out / 'report.pdf'}"
    write_atomically(out / "analysis.xlsx", workbook_bytes(record))
    yield f"workbook    {out / 'analysis.xlsx'}"


def answer_lines(analysis: TrafficAnalysis, *, unit: SpeedUnit = "km/h") -> Iterator[str]:
    """A line for each answer, `MAX_LINES` of a topic: those with the most vehicles; then what N stands for."""
    for topic, group in groupby(find_answers(analysis, unit=unit), key=lambda answer: answer.topic):
        found = list(group)
        for answer in found[:MAX_LINES]:
            yield f"{topic:11} {answer.subject}{': ' if answer.subject else ''}{answer.text}"
        if len(found) > MAX_LINES:
            yield f"{'':11} and {len(found) - MAX_LINES} more"
    yield f"directions  {analysis.arm_names.legend}"


def _explain_empty(table: AnalysisTable, analysis: TrafficAnalysis) -> AnalysisTable:
    """An empty table with the reason in its note; others as they are."""
    if table.rows:
        return table
    return table.model_copy(update={"note": f"{explain_none(table.name, analysis)} {table.note}".strip()})


def clip_name(number: int) -> str:
    """File of an unusual track's strip, in ``analysis/``.

    Examples
    --------
    >>> clip_name(3)
    'clips/unusual-003.jpg'
    """
    return f"clips/unusual-{number:03d}.jpg"


def _with_clips(table: AnalysisTable, clips: Mapping[int, bytes]) -> AnalysisTable:
    """The table of unusual tracks with the files of their strips; others as they are."""
    if table.name != "unusual" or not clips:
        return table
    rows = tuple(
        row.model_copy(update={"cells": {**row.cells, "clip": clip_name(k) if k in clips else None}})
        for k, row in enumerate(table.rows)
    )
    column = AnalysisColumn(name="clip", title="Pictures")
    return table.model_copy(update={"rows": rows, "columns": (*table.columns, column)})
