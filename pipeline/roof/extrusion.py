"""The geometry of `pipeline.roof.solid` in one kernel: from polygons in plan to the vertices and rings of solids.

A corner is a vertex in a ring of a face; its edge leads to the next corner of the ring, and the face lies to the left.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.sorting import ascending_order, counting_sort
from pipeline.kernels.union_find import numbered_sets, unite
from pipeline.model import FloatArray, IntArray, LabelArray

SAME_HEIGHT_MM = 2
"""Levels of one plan vertex that are closer than this are one: twice the rounding."""
MIN_SPAN_MM = 5
"""A crossing of two planes nearer than this to the end of its edge is moved to that end; numerical guard."""
SOUND, OVERLAP, PINCH, DIP, CROSSING, BROKEN_OUTLINE = range(6)
"""Kinds of faults."""
WALL, FLOOR = -1, -2
"""In the place of a polygon's number, for faces that are not roofs."""


class Fault(NamedTuple):
    """What is wrong with the faces, if anything is."""

    kind: int
    """`SOUND` where there are."""
    x: int
    y: int
    """The vertex of an overlap or a pinch, mm; x is by how much a plane dips under the floor."""


class Extruded(NamedTuple):
    """Closed solids of parts that no edge connects, part after part."""

    points: FloatArray
    """(p, 3) float64, vertices of the solids, metres."""
    points_of_part: IntArray
    """(parts + 1,) int64, where those of each part start."""
    vertices: IntArray
    """(k,) int64, vertices of all rings, by their number within the part."""
    rings: IntArray
    """(r + 1,) int64, where each ring starts."""
    rings_of_face: IntArray
    """(f + 1,) int64, where the rings of each face start, the outer one first."""
    source: IntArray
    """(f,) int64, the polygon of each roof, `WALL` or `FLOOR`; a part has its roofs first, its floor last."""
    outlines: FloatArray
    """(c, 3) float64, vertices of the roofs' rings and of the floors', these seen from above, metres."""
    ring_of_outline: IntArray
    """(c,) int64, the ring of each of these vertices, numbered without the walls."""
    face_of_outline: IntArray
    """(rings,) int64, the face of each of these rings, numbered without the walls."""


class _Mesh(NamedTuple):
    """Corners of all faces, face after face and ring after ring."""

    vertex: IntArray
    """(n,) int64, number of the vertex in plan."""
    ring: IntArray
    """(n,) int64, its ring."""
    face: IntArray
    """(n,) int64, its face."""
    after: IntArray
    """(n,) int64, the next corner of its ring."""
    opposite: IntArray
    """(n,) int64, the corner whose edge is the same one the other way; -1 at the outline."""
    at: LabelArray
    """(v + 1,) int32, where the corners of each vertex start in `corners`."""
    corners: LabelArray
    """(n,) int32, corners by vertex, ascending."""


class _Stack(NamedTuple):
    """Vertices of the solids, in a row on each vertical line, from below."""

    points: IntArray
    """(p, 3) int64, mm, part after part."""
    points_of_part: IntArray
    """(parts + 1,) int64, where those of each part start."""
    node: IntArray
    """(n,) int64, that of every corner, numbered within its part."""
    foot: IntArray
    """(n,) int64, the one on the floor beneath it; -1 off the outline."""
    dips: IntArray
    """(parts,) int64, by how much too low the first roof that is too low lies, mm; 0 without any."""


class _Boundary(NamedTuple):
    """Faces of the solids as they are added; see `Extruded`."""

    vertices: IntArray
    rings: IntArray
    rings_of_face: IntArray
    source: IntArray
    counts: IntArray
    """(3,) int64, how many vertices, rings and faces there are."""


@kernel
def _places(coordinates: FloatArray, ring_of: IntArray) -> tuple[IntArray, IntArray]:
    """Places (n, 2) of corners in whole mm, and the ring of each, none twice in a row.

    Rings are given closed, by `coordinates` (c, 2) with the ring of each.
    """
    xy, ring = np.empty((len(coordinates), 2), np.int64), np.empty(len(coordinates), np.int64)
    n = 0
    for k in range(len(coordinates) - 1):
        if ring_of[k + 1] != ring_of[k]:  # it closes its ring
            continue
        x, y = int(np.rint(coordinates[k, 0])), int(np.rint(coordinates[k, 1]))
        if n == 0 or ring[n - 1] != ring_of[k] or x != xy[n - 1, 0] or y != xy[n - 1, 1]:
            xy[n, 0], xy[n, 1], ring[n] = x, y, ring_of[k]
            n += 1
    return xy[:n], ring[:n]


@kernel
def _numbered(xy: IntArray) -> tuple[IntArray, int]:
    """The number of the place of every corner (n, 2), in the order in which places come first; how many there are."""
    keys = (xy[:, 0] << 32) + xy[:, 1]
    order = ascending_order(keys)
    first = np.empty(len(xy), np.int64)
    for k in range(len(xy)):
        i = order[k]
        first[i] = first[order[k - 1]] if k > 0 and keys[order[k - 1]] == keys[i] else i
    number = np.empty(len(xy), np.int64)
    count = 0
    for i in range(len(xy)):
        if first[i] == i:
            number[i] = count
            count += 1
        else:
            number[i] = number[first[i]]
    return number, count


@kernel
def _meshed(vertex: IntArray, ring: IntArray, face_of_ring: IntArray, count: int) -> tuple[_Mesh, int]:
    """The mesh of corners at `count` vertices, and the first one whose edge another face has, too; -1 for none."""
    n = len(vertex)
    face, after = face_of_ring[ring], np.empty(n, np.int64)
    first = 0
    for i in range(n):
        if i > 0 and ring[i] != ring[i - 1]:
            first = i
        after[i] = i + 1 if i + 1 < n and ring[i + 1] == ring[i] else first
    at, corners = counting_sort(vertex.astype(np.int32), count)
    opposite = np.full(n, -1)
    overlap = -1
    for i in range(n):
        a, b = vertex[i], vertex[after[i]]
        is_double = a == b
        for j in corners[at[a] : at[a + 1]]:
            is_double |= j < i and vertex[after[j]] == b
        if is_double:
            overlap = i
            break
        for j in corners[at[b] : at[b + 1]]:
            if vertex[after[j]] == a:
                opposite[i] = j
    return _Mesh(vertex, ring, face, after, opposite, at, corners), overlap


@kernel
def _height_mm(plane: FloatArray, place: IntArray) -> float:
    """Height of a plane over a place; all in millimetres."""
    return float((plane[0] * (place[0] * 1e-3) + plane[1] * (place[1] * 1e-3) + plane[2]) * 1e3)


@kernel
def _crossings(mesh: _Mesh, xy: IntArray, planes: FloatArray) -> tuple[IntArray, IntArray]:
    """Places (m, 2) where two faces' planes cross on their edge, and which of them is on each corner's edge, else -1.

    `xy` (v, 2) are the vertices, planes (f, 3) those of the faces. Crossings next to an end are left out.
    """
    places, on_edge = np.empty((len(mesh.vertex), 2), np.int64), np.full(len(mesh.vertex), -1)
    count = 0
    for i in range(len(mesh.vertex)):
        j = mesh.opposite[i]
        a, b = mesh.vertex[i], mesh.vertex[mesh.after[i]]
        if a > b or j < 0:
            continue
        p, q = planes[mesh.face[i]], planes[mesh.face[j]]
        at_a = _height_mm(p, xy[a]) - _height_mm(q, xy[a])
        at_b = _height_mm(p, xy[b]) - _height_mm(q, xy[b])
        if at_a * at_b >= 0.0 or min(abs(at_a), abs(at_b)) <= SAME_HEIGHT_MM:
            continue
        fraction = at_a / (at_a - at_b)
        dx, dy = xy[b, 0] - xy[a, 0], xy[b, 1] - xy[a, 1]
        if min(fraction, 1.0 - fraction) * math.hypot(dx, dy) < MIN_SPAN_MM:
            continue
        places[count, 0], places[count, 1] = round(xy[a, 0] + fraction * dx), round(xy[a, 1] + fraction * dy)
        on_edge[i] = on_edge[j] = count
        count += 1
    return places[:count], on_edge


@kernel
def _heights(mesh: _Mesh, xy: IntArray, planes: FloatArray) -> tuple[FloatArray, IntArray]:
    """Height of every corner, mm, and the first corner at its vertex in its face, which has the height of all.

    Where two planes still cross on an edge, they do so next to an end: that end gets one height.
    """
    heights, first = np.empty(len(mesh.vertex)), np.empty(len(mesh.vertex), np.int64)
    for i in range(len(mesh.vertex)):
        v = mesh.vertex[i]
        heights[i] = _height_mm(planes[mesh.face[i]], xy[v])
        for j in mesh.corners[mesh.at[v] : mesh.at[v + 1]]:
            if mesh.face[j] == mesh.face[i]:
                first[i] = j
                break
    for i in range(len(mesh.vertex)):
        j = mesh.opposite[i]
        if j < 0 or mesh.vertex[i] > mesh.vertex[mesh.after[i]]:
            continue
        left_a, left_b, right_a, right_b = first[i], first[mesh.after[i]], first[mesh.after[j]], first[j]
        at_a, at_b = heights[left_a] - heights[right_a], heights[left_b] - heights[right_b]
        if at_a * at_b < 0.0:
            left, right = (left_a, right_a) if abs(at_a) <= abs(at_b) else (left_b, right_b)
            heights[left] = heights[right] = 0.5 * (heights[left] + heights[right])
    return heights, first


@kernel
def _stacked(
    mesh: _Mesh, xy: IntArray, heights: FloatArray, first: IntArray, part: LabelArray, parts: int, floor_mm: int
) -> _Stack:
    """The vertices of the solids: `part` (f,) is the part of each face, `first` (n,) as in `_heights`."""
    n = len(mesh.vertex)
    points, starts, n_points = np.empty((2 * n, 3), np.int64), np.zeros(parts + 1, np.int64), 0
    node, foot, dips = np.full(n, -1), np.full(n, -1), np.zeros(parts, np.int64)
    is_outline = np.zeros((max(parts, 1), len(xy)), np.bool_)  # faces that overlap are not put into parts
    for i in range(n):
        if mesh.opposite[i] < 0:
            is_outline[part[mesh.face[i]], mesh.vertex[i]] = True
            is_outline[part[mesh.face[i]], mesh.vertex[mesh.after[i]]] = True
    for number in range(parts):
        for v in range(len(xy)):
            there = mesh.corners[mesh.at[v] : mesh.at[v + 1]]
            floor = n_points - starts[number] if is_outline[number, v] else -1
            if floor >= 0:
                points[n_points] = xy[v, 0], xy[v, 1], floor_mm
                n_points += 1
            level = floor_mm - SAME_HEIGHT_MM
            # those of equal height are in the order of their faces, as corners are
            for k in ascending_order(heights[there]):
                i = there[k]
                if part[mesh.face[i]] != number or first[i] != i:
                    continue
                z = round(heights[i])
                if z < floor_mm + SAME_HEIGHT_MM and dips[number] == 0:
                    dips[number] = floor_mm + SAME_HEIGHT_MM - z
                if z - level >= SAME_HEIGHT_MM:
                    level = z
                    points[n_points] = xy[v, 0], xy[v, 1], z
                    n_points += 1
                node[i] = n_points - 1 - starts[number]
            for i in there:
                if part[mesh.face[i]] == number:
                    node[i], foot[i] = node[first[i]], floor
        starts[number + 1] = n_points
    return _Stack(points[:n_points], starts, node, foot, dips)


@kernel
def _add_vertex(boundary: _Boundary, vertex: int) -> None:
    """Add a vertex to the ring that is being drawn."""
    boundary.vertices[boundary.counts[0]] = vertex
    boundary.counts[0] += 1


@kernel
def _end_ring(boundary: _Boundary) -> None:
    """End the ring that is being drawn."""
    boundary.counts[1] += 1
    boundary.rings[boundary.counts[1]] = boundary.counts[0]


@kernel
def _end_face(boundary: _Boundary, source: int) -> None:
    """End the face that is being drawn."""
    boundary.source[boundary.counts[2]] = source
    boundary.counts[2] += 1
    boundary.rings_of_face[boundary.counts[2]] = boundary.counts[1]


@kernel
def _empty_boundary(mesh: _Mesh, stack: _Stack) -> _Boundary:
    """A boundary without faces that has room for all."""
    n = len(mesh.vertex)
    room = 2 * n
    for i in range(n):
        j, k = mesh.opposite[i], mesh.after[i]
        right_a, right_b = (stack.foot[i], stack.foot[k]) if j < 0 else (stack.node[mesh.after[j]], stack.node[j])
        room += 2 + abs(stack.node[i] - right_a) + abs(stack.node[k] - right_b)
    rings = 3 * n + 1
    return _Boundary(
        np.empty(room, np.int64), np.zeros(rings, np.int64), np.zeros(rings, np.int64), np.empty(rings, np.int64),
        np.zeros(3, np.int64),
    )  # fmt: skip


@kernel
def _add_roofs(boundary: _Boundary, mesh: _Mesh, stack: _Stack, part: LabelArray, number: int) -> None:
    """Add the roofs of a part."""
    n = len(mesh.vertex)
    for i in range(n):
        if part[mesh.face[i]] == number:
            _add_vertex(boundary, stack.node[i])
            if i + 1 == n or mesh.ring[i + 1] != mesh.ring[i]:
                _end_ring(boundary)
            if i + 1 == n or mesh.face[i + 1] != mesh.face[i]:
                _end_face(boundary, mesh.face[i])


@kernel
def _add_walls(
    boundary: _Boundary, mesh: _Mesh, stack: _Stack, part: LabelArray, number: int, below: IntArray
) -> tuple[int, int, IntArray]:
    """Add the walls of a part; the kind and vertex of a fault, and the corners whose edges are its outline.

    Edge a -> b of the outline makes below[b] the corner at a; `below` (v,) is -1 before.
    """
    outline, m = np.empty(len(mesh.vertex), np.int64), 0
    for i in range(len(mesh.vertex)):
        if part[mesh.face[i]] != number:
            continue
        j, k = mesh.opposite[i], mesh.after[i]
        a, b = mesh.vertex[i], mesh.vertex[k]
        if j < 0:
            if below[b] >= 0:
                return PINCH, b, outline[:m]
            below[b] = i
            outline[m] = i
            m += 1
        elif a > b:
            continue
        left_a, left_b = stack.node[i], stack.node[k]
        right_a, right_b = (stack.foot[i], stack.foot[k]) if j < 0 else (stack.node[mesh.after[j]], stack.node[j])
        if left_a == right_a and left_b == right_b:
            continue
        if left_a < right_a or left_b < right_b:
            if left_a > right_a or left_b > right_b:
                return CROSSING, a, outline[:m]
            left_a, left_b, right_a, right_b = right_b, right_a, left_b, left_a
        # the higher face lies left of a -> b, so the wall is seen from the right: up at b, down at a
        for vertex in range(right_b, left_b + 1):
            _add_vertex(boundary, vertex)
        for vertex in range(left_a, right_a - 1, -1):
            _add_vertex(boundary, vertex)
        _end_ring(boundary)
        _end_face(boundary, WALL)
    return SOUND, 0, outline[:m]


@kernel
def _add_floor(
    boundary: _Boundary, mesh: _Mesh, stack: _Stack, xy: IntArray, outline: IntArray, below: IntArray
) -> bool:
    """Add the floor of a part, its outer ring (clockwise: it is seen from below) first; whether that is one ring.

    `below` (v,) leads from vertex to vertex, see `_add_walls`; it is -1 again afterwards.
    """
    traced, rings, n_rings = np.empty(len(outline), np.int64), np.zeros(len(outline) + 1, np.int64), 0
    areas = np.empty(len(outline), np.int64)
    n = 0
    for edge in outline:
        v, area = mesh.vertex[mesh.after[edge]], 0
        if below[v] < 0:
            continue
        while below[v] >= 0:
            i = below[v]
            below[v] = -1
            following = mesh.vertex[i]
            area += xy[v, 0] * xy[following, 1] - xy[following, 0] * xy[v, 1]
            traced[n] = stack.foot[mesh.after[i]]
            v = following
            n += 1
        areas[n_rings] = area
        n_rings += 1
        rings[n_rings] = n
    for r in ascending_order(areas[:n_rings]):
        for vertex in traced[rings[r] : rings[r + 1]]:
            _add_vertex(boundary, vertex)
        _end_ring(boundary)
    _end_face(boundary, FLOOR)
    return bool((areas[:n_rings] < 0).sum() == 1)


@kernel
def _outlines(boundary: _Boundary, stack: _Stack) -> tuple[FloatArray, IntArray, IntArray]:
    """The outlines of `Extruded` with the ring of each vertex and the face of each ring."""
    n, n_rings, n_faces = boundary.counts
    xyz, ring_of, face_of = np.empty((n, 3)), np.empty(n, np.int64), np.empty(n_rings, np.int64)
    m = ring = face = part = 0
    for f in range(n_faces):
        if boundary.source[f] == WALL:
            continue
        is_floor = boundary.source[f] == FLOOR
        for r in range(boundary.rings_of_face[f], boundary.rings_of_face[f + 1]):
            start, stop = boundary.rings[r], boundary.rings[r + 1]
            for k in range(stop - start):
                vertex = boundary.vertices[stop - 1 - k if is_floor else start + k]
                for axis in range(3):
                    xyz[m, axis] = stack.points[stack.points_of_part[part] + vertex, axis] / 1e3
                ring_of[m] = ring
                m += 1
            face_of[ring] = face
            ring += 1
        face += 1
        part += is_floor
    return xyz[:m], ring_of[:m], face_of[:ring]


@kernel
def _bounded(mesh: _Mesh, stack: _Stack, part: LabelArray, xy: IntArray) -> tuple[_Boundary, int, int]:
    """The faces of all parts, and the first fault: its kind, and its vertex or how far a plane dips under the floor."""
    boundary, below = _empty_boundary(mesh, stack), np.full(len(xy), -1)
    for number in range(len(stack.dips)):
        if stack.dips[number] > 0:
            return boundary, DIP, stack.dips[number] - SAME_HEIGHT_MM
        _add_roofs(boundary, mesh, stack, part, number)
        fault, vertex, outline = _add_walls(boundary, mesh, stack, part, number, below)
        if fault != SOUND:
            return boundary, fault, vertex
        if not _add_floor(boundary, mesh, stack, xy, outline, below):
            return boundary, BROKEN_OUTLINE, 0
    return boundary, SOUND, 0


@kernel
def _meshed_with_crossings(
    places: IntArray, ring: IntArray, face_of_ring: IntArray, planes: FloatArray
) -> tuple[_Mesh, IntArray, int]:
    """The mesh of corners at `places` (n, 2) and its vertices (v, 2), with one where two faces' planes cross.

    Also the first corner whose edge another face has, too; -1 for none. Planes (f, 3) are those of the faces.
    """
    vertex, count = _numbered(places)
    mesh, overlap = _meshed(vertex, ring, face_of_ring, count)
    xy = np.empty((count, 2), np.int64)
    for i in range(len(vertex)):
        xy[vertex[i], 0], xy[vertex[i], 1] = places[i, 0], places[i, 1]
    if overlap >= 0:
        return mesh, xy, overlap
    crossings, on_edge = _crossings(mesh, xy, planes)
    if len(crossings) == 0:
        return mesh, xy, overlap
    n = len(vertex) + 2 * len(crossings)
    longer, longer_ring = np.empty(n, np.int64), np.empty(n, np.int64)
    m = 0
    for i in range(len(vertex)):
        longer[m], longer_ring[m] = vertex[i], ring[i]
        m += 1
        if on_edge[i] >= 0:
            longer[m], longer_ring[m] = count + on_edge[i], ring[i]
            m += 1
    mesh, overlap = _meshed(longer, longer_ring, face_of_ring, count + len(crossings))
    return mesh, np.concatenate((xy, crossings)), overlap


@kernel
def extruded(
    coordinates: FloatArray,
    ring_of: IntArray,
    face_of_ring: IntArray,
    labels: LabelArray,
    coefficients: FloatArray,
    floor_mm: int,
) -> tuple[Extruded, Fault]:
    """Extrude polygons that share their borders to a closed solid for every part that edges connect.

    Closed rings are given by `coordinates` (c, 2), mm, with the ring of each and the polygon of each ring, ascending,
    the outer ring first; outer rings run counter-clockwise, holes clockwise. `labels` (f,) is the plane of each
    polygon; planes z = a x + b y + c have `coefficients` (k, 3), metres. With a fault nothing else counts.
    """
    planes = coefficients[labels]
    places, ring = _places(coordinates, ring_of)
    mesh, xy, overlap = _meshed_with_crossings(places, ring, face_of_ring, planes)
    part, parts = np.zeros(len(labels), np.int32), 0
    if overlap < 0:
        parent = np.arange(len(labels))
        for i in range(len(mesh.vertex)):
            if mesh.opposite[i] >= 0:
                unite(parent, mesh.face[i], mesh.face[mesh.opposite[i]])
        part, parts = numbered_sets(parent)
    heights, first = _heights(mesh, xy, planes)
    stack = _stacked(mesh, xy, heights, first, part, parts, floor_mm)
    boundary, kind, figure = _bounded(mesh, stack, part, xy)
    if overlap >= 0:
        kind, figure = OVERLAP, mesh.vertex[overlap]
    x, y = figure, 0
    if kind in (OVERLAP, PINCH):
        x, y = xy[figure, 0], xy[figure, 1]
    outlines, ring_of_outline, face_of_outline = _outlines(boundary, stack)
    n, n_rings, n_faces = boundary.counts
    solids = Extruded(
        stack.points / 1e3,
        stack.points_of_part,
        boundary.vertices[:n],
        boundary.rings[: n_rings + 1],
        boundary.rings_of_face[: n_faces + 1],
        boundary.source[:n_faces],
        outlines,
        ring_of_outline,
        face_of_outline,
    )
    return solids, Fault(kind, x, y)
