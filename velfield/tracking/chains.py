"""Chains of tracklets that share detections: one vehicle going by, counted once."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def assign_passages(detection_ids: NDArray[np.int64]) -> NDArray[np.int64]:
    """The passage of each tracklet: the smallest detection id of the chain of tracklets it belongs to.

    Parameters
    ----------
    detection_ids
        (n, 3) ids of each tracklet's detections. Tracklets that share a detection belong to one passage.

    Returns
    -------
    (n,) int64

    Examples
    --------
    >>> assign_passages(np.array([[1, 12, 23], [12, 23, 34], [2, 13, 24]])).tolist()
    [1, 1, 2]
    """
    if not detection_ids.size:
        return np.zeros(0, np.int64)
    ids, flat = np.unique(detection_ids, return_inverse=True)
    node = flat.reshape(detection_ids.shape)
    edges = np.concatenate([node[:, :2], node[:, 1:]])
    return smallest_joined(ids, edges)[node[:, 0]]


def smallest_joined(names: NDArray[np.int64], edges: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each of names (n,), the smallest of those that edges (m, 2), pairs of their indices, join it to."""
    count = len(names)
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    smallest = np.full(count, np.iinfo(np.int64).max)
    np.minimum.at(smallest, label, names)
    return np.asarray(smallest[label], dtype=np.int64)
