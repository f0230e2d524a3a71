"""Raw pixels <-> base pixels of a run folder: the stored transforms, followed by those of the base image."""

from pathlib import Path

import numpy as np
import pytest
from rasterio.crs import CRS
from rasterio.transform import Affine
from rasterio.warp import transform as to_system

from schemas.arrays import FloatArray
from schemas.camera import CameraRecord
from schemas.flight import FlightConfig
from schemas.records import GridRecord, RebaseRecord
from velfield.camera.lens import HarrisLens
from velfield.errors import InputError
from velfield.registration.intersensor.base_mesh import BaseMesh
from velfield.registration.mesh import CELLS, Support
from velfield.registration.transforms import (
    FrameTransform,
    MeshedTransform,
    PolyprojectiveTransform,
    vector_length,
)
from velfield.run.frame_transforms import (
    FrameTransforms,
    base_mesh_to_record,
    heading_deg,
    north_direction_rad,
    polyprojective_from_record,
    polyprojective_to_record,
    read_grid,
    read_lens,
    read_working,
)
from velfield.run.layout import RunLayout
from velfield.run.stores import RegistrationStore, create_frames, create_registration

WIDTH, HEIGHT, CONFIG = 320, 240, FlightConfig()
NORMALISATION = np.array([160.0, 120.0, 1 / 200])
LENS = HarrisLens(0.02, 158.0, 121.0, 200.0)


def similarity(scale: float, angle_rad: float, shift: tuple[float, float]) -> PolyprojectiveTransform:
    c, s = scale * np.cos(angle_rad), scale * np.sin(angle_rad)
    matrix = np.array([[c, -s, shift[0]], [s, c, shift[1]], [0, 0, 1.0]])
    return PolyprojectiveTransform.from_homography(matrix, NORMALISATION, NORMALISATION)


@pytest.fixture
def layout(tmp_path: Path) -> RunLayout:
    """A run of three frames: registered, not registered, registered."""
    layout = RunLayout(tmp_path)
    create_frames(layout.frames, key="k", count=3, height=HEIGHT, width=WIDTH, unit_frames=3, source={})
    length = vector_length(WIDTH, HEIGHT, CONFIG.registration)
    create_registration(layout.registration, key="k", count=3, vector_length=length, unit_frames=3)
    camera = CameraRecord(
        lens=LENS.to_record(), frame_width_px=WIDTH, frame_height_px=HEIGHT, accepted=True, reason="a test"
    )
    layout.camera.write_text(camera.model_dump_json())
    vectors = np.full((3, length), np.nan)
    for frame, transform in ((0, similarity(1.1, 0.1, (5, 7))), (2, similarity(0.9, -0.2, (0, 3)))):
        vectors[frame] = frame_transform(transform).to_vector(CONFIG.registration)
    RegistrationStore(layout.registration, "r+").write(0, vectors, ["ok", "failed:blurred", "ok"], {})
    layout.base.mkdir()
    return layout


def frame_transform(polyprojective: PolyprojectiveTransform) -> FrameTransform:
    return FrameTransform(
        width=WIDTH,
        height=HEIGHT,
        lens=LENS,
        polyprojective=polyprojective,
        row_coefficients=np.zeros((3, 0)),
        mesh=None,
        cell_size_px=CONFIG.registration.cell_size_px,
    )


def points(count: int = 50) -> FloatArray:
    return np.random.default_rng(0).uniform((10, 10), (WIDTH - 10, HEIGHT - 10), (count, 2))


def test_the_transforms_come_back_and_a_frame_without_one_has_none(layout: RunLayout) -> None:
    transforms = FrameTransforms.open(layout, CONFIG)
    assert transforms.transform(1) is None
    for frame, expected in ((0, similarity(1.1, 0.1, (5, 7))), (2, similarity(0.9, -0.2, (0, 3)))):
        found = transforms.transform(frame)
        assert transforms.transform(frame) is found, "it is kept"
        np.testing.assert_array_equal(found.to_base(points()), frame_transform(expected).to_base(points()))
        np.testing.assert_allclose(found.to_raw(found.to_base(points())), points(), atol=1e-6)
    with pytest.raises(InputError, match="frame 3 is not in the run: its frames go from 0 to 2"):
        transforms.transform(3)


def test_base_images_given_later_are_applied_after_a_frames_own(layout: RunLayout) -> None:
    own = FrameTransforms.open(layout, CONFIG).transform(0)
    to_given, to_newer = similarity(2.0, 0.3, (-9, 4)), similarity(0.5, 0.0, (1, 1))
    layout.own_to_base.write_text(polyprojective_to_record(to_given).model_dump_json())
    rebase = RebaseRecord(
        transform=polyprojective_to_record(to_newer),
        added_error_px=0.1,
        added_error_95_px=0.2,
        points=9,
        scale=0.5,
        rotation_rad=0.0,
        old_base="",
    )
    layout.rebased.write_text(rebase.model_dump_json())
    composed = FrameTransforms.open(layout, CONFIG).transform(0)
    xy = points()
    np.testing.assert_allclose(composed.to_base(xy), to_newer(to_given(own.to_base(xy))), atol=1e-9)
    np.testing.assert_allclose(composed.to_raw(composed.to_base(xy)), xy, atol=1e-6)


def test_the_map_to_a_given_image_has_a_mesh_and_a_standard_deviation_that_both_come_back(layout: RunLayout) -> None:
    mesh = np.random.default_rng(0).uniform(-1, 1, (3, 4, 2))
    sd_px = np.full(CELLS, 0.3, np.float32)
    sd_px[:, 16:] = np.nan  # the given image does not show the right half
    to_given = MeshedTransform(similarity(2.0, 0.0, (0, 0)), mesh, 100)
    record = base_mesh_to_record(BaseMesh(to_given, 0.2, 99, Support(sd_px, WIDTH, HEIGHT)))
    layout.own_to_base.write_text(record.model_dump_json())
    store = RegistrationStore(layout.registration, "r+")
    own_sd = np.full((3, *CELLS), 0.2, np.float32)
    store.write(0, store.column("vector", 0, 3), store.statuses(), {"position_sd_px": own_sd})
    frames = FrameTransforms.open(layout, CONFIG)
    transform, xy = frames.transform(0), np.array([[40.0, 60.0], [300.0, 60.0]])
    own = frame_transform(similarity(1.1, 0.1, (5, 7))).to_base(xy)
    np.testing.assert_allclose(transform.to_base(xy), to_given(own), atol=1e-9)
    np.testing.assert_allclose(transform.to_raw(transform.to_base(xy)), xy, atol=2e-3)
    known, unknown = frames.position_sd_px(0, xy)
    assert known == pytest.approx(np.hypot(2 * 0.2, 0.3), rel=0.02)
    assert np.isnan(unknown)
    assert np.isnan(frames.position_sd_px(1, xy)).all()


def test_a_record_of_a_transform_gives_it_back_to_the_bit() -> None:
    transform = PolyprojectiveTransform(np.random.default_rng(1).normal(size=(3, 6)), NORMALISATION, NORMALISATION / 3)
    record = polyprojective_to_record(transform)
    back = polyprojective_from_record(type(record).model_validate_json(record.model_dump_json()))
    for name in ("coefficients", "source", "target"):
        np.testing.assert_array_equal(getattr(back, name), getattr(transform, name))


def test_what_was_not_made_yet_is_said_with_the_command_that_makes_it(tmp_path: Path) -> None:
    layout = RunLayout(tmp_path)
    for read, name in ((read_lens, "camera.json"), (read_grid, "grid.json"), (read_working, "working.json")):
        with pytest.raises(InputError, match=f"{name} does not exist: run `velfield run`"):
            read(layout)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0, 200.0])
@pytest.mark.parametrize("easting_m", [500_000.0, 700_000.0])
def test_north_in_the_image_is_where_a_step_along_the_meridian_leads(angle_deg: float, easting_m: float) -> None:
    """In a UTM zone, on its central meridian and 2.8 degrees east of it."""
    affine = Affine.translation(easting_m, 5.5e6) @ Affine.rotation(angle_deg) @ Affine.scale(0.25, -0.25)
    zone = CRS.from_epsg(32637)
    grid = GridRecord(
        width_px=9, height_px=9, base_source="given", reference_frame=0, crs_wkt=zone.to_wkt(), affine=tuple(affine)[:6]
    )
    direction = north_direction_rad(grid)
    step = np.array([np.cos(direction), np.sin(direction)])
    xs, ys = zip(*(affine @ (4.5 + far * step[0], 4.5 + far * step[1]) for far in (0.0, 4000.0)), strict=True)
    longitude, latitude = to_system(zone, CRS.from_epsg(4326), xs, ys)
    assert longitude[0] == pytest.approx(longitude[1], abs=1e-6)
    assert latitude[1] > latitude[0]
    assert heading_deg(np.array([direction]), direction).tolist() == [0.0]
    assert heading_deg(np.array([direction + np.pi / 2]), direction)[0] == pytest.approx(90)


def test_without_a_georeference_north_is_unknown_and_headings_are_from_the_images_up() -> None:
    grid = GridRecord(width_px=9, height_px=9, base_source="flight", reference_frame=0)
    assert north_direction_rad(grid) is None
    headings = heading_deg(np.array([-np.pi / 2, 0.0, np.pi]), None)
    assert headings.tolist() == pytest.approx([0, 90, 270])
