"""Constrained Delaunay triangulation with greedy insertion: given edges stay, all else is Delaunay where they allow it.

Edges are recovered by flipping the diagonals that cross them (Sloan: *A fast algorithm for generating constrained
Delaunay triangulations*, Computers and Structures 47, 1993). Points are then inserted as in `greedy_insertion`, and no
flip crosses a given edge. The predicates are exact.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pipeline.compiler import kernel
from pipeline.geometry import bounds_of
from pipeline.kernels.heap import heap_pop, heap_push, heap_with_room
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray
from pipeline.tin.delaunay import insert_all, strip_order
from pipeline.tin.greedy_insertion import Buckets, Vertices, facet_plane, facets_around, is_left, put_in, take_out
from pipeline.tin.half_edges import following, must_flip, preceding, split_facet
from pipeline.tin.predicates import MAX_EXTENT_MM, lies_in_circumcircle, orientation


@dataclasses.dataclass(frozen=True, kw_only=True)
class ConstrainedTin:
    """A triangulation of n vertices with given edges, as half-edges (`pipeline.tin.half_edges`)."""

    x: FloatArray
    """(n + 1,) float64 mm; the last one is the vertex at infinity."""
    y: FloatArray
    """(n + 1,) float64 mm."""
    order: LabelArray
    """(n,) int32, the caller's number of every vertex."""
    origin: LabelArray
    """(4 m,) int32, the vertex where each half-edge starts."""
    twin: LabelArray
    """(4 m,) int32, the opposite half-edge."""
    is_given: BoolArray
    """(4 m,) bool, the half-edge is a part of a given edge."""
    region: LabelArray
    """(m,) int32, the region of every facet: no given edge lies within one; -1 at infinity."""
    inside: IntArray
    """(r, 3) int64, the vertices of the largest facet of each region."""


@kernel(inline="always")
def _flip(origin: LabelArray, twin: LabelArray, is_given: BoolArray, leaving: LabelArray, e: int) -> None:
    """Turn the diagonal e of its two facets: it and its twin become sides, and what follows them the diagonal."""
    f = twin[e]
    e_next, e_last, f_next, f_last = following(e), preceding(e), following(f), preceding(f)
    u, v, p, q = origin[e], origin[f], origin[e_last], origin[f_last]
    beyond_vp, beyond_uq = twin[e_next], twin[f_next]
    given_vp, given_uq = is_given[e_next], is_given[f_next]
    # (u, v, p) and (v, u, q) become (u, q, p) and (v, p, q)
    twin[e], twin[beyond_uq] = beyond_uq, e
    twin[f], twin[beyond_vp] = beyond_vp, f
    origin[e_next], origin[f_next] = q, p
    twin[e_next], twin[f_next] = f_next, e_next
    is_given[e], is_given[f] = given_uq, given_vp
    is_given[e_next] = is_given[f_next] = False
    leaving[u], leaving[v], leaving[p], leaving[q] = e, f, e_last, f_last


@kernel(inline="always")
def _edge_between(origin: LabelArray, twin: LabelArray, leaving: LabelArray, u: int, v: int) -> int:
    """The half-edge from u to v; -1 where there is none."""
    e = leaving[u]
    while True:
        if origin[following(e)] == v:
            return int(e)
        e = twin[preceding(e)]
        if e == leaving[u]:
            return -1


@kernel
def _crossed_edges(
    x: FloatArray, y: FloatArray, origin: LabelArray, twin: LabelArray, e: int, b: int, crossed: LabelArray
) -> tuple[LabelArray, int, int]:
    """The edges that the way crosses from the vertex where e starts to vertex b or the first vertex on the way.

    Returns an array with the two vertices of each edge, how many edges they are, and the vertex that was reached.
    """
    a, infinity = origin[e], len(x) - 1
    while True:
        u, v = origin[following(e)], origin[preceding(e)]
        if u != infinity:
            right = orientation(x[a], y[a], x[u], y[u], x[b], y[b])
            ahead = (x[u] - x[a]) * (x[b] - x[a]) + (y[u] - y[a]) * (y[b] - y[a]) > 0.0
            if u == b or (right == 0.0 and ahead):
                return crossed, 0, u
            if v not in (infinity, b) and right > 0.0 and orientation(x[a], y[a], x[v], y[v], x[b], y[b]) < 0.0:
                break
        e = twin[preceding(e)]
    count = 0
    h = following(e)
    while True:
        if 2 * count + 2 > len(crossed):
            crossed = np.concatenate((crossed, crossed))
        u, v = origin[h], origin[following(h)]
        crossed[2 * count], crossed[2 * count + 1] = u, v
        count += 1
        f = twin[h]
        w = origin[preceding(f)]
        side = orientation(x[a], y[a], x[b], y[b], x[w], y[w])
        if side == 0.0:
            return crossed, count, w
        # f runs from v to u: the way leaves by the edge u, w or by the edge w, v
        h = following(f) if side > 0.0 else preceding(f)


@kernel
def _recover(
    x: FloatArray, y: FloatArray, half_edges: tuple[LabelArray, LabelArray, BoolArray, LabelArray], edges: IntArray
) -> None:
    """Make the given edges (s, 2), which cross one another nowhere, edges of the triangulation, and mark them."""
    origin, twin, is_given, leaving = half_edges
    crossed = np.empty(64, np.int32)
    for s in range(len(edges)):
        a, b = edges[s, 0], edges[s, 1]
        while a != b:
            crossed, waiting, reached = _crossed_edges(x, y, origin, twin, leaving[a], b, crossed)
            if waiting:
                queue = crossed[: 2 * waiting].copy()
                room, first = waiting, 0
                while waiting > 0:
                    u, v = queue[2 * first], queue[2 * first + 1]
                    e = _edge_between(origin, twin, leaving, u, v)
                    p, q = origin[preceding(e)], origin[preceding(twin[e])]
                    side_u = orientation(x[p], y[p], x[q], y[q], x[u], y[u])
                    side_v = orientation(x[p], y[p], x[q], y[q], x[v], y[v])
                    first = (first + 1) % room
                    waiting -= 1
                    if side_u * side_v < 0.0:
                        _flip(origin, twin, is_given, leaving, e)
                        if a in (p, q) or reached in (p, q):
                            continue
                        side_p = orientation(x[a], y[a], x[reached], y[reached], x[p], y[p])
                        side_q = orientation(x[a], y[a], x[reached], y[reached], x[q], y[q])
                        if side_p * side_q > 0.0:
                            continue
                        u, v = p, q
                    last = (first + waiting) % room
                    queue[2 * last], queue[2 * last + 1] = u, v
                    waiting += 1
            e = _edge_between(origin, twin, leaving, a, reached)
            is_given[e] = is_given[twin[e]] = True
            a = reached


@kernel
def _make_delaunay(
    x: FloatArray,
    y: FloatArray,
    half_edges: tuple[LabelArray, LabelArray, BoolArray, LabelArray],
    n_facets: int,
) -> None:
    """Flip edges that are not given until all are Delaunay (Lawson 1977)."""
    origin, twin, is_given, leaving = half_edges
    infinity = len(x) - 1
    waiting = np.empty(4 * n_facets, np.int32)
    held = 0
    for t in range(n_facets):
        for e in range(4 * t, 4 * t + 3):
            if e < twin[e]:
                waiting[held] = e
                held += 1
    while held > 0:
        held -= 1
        e = waiting[held]
        if is_given[e]:
            continue
        f = twin[e]
        u, v, p, q = origin[e], origin[f], origin[preceding(e)], origin[preceding(f)]
        if infinity in (u, v, p, q):
            continue
        if lies_in_circumcircle(x[p], y[p], x[u], y[u], x[v], y[v], x[q], y[q]):
            if held + 4 > len(waiting):
                waiting = np.concatenate((waiting, waiting))
            _flip(origin, twin, is_given, leaving, e)
            waiting[held], waiting[held + 1], waiting[held + 2], waiting[held + 3] = e, preceding(e), f, preceding(f)
            held += 4


@kernel
def _regions(
    x: FloatArray, y: FloatArray, origin: LabelArray, twin: LabelArray, is_given: BoolArray, n_facets: int
) -> tuple[LabelArray, IntArray]:
    """The region of every facet (m,), -1 at infinity, and the vertices of the largest facet of each region (r, 3)."""
    infinity = len(x) - 1
    region = np.full(n_facets, -2, np.int32)
    largest = np.empty((n_facets, 3), np.int64)
    for t in range(n_facets):
        if infinity in (origin[4 * t], origin[4 * t + 1], origin[4 * t + 2]):
            region[t] = -1
    reached = np.empty(n_facets, np.int32)
    count = 0
    for start in range(n_facets):
        if region[start] != -2:
            continue
        reached[0], held = start, 1
        region[start] = count
        widest = -1.0
        while held > 0:
            held -= 1
            t = reached[held]
            a, b, c = origin[4 * t], origin[4 * t + 1], origin[4 * t + 2]
            area = orientation(x[a], y[a], x[b], y[b], x[c], y[c])
            if area > widest:
                widest = area
                largest[count, 0], largest[count, 1], largest[count, 2] = a, b, c
            for e in range(4 * t, 4 * t + 3):
                other = twin[e] >> 2
                if not is_given[e] and region[other] == -2:
                    region[other] = count
                    reached[held] = other
                    held += 1
        count += 1
    return region, largest[:count]


def triangulate_constrained(xy_mm: IntArray, edges: IntArray) -> ConstrainedTin:
    """The constrained Delaunay triangulation of different points (n, 2) on whole millimetres with edges (s, 2).

    Edges number their ends. They may meet at points only; a point on an edge divides it. Raises ValueError if the
    points extend over more than 2^21 mm, if two are equal, or if all lie on one line.
    """
    low, high = bounds_of(xy_mm)
    extent = int((high - low).max())
    if extent > MAX_EXTENT_MM:
        raise ValueError(f"points extend over {extent / 1000:.3f} m: use at most {MAX_EXTENT_MM / 1000:.3f} m")
    n, order = len(xy_mm), strip_order(xy_mm)
    x, y = np.append((xy_mm - low)[order].astype(np.float64), [[np.nan, np.nan]], axis=0).T.copy()
    origin, twin = np.empty(8 * n, np.int32), np.empty(8 * n, np.int32)
    n_facets, duplicate = insert_all(x, y, origin, twin)
    if n_facets == 0:
        place = tuple(xy_mm[order[max(duplicate, 0)]].tolist())
        raise ValueError(f"points at {place} mm are equal, or all points lie on one line")
    number = np.empty(n, np.int64)
    number[order] = np.arange(n)
    slots = 4 * np.arange(n_facets)[:, None] + np.arange(3)
    leaving = np.zeros(n + 1, np.int32)
    leaving[origin[slots]] = slots
    is_given = np.zeros(len(origin), np.bool_)
    half_edges = (origin, twin, is_given, leaving)
    _recover(x, y, half_edges, number[edges.reshape(-1, 2)])
    _make_delaunay(x, y, half_edges, n_facets)
    region, inside = _regions(x, y, origin, twin, is_given, n_facets)
    used = slice(4 * n_facets)
    return ConstrainedTin(
        x=x + low[0], y=y + low[1], order=order, origin=origin[used], twin=twin[used], is_given=is_given[used],
        region=region, inside=order[inside].astype(np.int64),
    )  # fmt: skip


@kernel
def _restore_constrained(
    x: FloatArray, y: FloatArray, origin: LabelArray, twin: LabelArray, is_given: BoolArray, facet: int
) -> None:
    """Flip around the newest vertex as `restore_delaunay` does, but across no given edge."""
    first = 4 * facet
    e = first
    p = origin[e]
    while True:
        f = twin[e + 1]
        after, before = following(f), preceding(f)
        v, q = origin[e + 2], origin[before]
        if not is_given[e + 1] and must_flip(x, y, p, origin[e + 1], v, q):
            twin_uq, twin_qv, twin_vp = twin[after], twin[before], twin[e + 2]
            given_uq, given_qv = is_given[after], is_given[before]
            g = f - (f & 3)
            origin[e + 2] = q
            twin[e + 1], twin[twin_uq] = twin_uq, e + 1
            origin[g], origin[g + 1], origin[g + 2] = p, q, v
            twin[g + 1], twin[twin_qv] = twin_qv, g + 1
            twin[g + 2], twin[twin_vp] = twin_vp, g + 2
            twin[e + 2], twin[g] = g, e + 2
            is_given[e + 1], is_given[g + 1] = given_uq, given_qv
            is_given[e + 2] = is_given[g] = is_given[g + 2] = False
        else:
            e = twin[e + 2]
            if e == first:
                return


@kernel
def _fill_buckets(
    vertices: Vertices, origin: LabelArray, buckets: Buckets, facets: IntArray, lattice: tuple[LabelArray, float, float]
) -> None:
    """Put the points of a lattice of 1 m into the buckets of the facets that hold them.

    `lattice` is the number of the point of every cell, (rows, columns) int32, -1 for none, and the place of the first.
    """
    x, y, _, rank = vertices
    point_of, west, south = lattice
    rows, columns = point_of.shape
    for t in facets:
        buckets.first[t] = -1
        a, b, c = origin[4 * t], origin[4 * t + 1], origin[4 * t + 2]
        low, high = min(y[a], y[b], y[c]), max(y[a], y[b], y[c])
        for r in range(max(int(np.ceil((low - south) / 1000.0)), 0), min(int((high - south) // 1000.0) + 1, rows)):
            row_y = south + 1000.0 * r
            left, right = np.inf, -np.inf
            for i, j in ((a, b), (b, c), (c, a)):
                if min(y[i], y[j]) <= row_y <= max(y[i], y[j]):
                    if y[i] == y[j]:
                        left, right = min(left, x[i], x[j]), max(right, x[i], x[j])
                    else:
                        crossing = x[i] + (x[j] - x[i]) * ((row_y - y[i]) / (y[j] - y[i]))
                        left, right = min(left, crossing), max(right, crossing)
            if left > right:
                continue
            # a cell more on each side: the exact test decides
            from_column = max(int(np.ceil((left - west) / 1000.0)) - 1, 0)
            to_column = min(int((right - west) // 1000.0) + 2, columns)
            for k in range(from_column, to_column):
                q = point_of[r, k]
                if (
                    q >= 0
                    and is_left(x, y, rank, a, b, q)
                    and is_left(x, y, rank, b, c, q)
                    and is_left(x, y, rank, c, a, q)
                ):
                    buckets.following[q] = buckets.first[t]
                    buckets.first[t] = q


@kernel(inline="always")
def _find_worst(buckets: Buckets, vertices: Vertices, origin: LabelArray, t: int, tolerance_mm: float) -> None:
    """Set the candidate of facet t: the point of the largest vertical error above a tolerance, -1 for none."""
    x, y, z, rank = vertices
    buckets.worst[t] = -1
    q = buckets.first[t]
    if q < 0:
        return
    base, gradient_x, gradient_y = facet_plane(vertices, origin, t)
    largest, chosen = tolerance_mm, -1
    while q >= 0:
        error = abs(z[q] - (z[base] + gradient_x * (x[q] - x[base]) + gradient_y * (y[q] - y[base])))
        if error > largest or (error == largest and chosen >= 0 and rank[q] < rank[chosen]):
            largest, chosen = error, q
        q = buckets.following[q]
    buckets.worst[t] = chosen
    buckets.worst_error[t] = largest


@kernel
def _refine(
    vertices: Vertices,
    half_edges: tuple[LabelArray, LabelArray, BoolArray],
    region: LabelArray,
    wanted: IntArray,
    lattice: tuple[LabelArray, float, float],
    limits: tuple[int, float],
) -> tuple[int, int, float, float]:
    """Insert points of a lattice into the wanted facets until none is off by more than a tolerance.

    The points are the first vertices; `limits` are the number of facets so far and the tolerance in mm. Returns the
    number of facets, that of the points in wanted facets, the sum of their squared errors, and the largest error.
    """
    x, y, z, rank = vertices
    origin, twin, is_given = half_edges
    n_facets, tolerance_mm = limits
    infinity = len(x) - 1
    room = len(region)
    buckets = Buckets(np.empty(room, np.int32), np.empty(infinity, np.int32), np.empty(room, np.int32), np.empty(room))
    _fill_buckets(vertices, origin, buckets, wanted, lattice)
    candidates = heap_with_room(1024)
    held = 0
    for t in wanted:
        _find_worst(buckets, vertices, origin, t, tolerance_mm)
        if buckets.worst[t] >= 0:
            candidates = heap_push(candidates, held, -buckets.worst_error[t], rank[buckets.worst[t]], t)
            held += 1
    n_old = n_facets
    star, unplaced = np.empty(64, np.int32), np.empty(infinity, np.int32)
    while held > 0:
        t = candidates.items[0]
        newest = buckets.worst[t]
        is_fresh = newest >= 0 and rank[newest] == candidates.ranks[0]
        is_fresh = is_fresh and buckets.worst_error[t] == -candidates.keys[0]
        heap_pop(candidates, held)
        held -= 1
        if not is_fresh:
            continue
        e = 4 * t
        given_ab, given_ca = is_given[e], is_given[e + 2]
        split_facet(origin, twin, t, n_facets, newest)
        f, g = 4 * n_facets, 4 * n_facets + 4
        is_given[e] = is_given[e + 2] = is_given[f] = is_given[f + 2] = is_given[g] = is_given[g + 2] = False
        is_given[f + 1], is_given[g + 1] = given_ca, given_ab
        for new in (n_facets, n_facets + 1):
            region[new] = region[t]
            buckets.first[new] = buckets.worst[new] = -1
        n_facets += 2
        _restore_constrained(x, y, origin, twin, is_given, t)
        # only the facets around the newest vertex have changed, and all of them
        star, n_star = facets_around(origin, twin, t, infinity, star)
        n_unplaced = take_out(buckets, star[:n_star], newest, unplaced, 0)
        put_in(buckets, vertices, origin, star[:n_star], newest, unplaced[:n_unplaced])
        for s in star[:n_star]:
            _find_worst(buckets, vertices, origin, s, tolerance_mm)
            if buckets.worst[s] >= 0:
                candidates = heap_push(candidates, held, -buckets.worst_error[s], rank[buckets.worst[s]], s)
                held += 1
    squares, largest, count = 0.0, 0.0, 0
    for i in range(len(wanted) + n_facets - n_old):
        t = wanted[i] if i < len(wanted) else n_old + i - len(wanted)
        q = buckets.first[t]
        if q >= 0:
            base, gradient_x, gradient_y = facet_plane(vertices, origin, t)
            while q >= 0:
                error = abs(z[q] - (z[base] + gradient_x * (x[q] - x[base]) + gradient_y * (y[q] - y[base])))
                squares += error * error
                largest = max(largest, error)
                count += 1
                q = buckets.following[q]
    return n_facets, count + (n_facets - n_old) // 2, squares, largest


@dataclasses.dataclass(frozen=True, kw_only=True)
class LatticePoints:
    """Points at the middle of cells of 1 m."""

    z_mm: FloatArray
    """(rows, columns) float64 elevation; nan for a cell that has no point."""
    west_mm: int
    """Easting of the points of the first column."""
    south_mm: int
    """Northing of those of the first row."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RefinedTin:
    """The facets of the wanted regions, and how far points are from them."""

    vertices_mm: IntArray
    """(v, 3) int64; all given vertices in the caller's order, then the inserted points."""
    facets: LabelArray
    """(t, 3) int32, turning left."""
    region: LabelArray
    """(t,) int32, the region of every facet."""
    beyond: LabelArray
    """(t, 3) int32, the region beyond the edge from each vertex to the next; -1 outside of everything."""
    n_points: int
    """Points in the wanted regions, those inserted among them."""
    squares_mm2: float
    """Sum of their squared vertical errors."""
    max_error_mm: float
    """The largest vertical error."""


def refine(
    tin: ConstrainedTin, z_mm: IntArray, wanted: BoolArray, points: LatticePoints, tolerance_mm: float
) -> RefinedTin:
    """Insert points of a lattice until each is at most a vertical tolerance off the facets of the wanted regions.

    `z_mm` (n,) are the elevations of the given vertices in the caller's order, `wanted` (r,) the regions. No point may
    lie on a given edge. The point of the largest error comes first (Garland and Heckbert 1995).
    """
    n_given = len(tin.order)
    has_point = ~np.isnan(points.z_mm)
    rows, columns = np.nonzero(has_point)
    n_points = len(rows)
    point_of = np.full(has_point.shape, -1, np.int32)
    point_of[rows, columns] = np.arange(n_points)
    n = n_points + n_given
    x, y, z = np.zeros(n + 1), np.zeros(n + 1), np.zeros(n + 1)
    x[:n_points], y[:n_points] = points.west_mm + 1000.0 * columns, points.south_mm + 1000.0 * rows
    z[:n_points] = points.z_mm[rows, columns]
    x[n_points:], y[n_points:] = tin.x, tin.y
    z[n_points:n] = z_mm[tin.order]
    rank = np.empty(n, np.int32)
    rank[np.lexsort((y[:n], x[:n]))] = np.arange(n)
    n_facets = len(tin.region)
    room = n_facets + 2 * n_points
    origin, twin = np.empty(4 * room, np.int32), np.empty(4 * room, np.int32)
    is_given, region = np.zeros(4 * room, np.bool_), np.empty(room, np.int32)
    origin[: 4 * n_facets], twin[: 4 * n_facets] = tin.origin + n_points, tin.twin
    is_given[: 4 * n_facets], region[:n_facets] = tin.is_given, tin.region
    chosen = np.append(wanted, [False])
    starts = np.flatnonzero(chosen[tin.region])
    n_facets, count, squares, largest = _refine(
        Vertices(x, y, z, rank),
        (origin, twin, is_given),
        region,
        starts,
        (point_of, float(points.west_mm), float(points.south_mm)),
        (n_facets, float(tolerance_mm)),
    )
    rows_of = np.flatnonzero(chosen[region[:n_facets]])
    edges = 4 * rows_of[:, None] + np.arange(3)
    corners = origin[edges]
    inserted = np.unique(corners[corners < n_points])
    number = np.empty(n, np.int32)
    number[n_points:] = tin.order
    number[inserted] = n_given + np.arange(len(inserted))
    vertices = np.empty((n_given + len(inserted), 3))
    vertices[number[n_points:]] = np.column_stack((x[n_points:n], y[n_points:n], z[n_points:n]))
    vertices[n_given:] = np.column_stack((x[inserted], y[inserted], z[inserted]))
    return RefinedTin(
        vertices_mm=np.rint(vertices).astype(np.int64),
        facets=number[corners],
        region=region[rows_of],
        beyond=region[twin[edges] >> 2],
        n_points=count,
        squares_mm2=squares,
        max_error_mm=largest,
    )
