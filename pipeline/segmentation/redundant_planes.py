"""Planes that add nothing: clusters of another plane's outliers, and planes across the edge between two."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.counting_sort import counting_sort
from pipeline.kernels.merge_sort import ascending_order
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray
from pipeline.segmentation.point_assignment import distance_to_plane, touching_pairs


@kernel(inline="always")
def _partners(pairs: IntArray, n: int) -> tuple[LabelArray, LabelArray]:
    """Partners of each of n clusters, ascending, from codes low * n + high: where those of each start, and they."""
    m = pairs.size
    owners = np.empty(2 * m, np.int32)
    for p in range(m):
        owners[p], owners[m + p] = pairs[p] % n, pairs[p] // n
    first, partner = counting_sort(owners, n)
    for p in range(2 * m):
        partner[p] = owners[(partner[p] + m) % (2 * m)]
    return first, partner


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
    begin, member = counting_sort(labels, n)
    size = np.empty(n, np.int64)
    for k in range(n):
        size[k] = begin[k + 1] - begin[k]
    for k in ascending_order(size):
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
