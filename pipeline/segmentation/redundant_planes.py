"""Planes that add nothing: clusters of another plane's outliers, and planes across the edge between two."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray
from pipeline.segmentation.plane_merge import touching_pairs
from pipeline.segmentation.point_assignment import distance_to_plane


@kernel
def dissolve_redundant(
    points: FloatArray,
    neighbours: LabelArray,
    labels: LabelArray,
    planes: FloatArray,
    usable: BoolArray,
    distance_m: float,
    plane_cost: float,
) -> None:
    """Give up planes whose points the planes around explain nearly as well, the smallest first, in place.

    The noise of a large plane leaves clusters of its outliers, and the edge between two planes a plane across it. The
    worth of a plane is the sum over its points of (distance / limit)^2 to the nearest touching plane, at most 1, less
    the same to itself. Points of a plane that is given up take the nearest touching plane, or none.

    Parameters
    ----------
    points : (n, 3) float64
        Original elevations, metres.
    neighbours : (n, k) int32
        Nearest neighbours of every point, -1 where there are fewer.
    labels : (n,) int32
        Plane of every point, -1 for none; changed.
    planes : (m, 3) float64
        (a, b, c).
    usable : (m,) bool
        Planes in use; False afterwards for those given up.
    distance_m : float
        Largest perpendicular distance of a point to its plane.
    plane_cost : float
        Least worth of a plane; 0 gives up none.
    """
    n = usable.size
    pairs = touching_pairs(neighbours, labels, usable)
    if plane_cost <= 0.0 or pairs.size == 0:
        return
    first, partner = _partners(pairs, n)
    size = np.zeros(n, np.int64)
    for k in labels:
        if k >= 0:
            size[k] += 1
    # Points by label, in their order.
    begin = np.zeros(n + 1, np.int64)
    for k in range(n):
        begin[k + 1] = begin[k] + size[k]
    fill = begin[:-1].copy()
    member = np.empty(begin[n], np.int64)
    for i in range(labels.size):
        k = labels[i]
        if k >= 0:
            member[fill[k]] = i
            fill[k] += 1
    for k in np.argsort(size, kind="mergesort"):
        if not usable[k] or first[k] == first[k + 1]:
            continue
        worth = 0.0
        for m in range(begin[k], begin[k + 1]):
            i = member[m]
            least = distance_m
            for p in range(first[k], first[k + 1]):
                if usable[partner[p]]:
                    least = min(least, distance_to_plane(points, i, planes, partner[p]))
            own = min(distance_m, distance_to_plane(points, i, planes, k))
            worth += (least * least - own * own) / (distance_m * distance_m)
            if worth > 4.0 * plane_cost:
                break
        if worth >= plane_cost:
            continue
        usable[k] = False
        for m in range(begin[k], begin[k + 1]):
            i = member[m]
            least = distance_m
            labels[i] = -1
            for p in range(first[k], first[k + 1]):
                if not usable[partner[p]]:
                    continue
                distance = distance_to_plane(points, i, planes, partner[p])
                if distance < least:
                    least = distance
                    labels[i] = partner[p]


@kernel
def _partners(pairs: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """Pairs as lists: where the partners of every cluster begin, (n + 1,), and the partners, ascending."""
    first = np.zeros(n + 1, np.int64)
    for code in pairs:
        first[code // n + 1] += 1
        first[code % n + 1] += 1
    for k in range(n):
        first[k + 1] += first[k]
    fill = first[:-1].copy()
    partner = np.empty(2 * pairs.size, np.int64)
    for side in range(2):
        for code in pairs:
            low = code // n
            high = code % n
            owner = high if side == 0 else low
            partner[fill[owner]] = low if side == 0 else high
            fill[owner] += 1
    return first, partner
