"""Low, thin objects: garden walls, fences and hedges that touch a building and would become part of its outline."""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, IntArray
from pipeline.spatial_hash import points_by_cell
from pipeline.terrain.facets import SceneVertices, VertexKind

_MIN_AROUND = 8
"""Not a setting: so many points of the scene's lattice lie in half of the circle beside a wall; sparse surveys have
fewer."""


@kernel
def thin_between(
    x_mm: IntArray, y_mm: IntArray, wanted: BoolArray, ground_x_mm: IntArray, ground_y_mm: IntArray, width_mm: int
) -> BoolArray:
    """Which wanted points (n,) have ground on two opposite sides, with no more than width_mm between.

    One side is the nearest ground point, the other any that is seen at least 135 degrees from it. Fewer than eight
    ground points within width_mm show no width. Ground points (g,) come sorted by (x, y): of those equally near the
    first counts.
    """
    out = np.zeros(x_mm.size, np.bool_)
    if width_mm <= 0 or ground_x_mm.size == 0:
        return out
    gx, gy = ground_x_mm, ground_y_mm
    start, members, column0, row0, columns, rows = points_by_cell(gx, gy, np.ones(gx.size, np.bool_), width_mm)
    for i in range(x_mm.size):
        if not wanted[i]:
            continue
        c, r = x_mm[i] // width_mm - column0, y_mm[i] // width_mm - row0
        west, east = max(c - 1, 0), min(c + 1, columns - 1)
        south, north = max(r - 1, 0), min(r + 1, rows - 1)
        if west > east:
            continue
        first, nearest, around = -1, np.int64(width_mm) * width_mm, 0
        for rr in range(south, north + 1):
            for k in range(start[rr * columns + west], start[rr * columns + east + 1]):
                j = members[k]
                distance = (gx[j] - x_mm[i]) ** 2 + (gy[j] - y_mm[i]) ** 2
                around += distance < width_mm * width_mm
                if distance < nearest or (distance == nearest and j < first):
                    first, nearest = j, distance
        if around < _MIN_AROUND:
            continue
        ax, ay = gx[first] - x_mm[i], gy[first] - y_mm[i]
        left_mm = width_mm - math.sqrt(float(nearest))
        for rr in range(south, north + 1):
            for k in range(start[rr * columns + west], start[rr * columns + east + 1]):
                bx, by = gx[members[k]] - x_mm[i], gy[members[k]] - y_mm[i]
                across, distance = ax * bx + ay * by, bx * bx + by * by
                if across < 0 and 2 * across * across >= nearest * distance and distance <= left_mm * left_mm:
                    out[i] = True
    return out


@kernel
def are_beside(
    x_mm: IntArray, y_mm: IntArray, wanted: BoolArray, other_x_mm: IntArray, other_y_mm: IntArray, reach_mm: int
) -> BoolArray:
    """Which wanted points (n,) have one of the other points (m,) within reach_mm in plan."""
    out = np.zeros(x_mm.size, np.bool_)
    if reach_mm <= 0 or other_x_mm.size == 0:
        return out
    ox, oy = other_x_mm, other_y_mm
    start, members, column0, row0, columns, rows = points_by_cell(ox, oy, np.ones(ox.size, np.bool_), reach_mm)
    for i in range(x_mm.size):
        if not wanted[i]:
            continue
        c, r = x_mm[i] // reach_mm - column0, y_mm[i] // reach_mm - row0
        west, east = max(c - 1, 0), min(c + 1, columns - 1)
        if west > east:
            continue
        for rr in range(max(r - 1, 0), min(r + 2, rows)):
            for k in range(start[rr * columns + west], start[rr * columns + east + 1]):
                j = members[k]
                out[i] |= (ox[j] - x_mm[i]) ** 2 + (oy[j] - y_mm[i]) ** 2 <= reach_mm * reach_mm
    return out


def are_thin(
    x_mm: IntArray, y_mm: IntArray, low: BoolArray, vertices: SceneVertices, low_mm: int, width_mm: int
) -> BoolArray:
    """Which low points (n,) are parts of thin objects.

    A vertex is thin if it is lower than `low_mm` and there is ground on both of its sides, with no more than `width_mm`
    between. The tips of a shed's outline look like that, too: so a point is thin only if a vertex near it is, and all
    others near it that stand above the ground.
    """
    x, y = vertices.x_mm, vertices.y_mm
    ground = vertices.kind == VertexKind.GROUND
    thin = thin_between(x, y, ~ground & (vertices.height_mm < low_mm), x[ground], y[ground], width_mm)
    thick = ~ground & ~thin
    if width_mm <= 0:
        return np.zeros(x_mm.size, np.bool_)
    near_mm = width_mm // 2
    beside = low & are_beside(x_mm, y_mm, low, x[thin], y[thin], near_mm)
    found: BoolArray = beside & ~are_beside(x_mm, y_mm, beside, x[thick], y[thick], near_mm)
    return found
