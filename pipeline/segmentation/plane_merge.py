"""Merging of clusters that represent one plane, best pair first (Shorter and Kasparis, section 3.3).

The paper says that clusters of one plane are merged, not by which test. Here two clusters are one plane where the plane
of their union adds little *systematic* residual to either, and their planes make a small angle. Only clusters that
touch, or lie within a reach, are compared, in a queue, so that a cluster costs about the same in a city block as in a
house.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.heap import heap_pop, heap_push, heap_with_room
from pipeline.kernels.sorting import ascending_order
from pipeline.kernels.union_find import root_of
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray
from pipeline.segmentation.plane_regression import best_fit_plane, cosine_of_slope, mean_square_residual
from pipeline.segmentation.point_votes import ascending_once

_NO_MERGE = 1e30
"""Residual of clusters that must not merge: above every real one."""
_SMALL_CLUSTER_ANGLES = 2.0
"""Planes of small clusters may differ by so many times the angle: the normal of a few points is as uncertain."""


class _Clusters(NamedTuple):
    """Clusters while they are merged; arrays of one length n."""

    sums: FloatArray
    """(n, 10) float64, as `plane_regression.cluster_sums` gives them."""
    planes: FloatArray
    """(n, 3) float64, (a, b, c)."""
    root: IntArray
    """(n,) int64, the cluster that each became part of, itself where it did not."""
    version: LabelArray
    """(n,) int32, merges of each: a queued pair of an older version is stale."""


class _Limits(NamedTuple):
    """Conditions for a merge."""

    max_residual_m: float
    min_cosine: float
    """Least cosine of the angle between two planes."""
    min_cosine_small: float
    """The same if one of the clusters is small."""
    small: float
    """Points below which a cluster is small."""


class _Chains(NamedTuple):
    """Chains of the partners of n clusters, with two entries per pair; -1 ends a chain."""

    first: IntArray
    """(n,) int64, first entry of each cluster's chain."""
    last: IntArray
    """(n,) int64, last entry."""
    following: IntArray
    """(2 m,) int64, next entry."""
    partner: IntArray
    """(2 m,) int64, the cluster that an entry names."""


@kernel
def parallel_pairs_in_reach(
    points: FloatArray,
    labels: LabelArray,
    planes: FloatArray,
    usable: BoolArray,
    reach_m: float,
    min_cosine: float,
    work_limit: int,
) -> tuple[IntArray, int]:
    """Codes of pairs of usable clusters whose boxes in plan lie within a reach and whose planes are about parallel.

    A plane that a dormer or a wing cuts in two has parts that do not touch. Returns the codes as `touching_pairs`
    does, and the work; a work beyond the limit means that the list is not complete.
    """
    n = usable.size
    box = np.empty((n, 4))
    box[:, 0] = np.inf
    box[:, 1] = np.inf
    box[:, 2] = -np.inf
    box[:, 3] = -np.inf
    for i in range(labels.size):
        k = labels[i]
        if k >= 0:
            box[k, 0] = min(box[k, 0], points[i, 0])
            box[k, 1] = min(box[k, 1], points[i, 1])
            box[k, 2] = max(box[k, 2], points[i, 0])
            box[k, 3] = max(box[k, 3], points[i, 1])
    west = np.full(n, np.inf)
    count_of_usable = 0
    for k in range(n):
        if usable[k]:
            west[k] = box[k, 0]
            count_of_usable += 1
    # those that are not usable come last, among those without points
    nodes = np.empty(count_of_usable, np.int64)
    held = 0
    for k in ascending_order(west):
        if usable[k]:
            nodes[held] = k
            held += 1
    codes = np.empty(64, np.int64)
    count = 0
    work = 0
    for s in range(nodes.size):
        i = nodes[s]
        for t in range(s + 1, nodes.size):
            j = nodes[t]
            if box[j, 0] > box[i, 2] + reach_m:
                break
            work += 1
            if work > work_limit:
                return codes[:count].copy(), work
            if box[j, 1] > box[i, 3] + reach_m or box[i, 1] > box[j, 3] + reach_m:
                continue
            if _cosine_between(planes, i, j) < min_cosine:
                continue
            if count == codes.size:
                codes = np.concatenate((codes, np.empty(count, np.int64)))
            codes[count] = min(i, j) * n + max(i, j)
            count += 1
    return ascending_once(codes[:count]), work


@kernel
def _cosine_between(planes: FloatArray, i: int, j: int) -> float:
    """Cosine of the angle between two planes (a, b, c)."""
    dot = planes[i, 0] * planes[j, 0] + planes[i, 1] * planes[j, 1] + 1.0
    return float(dot * cosine_of_slope(planes[i, 0], planes[i, 1]) * cosine_of_slope(planes[j, 0], planes[j, 1]))


@kernel
def _merged_residual(clusters: _Clusters, i: int, j: int, limits: _Limits) -> float:
    """Systematic residual in metres that the common plane adds to the worse of two clusters; huge where it must not be.

    The mean square of a cluster about the common plane is that about its own plane (noise) plus a systematic part.
    """
    sums, planes = clusters.sums, clusters.planes
    is_small = min(sums[i, 0], sums[j, 0]) < limits.small
    if _cosine_between(planes, i, j) < (limits.min_cosine_small if is_small else limits.min_cosine):
        return _NO_MERGE
    a, b, c, fitted = best_fit_plane(sums[i] + sums[j])
    if not fitted:
        return _NO_MERGE
    in_i = mean_square_residual(sums[i], a, b, c) - mean_square_residual(
        sums[i], planes[i, 0], planes[i, 1], planes[i, 2]
    )
    in_j = mean_square_residual(sums[j], a, b, c) - mean_square_residual(
        sums[j], planes[j, 0], planes[j, 1], planes[j, 2]
    )
    return math.sqrt(max(0.0, in_i, in_j)) * cosine_of_slope(a, b)


@kernel
def _chains_of_partners(pairs: IntArray, n: int) -> _Chains:
    """Chains in the order of the pairs, codes low * n + high."""
    first = np.full(n, -1, np.int64)
    last = np.full(n, -1, np.int64)
    following = np.full(2 * pairs.size, -1, np.int64)
    partner = np.empty(2 * pairs.size, np.int64)
    for p in range(pairs.size):
        i, j = pairs[p] // n, pairs[p] % n
        for entry, owner, other in ((2 * p, i, j), (2 * p + 1, j, i)):
            partner[entry] = other
            if first[owner] < 0:
                first[owner] = entry
            else:
                following[last[owner]] = entry
            last[owner] = entry
    return _Chains(first, last, following, partner)


@kernel
def _absorb(clusters: _Clusters, chains: _Chains, i: int, j: int) -> None:
    """Add cluster j with its chain to cluster i, and fit the plane of i again."""
    sums, planes = clusters.sums, clusters.planes
    clusters.root[j] = i
    clusters.version[i] += 1
    clusters.version[j] = -1
    sums[i] += sums[j]
    planes[i, 0], planes[i, 1], planes[i, 2], _ = best_fit_plane(sums[i])
    chains.following[chains.last[i]] = chains.first[j]
    chains.last[i] = chains.last[j]


@kernel
def _remove_repeated(chains: _Chains, root: IntArray, i: int, seen: IntArray, stamp: int) -> None:
    """Name the partners of a cluster by their roots; entries for itself or a partner named before are removed.

    `seen` (n,) holds the last stamp of each partner; no stamp comes twice.
    """
    before = -1
    entry = chains.first[i]
    while entry >= 0:
        other = root_of(root, chains.partner[entry])
        if other == i or seen[other] == stamp:
            if before < 0:
                chains.first[i] = chains.following[entry]
            else:
                chains.following[before] = chains.following[entry]
                if chains.last[i] == entry:
                    chains.last[i] = before
        else:
            seen[other] = stamp
            chains.partner[entry] = other
            before = entry
        entry = chains.following[entry]


@kernel
def merge_planes(
    sums: FloatArray,
    planes: FloatArray,
    pairs: IntArray,
    max_residual_m: float,
    max_angle_deg: float,
    small_cluster_points: int,
    work_limit: int,
) -> tuple[LabelArray, int]:
    """Merge pairs of clusters of one plane, the least systematic residual first, until none is left.

    Parameters
    ----------
    sums : (n, 10) float64
        As `plane_regression.cluster_sums` gives them; those of a merged cluster are added to its partner in place.
    planes : (n, 3) float64
        (a, b, c) of every cluster; refitted in place.
    pairs : (m,) int64
        Codes low * n + high of the clusters that may merge, ascending. Pairs of a merged cluster pass to its partner.
    max_residual_m : float
        Largest systematic residual of either cluster about the common plane, perpendicular.
    max_angle_deg : float
        Largest angle between two planes; twice as much where one has fewer than `small_cluster_points` points.
    work_limit : int
        Most comparisons of two planes.

    Returns
    -------
    root : (n,) int32
        The cluster that every cluster became part of; the smaller index of two stays.
    work : int
        Comparisons made; beyond the limit the merging is not complete.
    """
    n = sums.shape[0]
    limits = _Limits(
        max_residual_m,
        math.cos(math.radians(max_angle_deg)),
        math.cos(math.radians(_SMALL_CLUSTER_ANGLES * max_angle_deg)),
        float(small_cluster_points),
    )
    clusters = _Clusters(sums, planes, np.arange(n), np.zeros(n, np.int32))
    root, version = clusters.root, clusters.version
    chains = _chains_of_partners(pairs, n)
    # pairs of clusters, low * n + high, with the sum of their versions
    queue = heap_with_room(pairs.size)
    held = 0
    for p in range(pairs.size):
        residual = _merged_residual(clusters, pairs[p] // n, pairs[p] % n, limits)
        if residual < max_residual_m:
            queue = heap_push(queue, held, residual, pairs[p], 0)
            held += 1
    work = pairs.size
    seen = np.full(n, -1, np.int64)
    merges = 0
    while held > 0:
        i, j = queue.ranks[0] // n, queue.ranks[0] % n
        stale = root[i] != i or root[j] != j or version[i] + version[j] != queue.items[0]
        heap_pop(queue, held)
        held -= 1
        if stale:
            continue
        merges += 1
        _absorb(clusters, chains, i, j)
        _remove_repeated(chains, root, i, seen, merges)
        entry = chains.first[i]
        while entry >= 0:
            other = chains.partner[entry]
            work += 1
            low, high = min(i, other), max(i, other)
            residual = _merged_residual(clusters, low, high, limits)
            if residual < max_residual_m:
                queue = heap_push(queue, held, residual, low * n + high, version[low] + version[high])
                held += 1
            entry = chains.following[entry]
        if work > work_limit:
            break
    for k in range(n):
        root[k] = root_of(root, k)
    return root.astype(np.int32), work
