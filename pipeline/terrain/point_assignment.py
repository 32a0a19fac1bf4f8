"""The surface of each point of the full cloud, found in the TIN of the thinned cloud."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.sorting import counting_sort
from pipeline.model import BoolArray, IntArray, KindArray, LabelArray
from pipeline.terrain.facets import FacetKind, LabelledTin, SceneVertices, VertexKind, first_corner, stands_up
from pipeline.terrain.fragment_sums import Sum


@kernel
def _facet_containing(
    px: int, py: int, start: int, x: IntArray, y: IntArray, facets: LabelArray, neighbours: LabelArray
) -> tuple[int, int]:
    """Walk to the facet that contains a point, -1 outside the hull; and the edge it lies on, -1 if inside."""
    f = start
    came_from = -1
    for _ in range(4 * facets.shape[0] + 8):
        moved = False
        on_edge = -1
        for q in range(3):
            v, w = facets[f, (q + 1) % 3], facets[f, (q + 2) % 3]
            side = (x[w] - x[v]) * (py - y[v]) - (y[w] - y[v]) * (px - x[v])
            if side < 0:
                g = neighbours[f, q]
                if g == came_from and g >= 0:
                    # both sides negative cannot be in a valid TIN; take another way if there is one
                    continue
                if g < 0:
                    return -1, -1
                came_from = f
                f = g
                moved = True
                break
            if side == 0:
                on_edge = q
        if not moved:
            return f, on_edge
    return -1, -1


@kernel
def _nearest_vertex(px: int, py: int, pz: int, x: IntArray, y: IntArray, z: IntArray, far_mm: int) -> int:
    """Nearest vertex in plan within far_mm, equal distances by elevation, then by coordinates; -1 where none.

    The vertices come sorted by (x, y).
    """
    best = -1
    best_distance, best_dz = far_mm * far_mm + 1, np.int64(0)
    for v in range(np.searchsorted(x, px - far_mm), x.size):
        if x[v] > px + far_mm:
            break
        distance = (px - x[v]) ** 2 + (py - y[v]) ** 2
        if distance > best_distance:
            continue
        dz = abs(pz - z[v])
        if distance < best_distance or dz < best_dz:
            best = v
            best_distance = distance
            best_dz = dz
    return best


class Allowed(IntEnum):
    """What a point may belong to."""

    NEVER = 0
    """To no building, by its trusted class."""
    ANY = 1
    """To any surface."""
    BUILDING = 2
    """It is building, by its trusted class."""
    EVIDENCE = 3
    """To none, since it is a low, thin object; it counts where its surface is judged."""
    UNDER_GLASS = 4
    """To none, since it was seen through one; the surface above it counts it."""


class ScenePoints(NamedTuple):
    """The points that a tile's core owns; arrays of one length n, absolute mm."""

    x_mm: IntArray
    y_mm: IntArray
    z_mm: IntArray
    height_mm: IntArray
    """Height above the terrain."""
    last: BoolArray
    """Last return of its pulse."""
    several: BoolArray
    """The pulse has more than one return."""
    allowed: KindArray
    """As in `Allowed`."""


class AssignmentLimits(NamedTuple):
    """Millimetres: how far points belong to a surface, from where on they are canopy, lie above ground, are far off."""

    reach: int
    same: int
    """How far undecided points belong to a surface that is building by its class."""
    canopy: int
    ground: int
    far: int


_STRIP_MM = 1000
"""Side of the cells in whose order points are looked up: a matter of speed."""


@kernel(inline="always")
def _along_strips(points: ScenePoints, ground_mm: int) -> LabelArray:
    """Indices of the points that may belong to a surface, up one strip from west to east and down the next.

    Neighbours follow each other, and vertices sorted by (x, y), with their facets, are near in memory. The points are
    those of a tile: the strips have a count for each square metre between them.
    """
    x, y = points.x_mm, points.y_mm
    column0, row0 = x.min() // _STRIP_MM, y.min() // _STRIP_MM
    columns, rows = x.max() // _STRIP_MM - column0 + 1, y.max() // _STRIP_MM - row0 + 1
    keys = np.empty(x.size, np.int32)
    for i in range(x.size):
        c, r = x[i] // _STRIP_MM - column0, y[i] // _STRIP_MM - row0
        wanted = points.allowed[i] != Allowed.NEVER and points.height_mm[i] >= ground_mm
        wanted |= points.allowed[i] == Allowed.UNDER_GLASS
        keys[i] = c * rows + (r if c & 1 == 0 else rows - 1 - r) if wanted else -1
    _, members = counting_sort(keys, columns * rows)
    return members


@kernel(inline="always")
def _corner_at(px: int, py: int, f: int, vertices: SceneVertices, facets: LabelArray) -> int:
    """The vertex of facet f at a place in plan; -1 where there is none."""
    found = -1
    for q in range(3):
        if f >= 0:
            v = facets[f, q]
            if vertices.x_mm[v] == px and vertices.y_mm[v] == py:
                found = v
    return found


@kernel(inline="always")
def _facet_at_edge(f: int, edge: int, vertices: SceneVertices, tin: LabelledTin) -> int:
    """The facet at an edge that is not a gap, else the one with the smaller opposite vertex.

    It is the same from whichever side a walk came.
    """
    x, y, facets, kinds = vertices.x_mm, vertices.y_mm, tin.facets, tin.kinds
    g = tin.neighbours[f, edge]
    if g >= 0 and kinds[g] != FacetKind.VOID:
        v = facets[f, edge]
        k = 0
        while tin.neighbours[g, k] != f:
            k += 1
        w = facets[g, k]
        if kinds[f] == FacetKind.VOID or x[w] < x[v] or (x[w] == x[v] and y[w] < y[v]):
            f = g
    return f


@kernel(inline="always")
def _above_facet(px: int, py: int, pz: int, f: int, vertices: SceneVertices, facets: LabelArray) -> float:
    """Height in mm of a point above the plane of facet f, computed from its smallest vertex on."""
    x, y, z = vertices.x_mm, vertices.y_mm, vertices.z_mm
    k = first_corner(x, y, facets, f)
    a, b, c = facets[f, k], facets[f, (k + 1) % 3], facets[f, (k + 2) % 3]
    ux, uy, uz = x[b] - x[a], y[b] - y[a], z[b] - z[a]
    vx, vy, vz = x[c] - x[a], y[c] - y[a], z[c] - z[a]
    det = float(ux * vy - uy * vx)
    gx, gy = float(uz * vy - vz * uy) / det, float(ux * vz - vx * uz) / det
    above: float = float(pz - z[a]) - gx * (px - x[a]) - gy * (py - y[a])
    return above


@kernel(inline="always")
def _corner_on_level(
    px: int, py: int, pz: int, f: int, vertices: SceneVertices, tin: LabelledTin, reach_mm: int
) -> int:
    """The corner of facet f that is nearest in elevation, then in plan; -1 beyond the reach."""
    found = -1
    best = reach_mm + 1
    best_distance = np.int64(2**62)
    for q in range(3):
        v = tin.facets[f, q]
        if tin.vertex_label[v] < 0:
            continue
        dz = abs(pz - vertices.z_mm[v])
        distance = (px - vertices.x_mm[v]) ** 2 + (py - vertices.y_mm[v]) ** 2
        if dz < best or (dz == best and distance < best_distance):
            best = dz
            best_distance = distance
            found = v
    return found if best <= reach_mm else -1


@kernel(inline="always")
def _at_joined_edge(f: int, vertices: SceneVertices, tin: LabelledTin) -> bool:
    """Whether a facet lies between the ground and a building to which one of its corners was joined."""
    if f < 0 or tin.kinds[f] != FacetKind.BORDER:
        return False
    joined = False
    for q in range(3):
        kind = vertices.kind[tin.facets[f, q]]
        if kind == VertexKind.JOINED:
            joined = True
        elif kind != VertexKind.GROUND and kind != VertexKind.BUILDING:  # noqa: PLR1714 - compiled
            return False
    return joined


@kernel(inline="always")
def _lower(p: IntArray, px: int, py: int, pz: int) -> None:
    """Replace a place by one that is lexicographically smaller."""
    if px < p[0] or (px == p[0] and (py < p[1] or (py == p[1] and pz < p[2]))):
        p[0], p[1], p[2] = px, py, pz


@kernel(inline="always")
def _count_under_glass(f: int, tin: LabelledTin, sums: IntArray) -> None:
    """Count a point below facet f for the fragment that the facet belongs to, if it belongs to one."""
    if f >= 0 and tin.label[f] >= 0:
        sums[tin.label[f], Sum.GLASS] += 1


@kernel
def assign_points(
    points: ScenePoints,
    vertices: SceneVertices,
    tin: LabelledTin,
    limits: AssignmentLimits,
    sums: IntArray,
    lowest_point: IntArray,
) -> LabelArray:
    """Fragment of every point of the core, int32 (n,), -1 where none; fills the columns of sums that count points.

    A point belongs to the surface of the facet around it, or at walls and borders to that of the vertex nearest in
    elevation. Where that is building by its class, an undecided point has to be nearer, within `limits.same`.
    `lowest_point` (f, 3) int64 gets the smallest point of each fragment. All in mm.
    """
    x, y, z = vertices.x_mm, vertices.y_mm, vertices.z_mm
    facets, kinds, vertex_label = tin.facets, tin.kinds, tin.vertex_label
    out = np.full(points.x_mm.size, -1, np.int32)
    if facets.shape[0] == 0 or out.size == 0:
        return out
    previous = 0
    for i in _along_strips(points, limits.ground):
        px, py, pz = points.x_mm[i], points.y_mm[i], points.z_mm[i]
        f, on_edge = _facet_containing(px, py, previous, x, y, facets, tin.neighbours)
        if f >= 0:
            previous = f
        at_vertex = _corner_at(px, py, f, vertices, facets)
        if at_vertex < 0 and f >= 0 and on_edge >= 0:
            f = _facet_at_edge(f, on_edge, vertices, tin)
        fragment, v, over = -1, -1, 0.0
        if points.allowed[i] == Allowed.UNDER_GLASS:
            _count_under_glass(f, tin, sums)
            continue
        if f < 0 or kinds[f] == FacetKind.VOID or at_vertex >= 0:
            # facets across gaps differ from tile to tile: only the nearest vertex is sure
            v = at_vertex if at_vertex >= 0 else _nearest_vertex(px, py, pz, x, y, z, limits.far)
        elif kinds[f] == FacetKind.OBJECT or kinds[f] == FacetKind.BUILDING:
            over = _above_facet(px, py, pz, f, vertices, facets)
            if abs(over) <= limits.reach:
                fragment = tin.label[f]
            elif over > limits.canopy and not points.last[i]:
                sums[tin.label[f], Sum.CANOPY] += 1
        else:
            v = _corner_on_level(px, py, pz, f, vertices, tin, limits.reach)
        if v >= 0 and abs(pz - z[v]) <= limits.reach:
            fragment, over = vertex_label[v], float(pz - z[v])
        if fragment < 0 or not stands_up(tin.fragment_kind[fragment]):
            continue
        if tin.fragment_kind[fragment] == FacetKind.BUILDING and points.allowed[i] != Allowed.BUILDING:
            # at its edges they belong to it only beside others that do
            is_sure = v < 0 or at_vertex >= 0 or vertices.kind[v] == VertexKind.JOINED
            continues = is_sure or _at_joined_edge(f, vertices, tin)
            if points.allowed[i] != Allowed.ANY or not continues or abs(over) > limits.same:
                continue
        sums[fragment, Sum.POINTS] += 1
        sums[fragment, Sum.SEVERAL] += points.several[i]
        sums[fragment, Sum.THROUGH] += not points.last[i]
        if points.allowed[i] == Allowed.EVIDENCE:
            continue
        out[i] = fragment
        _lower(lowest_point[fragment], px, py, pz)
    return out
