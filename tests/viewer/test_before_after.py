"""Before and after as a page: a crossroads where more vehicles turn to the right, and from the west more come."""

import re

import numpy as np
import pytest

from tests.analysis.test_traffic_analysis import EAST, RIGHT, crossroads, drive, gather
from velfield.analysis.changes import find_changes
from velfield.analysis.traffic_analysis import TrafficAnalysis
from velfield.report.traffic.before_after import before_after_html


@pytest.fixture(scope="module")
def before() -> TrafficAnalysis:
    return TrafficAnalysis(gather(crossroads()))


@pytest.fixture(scope="module")
def after() -> TrafficAnalysis:
    """Three of four straight on become one of four: 48 straight and 12 right become 12 and 48."""
    tracks = [t for t in crossroads() if not np.isclose(t[1][0], EAST[0]).all()]
    for cycle in range(12):
        for k in range(5):
            path = EAST if k == 2 else RIGHT
            begin = cycle * 40.0
            tracks.append(drive(path, begin - 24 + 3 * k, stop_at_m=128.0 - 7 * k, go_s=begin + 1.8 * k + 1.8))
    return TrafficAnalysis(gather(tracks))


def listed(page: str) -> list[str]:
    return re.findall(r"<li>(.*?)</li>", page)


def test_the_page_says_what_changed_and_shows_the_turns_side_by_side(
    before: TrafficAnalysis, after: TrafficAnalysis
) -> None:
    changes = find_changes(before, after)
    page = before_after_html(before, after, changes, maps=[("Change of speed", "speed_change.png")])
    said = listed(page)
    assert sum(line.startswith("share from W to") for line in said) == 2
    right = next(line for line in said if line.startswith("share from W to S"))
    was, now = map(float, re.findall(r"(?:from|to) ([\d.]+) \(", right))
    assert was == pytest.approx(100 * 12 / 60, abs=2)
    assert now == pytest.approx(100 * 48 / 60, abs=4)
    assert right.endswith(" %")
    assert not [line for line in said if "from N" in line]  # what comes from the north did not change
    assert page.count(', before and after"') == 1
    assert 'src="speed_change.png"' in page
    assert page.count("<tr>") == len(changes) + 1


def test_two_flights_of_the_same_traffic_differ_in_nothing(before: TrafficAnalysis) -> None:
    page = before_after_html(before, before, find_changes(before, before))
    assert listed(page) == []
    assert "Nothing that was compared differs by more than chance" in page


def test_where_nothing_is_known_of_both_it_says_that_nothing_was_compared(before: TrafficAnalysis) -> None:
    short = TrafficAnalysis(gather([drive(EAST, 3.0 * k) for k in range(4)]))
    page = before_after_html(before, short, find_changes(before, short), pixels=["speed      no significant change"])
    assert listed(page) == ["speed      no significant change"]
    assert "could be compared: none is known at the same place in both" in page
    assert "by more than chance" not in page
    assert "0 of 0" not in page
