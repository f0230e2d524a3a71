"""``velfield georeference``: put a finished run's map on Earth by ground control points, of a file or of a page."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from flows.options import OpenBrowser, Port, RunFolder
from schemas.georeference import ControlPoint, ControlPointsRecord

if TYPE_CHECKING:
    from starlette.applications import Starlette

    from velfield.run.run import Run

Model = Literal["similarity", "affine"]


def georeference(
    run_folder: RunFolder,
    /,
    *,
    points: Path | None = None,
    epsg: int | None = None,
    model: Model | None = None,
    map_: Annotated[str | None, Parameter(name="--map")] = None,
    check: Annotated[bool, Parameter(negative=())] = False,
    port: Port = None,
    open_browser: OpenBrowser = True,
) -> int:
    """Georeference a finished run by three or more ground control points; no frame is registered again.

    Afterwards the maps, exports and page have coordinates, metres and north. Without --points a page in the browser
    opens, on which you click the points.

    Parameters
    ----------
    points
        CSV `x_px,y_px,longitude,latitude`, or `x_px,y_px,x,y` with --epsg; a column `name` is optional.
        Pixels are those of the map, as the page shows them. Default: click the points in the browser.
    epsg
        EPSG code of the reference system of `x,y`, such as 32633.
    model
        Transform to fit. Default: a similarity.
        With six or more points an affine transform, if its error at left-out points is smaller.
    map_
        Your own map, shown next to the run's in the page to click coordinates on. Nothing else is loaded.
        GeoTIFF, MBTiles of images, or a tile server, such as https://HOST/{z}/{x}/{y}.png.
    check
        Print the residuals of --points and change nothing.
    """
    from velfield.errors import InputError
    from velfield.pipeline.georeference import fit_run_points
    from velfield.pipeline.georeference import georeference as georeference_run
    from velfield.run.run import open_run
    from velfield.sources.control_points import read_control_points, residual_table

    if points is None:
        from flows.commands.view import serve_until_interrupted

        if check:
            raise InputError("--check needs --points; the page shows residuals itself")
        app = page_app(run_folder, epsg, model, map_)
        serve_until_interrupted(app, port=port, open_browser=open_browser, place=run_folder, purpose="control points")
        return 0
    if map_ is not None:
        raise InputError("--map cannot be combined with --points: the map is for clicking points in the page")
    read, code = read_control_points(points, epsg)
    if check:
        print(residual_table(fit_run_points(open_run(run_folder), read, code, model)))
        return 0
    done = georeference_run(run_folder, read, code, model)
    print(residual_table(done.points))
    for line in done.all_notes():
        print(f"note: {line}")
    print(f"map     {run_folder / 'maps'}")
    return 0


def page_app(run_folder: Path, epsg: int | None, model: Model | None, given_map: str | None = None) -> "Starlette":
    """The server of the page for a run, with a map to click on where one is given."""
    from velfield.pipeline.georeference import fit_run_points, open_finished_run
    from velfield.pipeline.georeference import georeference as georeference_run
    from velfield.pipeline.stages.georeference import saved_control_points
    from velfield.viewer.georeferencer import georeference_app, marked_points
    from velfield.viewer.reference_map import open_map

    run = open_finished_run(run_folder)

    def fit(points: Sequence[ControlPoint], code: int) -> ControlPointsRecord:
        return fit_run_points(run, points, code, model)

    def save(points: Sequence[ControlPoint], code: int) -> tuple[ControlPointsRecord, Sequence[str]]:
        done = georeference_run(run_folder, points, code, model)
        return done.points, done.all_notes()

    before = marked_points(saved_control_points(run.layout)[0], epsg)
    title = f"Control points of {run_folder.name or run_folder}"
    reference = None if given_map is None else open_map(given_map)
    start = None if reference is None else _find_centre(run)
    return georeference_app(run.base_image, before, title=title, fit=fit, save=save, reference=reference, start=start)


def _find_centre(run: "Run") -> tuple[float, float] | None:
    """Longitude and latitude of the middle of the run's map, where it has coordinates already."""
    import numpy as np

    from velfield.exports.georeference import Georeference

    place = Georeference.from_grid(run.grid)
    if not place.has_crs:
        return None
    ((longitude, latitude),) = place.to_lonlat(np.array([[run.grid.width_px / 2, run.grid.height_px / 2]]))
    return float(longitude), float(latitude)
