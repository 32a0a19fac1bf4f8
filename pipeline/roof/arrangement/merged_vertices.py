"""Borders of roof faces with as few corners as the points need: vertices that pay too little merge with a neighbour.

A vertex of the faces' borders is worth a few points (minimum description length). It is merged with a neighbour where
that changes the costs of the points by less: jogs of steps become straight, clusters of vertices become one, a hip that
ends beside a corner of the outline ends in it. Vertices of the given outline stay, and others on it move along it. A
step along the outline pays for a direction of its own, so it moves as a whole: its other end slides with it.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.sorting import ascending_order
from pipeline.model import FloatArray, IntArray
from pipeline.roof.arrangement.kept_directions import TURN, cost_of_sliding, slid_end, turned_steps
from pipeline.roof.arrangement.movable_borders import (
    KEEPS,
    MAX_DEGREE,
    Borders,
    Buckets,
    Ends,
    are_parallel,
    buckets_of,
    cost_of_moving,
    edges_at,
    ends_at_vertices,
    star_is_sound,
)
from pipeline.roof.arrangement.raster_labels import Limits

_NEEDLE_MM2 = 1e5
"""Borders that sweep less when a vertex moves go hardly anywhere, however far it moves along them."""
_ROUNDS = 8
"""Most turns through all edges: bounds the work; it ends as soon as nothing changes."""


@kernel
def _levels(heights: FloatArray, m: int, gap_m: float) -> int:
    """How many levels the first m heights make: higher ones that differ from the next lower by more than a gap."""
    levels = 0
    for i in range(m):
        below = -math.inf
        for j in range(m):
            if heights[j] < heights[i] or (heights[j] == heights[i] and j < i):
                below = max(below, heights[j])
        levels += heights[i] - below > gap_m
    return levels


@kernel
def _heights_at(borders: Borders, planes: FloatArray, v: int, found: IntArray, m: int, heights: FloatArray) -> int:
    """Heights over a vertex v of the faces beside the found edges, each face once; their number."""
    n = 0
    faces = np.empty(4 * MAX_DEGREE, np.int64)
    x, y = borders.xy[v, 0] * 1e-3, borders.xy[v, 1] * 1e-3
    for s in range(m):
        for side in (2, 3):
            face = borders.edges[found[s], side]
            known = face < 0
            for q in range(n):
                known = known or faces[q] == face
            if not known:
                plane = planes[borders.plane_of_face[face]]
                faces[n] = face
                heights[n] = plane[0] * x + plane[1] * y + plane[2]
                n += 1
    return n


@kernel(inline="always")
def _corners_saved(
    borders: Borders, planes: FloatArray, u: int, v: int, found: IntArray, m: int, m_v: int, gap_m: float
) -> int:
    """How many corners fewer there are with u merged into v; `found` holds the m edges at u, then those at v."""
    heights = np.empty(4 * MAX_DEGREE)
    before = _levels(heights, _heights_at(borders, planes, u, found, m, heights), gap_m)
    before += _levels(heights, _heights_at(borders, planes, v, found[m:], m_v, heights), gap_m)
    return before - _levels(heights, _heights_at(borders, planes, v, found, m + m_v, heights), gap_m)


@kernel(inline="always")
def _may_move(borders: Borders, edge: int, found: IntArray, m: int, reach_m: float) -> bool:
    """Whether the vertex with the m found edges may move along one of them: on outline or guide, and not too far."""
    xy, edges = borders.xy, borders.edges
    a, b = edges[edge, 0], edges[edge, 1]
    on_outline, swept = False, 0.0
    for s in range(m):
        on_outline = on_outline or edges[found[s], 3] < 0
        for end in range(2):
            o = edges[found[s], end]
            if o not in (a, b):
                ax, ay = xy[b, 0] - xy[a, 0], xy[b, 1] - xy[a, 1]
                swept += 0.5 * abs(float(ax * (xy[o, 1] - xy[a, 1]) - ay * (xy[o, 0] - xy[a, 0])))
        if edges[found[s], KEEPS] != 0 and not are_parallel(xy, edges, edge, found[s]):
            return False
    is_far = math.hypot(float(xy[a, 0] - xy[b, 0]), float(xy[a, 1] - xy[b, 1])) > reach_m * 1e3
    is_far = is_far and swept > _NEEDLE_MM2  # the tip of a needle may be far from its base
    return not (is_far and m > 2) and not (on_outline and edges[edge, 3] >= 0)


@kernel(inline="always")
def _gain_of_merging(
    borders: Borders,
    ends: Ends,
    buckets: Buckets,
    planes: FloatArray,
    way: tuple[int, int, int],
    slid: int,
    limits: Limits,
) -> float:
    """Points that merging a vertex of an edge into its other end gains; not positive where it cannot be done.

    `way` is the edge, the vertex and the other end. A vertex `slid` goes where `slid_end` puts it; -1 for none.
    """
    edges = borders.edges
    edge, u, v = way
    found = np.empty(2 * MAX_DEGREE, np.int64)
    m = edges_at(edges, ends, u, found[:MAX_DEGREE])
    if borders.is_fixed[u] or m > MAX_DEGREE or not _may_move(borders, edge, found, m, limits.corner_reach_m):
        return 0.0
    m_v = edges_at(edges, ends, v, found[m : m + MAX_DEGREE])
    if m_v > MAX_DEGREE:
        return 0.0
    gain = limits.corner_cost * _corners_saved(borders, planes, u, v, found, m, m_v, limits.corner_gap_m)
    if gain <= 0.0:
        return 0.0
    if slid >= 0:
        gain -= cost_of_sliding(borders, ends, buckets, planes, slid, limits)
    else:
        gain -= limits.corner_cost * TURN * turned_steps(borders, planes, u, v, found[:m], limits.corner_gap_m)
    if gain <= 0.0:
        return 0.0
    xy, trial = borders.xy, len(borders.xy) - 1
    moved = slid if slid >= 0 else trial
    x, y = xy[moved, 0], xy[moved, 1]
    xy[moved, 0], xy[moved, 1] = xy[trial, 0], xy[trial, 1]
    gain -= cost_of_moving(borders, buckets, planes, u, v, found[:m], limits.cap_m)
    if gain > 0.0 and not star_is_sound(borders, planes, v, u, found, m + m_v):
        gain = 0.0
    xy[moved, 0], xy[moved, 1] = x, y
    return gain


@kernel(inline="always")
def _shortest_first(borders: Borders) -> IntArray:
    """The edges by their length, those that are gone last, (e,)."""
    xy, edges = borders.xy, borders.edges
    lengths = np.empty(len(edges))
    for e in range(len(edges)):
        a, b = edges[e, 0], edges[e, 1]
        lengths[e] = math.hypot(float(xy[a, 0] - xy[b, 0]), float(xy[a, 1] - xy[b, 1])) if a >= 0 else math.inf
    return ascending_order(lengths)


@kernel(inline="always")
def _merge(edges: IntArray, ends: Ends, edge: int, u: int, v: int, into: IntArray) -> None:
    """Replace vertex u of an edge by its other end v, in place."""
    edges[edge, 0] = edges[edge, 1] = -1
    end, last = ends.first[u], -1
    while end >= 0:
        if edges[end // 2, 0] >= 0:
            edges[end // 2, end % 2] = v
        last, end = end, ends.following[end]
    ends.following[last] = ends.first[v]
    ends.first[v] = ends.first[u]
    ends.first[u] = -1
    for w in range(len(into)):
        if into[w] == u:
            into[w] = v


@kernel
def merge_vertices(borders: Borders, points: FloatArray, planes: FloatArray, limits: Limits) -> IntArray:
    """Merge vertices with a neighbour while that gains points, along the shortest edges first, in place.

    `points` (n, 3) and `planes` (k, 3) are in metres. Returns the vertex in place of each, (v,) int64.
    """
    edges = borders.edges
    into = np.arange(len(borders.xy))
    if len(points) == 0 or limits.corner_cost == 0.0:
        return into
    buckets = buckets_of(points)
    # one row more, in which places are tried
    xy = np.concatenate((borders.xy, np.zeros((1, 2), np.int64)))
    tried = Borders(xy, edges, borders.plane_of_face, borders.is_fixed, borders.directions)
    ends = ends_at_vertices(tried)
    for _ in range(_ROUNDS):
        changed = False
        for e in _shortest_first(tried):
            best, u, v, slid = 0.0, -1, -1, -1
            for side in range(2):
                one, other = edges[e, side], edges[e, 1 - side]
                if one < 0:
                    continue
                w = slid_end(tried, ends, planes, e, one, other, limits)
                gain = _gain_of_merging(tried, ends, buckets, planes, (e, one, other), w, limits) if w >= 0 else 0.0
                if gain <= 0.0:
                    w = -1
                    gain = _gain_of_merging(tried, ends, buckets, planes, (e, one, other), w, limits)
                if gain > best:
                    best, u, v, slid = gain, one, other, w
            if u < 0:
                continue
            if slid >= 0:
                slid = slid_end(tried, ends, planes, e, u, v, limits)
                xy[slid, 0], xy[slid, 1] = xy[-1, 0], xy[-1, 1]
            _merge(edges, ends, e, u, v, into)
            changed = True
        if not changed:
            break
    borders.xy[:] = xy[:-1]
    return into


@kernel
def rings_with_merged(vertices: IntArray, starts: IntArray, into: IntArray) -> tuple[IntArray, IntArray]:
    """The rings of `trace_faces` with merged vertices, from `merge_vertices`: vertices and the first of each ring."""
    merged = np.empty(len(vertices), np.int64)
    first = np.zeros(len(starts), np.int64)
    n = 0
    for r in range(len(starts) - 1):
        for s in range(starts[r], starts[r + 1]):
            v = into[vertices[s]]
            if n == first[r] or merged[n - 1] != v:
                merged[n] = v
                n += 1
        if n > first[r] + 1 and merged[n - 1] == merged[first[r]]:
            n -= 1
        first[r + 1] = n
    return merged[:n].copy(), first
