"""Tracks of vehicles: connected components of tracklets that share detections."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from schemas.arrays import IntArray


def assign_tracks(detection_ids: IntArray) -> IntArray:
    """The track of each tracklet: the smallest detection id of its connected component.

    Parameters
    ----------
    detection_ids
        (n, 3) ids of each tracklet's detections. Tracklets that share a detection belong to one track.

    Returns
    -------
    (n,) int64

    Examples
    --------
    >>> assign_tracks(np.array([[1, 12, 23], [12, 23, 34], [2, 13, 24]])).tolist()
    [1, 1, 2]
    """
    if not detection_ids.size:
        return np.zeros(0, np.int64)
    ids, flat = np.unique(detection_ids, return_inverse=True)
    node = flat.reshape(detection_ids.shape)
    edges = np.concatenate([node[:, :2], node[:, 1:]])
    return component_minimum(ids, edges)[node[:, 0]]


def component_minimum(ids: IntArray, edges: IntArray) -> IntArray:
    """The smallest of ids (n,) in each one's connected component; edges (m, 2) are pairs of their indices."""
    count = len(ids)
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    smallest = np.full(count, np.iinfo(np.int64).max)
    np.minimum.at(smallest, label, ids)
    return np.asarray(smallest[label], dtype=np.int64)
