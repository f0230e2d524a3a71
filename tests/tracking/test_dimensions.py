"""Dimensions of vehicles from strips along their axes, and classes from dimensions."""

import numpy as np
import pandas as pd
import pytest

from tools.train_dimensions import Strips
from velfield.analysis.vehicle_classes import CLASS_NAMES, add_dimensions, classify
from velfield.tracking.dimensions import direction_of_axes, measure, sample_tracks


def test_dimensions_of_drawn_vehicles_are_right_within_their_standard_deviations() -> None:
    maker = Strips(seed=902)
    drawn = [maker.draw() for _ in range(120)]
    found = measure(np.stack([strip for strip, _ in drawn]))
    length, width = np.stack([size for _, size in drawn]).T
    for size, value, sd in ((length, found.length, found.length_sd), (width, found.width, found.width_sd)):
        relative = (value - size) / size
        assert abs(np.median(relative)) < 0.03
        assert np.median(np.abs(relative)) < 0.09
        assert 0.8 < np.mean(np.abs(value - size) < 1.645 * sd) <= 0.98
    assert np.corrcoef(length, found.length)[0, 1] > 0.93


def test_a_strip_the_other_way_round_and_darker_gives_the_same() -> None:
    strip, _ = Strips(seed=903).draw()
    one = measure(strip[None])
    for other in (strip[::-1], strip[:, ::-1], strip - 20.0):
        assert measure(other[None]).length == pytest.approx(one.length, rel=1e-6)
    assert len(measure(np.empty((0, 32, 10))).width) == 0


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
