"""Tracks: connected components of tracklets that share detections."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from velfield.tracking.joins import assign_tracks


def test_a_track_is_named_after_its_first_detection() -> None:
    assert assign_tracks(np.array([[5, 15, 25], [15, 25, 35], [6, 16, 26], [25, 35, 45]])).tolist() == [5, 5, 6, 5]


def test_no_tracklets_no_tracks() -> None:
    assert assign_tracks(np.zeros((0, 3), np.int64)).size == 0


@given(
    st.lists(st.tuples(st.integers(0, 5), st.integers(10, 15), st.integers(20, 25)), min_size=1, max_size=12),
    st.randoms(),
)
def test_tracks_are_the_connected_components_in_any_order(rows: list[tuple[int, int, int]], random: object) -> None:
    ids = np.array(rows, np.int64)
    tracks = assign_tracks(ids)
    groups: list[set[int]] = []
    for row in rows:
        touching = [g for g in groups if g & set(row)]
        groups = [g for g in groups if g not in touching] + [set(row).union(*touching)]
    expected = [min(next(g for g in groups if row[0] in g)) for row in rows]
    assert tracks.tolist() == expected
    order = list(range(len(rows)))
    random.shuffle(order)
    assert assign_tracks(ids[order]).tolist() == tracks[order].tolist()
