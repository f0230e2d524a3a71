"""Maps of modal direction and speed, as figures and as layers for GIS; and the data of the viewer."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from schemas.arrays import FloatArray
from velfield.exports.cog import write_cog
from velfield.field.segments import stationary_speed_px_per_s
from velfield.field.statistics import direction_rad, speed_px_per_s
from velfield.pipeline.plan import Plan
from velfield.pipeline.result import StageResult, advance
from velfield.report.figures import MapScale, direction_figure, png_bytes, speed_figure
from velfield.report.quality_figures import registration_error_figure, undistortion_figure
from velfield.run.commits import write_atomically
from velfield.run.frame_transforms import heading_deg, north_direction_rad, read_base_image, read_grid, read_lens
from velfield.run.layout import local_output
from velfield.run.stores import open_field, open_frames, open_registration
from velfield.viewer.record import write_view_data

PREVIEW_SIDE_PX = 900
_FULL_PX = 1.0
"""Maximum of the colour scale of the error map."""


def make_maps(plan: Plan) -> StageResult:
    """Write ``maps/``: direction and speed as PNG and as GeoTIFF, previews of both for the Prefect UI; and the viewer's
    data beside the tiles of the field."""
    grid, config, layout = read_grid(plan.layout), plan.config.field, plan.layout
    store = open_field(layout.field)
    velocity = np.stack([store.layer("modal_vx"), store.layer("modal_vy")], axis=-1).astype(np.float64)
    direction = direction_rad(velocity, stationary_speed_px_per_s=stationary_speed_px_per_s(config, grid.gsd_m))
    speed = speed_px_per_s(velocity)
    grey = read_base_image(layout, plan.config.frames)
    scale = MapScale(gsd_m=grid.gsd_m, north_rad=north_direction_rad(grid))
    figures = {
        "direction": direction_figure(grey, direction, scale),
        "speed": speed_figure(grey, speed, scale),
    }
    written = []
    for name, figure in figures.items():
        for suffix, image in (("", figure), ("_preview", make_preview(figure))):
            path = layout.maps / f"{name}{suffix}.png"
            write_atomically(path, png_bytes(image))
            written.append(path)
    written += _layers(plan, direction, speed)
    written += _write_quality_figures(plan)
    written += write_view_data(layout)
    advance("maps")
    return StageResult(written, {"maps": float(len(figures))})


def _layers(plan: Plan, direction: FloatArray, speed: FloatArray) -> list[Path]:
    """Direction as heading and speed as GeoTIFF, each value with its unit."""
    grid, maps = read_grid(plan.layout), plan.layout.maps
    north = north_direction_rad(grid)
    heading = heading_deg(direction, north)
    unit, factor = ("m s-1", grid.gsd_m) if grid.gsd_m else ("px s-1", 1.0)
    about = "heading, clockwise from north" if north is not None else "heading, clockwise from the image's top"
    for name, values, label, units in (
        ("direction", heading, about, "degree"),
        ("speed", speed * factor, "modal speed", unit),
    ):
        with local_output(maps / f"{name}.tif") as here:
            write_cog(
                here,
                [values.astype(np.float32)],
                names=[label],
                units=[units],
                crs_wkt=grid.crs_wkt,
                affine=grid.affine,
            )
    return [maps / "direction.tif", maps / "speed.tif"]


def make_preview(figure: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The figure reduced for the Prefect UI."""
    factor = PREVIEW_SIDE_PX / max(figure.shape[:2])
    if factor >= 1:
        return figure
    return np.asarray(cv2.resize(figure, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), np.uint8)


def _write_quality_figures(plan: Plan) -> list[Path]:
    """Write ``maps/registration.png``, and ``maps/lens.png`` where the lens has distortion."""
    layout = plan.layout
    errors = open_registration(layout.registration).column("error_px")
    seen = np.isfinite(errors).any(axis=(1, 2))
    if not seen.any():
        return []
    grey = open_frames(layout.frames).read(int(np.flatnonzero(seen)[0]))
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
