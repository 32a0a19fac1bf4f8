"""Vertices of roof faces where the planes beside them meet: the end of a ridge lies where its three slopes cross.

A border between two planes that cross lies best on the line of their crossing, and a vertex where the planes of all its
borders have one height. There planes need not leave their points to meet. A vertex moves to the nearest such place
unless the points contradict it; on the outline and on steps it slides along their line.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FloatArray, IntArray
from pipeline.roof.arrangement.movable_borders import (
    KEEPS,
    MAX_DEGREE,
    Borders,
    buckets_of,
    cost_of_moving,
    edges_at,
    ends_at_vertices,
    star_is_sound,
)
from pipeline.roof.arrangement.raster_labels import Limits

_ROUNDS = 2
"""Turns through all vertices: a vertex may be free to move once its neighbour has moved."""
_LEAST_SLOPE = 0.05
"""Planes whose gradients differ by less do not determine where they cross: 1 cm of height is 20 cm in plan."""
_STRAIGHT_MM = 2.0
"""A vertex this near to the line of its two fixed borders slides along it: this is what rounding to 1 mm does."""


@kernel(inline="always")
def _line_to_keep(
    borders: Borders, found: IntArray, gaps: FloatArray, v: int, gap_m: float
) -> tuple[bool, float, float]:
    """Whether v may move, and the direction of the line that it stays on; zero without one.

    The outline, edges on guides, and steps, the found edges with a wider gap, keep their line: a corner or an end of
    them stays.
    """
    xy, edges = borders.xy, borders.edges
    n = 0
    ends = np.empty(2, np.int64)
    for s in range(len(found)):
        if edges[found[s], 3] < 0 or abs(gaps[s]) > gap_m or edges[found[s], KEEPS] != 0:
            if n == 2:
                return False, 0.0, 0.0
            ends[n] = edges[found[s], 0] + edges[found[s], 1] - v
            n += 1
    if n < 2:
        return n == 0, 0.0, 0.0
    dx, dy = float(xy[ends[1], 0] - xy[ends[0], 0]), float(xy[ends[1], 1] - xy[ends[0], 1])
    length = math.hypot(dx, dy)
    x, y = float(xy[v, 0] - xy[ends[0], 0]), float(xy[v, 1] - xy[ends[0], 1])
    if length == 0.0 or abs(x * dy - y * dx) > _STRAIGHT_MM * length:
        return False, 0.0, 0.0
    return True, dx / length, dy / length


@kernel(inline="always")
def _gaps_and_slopes(borders: Borders, planes: FloatArray, found: IntArray, v: int) -> tuple[FloatArray, FloatArray]:
    """By how much the left plane of each found edge is above the right one at v, (m,) metres, and the gradient of that.

    Gradients are (m, 2); both are zero on the outline.
    """
    gaps, slopes = np.zeros(len(found)), np.zeros((len(found), 2))
    x, y = borders.xy[v, 0] * 1e-3, borders.xy[v, 1] * 1e-3
    for s in range(len(found)):
        left, right = borders.edges[found[s], 2], borders.edges[found[s], 3]
        if right >= 0:
            p, q = borders.plane_of_face[left], borders.plane_of_face[right]
            slopes[s, 0], slopes[s, 1] = planes[p, 0] - planes[q, 0], planes[p, 1] - planes[q, 1]
            gaps[s] = slopes[s, 0] * x + slopes[s, 1] * y + planes[p, 2] - planes[q, 2]
    return gaps, slopes


@kernel(inline="always")
def _way_to_meeting(borders: Borders, planes: FloatArray, found: IntArray, v: int, gap_m: float) -> tuple[float, float]:
    """The way in metres from v to the nearest place where the planes beside the found edges meet, by least squares."""
    gaps, slopes = _gaps_and_slopes(borders, planes, found, v)
    may_move, along_x, along_y = _line_to_keep(borders, found, gaps, v, gap_m)
    way_x, way_y = 0.0, 0.0
    if not may_move:
        return way_x, way_y
    xx, xy, yy, xg, yg = 0.0, 0.0, 0.0, 0.0, 0.0
    for s in range(len(found)):
        a, b = slopes[s, 0], slopes[s, 1]
        if abs(gaps[s]) <= gap_m and math.hypot(a, b) >= _LEAST_SLOPE:
            xx, xy, yy = xx + a * a, xy + a * b, yy + b * b
            xg, yg = xg - a * gaps[s], yg - b * gaps[s]
    # on a line there is one direction; else the two eigenvectors of the normal equations
    is_on_line = along_x != 0.0 or along_y != 0.0
    turn = math.atan2(along_y, along_x) if is_on_line else 0.5 * math.atan2(2.0 * xy, xx - yy)
    for side in range(1 if is_on_line else 2):
        ux, uy = math.cos(turn + side * 0.5 * math.pi), math.sin(turn + side * 0.5 * math.pi)
        square = xx * ux * ux + 2.0 * xy * ux * uy + yy * uy * uy
        # the planes determine no place along a direction in which they hardly part
        if square >= _LEAST_SLOPE**2:
            way = (xg * ux + yg * uy) / square
            way_x, way_y = way_x + way * ux, way_y + way * uy
    return way_x, way_y


@kernel(inline="always")
def move_vertices(borders: Borders, points: FloatArray, planes: FloatArray, limits: Limits) -> bool:
    """Move vertices to where the planes beside them meet, in place, where that costs less than a corner; whether any.

    `points` (n, 3) and `planes` (k, 3) are in metres. The last row of `borders.xy` is not a vertex: it holds the place
    that is tried.
    """
    moved = False
    if len(points) == 0 or limits.corner_cost == 0.0:
        return moved
    xy = borders.xy
    buckets = buckets_of(points)
    ends = ends_at_vertices(borders)
    trial = len(xy) - 1
    found = np.empty(MAX_DEGREE, np.int64)
    for _ in range(_ROUNDS):
        for v in range(trial):
            m = edges_at(borders.edges, ends, v, found)
            if borders.is_fixed[v] or m < 2 or m > MAX_DEGREE:
                continue
            way_x, way_y = _way_to_meeting(borders, planes, found[:m], v, limits.corner_gap_m)
            xy[trial, 0], xy[trial, 1] = xy[v, 0] + round(way_x * 1e3), xy[v, 1] + round(way_y * 1e3)
            is_far = math.hypot(way_x, way_y) > limits.corner_reach_m
            if is_far or (xy[trial, 0] == xy[v, 0] and xy[trial, 1] == xy[v, 1]):
                continue
            cost = cost_of_moving(borders, buckets, planes, v, trial, found[:m], limits.cap_m)
            if cost < limits.corner_cost and star_is_sound(borders, planes, trial, v, found, m):
                xy[v, 0], xy[v, 1] = xy[trial, 0], xy[trial, 1]
                moved = True
    return moved
