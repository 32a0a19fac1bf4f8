"""Which plane a point belongs to: the paper's merging of points with planes, and a vote among neighbours."""

from __future__ import annotations

import numpy as np
from numba import njit

from pipeline.model import BoolArray, FloatArray, LabelArray
from pipeline.segmentation.plane_regression import cosine_of_slope


@njit(cache=True, nogil=True)
def distance_to_plane(points: FloatArray, i: int, planes: FloatArray, k: int) -> float:
    """Perpendicular distance of a point to a plane (Eq. 1)."""
    vertical = points[i, 2] - planes[k, 0] * points[i, 0] - planes[k, 1] * points[i, 1] - planes[k, 2]
    return float(abs(vertical) * cosine_of_slope(planes[k, 0], planes[k, 1]))


@njit(cache=True, nogil=True)
def vote_among_neighbours(
    points: FloatArray,
    neighbours: LabelArray,
    labels: LabelArray,
    planes: FloatArray,
    usable: BoolArray,
    distance_m: float,
    vote_weight: float,
    passes: int,
) -> LabelArray:
    """Every point takes the plane of its neighbourhood with the least (distance / limit)^2 minus weight times votes.

    All points choose at once from the labels before, so the outcome does not depend on their order. A plane beyond
    the distance is no choice; a point without any choice is an outlier.

    Parameters
    ----------
    points : (n, 3) float64
        Original elevations, metres.
    neighbours : (n, k) int32
        Nearest neighbours of every point, -1 where there are fewer.
    labels : (n,) int32
        Labels before, -1 for none.
    planes : (m, 3) float64
        (a, b, c).
    usable : (m,) bool
        Planes that may be chosen.
    distance_m : float
        Largest perpendicular distance.
    vote_weight : float
        What one neighbour's vote counts against the squared relative distance.
    passes : int
        Most repetitions; it ends when nothing changes.

    Returns
    -------
    (n,) int32
        -1 for outliers.
    """
    width = neighbours.shape[1]
    old = labels.copy()
    kind = np.empty(width + 1, np.int32)
    votes = np.empty(width + 1, np.int32)
    for _ in range(passes):
        new = np.full(old.size, -1, np.int32)
        changes = 0
        for i in range(old.size):
            kinds = 0
            for q in range(-1, width):
                j = i if q < 0 else neighbours[i, q]
                if j < 0 or (q >= 0 and j == i):
                    continue
                k = old[j]
                if k < 0 or not usable[k]:
                    continue
                at = 0
                while at < kinds and kind[at] != k:
                    at += 1
                if at == kinds:
                    kind[at] = k
                    votes[at] = 0
                    kinds += 1
                if q >= 0:
                    votes[at] += 1
            least = 1.0
            for s in range(kinds):
                ratio = distance_to_plane(points, i, planes, kind[s]) / distance_m
                if ratio > 1.0:
                    continue
                cost = ratio * ratio - vote_weight * votes[s]
                if cost < least or (cost == least and kind[s] < new[i]):
                    least = cost
                    new[i] = kind[s]
            changes += new[i] != old[i]
        old = new
        if changes == 0:
            break
    return old


@njit(cache=True, nogil=True)
def nearest_plane(points: FloatArray, planes: FloatArray, usable: BoolArray, distance_m: float) -> LabelArray:
    """The nearest of all planes within the distance: the paper's merging of points with planes.

    Returns (n,) int32, -1 for none; parameters as for `vote_among_neighbours`.
    """
    labels = np.full(points.shape[0], -1, np.int32)
    for i in range(points.shape[0]):
        least = distance_m
        for k in range(usable.size):
            if not usable[k]:
                continue
            distance = distance_to_plane(points, i, planes, k)
            if distance < least or (distance == least and labels[i] < 0):
                least = distance
                labels[i] = k
    return labels
