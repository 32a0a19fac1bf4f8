"""Delaunay triangulation of points on whole millimetres: exact, canonical, incremental.

Points are inserted along narrow strips, every 8^k-th point first, with a walk from the facet of the point before and
Lawson's flips. With the exact predicates and their symbolic perturbation the result is unique: it does not depend on
the order of the points, and facets whose circumcircles lie in a shared part of two data sets are the same in both.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.geometry import bounds_of
from pipeline.kernels.sorting import radix_order
from pipeline.model import FloatArray, IntArray, LabelArray, Tin
from pipeline.tin.half_edges import canonical_facets, locate, restore_delaunay, split_facet, start_sphere
from pipeline.tin.predicates import orientation

MAX_WINDOW_MM = 2_000_000
"""The largest width or depth of one triangulation."""

_ROUND_FACTOR = 8  # points of a round over those of the round before
_STRIP_SPACINGS = 2.0  # width of a strip in mean distances between points; which facets there are does not depend on it


@kernel
def _strip_keys(xy_mm: IntArray, low: tuple[int, int], high: tuple[int, int], width: float) -> IntArray:
    """Position of each point (n, 2) along the strips between two corners, (n,): quarters of a strip's width count."""
    steps = np.int64(4.0 * (high[1] - low[1]) / width)
    keys = np.empty(len(xy_mm), np.int64)
    for i in range(len(xy_mm)):
        strip, step = np.int64((xy_mm[i, 0] - low[0]) / width), np.int64(4.0 * (xy_mm[i, 1] - low[1]) / width)
        keys[i] = strip * (steps + 1) + (step if strip & 1 == 0 else steps - step)
    return keys


@kernel
def insert_all(x: FloatArray, y: FloatArray, origin: LabelArray, twin: LabelArray) -> tuple[int, int]:
    """Triangulate vertices in the order of strips; return the number of facets and a duplicate vertex or -1."""
    n = len(x) - 1
    third = 2
    while third < n and orientation(x[0], y[0], x[1], y[1], x[third], y[third]) == 0.0:
        third += 1
    if n < 3 or third == n:
        return 0, -1
    start_sphere(x, y, origin, twin, 0, 1, third)
    n_facets = 4
    facet = 0
    stride = 1
    while stride * _ROUND_FACTOR < n:
        stride *= _ROUND_FACTOR
    coarser = n
    while stride > 0:
        for p in range(0, n, stride):
            if p % coarser == 0 or p in (0, 1, third):
                continue
            facet = locate(x, y, origin, twin, facet, p)
            for k in range(3):
                v = origin[4 * facet + k]
                if x[v] == x[p] and y[v] == y[p]:
                    return 0, p
            split_facet(origin, twin, facet, n_facets, p)
            n_facets += 2
            restore_delaunay(x, y, origin, twin, facet)
        coarser = stride
        stride //= _ROUND_FACTOR
    return n_facets, -1


def strip_order(xy_mm: IntArray) -> LabelArray:
    """Indices of points, (n,) int32, up one strip from west to east and down the next; at least one point.

    Neighbours follow each other, and points sorted by (x, y) stay near the places that they had. Where dense clusters
    lie far apart a strip holds many points: then only sorted ones are near their neighbours.
    """
    xy_mm = np.ascontiguousarray(xy_mm)
    low, high = (tuple(corner.tolist()) for corner in bounds_of(xy_mm))
    spacing = math.sqrt((high[0] - low[0]) * (high[1] - low[1]) / len(xy_mm))
    return radix_order(_strip_keys(xy_mm, low, high, max(1.0, _STRIP_SPACINGS * spacing)))


def triangulate(xy_mm: IntArray) -> Tin:
    """The Delaunay triangulation of different points (n, 2) on whole millimetres; see `unique_xy`.

    The hull is the exact convex hull, and points on its edges are vertices of it; there are no auxiliary vertices. At
    the hull, facets may be long and narrow. Facets start with their smallest vertex index and are sorted, so the same
    points in the same order give the same arrays, and in another order the same triangles. Of points on a common
    circle, the perturbation described in `pipeline.tin.predicates` decides. There are no facets where fewer than three
    points are given or all are collinear. Raises ValueError if the points extend over more than 2 km, or two are equal.

    Examples
    --------
    >>> triangulate(np.array([[0, 0], [1000, 0], [1000, 1000], [0, 1000]])).facets
    array([[0, 1, 3],
           [1, 2, 3]], dtype=int32)
    """
    xy_mm = np.ascontiguousarray(xy_mm, dtype=np.int64)
    if xy_mm.ndim != 2 or xy_mm.shape[1] != 2:
        raise ValueError(f"xy_mm has shape {xy_mm.shape}, not (n, 2)")
    n = len(xy_mm)
    no_facets = np.empty((0, 3), np.int32)
    if n == 0:
        return Tin(facets=no_facets, neighbours=no_facets)
    low, high = bounds_of(xy_mm)
    extent = int((high - low).max())
    if extent > MAX_WINDOW_MM:
        raise ValueError(f"points extend over {extent / 1000:.3f} m: triangulate windows of at most 2000 m")
    order = strip_order(xy_mm)
    x = np.empty(n + 1)
    y = np.empty(n + 1)
    x[:n] = (xy_mm[:, 0] - low[0])[order]
    y[:n] = (xy_mm[:, 1] - low[1])[order]
    x[n] = y[n] = np.nan
    # the sphere over n vertices and infinity has 2 n - 2 facets
    origin = np.empty(8 * n, np.int32)
    twin = np.empty(8 * n, np.int32)
    n_facets, duplicate = insert_all(x, y, origin, twin)
    if n_facets == 0:
        _refuse_duplicates(xy_mm, order, duplicate)
        return Tin(facets=no_facets, neighbours=no_facets)
    facets, neighbours, _ = canonical_facets(origin, twin, n_facets, order)
    return Tin(facets=facets, neighbours=neighbours)


def _refuse_duplicates(xy_mm: IntArray, order: LabelArray, duplicate: int) -> None:
    """Raise where the insertion met a duplicate, or collinear points hold one."""
    if duplicate < 0:
        _, index, counts = np.unique(xy_mm, axis=0, return_index=True, return_counts=True)
        if not (counts > 1).any():
            return
        point = int(index[counts > 1][0])
    else:
        point = int(order[duplicate])
    raise ValueError(f"point {point} at {tuple(xy_mm[point].tolist())} mm is given twice: use unique_xy first")


def unique_xy(xy_mm: IntArray, z_mm: IntArray) -> tuple[IntArray, LabelArray]:
    """Keep the highest point of every position in whole millimetres, of equal heights the lowest index.

    Returns the indices of the kept points, (u,) int64, ascending, and for every point the position among them of the
    one that represents it, (n,) int32.

    Examples
    --------
    >>> unique_xy(np.array([[0, 0], [5, 5], [0, 0]]), np.array([1, 2, 3]))
    (array([1, 2]), array([1, 0, 1], dtype=int32))
    """
    kept, kept_of_point, _ = unique_xy_ranked(xy_mm, z_mm)
    return kept, kept_of_point


def unique_xy_ranked(xy_mm: IntArray, z_mm: IntArray) -> tuple[IntArray, LabelArray, LabelArray]:
    """As `unique_xy`, and the rank of every kept point, (u,) int32, in the lexicographic order of (x, y)."""
    if len(xy_mm) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int32), np.empty(0, np.int32)
    low, high = bounds_of(np.ascontiguousarray(xy_mm, dtype=np.int64))
    extent = high - low
    if extent.max() >= 1 << 31:
        raise ValueError(f"points extend over {extent.max() / 1000:.3f} m: use coordinates of at most 2^31 mm extent")
    position = ((xy_mm[:, 0] - low[0]) << int(extent[1]).bit_length()) + (xy_mm[:, 1] - low[1])
    if (position[1:] > position[:-1]).all():  # points in canonical order, each position once: they mostly are
        each = np.arange(len(position))
        return each, each.astype(np.int32), each.astype(np.int32)
    return _keep_highest(position, np.ascontiguousarray(z_mm, dtype=np.int64), radix_order(position))


@kernel
def _keep_highest(position: IntArray, z_mm: IntArray, order: LabelArray) -> tuple[IntArray, LabelArray, LabelArray]:
    """The kernel of `unique_xy_ranked`; `order` sorts the positions, in whatever way where they are equal."""
    n = len(position)
    stands_for = np.empty(n, np.int32)
    rank = np.full(n, -1, np.int32)
    n_kept = 0
    first = 0
    while first < n:
        end = first
        highest = order[first]
        while end < n and position[order[end]] == position[order[first]]:
            q = order[end]
            if z_mm[q] > z_mm[highest] or (z_mm[q] == z_mm[highest] and q < highest):
                highest = q
            end += 1
        rank[highest] = n_kept
        n_kept += 1
        for i in range(first, end):
            stands_for[order[i]] = highest
        first = end
    number = np.empty(n, np.int32)
    kept = np.empty(n_kept, np.int64)
    n_kept = 0
    for i in range(n):
        if rank[i] >= 0:
            number[i] = n_kept
            kept[n_kept] = i
            n_kept += 1
    return kept, number[stands_for], rank[kept]
