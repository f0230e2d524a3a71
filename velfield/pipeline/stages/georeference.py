"""Stage ``georeference``: scale, north and place of the base image, by every source that knows them.

The base image's reference system, ``--gsd-m``, ground control points and the camera's telemetry are compared; the
record says which one is used, what the others give, and where they disagree. The stage ``scale`` does it again with the
lengths of the vehicles, once they are tracked. `read_grid` puts the record over the grid, so that everything after
these stages, and every export, has metres and coordinates.
"""

from pathlib import Path

import numpy as np

from schemas.flight import FramesConfig
from schemas.georeference import ControlPointsRecord, FlightStart, GeoreferenceRecord
from schemas.records import GridRecord
from schemas.scale import ScaleEstimate
from velfield.errors import Failure
from velfield.exports.gis.cog import write_cog
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import StageResult, advance
from velfield.pipeline.stages.labels import base_px_per_raw_px
from velfield.registration.transforms import FrameMap
from velfield.run.commits import digest_bytes, write_record
from velfield.run.frame_transforms import (
    FrameTransforms,
    georeference_update,
    north_direction_rad,
    read_base_image,
    read_own_grid,
)
from velfield.run.layout import RunLayout
from velfield.run.stores import FrameStore, RegistrationStore
from velfield.sources.capture_times import read_flight_start
from velfield.sources.clips import read_clips_telemetry
from velfield.sources.geo import reconcile_gsd
from velfield.sources.scale import choose_scale
from velfield.sources.telemetry.find import note_unusable
from velfield.sources.telemetry.placement import (
    FramePoses,
    North,
    Place,
    estimate_north,
    estimate_place,
    estimate_scale,
)
from velfield.sources.telemetry.read import NOT_READ, read_telemetry
from velfield.sources.telemetry.telemetry import Telemetry

_MAX_FRAMES = 200
_CRS_SD = 0.005
_Z90 = 1.645
_POINTS = ["N", "NNE", "NE", "ENE", "E", "ESE", "SE", "SSE", "S", "SSW", "SW", "WSW", "W", "WNW", "NW", "NNW"]
_MIN_NORTH_DEG = 5.0
"""Smaller differences between the base image's north and the compass are not remarked on."""
_MIN_POSITION_M = 15.0
_MAX_LOG_SCALE = 0.1
"""Beyond this logarithm of the scale, the ground sample distances of base image and frames must not be confused."""


def georeference_run(plan: Plan) -> StageResult:
    """Write ``base/georeference.json``; and the base image as GeoTIFF where its place became known here.

    Raises
    ------
    InputError
        ``--gsd-m`` contradicts the base image's own reference system.
    """
    layout, grid = plan.layout, read_own_grid(plan.layout)
    layout.scale.unlink(missing_ok=True)  # its stage follows
    record, notes = compare_sources(plan, grid)
    used = record.scale.used
    if used is not None and used.source == "metadata":
        from velfield.pipeline.stages.car_size import contradict_metadata

        found = contradict_metadata(plan, used)
        if found is not None:
            record, notes = compare_sources(plan, grid, found)
    outputs = write_georeference(layout, layout.georeference, record, plan.config.frames)
    advance("georeference")
    notes = [*describe(record), *notes, *_gsd_of_frames(plan, grid)]
    return StageResult(outputs, georeference_counts(record), notes, georeference_warnings(record))


def compare_sources(
    plan: Plan, grid: GridRecord, measured: ScaleEstimate | None = None
) -> tuple[GeoreferenceRecord, list[str]]:
    """Combine all sources, with notes on what they do not give; ``measured``: the scale by the lengths of vehicles.

    Raises
    ------
    InputError
        ``--gsd-m`` contradicts the base image's own reference system.
    """
    reconcile_gsd(grid.gsd_m, plan.config.gsd_m)
    points, remarks = saved_control_points(plan.layout)
    estimates = [*scale_by_grid(grid), *_given_scale(plan.config.gsd_m), *([] if measured is None else [measured])]
    estimates += [] if points is None else [scale_of_points(points)]
    poses = _frame_poses(plan)
    scale = poses if isinstance(poses, Failure) else estimate_scale(poses)
    estimates += [scale] if isinstance(scale, ScaleEstimate) else []
    described = poses.reason if isinstance(poses, Failure) else poses.telemetry.origin
    record = GeoreferenceRecord(scale=choose_scale(estimates), telemetry=described, start=_start(plan))
    unusable = note_unusable(Path(plan.job.inputs.source)) if plan.job.inputs.telemetry is None else ""
    notes = [unusable] if unusable else []
    notes += [] if isinstance(poses, Failure) else _missing(scale, poses)
    if points is not None:
        record = with_control_points(record, points)
    if isinstance(poses, FramePoses):
        record, more = _with_telemetry(record, poses, grid)
        notes += more
    return record.model_copy(update={"remarks": (*record.remarks, *remarks)}), notes


def _gsd_of_frames(plan: Plan, grid: GridRecord) -> list[str]:
    """A note where ``--gsd-m`` is of a given base image whose pixels are not as large as the frames'."""
    given_m = plan.config.gsd_m
    if given_m is None or grid.base_source == "flight" or grid.gsd_m is not None:
        return []
    scale = base_px_per_raw_px(plan)
    if abs(np.log(scale)) <= _MAX_LOG_SCALE:
        return []
    frame_gsd = f"that of the frames is {given_m * scale:.3g} m"
    return [f"--gsd-m {given_m:g} is the ground sample distance of the base image, {frame_gsd}"]


def scale_by_grid(grid: GridRecord) -> list[ScaleEstimate]:
    """The scale by the base image's own reference system, where it has one."""
    if grid.gsd_m is None:
        return []
    low, high = grid.gsd_m * (1 - _CRS_SD), grid.gsd_m * (1 + _CRS_SD)
    return [ScaleEstimate(gsd_m=grid.gsd_m, low_m=low, high_m=high, source="base")]


def _given_scale(given_m: float | None) -> list[ScaleEstimate]:
    return [] if given_m is None else [ScaleEstimate(gsd_m=given_m, low_m=given_m, high_m=given_m, source="given")]


def saved_control_points(layout: RunLayout) -> tuple[ControlPointsRecord | None, tuple[str, ...]]:
    """The control points of this base image, and a remark where there are some of another."""
    if not layout.control_points.exists():
        return None, ()
    points = ControlPointsRecord.model_validate_json(layout.control_points.read_bytes())
    if points.base_digest == base_digest(layout):
        return points, ()
    return None, (
        "the control points are of a base image that is no longer there, and are not used; give them once more with "
        "`velfield georeference`",
    )


def base_digest(layout: RunLayout) -> str:
    """Digest of the base image's pixels' file: of the flight's own where there is one."""
    path = layout.base_image if layout.base_image.exists() else layout.base_image_tif
    return digest_bytes(path.read_bytes())


def scale_of_points(points: ControlPointsRecord) -> ScaleEstimate:
    """The scale by control points; at least half a per cent wide."""
    half = max(_Z90 * points.gsd_sd_m, _CRS_SD * points.gsd_m)
    return ScaleEstimate(
        gsd_m=points.gsd_m,
        low_m=max(points.gsd_m - half, points.gsd_m / 2),
        high_m=points.gsd_m + half,
        source="control_points",
        note=points.text(),
    )


def with_control_points(record: GeoreferenceRecord, points: ControlPointsRecord) -> GeoreferenceRecord:
    """The record with the place by control points."""
    return record.model_copy(
        update={
            "place_source": "control_points",
            "crs_wkt": points.crs_wkt,
            "affine": points.affine,
            "north_sd_deg": points.north_sd_deg,
            "position_sd_m": points.left_out_rms_m if points.left_out_rms_m is not None else points.rms_m,
        }
    )


def _start(plan: Plan) -> FlightStart | None:
    """When the run's first frame was taken."""
    given, times_s = plan.job.inputs.telemetry, FrameStore(plan.layout.frames).column("time_s")
    start = read_flight_start(Path(plan.job.inputs.source), plan.info, Path(given) if given else None)
    if start is None or not len(times_s):
        return None
    return start.model_copy(update={"clock_s": start.clock_s + float(times_s[0] - plan.info.times_s[0])})


def _frame_poses(plan: Plan) -> FramePoses | Failure:
    source, given = Path(plan.job.inputs.source), plan.job.inputs.telemetry
    if plan.info.parts and not given:
        telemetry = read_clips_telemetry(plan.info)
    else:
        telemetry = read_telemetry(source, plan.info, Path(given) if given else None)
    if isinstance(telemetry, Failure):
        return telemetry
    transforms = FrameTransforms.open(plan.layout, plan.config)
    statuses = RegistrationStore(plan.layout.registration).statuses()
    registered = [frame for frame, status in enumerate(statuses) if status == "ok"]
    chosen = [registered[k] for k in np.unique(np.linspace(0, len(registered) - 1, _MAX_FRAMES).astype(int))]
    times_s = FrameStore(plan.layout.frames).column("time_s")
    maps = [(frame, found) for frame in chosen if (found := transforms.transform(frame)) is not None]
    if not maps:
        return Failure("no frame is registered")
    at = telemetry.at(np.array([times_s[frame] for frame, _ in maps]) - plan.info.times_s[0])
    return _poses(at, [found for _, found in maps])


def _poses(telemetry: Telemetry, maps: list[FrameMap]) -> FramePoses:
    width, height = maps[0].width, maps[0].height
    step = min(width, height) / 8  # the mean over the middle: vibration within a frame does not show
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    around = centre + step * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    base = np.stack([found.to_base(around) for found in maps])
    jacobian = np.stack([base[:, 1] - base[:, 2], base[:, 3] - base[:, 4]], axis=2) / (2 * step)
    return FramePoses(telemetry, width, height, base[:, 0], jacobian)


def _missing(scale: ScaleEstimate | Failure, poses: FramePoses) -> list[str]:
    found = [] if isinstance(scale, ScaleEstimate) else [f"no scale by the metadata: {scale.reason}"]
    return [*found, *poses.telemetry.notes]


def _with_telemetry(
    record: GeoreferenceRecord, poses: FramePoses, grid: GridRecord
) -> tuple[GeoreferenceRecord, list[str]]:
    """The record with north and place by telemetry where nothing better gives them; notes; and remarks where they do
    and disagree."""
    north = estimate_north(poses)
    if isinstance(north, Failure):
        return record, [f"no north by the metadata: {north.reason}"]
    crs_grid = grid if record.crs_wkt is None else grid.model_copy(update=georeference_update(record))
    if crs_grid.crs_wkt is not None:
        return record.model_copy(update={"remarks": tuple(_contradictions(crs_grid, poses, north))}), []
    update: dict[str, object] = {"north_rad": north.direction_rad, "north_sd_deg": north.sd_deg}
    notes = []
    if record.scale.used is not None:
        place = estimate_place(poses, record.scale.used.gsd_m, north)
        if isinstance(place, Place):
            update |= {
                "place_source": "metadata",
                "position_sd_m": place.sd_m,
                "crs_wkt": place.crs_wkt,
                "affine": place.affine,
            }
        else:
            notes.append(f"no place by the metadata: {place.reason}")
    return record.model_copy(update=update), notes


def _contradictions(grid: GridRecord, poses: FramePoses, north: North) -> list[str]:
    """Contradictions between the camera's telemetry and the position of the map, one line each."""
    known_rad = north_direction_rad(grid)
    if known_rad is None or grid.gsd_m is None or grid.affine is None:
        return []
    turned_deg = float(np.degrees(np.angle(np.exp(1j * (north.direction_rad - known_rad)))))
    found = []
    if abs(turned_deg) > max(3 * north.sd_deg, _MIN_NORTH_DEG):
        found.append(f"north by the metadata is {turned_deg:+.0f}° off the map's (clockwise): check the map's place")
    place = estimate_place(poses, grid.gsd_m, north)
    if isinstance(place, Place) and place.crs_wkt == grid.crs_wkt:
        corner = np.array([grid.width_px / 2, grid.height_px / 2, 1.0])
        there, here = (np.reshape(affine, (2, 3)) @ corner for affine in (place.affine, grid.affine))
        distance_m = float(np.linalg.norm(there - here))
        if distance_m > max(3 * place.sd_m, _MIN_POSITION_M):
            found.append(f"the camera was {distance_m:.0f} m from where the map puts it: check the map's place")
    return found


def write_georeference(layout: RunLayout, path: Path, record: GeoreferenceRecord, frames: FramesConfig) -> list[Path]:
    """Write the record, and the base image as GeoTIFF where it was built from the flight and its place is known."""
    outputs = [path]
    grid = read_own_grid(layout)
    if grid.crs_wkt is None and layout.base_image.exists():
        layout.base_image_tif.unlink(missing_ok=True)
        grey = read_base_image(layout, frames)
        if record.crs_wkt is not None and record.affine is not None:
            outputs.append(layout.base_image_tif)
            write_cog(outputs[-1], [grey], names=["grey"], units=["1"], crs_wkt=record.crs_wkt, affine=record.affine)
    write_record(path, record)
    return outputs


def georeference_counts(record: GeoreferenceRecord) -> dict[str, float]:
    """The counts of the stage's commit record."""
    used = record.scale.used
    counts = {"placed": float(record.crs_wkt is not None), "north": float(record.north_rad is not None)}
    return counts if used is None else {**counts, "gsd_m": used.gsd_m, f"by_{used.source}": 1.0}


def compass_text(bearing_deg: float) -> str:
    """A bearing, degrees clockwise from north, for people.

    Examples
    --------
    >>> compass_text(-26.0), compass_text(359.96)
    ('334.0° (NNW)', '0.0° (N)')
    """
    bearing_deg = round(bearing_deg, 1) % 360
    return f"{bearing_deg:.1f}° ({_POINTS[round(bearing_deg / 22.5) % 16]})"


def describe(record: GeoreferenceRecord) -> list[str]:
    """Describe the estimates that are used and those of the other sources, one line each."""
    used = record.scale.used
    lines = [] if used is None else [f"scale: {used.text()}{f' ({used.note})' if used.note else ''}"]
    lines += [f"scale, not used: {other.text()}" for other in record.scale.others]
    if record.north_rad is not None and record.north_sd_deg is not None:
        top = compass_text(float(-90 - np.degrees(record.north_rad)))
        lines.append(f"north: the map's top is {top}, standard deviation {record.north_sd_deg:.1f}°")
    if record.place_source is not None and record.position_sd_m is not None:
        by = {"control_points": "control points", "metadata": "the metadata", "base": "the base image"}
        lines.append(f"place: by {by[record.place_source]}, to about {record.position_sd_m:.1f} m")
    return [*lines, f"metadata: {record.telemetry}"] if NOT_READ in record.telemetry else lines


def georeference_warnings(record: GeoreferenceRecord) -> list[str]:
    """Disagreements, one line each."""
    return [*record.scale.disagreements, *record.remarks]
