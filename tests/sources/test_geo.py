"""Base images: their ground sample distance, reprojection from degrees, refusals."""

import warnings

import numpy as np
import pytest
import rasterio
from PIL import Image
from rasterio.crs import CRS
from rasterio.warp import transform

from schemas.flight import FramesConfig
from tests.media import ground
from velfield.errors import InputError
from velfield.sources.geo import read_base_raster, reconcile_gsd

CONFIG = FramesConfig()
LATITUDE, LONGITUDE = 32.0, 34.8


def save_tif(path, array, crs=None, affine=None, **options):
    bands = array if array.ndim == 3 else array[None]
    count, height, width = bands.shape
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(
            path,
            "w",
            driver="GTiff",
            width=width,
            height=height,
            count=count,
            dtype=bands.dtype,
            crs=crs,
            transform=affine,
            **options,
        ) as dataset:
            dataset.write(bands)
    return path


def from_origin(west, north, width, height):
    """As rasterio's, which uses an operator that `affine` is giving up."""
    return rasterio.Affine(width, 0, west, 0, -height, north)


def place_in(crs, pixel):
    """Affine of an image about (LONGITUDE, LATITUDE), pixels of the given size in the system's own unit."""
    (x,), (y,) = transform(CRS.from_epsg(4326), crs, [LONGITUDE], [LATITUDE])
    return from_origin(x, y, pixel, pixel)


@pytest.fixture(scope="module")
def scene():
    return ground(300, 200)


@pytest.mark.parametrize(
    ("epsg", "pixel", "gsd_m"),
    [
        (32636, 0.25, 0.25),  # UTM: its scale is within 0.1 % of 1
        (3857, 0.25, 0.25 * np.cos(np.radians(LATITUDE))),  # Web Mercator: 18 % too large here
        (2039, 0.3, 0.3),  # the Israeli grid
    ],
)
def test_gsd_is_by_the_local_scale(tmp_path, scene, epsg, pixel, gsd_m):
    crs = CRS.from_epsg(epsg)
    path = save_tif(tmp_path / "b.tif", scene, crs, place_in(crs, pixel))
    base = read_base_raster(path, CONFIG)
    assert base.gsd_m == pytest.approx(gsd_m, rel=3e-3)
    assert np.array_equal(base.grey, scene)
    assert base.valid is None
    assert base.affine == tuple(place_in(crs, pixel))[:6]


def test_feet_are_metres_in_the_end(tmp_path, scene):
    crs = CRS.from_epsg(2263)  # New York Long Island, US survey feet
    (x,), (y,) = transform(CRS.from_epsg(4326), crs, [-73.9], [40.7])
    base = read_base_raster(save_tif(tmp_path / "b.tif", scene, crs, from_origin(x, y, 1, 1)), CONFIG)
    assert base.gsd_m == pytest.approx(0.3048, rel=1e-3)


@pytest.mark.parametrize(
    ("longitude", "latitude", "epsg"), [(34.8, 32.0, 32636), (-70.6, -33.4, 32719), (179.99, 10.0, 32660)]
)
def test_degrees_are_reprojected_to_the_utm_zone(tmp_path, longitude, latitude, epsg):
    step = 2.5e-6
    image = ground(300, 260)
    affine = from_origin(longitude - 150 * step, latitude + 130 * step, step, step)
    base = read_base_raster(save_tif(tmp_path / "b.tif", image, CRS.from_epsg(4326), affine), CONFIG)
    assert CRS.from_wkt(base.crs_wkt).to_epsg() == epsg
    metres_north, metres_east = step * 110_900, step * 111_320 * np.cos(np.radians(latitude))
    assert min(metres_north, metres_east) * 0.99 < base.gsd_m < max(metres_north, metres_east) * 1.01
    assert any("reprojected from degrees" in note for note in base.notes)
    # The centre of the image stayed where it was on earth.
    inverse = ~rasterio.Affine(*base.affine)
    xs, ys = transform(CRS.from_epsg(4326), CRS.from_epsg(epsg), [longitude], [latitude])
    column = inverse.a * xs[0] + inverse.b * ys[0] + inverse.c
    row = inverse.d * xs[0] + inverse.e * ys[0] + inverse.f
    window = base.grey[int(row) - 4 : int(row) + 4, int(column) - 4 : int(column) + 4]
    assert abs(window.mean() - image[126:134, 146:154].mean()) < 12


def test_an_image_with_a_world_file_and_a_prj_has_its_place(tmp_path, scene):
    Image.fromarray(scene).save(tmp_path / "b.png")
    (tmp_path / "b.pgw").write_text("0.25\n0\n0\n-0.25\n700000.125\n3499999.875\n")
    assert read_base_raster(tmp_path / "b.png", CONFIG).crs_wkt is None
    assert "names its reference system" in read_base_raster(tmp_path / "b.png", CONFIG).notes[0]
    (tmp_path / "b.prj").write_text(CRS.from_epsg(32636).to_wkt())
    base = read_base_raster(tmp_path / "b.png", CONFIG)
    assert base.affine == pytest.approx((0.25, 0, 700000, 0, -0.25, 3500000))  # a world file has the pixel's centre
    assert base.gsd_m == pytest.approx(0.25, rel=2e-3)


def test_a_plain_image_has_no_place(tmp_path, scene):
    Image.fromarray(scene).save(tmp_path / "b.png")
    base = read_base_raster(tmp_path / "b.png", CONFIG)
    assert (base.crs_wkt, base.affine, base.gsd_m, base.notes) == (None, None, None, ())
    assert np.array_equal(base.grey, scene)
    bare = read_base_raster(save_tif(tmp_path / "b.tif", scene), CONFIG)
    assert (bare.crs_wkt, bare.gsd_m) == (None, None)


def test_colours_depths_and_nodata_become_grey_and_valid(tmp_path, scene):
    colour = np.stack([scene, scene, scene])
    assert np.array_equal(read_base_raster(save_tif(tmp_path / "c.tif", colour), CONFIG).grey, scene)
    deep = scene.astype(np.uint16) * 40 + 300
    deep[:50] = 0
    base = read_base_raster(save_tif(tmp_path / "d.tif", deep, nodata=0), CONFIG)
    assert not base.valid[:50].any()
    assert base.valid[50:].all()
    assert np.corrcoef(base.grey[50:].ravel(), scene[50:].ravel())[0, 1] > 0.99
    real = scene.astype(np.float32) / 255
    real[0, 0] = np.nan
    assert not read_base_raster(save_tif(tmp_path / "f.tif", real), CONFIG).valid[0, 0]


def test_pixels_that_are_not_square_on_the_ground_stop(tmp_path, scene):
    affine = from_origin(700000, 3500000, 0.25, 0.3)
    path = save_tif(tmp_path / "b.tif", scene, CRS.from_epsg(32636), affine)
    with pytest.raises(InputError, match=r"0\.25 m by 0\.29\d* m|0\.25\d* m by 0\.3\d* m"):
        read_base_raster(path, CONFIG)


def test_a_given_gsd_that_disagrees_stops():
    assert reconcile_gsd(0.25, 0.254) == 0.25
    with pytest.raises(InputError, match=r"found --gsd-m 0.3, expected 0.25 m a pixel"):
        reconcile_gsd(0.25, 0.3)


def test_vrt_urls_truncated_and_large_images_are_refused(tmp_path, scene):
    save_tif(tmp_path / "whole.tif", scene, compress="deflate")
    vrt = tmp_path / "vrt.tif"
    vrt.write_text(
        '<VRTDataset rasterXSize="300" rasterYSize="200"><VRTRasterBand dataType="Byte" band="1"><SimpleSource>'
        "<SourceFilename relativeToVRT='1'>whole.tif</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
    )
    cut = tmp_path / "cut.tif"
    cut.write_bytes((tmp_path / "whole.tif").read_bytes()[:5000])
    half = tmp_path / "half.png"
    Image.fromarray(scene).save(tmp_path / "whole.png")
    half.write_bytes((tmp_path / "whole.png").read_bytes()[:9000])
    refusals = {
        vrt: "found a VRT",
        cut: "truncated or damaged",
        half: "truncated or damaged",
        tmp_path / "none.tif": "found no base image",
        "https://example.org/b.tif": "is not supported",
        "/vsicurl/https://example.org/b.tif": "found no base image",
    }
    for path, match in refusals.items():
        with pytest.raises(InputError, match=match) as caught:
            read_base_raster(path, CONFIG)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match="300x200 = 60000 px, expected at most 1000"):
        read_base_raster(tmp_path / "whole.tif", FramesConfig(max_pixels=1000))


def test_a_prj_that_is_none_stops(tmp_path, scene):
    Image.fromarray(scene).save(tmp_path / "b.png")
    (tmp_path / "b.pgw").write_text("0.25\n0\n0\n-0.25\n700000\n3500000\n")
    (tmp_path / "b.prj").write_text("somewhere")
    with pytest.raises(InputError, match="found no reference system"):
        read_base_raster(tmp_path / "b.png", CONFIG)


def local(unit: str) -> CRS:
    return CRS.from_wkt(f'LOCAL_CS["Arbitrary",{unit}]')


@pytest.mark.parametrize(
    ("crs", "pixel", "gsd_m"),
    [
        (local('UNIT["metre",1]'), 0.23, 0.23),
        (local('UNIT["foot",0.3048]'), 0.5, 0.1524),
        (local('UNIT["unknown",1]'), 0.5, None),
        (local('UNIT["degree",0.0174532925199433]'), 0.5, None),
        (CRS.from_epsg(5773), 0.5, None),  # of heights
    ],
)
def test_a_local_reference_system_gives_the_scale_and_no_place(tmp_path, scene, crs, pixel, gsd_m):
    Image.fromarray(scene).save(tmp_path / "b.png")  # GDAL writes any other unit of a local system as metres to TIFF
    (tmp_path / "b.pgw").write_text(f"{pixel}\n0\n0\n{-pixel}\n100\n200\n")
    (tmp_path / "b.prj").write_text(crs.to_wkt())
    base = read_base_raster(tmp_path / "b.png", CONFIG)
    assert base.gsd_m == (None if gsd_m is None else pytest.approx(gsd_m, rel=1e-6))
    assert (base.crs_wkt, base.affine) == (None, None)
    assert len(base.notes) == 1
    assert ("local one" if gsd_m else "is not used") in base.notes[0]


@pytest.mark.parametrize("name", ["b.tif", "b.png"])
@pytest.mark.parametrize("beside", ["place", "system"])
def test_half_a_georeference_is_noted(tmp_path, scene, name, beside):
    Image.fromarray(scene).save(tmp_path / name)
    if beside == "place":
        (tmp_path / name).with_suffix({"b.tif": ".tfw", "b.png": ".pgw"}[name]).write_text("0.2\n0\n0\n-0.2\n7\n9\n")
    else:
        (tmp_path / "b.prj").write_text(CRS.from_epsg(32636).to_wkt())
    base = read_base_raster(tmp_path / name, CONFIG)
    assert base.gsd_m is None
    assert "it is not used" in base.notes[0]


def test_ground_control_points_in_the_file_are_noted(tmp_path, scene):
    points = [rasterio.control.GroundControlPoint(row, row / 2, 10.0 + row, 50.0 + row) for row in (0, 50, 100)]
    path = save_tif(tmp_path / "b.tif", scene, CRS.from_epsg(4326), gcps=points)
    assert "its 3 ground control points are not used" in read_base_raster(path, CONFIG).notes[0]


@pytest.mark.parametrize(
    "crs", [CRS.from_epsg(32636), CRS.from_wkt(CRS.from_epsg(4326).to_wkt().replace("6378137", "1737400"))]
)
def test_a_place_beyond_the_reference_system_is_one_line(tmp_path, scene, crs):
    path = save_tif(tmp_path / "b.tif", scene, crs, from_origin(1e9, 1e9, 0.25, 0.25))
    with pytest.raises(InputError, match=r"b\.tif: found") as caught:
        read_base_raster(path, CONFIG)
    assert "\n" not in str(caught.value)
