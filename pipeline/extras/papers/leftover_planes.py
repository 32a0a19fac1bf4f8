"""A second look at points that no plane explains: small faces whose facets were too few or too noisy to cluster.

An extension of the paper, which reports that small, under-sampled faces are lost: clusters grow among the leftovers,
from the flattest neighbourhoods on, and go through the same refinement as those of the facets.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.sorting import ascending_order
from pipeline.model import FloatArray, LabelArray
from pipeline.segmentation.plane_regression import (
    N_SUMS,
    add_point,
    best_fit_plane,
    cosine_of_slope,
    height_above,
    mean_square_residual,
)

_MIN_SEED_POINTS = 4
"""A plane has three free parameters: four points are the fewest that can contradict one another."""


@kernel
def cluster_leftovers(
    points: FloatArray, neighbours: LabelArray, labels: LabelArray, distance_m: float, fewest_points: int
) -> LabelArray:
    """Grow clusters among the points without a label; their numbers, from the largest label on, replace the -1.

    Parameters
    ----------
    points : (n, 3) float64
        Roof points, metres.
    neighbours : (n, k) int32
        Nearest neighbours of every point, -1 where there are fewer.
    labels : (n,) int32
        Plane of every point, -1 for leftovers.
    distance_m : float
        Largest perpendicular distance of a point to the plane of the cluster that it joins.
    fewest_points : int
        Smaller clusters are not kept.
    """
    n = labels.size
    grown = labels.copy()
    next_label = 0
    for i in range(n):
        next_label = max(next_label, labels[i] + 1)
    flatness = _flatness(points, neighbours, labels)
    queue = np.empty(n, np.int32)
    asked = np.full(n, -1, np.int32)
    for seed in ascending_order(flatness):
        if flatness[seed] > distance_m * distance_m:
            break
        if grown[seed] >= 0:
            continue
        sums = _sums_of_neighbourhood(points, neighbours, grown, seed)
        a, b, c, fitted = best_fit_plane(sums)
        if not fitted or sums[0] < _MIN_SEED_POINTS:
            continue
        sums = np.zeros(N_SUMS)
        queue[0] = seed
        asked[seed] = seed
        held = 1
        at = 0
        refit = 2 * _MIN_SEED_POINTS
        while at < held:
            i = queue[at]
            at += 1
            add_point(sums, points, i)
            if sums[0] >= refit:
                a, b, c, fitted = best_fit_plane(sums)
                if not fitted:
                    break
                refit = int(1.5 * sums[0])
            cosine = cosine_of_slope(a, b)
            for q in range(neighbours.shape[1]):
                j = neighbours[i, q]
                if j < 0 or grown[j] >= 0 or asked[j] == seed:
                    continue
                asked[j] = seed
                if abs(height_above(points, j, a, b, c)) * cosine <= distance_m:
                    queue[held] = j
                    held += 1
        if at == held and held >= fewest_points:
            for s in range(held):
                grown[queue[s]] = next_label
            next_label += 1
    return grown


@kernel
def _flatness(points: FloatArray, neighbours: LabelArray, labels: LabelArray) -> FloatArray:
    """Mean square perpendicular residual of each leftover point's neighbourhood, (n,) m2; infinite without a plane."""
    flatness = np.full(labels.size, np.inf)
    for i in range(labels.size):
        if labels[i] < 0:
            sums = _sums_of_neighbourhood(points, neighbours, labels, i)
            a, b, c, fitted = best_fit_plane(sums)
            if fitted and sums[0] >= _MIN_SEED_POINTS:
                flatness[i] = mean_square_residual(sums, a, b, c) * cosine_of_slope(a, b) ** 2
    return flatness


@kernel
def _sums_of_neighbourhood(points: FloatArray, neighbours: LabelArray, labels: LabelArray, i: int) -> FloatArray:
    """The sums of the regression over a point and its leftover neighbours."""
    sums = np.zeros(N_SUMS)
    add_point(sums, points, i)
    for q in range(neighbours.shape[1]):
        j = neighbours[i, q]
        if j >= 0 and labels[j] < 0:
            add_point(sums, points, j)
    return sums
