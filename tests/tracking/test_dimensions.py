"""Dimensions of tracks by those of their detections, and classes from dimensions."""

import numpy as np
import pandas as pd
import pytest

from velfield.analysis.vehicle_classes import CLASS_NAMES, add_dimensions, classify
from velfield.tracking.dimensions import direction_of_axes, mean_dimensions, sample_tracks


def test_a_track_has_the_mean_of_its_detections_by_their_standard_deviations() -> None:
    sizes = np.array([[16, 7, 0.05, 0.05], [17, 7.5, 0.05, 0.05], [40, 16, 0.05, 0.05], [18, 8, 0.5, 0.5]])
    track = np.array([0, 0, 2, 2])
    found = mean_dimensions(sizes, track, 3)
    assert found[0, :2] == pytest.approx([np.sqrt(16 * 17), np.sqrt(7 * 7.5)])
    assert found[2, 0] == pytest.approx(40, rel=0.05)  # the other one says itself that it is not sure
    assert found[:, 4].tolist() == [2, 0, 2]
    assert np.isnan(found[1, :4]).all()
    assert 0.05 / np.sqrt(2) < found[0, 2] < 0.05  # the errors of one vehicle's detections are not independent


def test_a_detection_of_another_vehicle_hardly_changes_a_track() -> None:
    sizes = np.tile([16.0, 7.0, 0.07, 0.07], (9, 1))
    sizes[4, :2] = 45, 10
    found = mean_dimensions(sizes, np.zeros(9, np.int64), 1)
    assert found[0, 0] == pytest.approx(16, rel=0.02)


def test_strips_are_spread_over_a_track_and_turned_along_its_heading() -> None:
    count = 40
    tracklets = pd.DataFrame({f"detection_id_{k}": np.arange(count) + k for k in range(3)})
    tracklets["track_id"] = 0
    for link in ("01", "12"):
        tracklets[f"vx_{link}_px_per_s"] = np.r_[np.full(30, 0.01), np.full(10, 50.0)]
        tracklets[f"vy_{link}_px_per_s"] = np.r_[np.full(30, 0.3), np.zeros(10)]
    ids, chosen = sample_tracks(tracklets)
    assert ids.tolist() == [0]
    spread = chosen[chosen["spread"]]
    assert len(spread) == 16
    assert np.diff(spread["detection_id"]).max() <= 3
    assert chosen.loc[chosen["end"], "detection_id"].tolist() == [*range(37, 42)]
    assert chosen.loc[chosen["start"], "detection_id"].tolist() == [*range(5)]
    assert np.abs(chosen["heading_rad"]).max() < 0.02  # of what hardly moves the mean heading is taken
    assert direction_of_axes(np.array([0.1, 3.0]), np.array([0.0, 0.0])).tolist() == [False, True]


def test_classes_follow_from_dimensions_and_are_unsure_where_dimensions_are() -> None:
    sizes = np.array([[2.1, 0.8], [4.3, 1.8], [5.6, 2.05], [11.5, 2.5]])
    sure = classify(sizes, np.full((4, 2), [0.2, 0.08]))
    assert [CLASS_NAMES[k] for k in sure.argmax(axis=1)] == ["motorcycle", "car", "van", "lorry or bus"]
    assert sure.sum(axis=1) == pytest.approx(1)
    unsure = classify(sizes, np.full((4, 2), [1.0, 0.4]))
    assert unsure[2].max() < sure[2].max()
    table = pd.DataFrame({"track_id": [3, 4]})
    measured = pd.DataFrame(
        {
            "track_id": [3],
            "length_px": [18.0],
            "length_sd_px": [0.6],
            "width_px": [7.5],
            "width_sd_px": [0.3],
            "strips": [9],
        }
    )
    found = add_dimensions(table, measured, 0.24)
    assert found["vehicle_class"].tolist() == ["car", np.nan]
    assert found["length_m"][0] == pytest.approx(4.32)
    assert found["class_probability"].isna().tolist() == [False, True]
    assert add_dimensions(table, measured, None)["vehicle_class"].isna().all()
