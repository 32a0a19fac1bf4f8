"""Roof faces from labelled cells: crossing borders are separated, cells united, rings traced.

Where two borders cross, walls of four faces can meet in one vertical edge, or one face can touch itself: a solid with
such an edge is not valid (val3dity's 303). A small corner of one face then goes to its neighbour, which separates them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.orientation import turn_of
from pipeline.kernels.sorting import counting_sort
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray
from pipeline.roof.arrangement.plan_cells import cell_borders, connected_faces
from pipeline.roof.arrangement.subdivision import (
    CELLS,
    EDGES,
    FACE,
    LINE,
    NEXT,
    ORIGIN,
    PREVIOUS,
    VERTICES,
    Subdivision,
    insert_chord,
    insert_vertex,
)

_CORNER_MM = 120.0
"""Size of the corner that goes to a neighbour: well above the rounding to 1 mm, below the size of details."""
_MIN_CORNER_MM = 20.0
"""Where there is room for less only, the border is not parted here; numerical guard."""
_STRAIGHT_MM = 2.0
"""A vertex that was put on a line and bends it by less goes again: this is what rounding to 1 mm does."""
_MAX_BORDERS = 32
"""Room for the borders that meet in one vertex; further ones are not looked at."""
_LARGE_COST = 100.0
"""Metres: more than heights differ by."""


class _Star(NamedTuple):
    """The borders between faces at one vertex, turning left, and what lies to the left of each, with room for 32."""

    borders: IntArray
    """int64, half-edges."""
    faces: IntArray
    """int64, -1 outside."""
    planes: IntArray
    """int64, -1 outside."""
    heights: FloatArray
    """Heights of the planes at the vertex, metres; -inf outside."""
    refused: BoolArray
    """(64,), corners that cannot be given to the left and to the right."""


@kernel
def _face_left(graph: IntArray, h: int, faces: LabelArray) -> int:
    """The face to the left of a half-edge; -1 outside."""
    cell = graph[h, FACE]
    return int(faces[cell]) if cell >= 0 else -1


@kernel
def _borders_at(graph: IntArray, h: int, faces: LabelArray, borders: IntArray) -> int:
    """Fill in the borders between faces that leave the origin of h, turning left; their number."""
    m = 0
    g = h
    while True:
        if m < len(borders) and _face_left(graph, g, faces) != _face_left(graph, g ^ 1, faces):
            borders[m] = g
            m += 1
        # what comes in before g leaves to the left of it
        g = graph[g, PREVIOUS] ^ 1
        if g == h:
            return m


@kernel
def _crosses(star: _Star, m: int) -> bool:
    """Whether a face meets itself at a vertex of m borders, or walls of four faces meet above it."""
    for i in range(m):
        for j in range(i):
            if star.faces[i] == star.faces[j]:
                return True
    heights = star.heights
    for k in range(m):
        changes = 0
        for i in range(m):
            changes += (heights[i] > heights[k]) != (heights[(i + 1) % m] > heights[k])
        if changes > 2:
            return True
    return False


@kernel
def _give_corner(
    plan: Subdivision, labels: LabelArray, first: int, last: int, label: int, corner_mm: float, known: int
) -> bool:
    """Give the corner from half-edge `first` to the left up to `last` another label; whether there was room for it.

    Earlier tries at this vertex left the vertices from `known` on, which serve again.
    """
    xy, graph, counts = plan.xy, plan.graph, plan.counts
    g = first
    while True:
        v, w = graph[g, ORIGIN], graph[g ^ 1, ORIGIN]
        if counts[VERTICES] >= len(xy) or counts[EDGES] + 4 > len(graph):
            return False
        if w < known:
            dx, dy = float(xy[w, 0] - xy[v, 0]), float(xy[w, 1] - xy[v, 1])
            length = math.hypot(dx, dy)
            size = min(corner_mm, 0.4 * length)
            x, y = int(np.rint(xy[v, 0] + size / length * dx)), int(np.rint(xy[v, 1] + size / length * dy))
            if size < _MIN_CORNER_MM or not insert_vertex(plan, g, x, y):
                return False
        if g == last:
            break
        g = graph[g, PREVIOUS] ^ 1
    given_from = counts[CELLS]
    g = first
    while g != last:
        left = graph[g, PREVIOUS] ^ 1
        u, v = graph[g ^ 1, ORIGIN], graph[left ^ 1, ORIGIN]
        cell = graph[g, FACE]
        if insert_chord(plan, u, v, cell, -1) != 1:
            for given in range(given_from, counts[CELLS]):
                labels[given] = labels[cell]
            return False
        # the triangle lies left of the chord, and so is the new cell
        labels[counts[CELLS] - 1] = label
        g = left
    return True


@kernel
def _height_m(plane: FloatArray, x_mm: float, y_mm: float) -> float:
    """Height of a plane over a place."""
    height: float = plane[0] * x_mm * 1e-3 + plane[1] * y_mm * 1e-3 + plane[2]
    return height


@kernel
def _corner_cost(
    plan: Subdivision, planes: FloatArray, own: int, giver: int, beyond: int, edge: int, corner_mm: float
) -> float:
    """How much heights change where a corner takes its neighbour's plane, metres; much where planes would then cross.

    Along `edge` the neighbour's plane meets that beyond the corner: if they cross close to the vertex, the solid would
    get vertices too close to one another.
    """
    xy, graph = plan.xy, plan.graph
    v, w = graph[edge, ORIGIN], graph[edge ^ 1, ORIGIN]
    fraction = min(corner_mm / math.hypot(float(xy[w, 0] - xy[v, 0]), float(xy[w, 1] - xy[v, 1])), 0.4)
    x, y = xy[v, 0] + fraction * (xy[w, 0] - xy[v, 0]), xy[v, 1] + fraction * (xy[w, 1] - xy[v, 1])
    cost = abs(_height_m(planes[giver], x, y) - _height_m(planes[own], x, y))
    if beyond >= 0 and beyond != giver:
        at_x, at_y = float(xy[v, 0]), float(xy[v, 1])
        at_vertex = _height_m(planes[giver], at_x, at_y) - _height_m(planes[beyond], at_x, at_y)
        at_end = _height_m(planes[giver], x, y) - _height_m(planes[beyond], x, y)
        if at_vertex * at_end < 0.0:
            cost += 0.1 * _LARGE_COST
    return cost


@kernel(inline="always")
def _cheapest_corner(plan: Subdivision, planes: FloatArray, star: _Star, m: int, corner_mm: float) -> int:
    """The corner i of m that costs least to give to its left (2 i) or right neighbour (2 i + 1); -1 for none."""
    faces, plane_of = star.faces, star.planes
    least, choice = math.inf, -1
    for i in range(m):
        for side in range(2):
            j, beyond = ((i + 1) % m, (i - 1) % m) if side == 0 else ((i - 1) % m, (i + 1) % m)
            if faces[i] < 0 or faces[j] < 0 or star.refused[2 * i + side]:
                continue
            edge = star.borders[i] if side == 0 else star.borders[(i + 1) % m]
            cost = _corner_cost(plan, planes, plane_of[i], plane_of[j], plane_of[beyond], edge, corner_mm)
            if faces[j] == faces[beyond]:
                cost -= _LARGE_COST
            elif plane_of[j] == plane_of[beyond]:
                # a neck would make two faces one
                cost += _LARGE_COST
            if cost < least:
                least, choice = cost, 2 * i + side
    return choice


@kernel
def part_crossings(
    plan: Subdivision, labels: LabelArray, planes: FloatArray, clearance: float
) -> tuple[LabelArray, int]:
    """Part borders that cross in a way that no solid can have, in the plan and in the labels, in place.

    `labels` (c + room,) are the planes of the cells, with room for the new ones. Corners have `clearance` times the
    usual size. Returns the face of every cell, (c,) int32, and the number of faces.
    """
    xy, graph, counts = plan.xy, plan.graph, plan.counts
    corner_mm = clearance * _CORNER_MM
    star = _Star(
        np.empty(_MAX_BORDERS, np.int64),
        np.empty(_MAX_BORDERS, np.int64),
        np.empty(_MAX_BORDERS, np.int64),
        np.empty(_MAX_BORDERS),
        np.empty(2 * _MAX_BORDERS, np.bool_),
    )
    borders = star.borders
    pairs, _ = cell_borders(plan, 0.0, np.empty((0, 4)))
    faces, n_faces = connected_faces(labels[: counts[CELLS]], pairs)
    leaving = np.full(len(xy), -1, np.int64)
    for h in range(counts[EDGES]):
        leaving[graph[h, ORIGIN]] = h
    for v in range(counts[VERTICES]):
        # every corner that goes takes a border away from the vertex
        while leaving[v] >= 0:
            m = _borders_at(graph, leaving[v], faces, borders)
            if m < 4:
                break
            for i in range(m):
                star.faces[i] = _face_left(graph, borders[i], faces)
                star.heights[i] = -math.inf
                star.planes[i] = -1
                if star.faces[i] >= 0:
                    star.planes[i] = labels[graph[borders[i], FACE]]
                    star.heights[i] = _height_m(planes[star.planes[i]], float(xy[v, 0]), float(xy[v, 1]))
            if not _crosses(star, m):
                break
            star.refused[:] = False
            known = counts[VERTICES]
            given = False
            while not given:
                choice = _cheapest_corner(plan, planes, star, m, corner_mm)
                if choice < 0:
                    break
                corner = choice // 2
                giver = (corner + 1) % m if choice % 2 == 0 else (corner - 1) % m
                label = labels[graph[borders[giver], FACE]]
                given = _give_corner(plan, labels, borders[corner], borders[(corner + 1) % m], label, corner_mm, known)
                star.refused[choice] = not given
            pairs, _ = cell_borders(plan, 0.0, np.empty((0, 4)))
            faces, n_faces = connected_faces(labels[: counts[CELLS]], pairs)
            if not given:
                break
    return faces, n_faces


@kernel
def corners_of_borders(plan: Subdivision, n_outline: int, faces: LabelArray) -> BoolArray:
    """Which vertices the faces need, (v,) bool.

    The outline's own are needed; one that was put on a line is not where two faces only meet along that line.
    """
    xy, graph, n_vertices = plan.xy, plan.graph, plan.counts[VERTICES]
    degree = np.zeros(n_vertices, np.int64)
    ends = np.full((n_vertices, 2), -1, np.int64)
    for h in range(plan.counts[EDGES]):
        if _face_left(graph, h, faces) != _face_left(graph, h ^ 1, faces):
            v = graph[h, ORIGIN]
            if degree[v] < 2:
                ends[v, degree[v]] = h
            degree[v] += 1
    needed = np.zeros(n_vertices, np.bool_)
    for v in range(n_vertices):
        needed[v] = degree[v] > 0
    for v in range(n_outline, n_vertices):
        if degree[v] != 2 or graph[ends[v, 0], LINE] != graph[ends[v, 1], LINE]:
            continue
        a, b = graph[ends[v, 0] ^ 1, ORIGIN], graph[ends[v, 1] ^ 1, ORIGIN]
        dx, dy = float(xy[b, 0] - xy[a, 0]), float(xy[b, 1] - xy[a, 1])
        cross = (xy[v, 0] - xy[a, 0]) * dy - (xy[v, 1] - xy[a, 1]) * dx
        if abs(cross) <= _STRAIGHT_MM * math.hypot(dx, dy):
            needed[v] = False
    return needed


@kernel
def trace_faces(plan: Subdivision, faces: LabelArray, needed: BoolArray) -> tuple[IntArray, IntArray, LabelArray]:
    """The rings around all faces, outer rings to the left, holes to the right; rings that touch themselves are parted.

    Returns the vertices of the rings, one ring after the other, not closed, the first vertex of every ring, (r + 1,),
    and the face of every ring, (r,).
    """
    graph, n_edges = plan.graph, plan.counts[EDGES]
    vertices = np.empty(n_edges, np.int64)
    starts = np.zeros(n_edges + 1, np.int64)
    owner = np.empty(n_edges, np.int32)
    done = np.zeros(n_edges, np.bool_)
    place = np.full(len(plan.xy), -1, np.int64)
    stack = np.empty(n_edges, np.int64)
    n = 0
    rings = 0
    for start in range(n_edges):
        face = _face_left(graph, start, faces)
        if done[start] or face < 0 or face == _face_left(graph, start ^ 1, faces):
            continue
        depth = 0
        h = start
        while not done[h]:
            done[h] = True
            v = graph[h, ORIGIN]
            if needed[v]:
                if place[v] >= 0:
                    # back at a vertex of this ring: what lies between is a ring of its own
                    for s in range(place[v], depth):
                        vertices[n] = stack[s]
                        n += 1
                        if s > place[v]:
                            place[stack[s]] = -1
                    depth = place[v]
                    owner[rings] = face
                    rings += 1
                    starts[rings] = n
                place[v] = depth
                stack[depth] = v
                depth += 1
            h = graph[h, NEXT]
            while _face_left(graph, h ^ 1, faces) == face:
                h = graph[h ^ 1, NEXT]
        for s in range(depth):
            vertices[n] = stack[s]
            n += 1
            place[stack[s]] = -1
        owner[rings] = face
        rings += 1
        starts[rings] = n
    return vertices[:n].copy(), starts[: rings + 1].copy(), owner[:rings].copy()


@kernel
def rings_of_faces(
    xy: IntArray, vertices: IntArray, starts: IntArray, owner: LabelArray, n_faces: int
) -> tuple[FloatArray, IntArray, LabelArray, bool]:
    """The rings from `trace_faces` by faces, the outer one of each first.

    Returns nodes (n, 2) in millimetres, the ring of each, ascending, the face of every ring, ascending, and whether the
    rings are sound: every face has one outer ring, and every ring three vertices.
    """
    n_rings = len(owner)
    is_outer = np.empty(n_rings, np.bool_)
    is_sound = True
    outer = 0
    for r in range(n_rings):
        first, last = starts[r], starts[r + 1]
        is_sound = is_sound and last - first >= 3
        area = np.int64(0)
        for s in range(first + 1, last - 1):
            area += turn_of(xy, vertices[first], vertices[s], vertices[s + 1])
        is_outer[r] = area > 0
        outer += is_outer[r]
    nodes = np.empty((len(vertices), 2))
    ring_of = np.empty(len(vertices), np.int64)
    owners = np.empty(n_rings, np.int32)
    n = 0
    key = np.empty(n_rings, np.int32)
    for r in range(n_rings):
        key[r] = 2 * owner[r] + (not is_outer[r])
    _, order = counting_sort(key, 2 * n_faces)
    for m in range(n_rings):
        r = order[m]
        is_sound = is_sound and (is_outer[r] or (m > 0 and owners[m - 1] == owner[r]))
        for s in range(starts[r], starts[r + 1]):
            nodes[n, 0], nodes[n, 1] = xy[vertices[s], 0], xy[vertices[s], 1]
            ring_of[n] = m
            n += 1
        owners[m] = owner[r]
    return nodes, ring_of, owners, is_sound and outer == n_faces
