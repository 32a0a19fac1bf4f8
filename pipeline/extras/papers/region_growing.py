"""Points of roof faces by region growing from the mean of clusters (the outlook of Hofmann et al. 2003, section 5).

A region starts where the neighbourhood of a point fits the mean direction of its cluster best, and grows over nearest
neighbours that lie near the running plane and are not isolated. If a cluster has points in several places, such as the
parallel faces of two roofs, they become several regions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.kernels.sorting import ascending_order
from pipeline.model import FloatArray, LabelArray, Reason
from pipeline.segmentation.plane_regression import (
    N_SUMS,
    add_point,
    best_fit_plane,
    cosine_of_slope,
    has_company,
    height_above,
)
from pipeline.segmentation.refinement_settings import RegionGrowingSettings

WORK_LIMIT = 1_000_000_000
"""Looks at neighbours after which a building is too complex: points that hold no region are grown over once a seed."""


def grow_regions(
    points: FloatArray,
    neighbours: LabelArray,
    clusters: LabelArray,
    gradients: FloatArray,
    *,
    distance_m: float,
    fewest_points: int,
    settings: RegionGrowingSettings,
    work_limit: int = WORK_LIMIT,
) -> tuple[FloatArray, LabelArray]:
    """Regions that start at points of clusters.

    Parameters
    ----------
    points : (n, 3) float64
        Roof points, metres.
    neighbours : (n, k) int32
        Nearest neighbours of every point, -1 where there are fewer.
    clusters : (n,) int32
        Cluster of every point, -1 for none.
    gradients : (c, 2) float64
        (a, b) of the mean plane of each cluster.
    distance_m : float
        Largest perpendicular distance of a point to the plane of the region that it joins.
    fewest_points : int
        Smaller regions are not kept.

    Returns
    -------
    planes : (r, 3) float64
        (a, b, c) of the least-squares plane of each region.
    labels : (n,) int32
        Region of every point, -1 for none; numbered in the order in which they grew, from the best fitting seed on.

    Raises
    ------
    BuildingError
        Reason ``too_complex`` beyond the limit of work.
    """
    planes, labels, work = _grow_regions(
        np.ascontiguousarray(points),
        np.ascontiguousarray(neighbours, dtype=np.int32),
        clusters.astype(np.int32),
        np.ascontiguousarray(gradients, dtype=np.float64),
        _Rules(distance_m, max(fewest_points, 3), settings.agreeing_share, settings.free_plane_points, work_limit),
    )
    if work > work_limit:
        raise BuildingError(
            Reason.TOO_COMPLEX,
            f"region growing stood at {work} looks at neighbours of {len(points)} points, the limit is {work_limit}",
        )
    return planes, labels


class _Rules(NamedTuple):
    """`RegionGrowingSettings` for one building."""

    distance_m: float
    fewest_points: int
    agreeing_share: float
    free_plane_points: int
    work_limit: int


@kernel
def _misfits(points: FloatArray, neighbours: LabelArray, clusters: LabelArray, gradients: FloatArray) -> FloatArray:
    """Mean square perpendicular distance of a point's neighbourhood to the best plane of its cluster's direction."""
    misfits = np.full(len(points), np.inf)
    for i in range(len(points)):
        k = clusters[i]
        if k < 0:
            continue
        a, b = gradients[k]
        count = 1
        total = 0.0
        squares = 0.0
        for j in neighbours[i]:
            if j >= 0:
                rise = (
                    points[j, 2] - points[i, 2] - a * (points[j, 0] - points[i, 0]) - b * (points[j, 1] - points[i, 1])
                )
                total += rise
                squares += rise * rise
                count += 1
        misfits[i] = max(0.0, squares / count - (total / count) ** 2) * cosine_of_slope(a, b) ** 2
    return misfits


@kernel
def _grow_regions(
    points: FloatArray,
    neighbours: LabelArray,
    clusters: LabelArray,
    gradients: FloatArray,
    rules: _Rules,
) -> tuple[FloatArray, LabelArray, int]:
    """Kernel of `grow_regions`; the looks at neighbours too, with which it gives up beyond the limit."""
    distance_m, fewest_points, agreeing_share, free_plane_points, work_limit = rules
    n = len(points)
    work = 0
    labels = np.full(n, -1, np.int32)
    asked = np.full(n, -1, np.int64)
    queue = np.empty(n, np.int32)
    planes = np.empty((n // fewest_points + 1, 3))
    count = 0
    misfits = _misfits(points, neighbours, clusters, gradients)
    for seed in ascending_order(misfits):
        if misfits[seed] > distance_m * distance_m:
            break
        if labels[seed] >= 0:
            continue
        if work > work_limit:
            break
        a, b = gradients[clusters[seed]]
        c = points[seed, 2] - a * points[seed, 0] - b * points[seed, 1]
        reach = distance_m / cosine_of_slope(a, b)
        sums = np.zeros(N_SUMS)
        queue[0] = seed
        asked[seed] = seed
        held = 1
        at = 0
        refit = free_plane_points
        while at < held:
            i = queue[at]
            at += 1
            work += neighbours.shape[1]
            add_point(sums, points, i)
            if sums[0] >= refit:
                own_a, own_b, own_c, fitted = best_fit_plane(sums)
                if fitted:
                    a, b, c = own_a, own_b, own_c
                    reach = distance_m / cosine_of_slope(a, b)
                refit = int(1.3 * sums[0]) + 1
            elif sums[0] < free_plane_points:
                c = (sums[3] - a * sums[1] - b * sums[2]) / sums[0]
            for j in neighbours[i]:
                if j < 0 or labels[j] >= 0 or asked[j] == seed:
                    continue
                if abs(height_above(points, j, a, b, c)) > reach:
                    continue
                work += neighbours.shape[1]
                if has_company(points, neighbours, j, a, b, c, reach, agreeing_share):
                    asked[j] = seed
                    queue[held] = j
                    held += 1
        a, b, c, fitted = best_fit_plane(sums)
        if held >= fewest_points and fitted:
            for q in range(held):
                labels[queue[q]] = count
            planes[count, 0], planes[count, 1], planes[count, 2] = a, b, c
            count += 1
    return planes[:count].copy(), labels, work
