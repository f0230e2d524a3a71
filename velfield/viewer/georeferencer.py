"""The georeferencing page's server: shows the base image, receives control points, and answers with the fit.

It changes one run, and only when the page's user saves.
"""

import re
from collections.abc import Callable, Sequence
from typing import Any

from starlette.applications import Starlette

from schemas.arrays import GreyImage
from schemas.georeference import ControlPoint, ControlPointsRecord, MarkedPlace, MarkedPoint, MarkedPoints
from velfield.errors import InputError
from velfield.report.viewer_page import render_editor
from velfield.sources.control_points import WGS84, scale_text
from velfield.viewer.editing import editing_app
from velfield.viewer.reference_map import ReferenceMap, TileServer, change_coordinates

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)")
_BRACKETS = "()[] \t\r\n"

Fit = Callable[[Sequence[ControlPoint], int], ControlPointsRecord]
Save = Callable[[Sequence[ControlPoint], int], tuple[ControlPointsRecord, Sequence[str]]]


def georeference_app(
    base_image: GreyImage,
    before: MarkedPoints,
    *,
    title: str,
    fit: Fit,
    save: Save,
    reference: ReferenceMap | TileServer | None = None,
    start: tuple[float, float] | None = None,
) -> Starlette:
    """The server of the page on which a user marks control points.

    Parameters
    ----------
    base_image
        (h, w) uint8, the map.
    before
        The points that the page begins with.
    fit
        Fits the map to points and the EPSG code of their coordinates, and writes nothing.
    save
        The same, and georeferences the run; returns notes for the user too.
    reference
        A map of the user's own, shown beside it to click coordinates on.
    start
        Longitude and latitude that it begins with, where it has no extent; None: not known.

    Raises
    ------
    InputError
        The page is not built.
    """
    height, width = base_image.shape
    origin = reference.origin if isinstance(reference, TileServer) else ""

    def page(token: str) -> str:
        content = {"token": token, "width": width, "height": height, "before": before.model_dump(mode="json")}
        content["map"] = _describe_map(reference, start)
        return render_editor("georeference", title, content, image_origin=origin)

    def image(number: int) -> GreyImage | None:
        return base_image if number == 0 else None

    def answer_fit(body: bytes) -> dict[str, Any]:
        return _describe(fit(*read_marked_points(MarkedPoints.model_validate_json(body))))

    def answer_save(body: bytes) -> dict[str, Any]:
        record, notes = save(*read_marked_points(MarkedPoints.model_validate_json(body)))
        return {**_describe(record), "notes": list(notes)}

    def answer_places(body: bytes) -> dict[str, Any]:
        return {"places": find_places(MarkedPoints.model_validate_json(body))}

    def answer_coordinates(body: bytes) -> dict[str, Any]:
        return {"coordinates": write_coordinates(MarkedPlace.model_validate_json(body))}

    requests = {"/fit": answer_fit, "/save": answer_save}
    if reference is not None:
        requests |= {"/places": answer_places, "/coordinates": answer_coordinates}
    tiles = reference.tile if isinstance(reference, ReferenceMap) else None
    return editing_app(page, image, requests, tiles=tiles, image_origin=origin)


def _describe_map(
    reference: ReferenceMap | TileServer | None, start: tuple[float, float] | None
) -> dict[str, Any] | None:
    """The user's map, for the page."""
    if reference is None:
        return None
    if isinstance(reference, TileServer):
        return {"name": reference.origin, "url": reference.template, "remote": True, "bounds": None, "start": start}
    name, zoom = reference.name, reference.native_zoom
    return {"name": name, "url": "map/{z}/{x}/{y}.png", "remote": False, "bounds": reference.bounds, "zoom": zoom}


def find_places(marked: MarkedPoints) -> list[tuple[float, float] | None]:
    """Longitude and latitude of each point, None where its coordinates are none (yet)."""
    return [_find_place(marked.model_copy(update={"points": (point,)})) for point in marked.points]


def _find_place(marked: MarkedPoints) -> tuple[float, float] | None:
    try:
        ((point,), epsg) = read_marked_points(marked)
        longitude, latitude = change_coordinates(point.x, point.y, epsg, WGS84)
    except InputError:
        return None
    return (longitude, latitude) if abs(longitude) <= 180 and abs(latitude) <= 90 else None


def write_coordinates(place: MarkedPlace) -> str:
    """A place's coordinates as the page's user would type them: degrees to 1 mm, others to 1 mm.

    Raises
    ------
    InputError
        The reference system is not given, or does not cover the place.

    Examples
    --------
    >>> write_coordinates(MarkedPlace(longitude=13.4, latitude=52.5, order="latitude_longitude"))
    '52.50000000, 13.40000000'
    """
    if place.order == "longitude_latitude":
        return f"{place.longitude:.8f}, {place.latitude:.8f}"
    if place.order == "latitude_longitude":
        return f"{place.latitude:.8f}, {place.longitude:.8f}"
    if place.epsg is None:
        raise InputError("found no EPSG code for x, y, expected one such as 32633; fill it in")
    x, y = change_coordinates(place.longitude, place.latitude, WGS84, place.epsg)
    return f"{x:.8f}, {y:.8f}" if abs(x) <= 360 and abs(y) <= 360 else f"{x:.3f}, {y:.3f}"


def _describe(record: ControlPointsRecord) -> dict[str, Any]:
    residuals = [residual.model_dump(mode="json") for residual in record.residuals]
    return {"text": record.text(), "scale": scale_text(record), "residuals": residuals}


def marked_points(record: ControlPointsRecord | None, epsg: int | None) -> MarkedPoints:
    """Points that the page starts with: those of a record, else none, in the reference system ``epsg``."""
    if record is None:
        return MarkedPoints(points=(), order="longitude_latitude" if epsg in (None, WGS84) else "x_y", epsg=epsg)
    points = [MarkedPoint(x_px=p.x_px, y_px=p.y_px, coordinates=f"{p.x!r}, {p.y!r}") for p in record.points]
    order = "longitude_latitude" if record.epsg == WGS84 else "x_y"
    return MarkedPoints(points=tuple(points), order=order, epsg=record.epsg)


def read_marked_points(marked: MarkedPoints) -> tuple[tuple[ControlPoint, ...], int]:
    """Control points and the EPSG code of their coordinates.

    Raises
    ------
    InputError
        Coordinates are not two numbers, or their reference system is not given.

    Examples
    --------
    >>> point = MarkedPoint(x_px=3, y_px=4, coordinates="52.5000, 13.4000")
    >>> read_marked_points(MarkedPoints(points=(point,), order="latitude_longitude"))[0][0].x
    13.4
    """
    if marked.order == "x_y" and marked.epsg is None:
        raise InputError("found no EPSG code for x, y, expected one such as 32633; fill it in")
    points = []
    for number, point in enumerate(marked.points, start=1):
        x, y = _read_coordinates(number, point.coordinates)
        x, y = (y, x) if marked.order == "latitude_longitude" else (x, y)
        points.append(ControlPoint(x_px=point.x_px, y_px=point.y_px, x=x, y=y))
    return tuple(points), WGS84 if marked.epsg is None or marked.order != "x_y" else marked.epsg


def _read_coordinates(number: int, text: str) -> tuple[float, float]:
    """Two numbers, between them a comma, a semicolon or white space: as maps and tables copy them."""
    parts = re.split(r"[\s,;]+", text.strip(_BRACKETS).replace("\N{MINUS SIGN}", "-"))
    if len(parts) != 2 or not all(_NUMBER.fullmatch(part) for part in parts):
        found = repr(text) if text.strip() else "no coordinates"
        raise InputError(
            f"control point {number}: found {found}, expected two decimal numbers such as 13.4050, 52.5200"
        )
    return float(parts[0]), float(parts[1])
