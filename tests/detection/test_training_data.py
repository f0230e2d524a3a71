"""Readers of the sets that the shipped detector is trained on."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from tools.training_data import large_in_upright_box, read_oriented, read_upright
from velfield.errors import InputError


def write_picture(file: Path, width: int = 200, height: int = 100) -> None:
    grey = np.random.default_rng(0).integers(0, 255, (height, width, 3), np.uint8)
    assert cv2.imwrite(str(file), grey)


@pytest.mark.parametrize("angle", [0.0, 0.3, 0.9, 1.5])
def test_a_bus_in_an_upright_box_has_its_length_and_angle(angle: float) -> None:
    c, s = np.cos(angle), np.sin(angle)
    length, width, found = large_in_upright_box(120 * c + 25 * s, 120 * s + 25 * c, 25)
    assert (length, width, found) == pytest.approx((120, 25, angle), abs=0.2)


def test_oriented_boxes_come_at_the_working_scale_without_what_is_doubtful(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png")
    (tmp_path / "labels.csv").write_text(
        "file,x_px,y_px,orientation_rad,length_px,width_px,class\n"
        "a.png,49.5,19.5,0.5,32,14,car\na.png,99.5,59.5,1.0,90,18,bus\n"
        "a.png,150,50,0,40,20,ignore\na.png,20,80,0,8,8,person\n"
    )
    (image,) = read_oriented(tmp_path, car_length_px=32.0)["a.png"]
    assert image.image.shape == (50, 100)
    np.testing.assert_allclose(image.cars, [[24.5, 9.5, 0.5, 16, 7], [49.5, 29.5, 1.0, 45, 9]])
    np.testing.assert_allclose(image.ignore, [[74.75, 24.75, 10]])
    (nominal,) = read_oriented(tmp_path, car_length_px=32.0, nominal_length_px=32.0)["a.png"]
    assert np.isnan(nominal.cars[0, 3:]).all()
    assert np.isfinite(nominal.cars[1]).all()


def test_upright_boxes_of_buses_are_vehicles_and_motorcycles_neither(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png")
    rows = [(0, 50, 50, 32, 14.4), (1, 120, 50, 80, 16), (3, 20, 20, 6, 6), (0, 195, 50, 20, 14)]
    lines = [f"{kind} {x / 200} {y / 100} {w / 200} {h / 100}" for kind, x, y, w, h in rows]
    (tmp_path / "a.txt").write_text("\n".join(lines))
    (image,) = read_upright([tmp_path / "a.png"])
    assert len(image.cars) == 3
    assert image.cars[1, 3] / image.cars[0, 3] == pytest.approx(2.5, rel=0.02)
    assert image.cars[1, 2] == 0
    assert np.isnan(image.cars[2, 3:]).all()  # the edge cuts it
    assert len(image.ignore) == 1


def test_no_pictures_are_one_clear_line() -> None:
    with pytest.raises(InputError, match="expected the folders songdo and kit_ais"):
        read_upright([])
