"""Integer sums over the facets, vertices and outline of a fragment of a surface; they add up over tile borders."""

from __future__ import annotations

import math
from enum import IntEnum

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import IntArray, LabelArray
from pipeline.terrain.facets import FacetKind, LabelledTin, SceneVertices, VertexKind, connects, first_corner, stands_up


class Sum(IntEnum):
    """Columns of the sums of a fragment; all add up over tile borders."""

    FACETS = 0
    AREA2 = 1
    """Twice the plan area, mm2."""
    VERTICES = 2
    HEIGHT = 3
    """Heights of the vertices above the terrain, mm."""
    PLANAR = 4
    """Vertices with planar surroundings."""
    ROUGH = 5
    """Vertices with rough surroundings."""
    BOUNDARY = 6
    """Length of the outline in plan, mm."""
    WALL = 7
    """Length of the outline that touches walls (MX_zdiff >= 2 m), mm."""
    WALL_TOP = 8
    """Length of the outline that lies at the upper half of its wall, mm."""
    STEP = 9
    """Length of the outline that touches steps, mm."""
    WALLS = 10
    """Number of wall facets along the outline."""
    WALLS_Z_MX = 11
    """Sum of their highest vertices Z_mx, mm."""
    WALLS_OWN_Z = 12
    """Sum of the fragment's own elevation at them, mm."""
    POINTS = 13
    CANOPY = 14
    """Earlier returns well above the fragment."""
    HEIGHT2 = 15
    """Squared heights of the vertices above the terrain, mm2."""
    SEVERAL = 16
    """Points from pulses with several returns."""
    THROUGH = 17
    """Points whose pulse went on to a later return."""
    SMOOTH = 18
    """Vertices with smooth surroundings."""
    OPEN = 19
    """Length of the outline of objects that stands free: what is beside it is less than two thirds as high, mm."""
    AREA_W = 20
    """Plan area of objects, in 1000 mm2, then its first and second moments with places in dm."""
    AREA_X = 21
    AREA_Y = 22
    AREA_XX = 23
    AREA_XY = 24
    AREA_YY = 25
    LEVEL_W = 26
    """Length of the outline of objects where the ground goes on without a step, in cm, then its moments."""
    LEVEL_X = 27
    LEVEL_Y = 28
    LEVEL_XX = 29
    LEVEL_XY = 30
    LEVEL_YY = 31
    GAP_W = 32
    """Length of the outline of objects at gaps in the data, in cm, then its moments."""
    GAP_X = 33
    GAP_Y = 34
    GAP_XX = 35
    GAP_XY = 36
    GAP_YY = 37
    SEAM = 38
    """Length of the outline where building goes on in what nothing is known of, or the reverse, mm."""
    GLASS = 39
    """Points of ground and plants that were seen through the surface."""


N_SUMS = len(Sum)
MOMENTS = 6
"""Columns of a weight and its moments: sums of w, w x, w y, w x x, w x y and w y y."""
LEVEL_MM = 300
"""Outline beside ground is level where the facet there spans less.

Not a setting: objects are at least `GroundSettings.tolerance_m`, 0.5 m, high; and a ramp of 1 in 7 rises this far
between points 2 m apart.
"""
Core = tuple[int, int, int, int]
"""x0, y0, x1, y1 of a tile in mm, half-open."""


@kernel(inline="always")
def _sum_vertices(sums: IntArray, vertices: SceneVertices, vertex_label: LabelArray, core: Core) -> None:
    """Add the vertices that the core owns to the sums of their fragments."""
    x, y, _, height, _, planar = vertices
    x0, y0, x1, y1 = core
    for v in range(x.size):
        fragment = vertex_label[v]
        if fragment >= 0 and x0 <= x[v] < x1 and y0 <= y[v] < y1:
            sums[fragment, Sum.VERTICES] += 1
            sums[fragment, Sum.HEIGHT] += height[v]
            sums[fragment, Sum.HEIGHT2] += np.int64(height[v]) * height[v]
            if planar[v] > 0:
                sums[fragment, Sum.PLANAR] += 1
                sums[fragment, Sum.SMOOTH] += planar[v] == 2
            elif planar[v] == 0:
                sums[fragment, Sum.ROUGH] += 1


@kernel(inline="always")
def _with_room(rows: IntArray, used: int) -> IntArray:
    """The rows (n, 3), in an array twice as long if all are used."""
    if used < rows.shape[0]:
        return rows
    grown = np.empty((2 * used, 3), np.int64)
    for m in range(used):
        grown[m, 0], grown[m, 1], grown[m, 2] = rows[m, 0], rows[m, 1], rows[m, 2]
    return grown


@kernel(inline="always")
def _add_moments(row: IntArray, first: int, weight: int, x_mm: int, y_mm: int) -> None:
    """Add a weight at a place to the six moments from column `first` on.

    Products of coordinates may pass 2^63 and wrap; moments about a place nearby are exact again, since they fit.
    """
    x, y = x_mm // 100, y_mm // 100
    row[first] += weight
    row[first + 1] += weight * x
    row[first + 2] += weight * y
    row[first + 3] += weight * x * x
    row[first + 4] += weight * x * y
    row[first + 5] += weight * y * y


@kernel(inline="always")
def _add_free_outline(
    row: IntArray, vertices: SceneVertices, tin: LabelledTin, g: int, edge: tuple[int, int], length: int
) -> None:
    """Add an edge (v, w) of an object's outline, with facet g beyond it, to the sums of open, level and cut outline."""
    v, w = edge
    x, y = (vertices.x_mm[v] + vertices.x_mm[w]) // 2, (vertices.y_mm[v] + vertices.y_mm[w]) // 2
    if g < 0 or tin.kinds[g] == FacetKind.VOID:
        _add_moments(row, Sum.GAP_W, length // 10, x, y)
    elif tin.kinds[g] == FacetKind.BORDER or tin.kinds[g] == FacetKind.SEAM:
        beyond = tin.facets[g, 0] + tin.facets[g, 1] + tin.facets[g, 2] - v - w
        height, z = vertices.height_mm, vertices.z_mm
        # below two thirds of the mean height of the edge
        if 3 * height[beyond] < height[v] + height[w]:
            row[Sum.OPEN] += length
        span = max(z[v], z[w], z[beyond]) - min(z[v], z[w], z[beyond])
        if vertices.kind[beyond] == VertexKind.GROUND and span < LEVEL_MM:
            _add_moments(row, Sum.LEVEL_W, length // 10, x, y)


@kernel
def sum_fragments(
    vertices: SceneVertices, tin: LabelledTin, core: Core, wall_mm: int
) -> tuple[IntArray, IntArray, IntArray]:
    """Sums (f, N_SUMS) of the fragments over what the core owns, bounding boxes (f, 4), and rows of `along_steps`.

    A facet is owned through its smallest (x, y) vertex, a vertex through itself. All in mm.
    """
    x, y, z = vertices.x_mm, vertices.y_mm, vertices.z_mm
    facets, kinds, label = tin.facets, tin.kinds, tin.label
    x0, y0, x1, y1 = core
    sums = np.zeros((tin.fragment_kind.size, N_SUMS), np.int64)
    boxes = np.empty((tin.fragment_kind.size, 4), np.int64)
    boxes[:, 0] = boxes[:, 1] = 2**62
    boxes[:, 2] = boxes[:, 3] = -(2**62)
    along = np.empty((1024, 3), np.int64)
    n_along = 0
    for f in range(facets.shape[0]):
        fragment = label[f]
        if fragment < 0:
            continue
        v = facets[f, first_corner(x, y, facets, f)]
        if not (x0 <= x[v] < x1 and y0 <= y[v] < y1):
            continue
        a, b, c = facets[f, 0], facets[f, 1], facets[f, 2]
        sums[fragment, Sum.FACETS] += 1
        sums[fragment, Sum.AREA2] += (x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a])
        is_object = stands_up(kinds[f])
        for q in range(3 if is_object else 0):
            # the mean over the middles of the edges is exact for squares of coordinates
            v, w = facets[f, q], facets[f, (q + 1) % 3]
            third = ((x[b] - x[a]) * (y[c] - y[a]) - (y[b] - y[a]) * (x[c] - x[a])) // 6000
            _add_moments(sums[fragment], Sum.AREA_W, third, (x[v] + x[w]) // 2, (y[v] + y[w]) // 2)
        boxes[fragment, 0] = min(boxes[fragment, 0], x[a], x[b], x[c])
        boxes[fragment, 1] = min(boxes[fragment, 1], y[a], y[b], y[c])
        boxes[fragment, 2] = max(boxes[fragment, 2], x[a], x[b], x[c])
        boxes[fragment, 3] = max(boxes[fragment, 3], y[a], y[b], y[c])
        for q in range(3):
            g = tin.neighbours[f, q]
            if g >= 0 and kinds[g] == kinds[f]:
                continue
            v, w = facets[f, (q + 1) % 3], facets[f, (q + 2) % 3]
            dx, dy = x[v] - x[w], y[v] - y[w]
            length = np.int64(round(math.sqrt(float(dx * dx + dy * dy))))
            sums[fragment, Sum.BOUNDARY] += length
            if is_object:
                _add_free_outline(sums[fragment], vertices, tin, g, (v, w), int(length))
            if g < 0 or kinds[g] == FacetKind.VOID:
                continue
            ga, gb, gc = facets[g, 0], facets[g, 1], facets[g, 2]
            top = max(z[ga], z[gb], z[gc])
            foot = min(z[ga], z[gb], z[gc])
            if top - foot >= wall_mm:
                own = (z[v] + z[w]) // 2
                sums[fragment, Sum.WALL] += length
                sums[fragment, Sum.WALLS] += 1
                sums[fragment, Sum.WALLS_Z_MX] += top
                sums[fragment, Sum.WALLS_OWN_Z] += own
                if 2 * own >= top + foot:
                    sums[fragment, Sum.WALL_TOP] += length
            if connects(kinds[g]) and not connects(kinds[f]):
                sums[fragment, Sum.STEP if kinds[g] == FacetKind.STEP else Sum.SEAM] += length
                along = _with_room(along, n_along)
                along[n_along, 0], along[n_along, 1], along[n_along, 2] = fragment, label[g], length
                n_along += 1
    _sum_vertices(sums, vertices, tin.vertex_label, core)
    return sums, boxes, along[:n_along].copy()
