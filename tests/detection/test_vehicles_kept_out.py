"""Key points are not taken on vehicles where another detector's boxes are given."""

from pathlib import Path

import cv2
import numpy as np

from schemas.job import Inputs, Job
from velfield.pipeline.configuration import resolve_config
from velfield.pipeline.plan import make_plan
from velfield.pipeline.stages.frames import create_frame_store, read_unit
from velfield.pipeline.stages.registration import detect_frame_keypoints, vehicle_free_mask


def test_no_key_point_lies_on_a_given_vehicle(tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()
    blocks = np.random.default_rng(0).integers(0, 255, (15, 20), dtype=np.uint8).repeat(8, 0).repeat(8, 1)
    for name in ("a.png", "b.png", "c.png"):
        cv2.imwrite(str(folder / name), blocks)
    boxes = tmp_path / "boxes.csv"
    boxes.write_text("frame,x_px,y_px,orientation_rad,length_px,width_px\nb.png,80,60,0.0,60,30\nc.png,80,60,,,\n")
    inputs = Inputs(source=str(folder), detections=str(boxes))
    plan = make_plan(
        Job(
            root=str(tmp_path / "run"),
            inputs=inputs,
            config=resolve_config(overrides={"frames.fps": 5, "lens.refine": "never"}),
        )
    )
    create_frame_store(plan)
    read_unit(plan, range(3))
    free = vehicle_free_mask(plan, 1, (120, 160))
    assert not free[46:74, 52:108].any()
    assert free[:43].all()
    assert free[:, 114:].all()
    everywhere, masked, unsized = (detect_frame_keypoints(plan, frame).xy for frame in range(3))

    def on_the_vehicle(xy: np.ndarray) -> int:
        return int(((np.abs(xy - [80, 60])) < [28, 13]).all(axis=1).sum())

    assert on_the_vehicle(everywhere) > 0
    assert on_the_vehicle(masked) == 0
    assert on_the_vehicle(unsized) == on_the_vehicle(everywhere)


def test_an_upright_box_masks_both_orientations_of_the_car_in_it(tmp_path: Path) -> None:
    """A YOLO box of 60 x 60 px is a car of 60 px at +45 or -45 degrees."""
    folder, boxes = tmp_path / "frames", tmp_path / "boxes"
    folder.mkdir()
    boxes.mkdir()
    for name in ("a.png", "b.png", "c.png"):
        cv2.imwrite(str(folder / name), np.full((120, 160), 90, np.uint8))
    (boxes / "a.txt").write_text(f"0 {80.5 / 160} {60.5 / 120} {60 / 160} {60 / 120}\n")
    job = Job(
        root=str(tmp_path / "run"),
        inputs=Inputs(source=str(folder), detections=str(boxes)),
        config=resolve_config(overrides={"frames.fps": 5}),
    )
    free = vehicle_free_mask(make_plan(job), 0, (120, 160))
    ends = [(80 + dx, 60 + dy) for dx in (-18, 18) for dy in (-18, 18)]
    assert not any(free[y, x] for x, y in ends)
    assert free[60, 55]
    assert free[40, 80]
