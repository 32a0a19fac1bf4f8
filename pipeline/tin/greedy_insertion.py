"""Greedy insertion TIN with noise absorption (Garland & Heckbert 1995; Shorter & Kasparis, section 3.1).

Always the unused point with the largest vertical error is inserted and the Delaunay property restored, so the points
that define the surface most come first: corners, ridges, break lines. What lies on a facet up to a distance (Eq. 1),
where the facet is no wall (Eq. 2), is absorbed by it.

Nothing here depends on the order of the points. Facets are half-open, so that each unused point is in one facet only;
the plane of a facet is computed from its smallest vertex on; equal errors follow the lexicographic order of (x, y).
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.heap import heap_pop, heap_push, heap_with_room
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray, Tin
from pipeline.parameters import Parameters, parameter
from pipeline.tin.delaunay import strip_order, unique_xy_ranked
from pipeline.tin.half_edges import canonical_facets, locate, restore_delaunay, split_facet, start_sphere
from pipeline.tin.predicates import MAX_EXTENT_MM, orientation


class GreedyInsertionSettings(Parameters):
    """Settings of the greedy insertion."""

    absorption: str = parameter(
        "bucket",
        "What becomes of absorbed points: they stay in the bucket of their facet and insertion ends when all that is "
        "left would be absorbed, or they are inserted at the facet's elevation (the paper's way, slower).",
        choices=("bucket", "insert"),
    )
    absorption_distance_m: float = parameter(
        0.2, "Perpendicular distance up to which a facet absorbs a point (Eq. 1).", unit="m", minimum=0.0, maximum=10.0
    )
    absorption_slope_deg: float = parameter(
        60.0, "Slope up to which a facet absorbs points (Eq. 2).", unit="deg", minimum=0.0, maximum=89.0
    )
    margin_m: float = parameter(
        2.0,
        "Distance of the four corners of the TIN beyond the bounding box of the points.",
        unit="m",
        minimum=0.001,
        maximum=40.0,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class GreedyTin:
    """A TIN by greedy insertion, and where every point went."""

    tin: Tin
    """Delaunay facets over `vertices`."""
    vertices: FloatArray
    """(v, 3) float64 metres: four corners, counter-clockwise from the lower left, then the inserted points in the order
    of the input. The elevation of a point that was absorbed and inserted is that of its facet."""
    vertex_point: LabelArray
    """(v,) int32, the input point of every vertex; -1 for the corners."""
    facet_of_point: LabelArray
    """(n,) int32, the facet that contains a point; -1 for inserted points. A point beneath another one at the same
    position follows that one's facet, or the first facet at its vertex."""
    absorbed: BoolArray
    """(n,) bool, True for a point that was absorbed by a facet; False for one beneath another at the same position."""


class Vertices(NamedTuple):
    """The n points, the four corners counter-clockwise, and the vertex at infinity."""

    x: FloatArray
    y: FloatArray
    z: FloatArray
    """(n + 5,) float64 mm; the elevation of a point that is absorbed and inserted changes."""
    rank: LabelArray
    """(n + 4,) int32, place in the lexicographic order of (x, y)."""


class _Absorption(NamedTuple):
    """What a facet absorbs."""

    is_inserted: bool
    """Absorbed points are inserted at the elevation of their facet."""
    distance_mm: float
    """Perpendicular distance of Eq. 1."""
    steepest: float
    """Square of the rise over run of Eq. 2."""


class Buckets(NamedTuple):
    """The unused points of every facet, as linked lists, and which of them it would insert next."""

    first: LabelArray
    """(f,) int32, the first point of every facet; -1 where there is none."""
    following: LabelArray
    """(n,) int32, the next point in the same facet."""
    worst: LabelArray
    """(f,) int32, the candidate of every facet: the point of the largest vertical error."""
    worst_error: FloatArray
    """(f,) float64 mm."""


@kernel
def is_left(x: FloatArray, y: FloatArray, rank: LabelArray, a: int, b: int, p: int) -> bool:
    """Whether p belongs to the left of the directed edge a, b; points on it are left of its ascending direction."""
    turn = orientation(x[a], y[a], x[b], y[b], x[p], y[p])
    return bool(turn > 0.0 or (turn == 0.0 and rank[a] < rank[b]))


@kernel
def facet_plane(vertices: Vertices, origin: LabelArray, facet: int) -> tuple[int, float, float]:
    """The smallest vertex of a facet and its gradient from there: independent of the slots that the vertices are in."""
    x, y, z, rank = vertices
    e = 4 * facet
    a, b, c = origin[e], origin[e + 1], origin[e + 2]
    if rank[b] < rank[a] and rank[b] < rank[c]:
        a, b, c = b, c, a
    elif rank[c] < rank[a] and rank[c] < rank[b]:
        a, b, c = c, a, b
    ux, uy, uz = x[b] - x[a], y[b] - y[a], z[b] - z[a]
    vx, vy, vz = x[c] - x[a], y[c] - y[a], z[c] - z[a]
    twice_area = ux * vy - uy * vx
    return a, (uz * vy - vz * uy) / twice_area, (ux * vz - vx * uz) / twice_area


@kernel(inline="always")
def facets_around(
    origin: LabelArray, twin: LabelArray, facet: int, infinity: int, star: LabelArray
) -> tuple[LabelArray, int]:
    """The real facets around the vertex in slot 0 of a facet, in `star` or a larger array; how many they are."""
    first = 4 * facet
    e = first
    count = 0
    while True:
        if origin[e + 1] != infinity and origin[e + 2] != infinity:
            if count == len(star):
                star = np.concatenate((star, star))
            star[count] = e >> 2
            count += 1
        e = twin[e + 2]
        if e == first:
            return star, count


@kernel(inline="always")
def take_out(buckets: Buckets, star: LabelArray, newest: int, unplaced: LabelArray, count: int) -> int:
    """Empty the buckets of some facets and append their points but the newest to `unplaced`, which holds `count`."""
    for t in star:
        q = buckets.first[t]
        while q >= 0:
            if q != newest:
                unplaced[count] = q
                count += 1
            q = buckets.following[q]
        buckets.first[t] = -1
    return count


@kernel(inline="always")
def put_in(
    buckets: Buckets, vertices: Vertices, origin: LabelArray, star: LabelArray, newest: int, unplaced: LabelArray
) -> None:
    """Put points into the buckets of the facets around the newest vertex.

    The search goes from one facet to the next around that vertex: neighbours in a bucket are neighbours in the plane.
    """
    x, y, _, rank = vertices
    s = 0
    e = 4 * star[0]
    for q in unplaced:
        if is_left(x, y, rank, newest, origin[e + 1], q):
            while is_left(x, y, rank, newest, origin[e + 2], q):
                s = s + 1 if s + 1 < len(star) else 0
                e = 4 * star[s]
        else:
            s = s - 1 if s > 0 else len(star) - 1
            e = 4 * star[s]
            while not is_left(x, y, rank, newest, origin[e + 1], q):
                s = s - 1 if s > 0 else len(star) - 1
                e = 4 * star[s]
        buckets.following[q] = buckets.first[e >> 2]
        buckets.first[e >> 2] = q


@kernel(inline="always")
def _find_worst(buckets: Buckets, vertices: Vertices, origin: LabelArray, t: int, absorption: _Absorption) -> None:
    """Set the candidate of facet t: the point of the largest vertical error, of equal ones the smallest; -1 for none.

    A point that the facet absorbs is no candidate, unless absorbed points are inserted.
    """
    x, y, z, rank = vertices
    buckets.worst[t] = -1
    q = buckets.first[t]
    if q >= 0:
        base, gradient_x, gradient_y = facet_plane(vertices, origin, t)
        steepness = gradient_x * gradient_x + gradient_y * gradient_y
        # Eq. 1 by Eq. 2: perpendicular is vertical distance times the cosine of the slope
        absorbing_mm = -1.0
        if steepness <= absorption.steepest and not absorption.is_inserted:
            absorbing_mm = absorption.distance_mm * math.sqrt(1.0 + steepness)
        largest = -1.0
        chosen = -1
        while q >= 0:
            error = abs(z[q] - (z[base] + gradient_x * (x[q] - x[base]) + gradient_y * (y[q] - y[base])))
            if error > absorbing_mm and (error > largest or (error == largest and rank[q] < rank[chosen])):
                largest = error
                chosen = q
            q = buckets.following[q]
        buckets.worst[t] = chosen
        buckets.worst_error[t] = largest


@kernel(inline="always")
def _facets_of_rest(buckets: Buckets, n_facets: int, is_absorbed: BoolArray) -> LabelArray:
    """Facet of every point, (n,) int32, -1 where it was inserted; marks the rest as absorbed."""
    facet_of_point = np.full(len(buckets.following), -1, np.int32)
    for t in range(n_facets):
        q = buckets.first[t]
        while q >= 0:
            facet_of_point[q] = t
            is_absorbed[q] = True
            q = buckets.following[q]
    return facet_of_point


@kernel
def _insert_greedily(
    vertices: Vertices, absorption: _Absorption
) -> tuple[LabelArray, LabelArray, int, LabelArray, BoolArray]:
    """The insertion over n points; z of the vertices changes in place.

    Returns origins and twins of the half-edges, the number of facets, the facet of every point or -1 where it was
    inserted, and which points are absorbed.
    """
    x, y, z, rank = vertices
    infinity = len(x) - 1
    n = infinity - 4
    origin = np.empty(8 * (n + 4), np.int32)
    twin = np.empty(8 * (n + 4), np.int32)
    start_sphere(x, y, origin, twin, n, n + 1, n + 2)
    facet = locate(x, y, origin, twin, 0, n + 3)
    split_facet(origin, twin, facet, 4, n + 3)
    n_facets = 6
    restore_delaunay(x, y, origin, twin, facet)

    room = 2 * (n + 4)
    buckets = Buckets(np.full(room, -1, np.int32), np.empty(n, np.int32), np.full(room, -1, np.int32), np.empty(room))
    worst, worst_error = buckets.worst, buckets.worst_error
    is_absorbed = np.zeros(n, np.bool_)
    # the candidates of all facets: the largest error first, of equal ones the smallest point
    candidates = heap_with_room(1024)
    held = 0
    star = np.empty(64, np.int32)
    unplaced = np.arange(n).astype(np.int32)
    n_unplaced = n
    # opposite to the lower left corner, which the diagonal of the square avoids: both facets are its own
    newest = n + 3
    while True:
        # only the facets around the newest vertex have changed, and all of them
        star, n_star = facets_around(origin, twin, facet, infinity, star)
        n_unplaced = take_out(buckets, star[:n_star], newest, unplaced, n_unplaced)
        put_in(buckets, vertices, origin, star[:n_star], newest, unplaced[:n_unplaced])
        n_unplaced = 0
        for t in star[:n_star]:
            _find_worst(buckets, vertices, origin, t, absorption)
            if worst[t] >= 0:
                candidates = heap_push(candidates, held, -worst_error[t], rank[worst[t]], t)
                held += 1
        newest = -1
        while held > 0 and newest < 0:
            # an entry is stale where its facet has changed since
            t = candidates.items[0]
            if worst[t] >= 0 and rank[worst[t]] == candidates.ranks[0] and worst_error[t] == -candidates.keys[0]:
                newest = worst[t]
                facet = t
            heap_pop(candidates, held)
            held -= 1
        if newest < 0:
            break
        if absorption.is_inserted:
            base, gradient_x, gradient_y = facet_plane(vertices, origin, facet)
            steepness = gradient_x * gradient_x + gradient_y * gradient_y
            absorbing_mm = absorption.distance_mm * math.sqrt(1.0 + steepness)
            if steepness <= absorption.steepest and worst_error[facet] <= absorbing_mm:
                is_absorbed[newest] = True
                z[newest] = z[base] + gradient_x * (x[newest] - x[base]) + gradient_y * (y[newest] - y[base])
        split_facet(origin, twin, facet, n_facets, newest)
        n_facets += 2
        restore_delaunay(x, y, origin, twin, facet)
    return origin, twin, n_facets, _facets_of_rest(buckets, n_facets, is_absorbed), is_absorbed


def _lower_left_and_extent(xyz_mm: IntArray, margin_mm: int) -> tuple[IntArray, IntArray]:
    """Lower left corner and extent (2,) of points (n, 3) with a margin around them."""
    low = xyz_mm[:, :2].min(axis=0) - margin_mm
    wide = xyz_mm[:, :2].max(axis=0) + margin_mm - low
    if wide.max() > MAX_EXTENT_MM:
        raise ValueError(
            f"points with their margin extend over {wide.max() / 1000:.3f} m: triangulate windows of at most "
            f"{MAX_EXTENT_MM / 1000:.3f} m"
        )
    return low, wide


def _facets_of(points: IntArray, facet_of_point: LabelArray, inserted: IntArray, facets: LabelArray) -> LabelArray:
    """The facet of each of some points; for an inserted one, of the ascending `inserted`, the first at its vertex."""
    first_facet = np.full(4 + len(inserted), len(facets), np.int32)
    np.minimum.at(first_facet, facets.ravel(), np.repeat(np.arange(len(facets), dtype=np.int32), 3))
    found = facet_of_point[points]
    at_vertex = found < 0
    found[at_vertex] = first_facet[4 + np.searchsorted(inserted, points[at_vertex])]
    return found


def insert_greedily(points_m: FloatArray, settings: GreedyInsertionSettings, corner_z_m: float) -> GreedyTin:
    """Triangulate points by greedy insertion with noise absorption.

    The TIN begins with four corners around the points (n, 3), metres of whole millimetres, at the elevation of the
    ground. Of points at one position the highest takes part. Without points there are no vertices and no facets. Raises
    ValueError if the points with their margins extend over more than 2^21 mm, 2.097 km.

    The point inserted next is that of the largest *vertical* error, as Garland & Heckbert have it: perpendicular
    distances differ wildly on walls. Eq. 2 of Shorter & Kasparis is the slope of the facet and is computed as such, as
    it is 0/0 for a point on the facet.

    Examples
    --------
    >>> flat = np.array([[0.0, 0.0, 5.0], [4.0, 0.0, 5.0], [4.0, 4.0, 5.0], [0.0, 4.0, 5.0], [1.0, 2.0, 4.9]])
    >>> greedy = insert_greedily(flat, GreedyInsertionSettings(), corner_z_m=0.0)
    >>> greedy.absorbed
    array([False, False, False, False,  True])
    """
    n_points = len(points_m)
    if n_points == 0:
        none, nothing = np.empty(0, np.int32), np.empty((0, 3), np.int32)
        return GreedyTin(
            tin=Tin(facets=nothing, neighbours=nothing),
            vertices=np.empty((0, 3)),
            vertex_point=none,
            facet_of_point=none,
            absorbed=none.astype(np.bool_),
        )
    xyz_mm = np.rint(points_m * 1000.0).astype(np.int64)
    low, wide = _lower_left_and_extent(xyz_mm, round(settings.margin_m * 1000.0))
    kept, kept_of_point, kept_rank = unique_xy_ranked(xyz_mm[:, :2], xyz_mm[:, 2])
    kept_mm = xyz_mm[kept]
    along_strips = strip_order(kept_mm[:, :2])
    point = kept[along_strips]
    n = len(point)

    corners_xy = np.array([[0, 0], [wide[0], 0], [wide[0], wide[1]], [0, wide[1]]])
    x = np.concatenate((xyz_mm[point, 0] - low[0], corners_xy[:, 0], [0])).astype(np.float64)
    y = np.concatenate((xyz_mm[point, 1] - low[1], corners_xy[:, 1], [0])).astype(np.float64)
    z = np.concatenate((xyz_mm[point, 2], np.full(5, round(corner_z_m * 1000.0)))).astype(np.float64)
    rank = np.empty(n + 4, np.int32)
    rank[:n] = kept_rank[along_strips] + 2
    rank[n:] = [0, n + 2, n + 3, 1]
    surveyed_z = z.copy()
    absorption = _Absorption(
        is_inserted=settings.absorption == "insert",
        distance_mm=settings.absorption_distance_m * 1000.0,
        steepest=math.tan(math.radians(settings.absorption_slope_deg)) ** 2,
    )
    origin, twin, n_facets, facet_of_vertex, is_absorbed = _insert_greedily(Vertices(x, y, z, rank), absorption)

    inserted = np.sort(point[facet_of_vertex < 0])
    number_of_vertex = np.full(n + 4, -1, np.int32)
    number_of_vertex[n:] = np.arange(4)
    number_of_vertex[:n][facet_of_vertex < 0] = 4 + np.searchsorted(inserted, point[facet_of_vertex < 0])
    facets, neighbours, row_of_facet = canonical_facets(origin, twin, n_facets, number_of_vertex)

    vertices = np.empty((4 + len(inserted), 3))
    vertices[:4, :2] = (corners_xy + low) / 1000.0
    vertices[:4, 2] = corner_z_m
    vertices[4:] = points_m[inserted]
    moved = z[:n] != surveyed_z[:n]
    vertices[number_of_vertex[:n][moved], 2] = z[:n][moved] / 1000.0
    vertex_point = np.concatenate((np.full(4, -1), inserted)).astype(np.int32)

    facet_of_point = np.full(n_points, -1, np.int32)
    facet_of_point[point] = np.where(facet_of_vertex < 0, -1, row_of_facet[facet_of_vertex])
    beneath = np.ones(n_points, np.bool_)
    beneath[kept] = False
    if beneath.any():
        above = kept[kept_of_point[beneath]]
        facet_of_point[beneath] = _facets_of(above, facet_of_point, inserted, facets)
    absorbed = np.zeros(n_points, np.bool_)
    absorbed[point] = is_absorbed
    return GreedyTin(
        tin=Tin(facets=facets, neighbours=neighbours),
        vertices=vertices,
        vertex_point=vertex_point,
        facet_of_point=facet_of_point,
        absorbed=absorbed,
    )
