"""Borders of roof faces whose vertices may move: where a vertex may go, and what that costs in points.

The points between the old and the new border then count for the other plane. No border touches or passes another, and
no vertex becomes one that a solid cannot have.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.orientation import same_ray, segments_meet, turn_of
from pipeline.kernels.sorting import ascending_order, counting_sort
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray
from pipeline.roof.arrangement.raster_labels import vertical_distance_m

_CLEARANCE_MM = 25.0
"""Moved borders keep this far from vertices; numerical guard of solids, whose vertices must stay distinct."""
_BUCKET_M = 1.0
"""Side of the squares by which points are sorted; changes the speed only."""
_ONE_WAY = 0.1
"""Sine of the angle below which edges have one direction."""
MAX_DEGREE = 16
"""Vertices with more edges stay."""


KEEPS = 4
"""Column of the edges: 1 where an edge lies on a guide, whose line it keeps."""


class Borders(NamedTuple):
    """Edges of the faces, one each: ends, face to the left of first to second, face to the right or -1, and `KEEPS`."""

    xy: IntArray
    """(v, 2) int64, millimetres."""
    edges: IntArray
    """(e, 5) int64; -1 as first end of an edge that is gone."""
    plane_of_face: LabelArray
    """(f,) int32."""
    is_fixed: BoolArray
    """(v,), the vertices of the outline."""
    directions: FloatArray = np.empty(0)
    """(d,) float64, those of the outline, which steps keep, radians."""


class Ends(NamedTuple):
    """The ends of the edges by vertex, in lists; end 2 e + side is that of edge e."""

    first: IntArray
    """(v,), an end at each vertex; -1 for none."""
    following: IntArray
    """(2 e,), the next end at the same vertex; -1 after the last."""


class Buckets(NamedTuple):
    """Points by squares of a raster."""

    points: FloatArray
    """(n, 3) float64, metres."""
    starts: LabelArray
    """(rows * columns + 1,), where each square begins in `order`."""
    order: LabelArray
    """(n,), points square by square, row after row from the south."""
    west: float
    south: float
    columns: int
    rows: int


@kernel
def buckets_of(points: FloatArray) -> Buckets:
    """Sort points (n, 3), at least one."""
    west, south, east, north = math.inf, math.inf, -math.inf, -math.inf
    for i in range(len(points)):
        west, south = min(west, points[i, 0]), min(south, points[i, 1])
        east, north = max(east, points[i, 0]), max(north, points[i, 1])
    columns, rows = int((east - west) / _BUCKET_M) + 1, int((north - south) / _BUCKET_M) + 1
    square = np.empty(len(points), np.int32)
    for i in range(len(points)):
        square[i] = int((points[i, 1] - south) / _BUCKET_M) * columns + int((points[i, 0] - west) / _BUCKET_M)
    starts, order = counting_sort(square, rows * columns)
    return Buckets(points, starts, order, west, south, columns, rows)


@kernel(inline="always")
def _change_in_triangle(
    buckets: Buckets,
    xy: IntArray,
    corners: tuple[int, int, int],
    planes: FloatArray,
    own: int,
    other: int,
    cap_m: float,
) -> float:
    """By how many unexplained points the costs rise where a triangle goes from its own plane to another."""
    p, q, r = corners
    x0, y0 = xy[p, 0] * 1e-3, xy[p, 1] * 1e-3
    x1, y1 = xy[q, 0] * 1e-3, xy[q, 1] * 1e-3
    x2, y2 = xy[r, 0] * 1e-3, xy[r, 1] * 1e-3
    low_column = max(int((min(x0, x1, x2) - buckets.west) / _BUCKET_M), 0)
    high_column = min(int((max(x0, x1, x2) - buckets.west) / _BUCKET_M), buckets.columns - 1)
    low_row = max(int((min(y0, y1, y2) - buckets.south) / _BUCKET_M), 0)
    high_row = min(int((max(y0, y1, y2) - buckets.south) / _BUCKET_M), buckets.rows - 1)
    change = 0.0
    for row in range(low_row, high_row + 1):
        for column in range(low_column, high_column + 1):
            square = row * buckets.columns + column
            for s in range(buckets.starts[square], buckets.starts[square + 1]):
                i = buckets.order[s]
                x, y = buckets.points[i, 0], buckets.points[i, 1]
                one = (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0)
                two = (x2 - x1) * (y - y1) - (y2 - y1) * (x - x1)
                three = (x0 - x2) * (y - y2) - (y0 - y2) * (x - x2)
                if (one >= 0.0 and two >= 0.0 and three >= 0.0) or (one <= 0.0 and two <= 0.0 and three <= 0.0):
                    change += min(vertical_distance_m(buckets.points, i, planes, other) / cap_m, 1.0)
                    change -= min(vertical_distance_m(buckets.points, i, planes, own) / cap_m, 1.0)
    return change


@kernel(inline="always")
def edges_of_rings(xy: IntArray, vertices: IntArray, starts: IntArray, owner: LabelArray) -> IntArray:
    """The edges of `Borders`; vertices, starts and owners of rings are those of `trace_faces`."""
    n = len(vertices)
    ends = np.empty((n, 3), np.int64)
    keys = np.empty(n, np.int64)
    for r in range(len(owner)):
        for s in range(starts[r], starts[r + 1]):
            after = s + 1 if s + 1 < starts[r + 1] else starts[r]
            a, b = vertices[s], vertices[after]
            ends[s, 0], ends[s, 1], ends[s, 2] = a, b, owner[r]
            keys[s] = min(a, b) * len(xy) + max(a, b)
    edges = np.zeros((n, 5), np.int64)
    m = 0
    before = np.int64(-1)
    for s in ascending_order(keys):
        if keys[s] == before:
            edges[m - 1, 3] = ends[s, 2]
        else:
            edges[m, 0], edges[m, 1], edges[m, 2], edges[m, 3] = ends[s, 0], ends[s, 1], ends[s, 2], -1
            m += 1
        before = keys[s]
    return edges[:m].copy()


@kernel(inline="always")
def are_parallel(xy: IntArray, edges: IntArray, one: int, other: int) -> bool:
    """Whether two edges have one direction, but for what rounding to 1 mm and passing through vertices turn them."""
    ax, ay = xy[edges[one, 1], 0] - xy[edges[one, 0], 0], xy[edges[one, 1], 1] - xy[edges[one, 0], 1]
    bx, by = xy[edges[other, 1], 0] - xy[edges[other, 0], 0], xy[edges[other, 1], 1] - xy[edges[other, 0], 1]
    turned = abs(float(ax * by - ay * bx))
    return turned <= _ONE_WAY * math.hypot(float(ax), float(ay)) * math.hypot(float(bx), float(by))


@kernel
def ends_at_vertices(borders: Borders) -> Ends:
    """List the ends of the edges by vertex."""
    edges = borders.edges
    first = np.full(len(borders.xy), -1, np.int64)
    following = np.full(2 * len(edges), -1, np.int64)
    for end in range(2 * len(edges) - 1, -1, -1):
        v = edges[end // 2, end % 2]
        if v >= 0:
            following[end] = first[v]
            first[v] = end
    return Ends(first, following)


@kernel
def edges_at(edges: IntArray, ends: Ends, v: int, found: IntArray) -> int:
    """Fill in the edges at a vertex, ascending; their number, or more than there is room for."""
    m = 0
    end = ends.first[v]
    while end >= 0:
        e = end // 2
        end = ends.following[end]
        if edges[e, 0] < 0:
            continue
        if m == len(found):
            return m + 1
        place = m
        while place > 0 and found[place - 1] > e:
            found[place] = found[place - 1]
            place -= 1
        found[place] = e
        m += 1
    return m


@kernel
def star_is_sound(borders: Borders, planes: FloatArray, v: int, gone: int, found: IntArray, m: int) -> bool:
    """Whether a solid can have the edges found at v and at `gone`, merged in v: no face twice, no walls that cross."""
    xy, edges = borders.xy, borders.edges
    angles = np.empty(2 * MAX_DEGREE)
    left = np.empty(2 * MAX_DEGREE, np.int64)
    n = 0
    x, y = xy[v, 0], xy[v, 1]
    for s in range(m):
        a, b = edges[found[s], 0], edges[found[s], 1]
        if (a in (v, gone)) and (b in (v, gone)):
            continue
        starts_here = a in (v, gone)
        w = b if starts_here else a
        angles[n] = math.atan2(float(xy[w, 1] - y), float(xy[w, 0] - x))
        left[n] = edges[found[s], 2] if starts_here else edges[found[s], 3]
        n += 1
    heights = np.empty(n)
    order = ascending_order(angles[:n])
    for i in range(n):
        face = left[order[i]]
        heights[i] = -math.inf
        if face >= 0:
            plane = planes[borders.plane_of_face[face]]
            heights[i] = plane[0] * x * 1e-3 + plane[1] * y * 1e-3 + plane[2]
        for j in range(i):
            if left[order[j]] == face:
                return False
    for k in range(n):
        changes = 0
        for i in range(n):
            changes += (heights[i] > heights[k]) != (heights[(i + 1) % n] > heights[k])
        if changes > 2:
            return False
    return True


@kernel(inline="always")
def _is_in_the_way(xy: IntArray, u: int, v: int, w: int, p: int) -> bool:
    """Whether vertex p lies in the triangle u, v, w, which is swept over, or too near to the edge from v to w."""
    dx, dy = float(xy[w, 0] - xy[v, 0]), float(xy[w, 1] - xy[v, 1])
    length = math.hypot(dx, dy)
    along = ((xy[p, 0] - xy[v, 0]) * dx + (xy[p, 1] - xy[v, 1]) * dy) / length
    off = abs((xy[p, 0] - xy[v, 0]) * dy - (xy[p, 1] - xy[v, 1]) * dx) / length
    if off < _CLEARANCE_MM and -_CLEARANCE_MM < along < length + _CLEARANCE_MM:
        return True
    one, two, three = turn_of(xy, u, w, p), turn_of(xy, w, v, p), turn_of(xy, v, u, p)
    is_flat = turn_of(xy, u, w, v) == 0
    return not is_flat and (min(one, two, three) >= 0 or max(one, two, three) <= 0)


@kernel
def _is_free(borders: Borders, u: int, v: int, w: int) -> bool:
    """Whether the edge from u to w can go from v to w instead: it sweeps over no vertex and touches nothing."""
    xy, edges = borders.xy, borders.edges
    if xy[v, 0] == xy[w, 0] and xy[v, 1] == xy[w, 1]:
        return False  # a place that is tried may be that of another vertex
    low_x, high_x = min(xy[u, 0], xy[v, 0], xy[w, 0]), max(xy[u, 0], xy[v, 0], xy[w, 0])
    low_y, high_y = min(xy[u, 1], xy[v, 1], xy[w, 1]), max(xy[u, 1], xy[v, 1], xy[w, 1])
    for e in range(len(edges)):
        c, d = edges[e, 0], edges[e, 1]
        if c < 0 or u in (c, d):
            continue
        if max(xy[c, 0], xy[d, 0]) < low_x - _CLEARANCE_MM or min(xy[c, 0], xy[d, 0]) > high_x + _CLEARANCE_MM:
            continue
        if max(xy[c, 1], xy[d, 1]) < low_y - _CLEARANCE_MM or min(xy[c, 1], xy[d, 1]) > high_y + _CLEARANCE_MM:
            continue
        for p in (c, d):
            if p not in (v, w) and _is_in_the_way(xy, u, v, w, p):
                return False
        from_c, from_d = c in (v, w), d in (v, w)
        if from_c and from_d:
            return False
        if from_c or from_d:
            shared, other = (c, d) if from_c else (d, c)
            if same_ray(xy, shared, other, w if shared == v else v):
                return False
        elif segments_meet(xy, v, w, c, d):
            return False
    return True


@kernel
def cost_of_moving(
    borders: Borders, buckets: Buckets, planes: FloatArray, u: int, v: int, found: IntArray, cap_m: float
) -> float:
    """Unexplained points more if the found edges at u end in v; infinite where they cannot. One from u to v goes."""
    xy, edges = borders.xy, borders.edges
    cost = 0.0
    for e in found:
        starts_here = edges[e, 0] == u
        w = edges[e, 1] if starts_here else edges[e, 0]
        if w == v:
            continue
        if not _is_free(borders, u, v, w):
            return math.inf
        left, right = edges[e, 2], edges[e, 3]
        if right < 0:
            continue
        # what lies between the old edge and the new one goes from the face on that side to the other
        if starts_here != (turn_of(xy, u, w, v) >= 0):
            left, right = right, left
        own, other = borders.plane_of_face[left], borders.plane_of_face[right]
        cost += _change_in_triangle(buckets, xy, (u, w, v), planes, own, other, cap_m)
    return cost
