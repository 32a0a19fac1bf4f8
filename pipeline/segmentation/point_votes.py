"""The plane of each point: the paper's merging of points with planes, and a vote among neighbours."""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.sorting import ascending_order, counting_sort, in_order
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray
from pipeline.segmentation.plane_regression import cosine_of_slope

_LEVEL = math.tan(math.radians(10.0))
"""Rise over run of a slope."""
_STEP = 2.0
"""Largest distances of a point to its plane that make a step."""


@kernel
def distance_to_plane(points: FloatArray, i: int, planes: FloatArray, k: int) -> float:
    """Perpendicular distance of a point to a plane (Eq. 1)."""
    vertical = points[i, 2] - planes[k, 0] * points[i, 0] - planes[k, 1] * points[i, 1] - planes[k, 2]
    return float(abs(vertical) * cosine_of_slope(planes[k, 0], planes[k, 1]))


@kernel(inline="always")
def _relative_distance(
    points: FloatArray, i: int, planes: FloatArray, cosines: FloatArray, k: int, distance_m: float
) -> float:
    """Perpendicular distance of a point to a plane whose cosine of slope is known, over the largest one."""
    vertical = points[i, 2] - planes[k, 0] * points[i, 0] - planes[k, 1] * points[i, 1] - planes[k, 2]
    return float(abs(vertical) * cosines[k] / distance_m)


@kernel(inline="always")
def _votes(
    neighbours: LabelArray, labels: LabelArray, usable: BoolArray, i: int, kind: LabelArray, votes: LabelArray
) -> int:
    """Fill in the planes of a point and its neighbours, each once, and the votes of the neighbours; how many planes."""
    kinds = 0
    for q in range(-1, neighbours.shape[1]):
        j = i if q < 0 else neighbours[i, q]
        if j < 0 or (q >= 0 and j == i):
            continue
        k = labels[j]
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
    return kinds


@kernel
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

    All points choose at once from the labels before, so the outcome does not depend on their order. A plane beyond the
    distance is not a choice; a point without any choice is an outlier, -1.

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
    """
    width = neighbours.shape[1]
    old = labels.copy()
    new = np.empty_like(old)
    cosines = np.empty(len(planes))
    for k in range(len(planes)):
        cosines[k] = cosine_of_slope(planes[k, 0], planes[k, 1])
    changed = np.ones(old.size, np.bool_)
    changes = np.empty(old.size, np.int32)
    kind = np.empty(width + 1, np.int32)
    votes = np.empty(width + 1, np.int32)
    for _ in range(passes):
        n_changes = 0
        for i in range(old.size):
            # a point chooses as before where the labels around it stayed
            new[i] = old[i]
            asked = changed[i]
            alike = width > 0 and old[i] >= 0
            for q in range(width):
                j = neighbours[i, q]
                asked |= j >= 0 and changed[j]
                alike &= j >= 0 and j != i and old[j] == old[i]
            if not asked:
                continue
            if alike and usable[old[i]]:
                ratio = _relative_distance(points, i, planes, cosines, old[i], distance_m)
                if ratio > 1.0 or not ratio * ratio - vote_weight * width < 1.0:
                    new[i] = -1
                    changes[n_changes] = i
                    n_changes += 1
                continue
            kinds = _votes(neighbours, old, usable, i, kind, votes)
            least = 1.0
            chosen = np.int32(-1)
            for s in range(kinds):
                k = kind[s]
                ratio = _relative_distance(points, i, planes, cosines, k, distance_m)
                if ratio > 1.0:
                    continue
                cost = ratio * ratio - vote_weight * votes[s]
                if cost < least or (cost == least and k < chosen):
                    least = cost
                    chosen = k
            new[i] = chosen
            if chosen != old[i]:
                changes[n_changes] = i
                n_changes += 1
        old, new = new, old
        if n_changes == 0:
            break
        changed[:] = False
        for q in range(n_changes):
            changed[changes[q]] = True
    return old


@kernel
def touching_pairs(neighbours: LabelArray, labels: LabelArray, usable: BoolArray) -> IntArray:
    """Codes low * n + high of all pairs of usable clusters that occur together among one point and its neighbours.

    They ascend, each pair once, int64. `neighbours` (p, k) of every point are -1 where there are fewer; `labels` (p,)
    are the clusters of the points, -1 for none: so a gap of unlabelled points one wide is bridged. `usable` (n,)
    clusters have a plane.
    """
    n = usable.size
    width = neighbours.shape[1]
    codes = np.empty(64, np.int64)
    count = 0
    seen = np.empty(width + 1, np.int64)
    for i in range(labels.size):
        first = labels[i]
        mixed = first < 0
        if not mixed:
            for q in range(width):
                j = neighbours[i, q]
                if j >= 0 and labels[j] != first:
                    mixed = True
                    break
        if not mixed:
            continue
        kinds = 0
        for q in range(-1, width):
            j = i if q < 0 else neighbours[i, q]
            if j < 0 or labels[j] < 0 or not usable[labels[j]]:
                continue
            known = False
            for s in range(kinds):
                known = known or seen[s] == labels[j]
            if not known:
                seen[kinds] = labels[j]
                kinds += 1
        for s in range(kinds):
            for t in range(s):
                if count == codes.size:
                    codes = np.concatenate((codes, np.empty(count, np.int64)))
                codes[count] = min(seen[s], seen[t]) * n + max(seen[s], seen[t])
                count += 1
    return ascending_once(codes[:count])


@kernel
def ascending_once(codes: IntArray) -> IntArray:
    """Sorted codes without repetition."""
    ordered = in_order(codes)
    kept = 0
    for i in range(ordered.size):
        if i == 0 or ordered[i] != ordered[i - 1]:
            ordered[kept] = ordered[i]
            kept += 1
    return ordered[:kept].copy()


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
    row_m: float,
) -> None:
    """Give up planes whose points the planes around explain nearly as well, the smallest first, in place.

    The noise of a large plane leaves clusters of its outliers, and the edge between two planes a plane across it. The
    worth of a plane is the sum over its points of (distance / limit)^2 to the nearest touching plane, at most 1, less
    the same to itself. A slope is worth nothing, either, if all that is left to it is one row of points along a contour
    line, such as a parapet: with points below the step any row makes a plane. Points of a plane that is given up take
    the nearest touching plane, or none.

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
    row_m : float
        Extent in plan up to which points are one row.
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
        worth, low, high, off, own_points = 0.0, np.inf, -np.inf, 0.0, 0
        a, b = planes[k, 0], planes[k, 1]
        steep = math.sqrt(a * a + b * b)
        for m in range(begin[k], begin[k + 1]):
            i = member[m]
            away = np.inf
            for p in range(first[k], first[k + 1]):
                if usable[partner[p]]:
                    away = min(away, distance_to_plane(points, i, planes, partner[p]))
            least = min(away, distance_m)
            own = min(distance_m, distance_to_plane(points, i, planes, k))
            worth += (least * least - own * own) / (distance_m * distance_m)
            if least == distance_m:
                rise = a * points[i, 0] + b * points[i, 1]
                low, high, off, own_points = min(low, rise), max(high, rise), off + away, own_points + 1
            if worth > 4.0 * plane_cost and high - low >= row_m * steep:
                break
        is_row = own_points > 0 and steep > _LEVEL and high - low < row_m * steep
        if worth >= plane_cost and not (is_row and _STEP * distance_m * own_points <= off < np.inf):
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
