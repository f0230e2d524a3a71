"""Maps of modal direction and speed, as figures and as layers for GIS; and the data of the viewer."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray, Mask
from velfield.exports.gis.cog import write_cog
from velfield.field.segments import stationary_speed_px_per_s
from velfield.field.statistics import direction_rad, speed_px_per_s
from velfield.parallel import parallel_map
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import StageResult, advance
from velfield.report.figures import MapScale, direction_figure, png_bytes, speed_figure
from velfield.report.quality_figures import registration_error_figure, undistortion_figure
from velfield.run.commits import write_atomically
from velfield.run.frame_transforms import heading_deg, north_direction_rad, read_base_image, read_grid, read_lens
from velfield.run.stores import FieldStore, FrameStore, RegistrationStore
from velfield.sources.geo import ignore_missing_georeference
from velfield.viewer.record import write_view_data

PREVIEW_SIDE_PX = 900
_FULL_PX = 1.0
"""Maximum of the colour scale of the error map."""


def make_maps(plan: Plan) -> StageResult:
    """Write ``maps/``: direction and speed as PNG and as GeoTIFF, previews of both for the Prefect UI; and the viewer's
    data beside the tiles of the field."""
    grid, config, layout = read_grid(plan.layout), plan.config.field, plan.layout
    slow = stationary_speed_px_per_s(config, grid.gsd_m)
    scale = MapScale(gsd_m=grid.gsd_m, north_rad=north_direction_rad(grid))

    def write_figures() -> list[Path]:
        # One map after the other, each of the few pixels that vehicles passed: whole layers of float64 fill the memory.
        return [*_write_direction(plan, scale, slow), *_write_speed(plan, scale)]

    counts = {"maps": 2.0}

    def write_view() -> list[Path]:
        written, states = write_view_data(layout)
        counts.update(states)
        return written

    # The viewer's data take about as long as the figures of the field.
    writers: list[Callable[[], list[Path]]] = [
        write_figures,
        write_view,
        partial(_write_quality_figures, plan),
    ]
    with ignore_missing_georeference():
        written = parallel_map(lambda write: write(), writers)
    advance("maps")
    return StageResult([path for paths in written for path in paths], counts)


def _modal_velocity(plan: Plan) -> tuple[Mask, FloatArray]:
    """Where a velocity is known, (y, x), and the velocities there, (n, 2) px/s."""
    store = FieldStore(plan.layout.field)
    layers = store.layer("modal_vx"), store.layer("modal_vy")
    known = np.isfinite(layers[0]) & np.isfinite(layers[1])
    return known, np.stack([layer[known] for layer in layers], axis=-1).astype(np.float64)


def _write_direction(plan: Plan, scale: MapScale, slow_px_per_s: float) -> list[Path]:
    """Figure and GeoTIFF of the direction, which as a layer is the heading, degrees."""
    known, velocity = _modal_velocity(plan)
    direction = direction_rad(velocity, stationary_speed_px_per_s=slow_px_per_s)
    figure = direction_figure(read_base_image(plan.layout, plan.config.frames), _spread(known, direction), scale)
    north = scale.north_rad
    about = "heading, clockwise from north" if north is not None else "heading, clockwise from the top of the image"
    layer = _spread(known, heading_deg(direction, north).astype(np.float32))
    return [*_write_figure(plan, "direction", figure), _write_layer(plan, "direction", layer, about, "degree")]


def _write_speed(plan: Plan, scale: MapScale) -> list[Path]:
    """Figure and GeoTIFF of the speed."""
    known, velocity = _modal_velocity(plan)
    speed = speed_px_per_s(velocity)
    figure = speed_figure(read_base_image(plan.layout, plan.config.frames), _spread(known, speed), scale)
    unit, factor = ("m s-1", scale.gsd_m) if scale.gsd_m else ("px s-1", 1.0)
    layer = _spread(known, (speed * factor).astype(np.float32))
    return [*_write_figure(plan, "speed", figure), _write_layer(plan, "speed", layer, "modal speed", unit)]


def _spread(known: Mask, values: NDArray[np.floating]) -> NDArray[np.floating]:
    """Values (n,) of the known pixels as a layer (y, x) of their type, NaN elsewhere."""
    layer = np.full(known.shape, np.nan, values.dtype)
    layer[known] = values
    return layer


def _write_figure(plan: Plan, name: str, figure: NDArray[np.uint8]) -> list[Path]:
    """A figure, and its preview."""
    written = []
    for suffix, image in (("", figure), ("_preview", make_preview(figure))):
        path = plan.layout.maps / f"{name}{suffix}.png"
        write_atomically(path, png_bytes(image))
        written.append(path)
    return written


def _write_layer(plan: Plan, name: str, values: NDArray[np.floating], label: str, unit: str) -> Path:
    grid, path = read_grid(plan.layout), plan.layout.maps / f"{name}.tif"
    write_cog(path, [values], names=[label], units=[unit], crs_wkt=grid.crs_wkt, affine=grid.affine)
    return path


def make_preview(figure: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The figure reduced for the Prefect UI."""
    factor = PREVIEW_SIDE_PX / max(figure.shape[:2])
    if factor >= 1:
        return figure
    return np.asarray(cv2.resize(figure, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), np.uint8)


def _write_quality_figures(plan: Plan) -> list[Path]:
    """Write ``maps/registration.png``, and ``maps/lens.png`` where the lens has distortion."""
    layout = plan.layout
    errors = RegistrationStore(layout.registration).column("error_px")
    seen = np.isfinite(errors).any(axis=(1, 2))
    if not seen.any():
        return []
    grey = FrameStore(layout.frames).read(int(np.flatnonzero(seen)[0]))
    known = np.isfinite(errors)
    mean_square = np.sum(np.where(known, errors, 0.0) ** 2, axis=0) / np.maximum(known.sum(axis=0), 1)
    by_cell = np.where(known.any(axis=0), np.sqrt(mean_square), np.nan)
    figures = {layout.maps / "registration.png": registration_error_figure(grey, by_cell, full_px=_FULL_PX)}
    lens = read_lens(layout)
    if not lens.is_identity:
        figures[layout.maps / "lens.png"] = undistortion_figure(grey, lens)
    else:
        (layout.maps / "lens.png").unlink(missing_ok=True)
    for path, figure in figures.items():
        write_atomically(path, png_bytes(figure))
    return list(figures)
