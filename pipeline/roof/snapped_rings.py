"""Rings on the millimetre grid, and the distance between two of them, without an overlay."""

from __future__ import annotations

import math

import numpy as np
import shapely

from pipeline.compiler import kernel
from pipeline.model import FloatArray

_CLEAR = 0.75
"""An edge that keeps this far from a rounded vertex passes by its grid cell, whose corners are 0.71 away."""
_CERTAINLY = 0.99
"""An upper bound below this part of an area needs no overlay, whatever that is rounded to."""


@kernel
def _turns_left(ring: FloatArray) -> bool:
    """Whether the interior of a ring (n, 2) is on its left."""
    twice_area = 0.0
    for k in range(len(ring)):
        twice_area += ring[k - 1, 0] * ring[k, 1] - ring[k, 0] * ring[k - 1, 1]
    return twice_area > 0.0


@kernel(inline="always")
def _whole(value: float) -> float:
    """A value rounded to a whole number as GEOS does it: halves up."""
    return float(np.ceil(value) if value - np.floor(value) >= 0.5 else np.floor(value))


@kernel
def _is_near(ring: FloatArray, first: int, vertex: int) -> bool:
    """Whether the edge from the vertex `first` passes near another vertex, rounded, that does not end it."""
    second = (first + 1) % len(ring)
    if vertex in (first, second):
        return False
    x, y = _whole(ring[vertex, 0]) - ring[first, 0], _whole(ring[vertex, 1]) - ring[first, 1]
    ux, uy = ring[second, 0] - ring[first, 0], ring[second, 1] - ring[first, 1]
    squared = ux * ux + uy * uy
    t = min(max((x * ux + y * uy) / squared, 0.0), 1.0) if squared > 0.0 else 0.0
    return math.hypot(x - t * ux, y - t * uy) <= _CLEAR


@kernel
def _parts(ring: FloatArray, first: int, vertex: int) -> bool:
    """Whether the line of the edge from the vertex `first` runs between the ends of the edge from another vertex."""
    n = len(ring)
    ux, uy = ring[(first + 1) % n, 0] - ring[first, 0], ring[(first + 1) % n, 1] - ring[first, 1]
    one = ux * (ring[vertex, 1] - ring[first, 1]) - uy * (ring[vertex, 0] - ring[first, 0])
    second = (vertex + 1) % n
    other = ux * (ring[second, 1] - ring[first, 1]) - uy * (ring[second, 0] - ring[first, 0])
    return bool((one > 0.0) != (other > 0.0))


@kernel
def snapped_ring(ring: FloatArray) -> FloatArray:
    """A ring (n, 2) on the grid of whole units, as `shapely.set_precision` draws it: clockwise, its first vertex last.

    So it is where no two edges cross and none passes by another vertex's place on the grid: then vertices are rounded
    and nothing else happens. Empty, (0, 2), where this is not so. The first vertex is not repeated.
    """
    n = len(ring)
    low, high = np.empty((2, n)), np.empty((2, n))
    for i in range(n):
        for axis in range(2):
            one, other = ring[i, axis], ring[(i + 1) % n, axis]
            low[axis, i], high[axis, i] = min(one, other) - _CLEAR, max(one, other) + _CLEAR
    for i in range(n):
        left, right, bottom, top = low[0, i], high[0, i], low[1, i], high[1, i]
        for j in range(i + 1, n):
            if low[0, j] > right or high[0, j] < left or low[1, j] > top or high[1, j] < bottom:
                continue
            k, m = i + 1, (j + 1) % n
            if _is_near(ring, i, j) or _is_near(ring, i, m) or _is_near(ring, j, i) or _is_near(ring, j, k):
                return np.empty((0, 2))
            if k != j and m != i and _parts(ring, i, j) and _parts(ring, j, i):
                return np.empty((0, 2))
    turns_left = _turns_left(ring)
    snapped = np.empty((n if n > 2 else 0, 2))
    for k in range(len(snapped)):
        v = n - 1 - k if turns_left else (k + 1) % n
        snapped[k, 0], snapped[k, 1] = _whole(ring[v, 0]), _whole(ring[v, 1])
    return snapped


@kernel
def _most_area_between(ring: FloatArray, other: FloatArray) -> float:
    """An upper bound of the area that only one of two rings encloses, (n, 2) and (m, 2); infinite if none is found.

    Each edge of `ring` is compared with the stretch of the other one between the vertices nearest to its ends: with
    their projections on the edge the vertices of the stretch make quadrilaterals that cover all between the two.
    """
    n, m = len(ring), len(other)
    step = 1 if _turns_left(ring) == _turns_left(other) else m - 1
    nearest = np.zeros(n, np.int64)
    for k in range(n):
        least = math.inf
        for i in range(m):
            dx, dy = other[i, 0] - ring[k, 0], other[i, 1] - ring[k, 1]
            if dx * dx + dy * dy < least:
                least, nearest[k] = dx * dx + dy * dy, i
    passed, area = 0, 0.0
    for k in range(n):
        x0, y0 = ring[k - 1, 0], ring[k - 1, 1]
        ux, uy = ring[k, 0] - x0, ring[k, 1] - y0
        squared = max(ux * ux + uy * uy, 1.0)
        i, end = nearest[k - 1], nearest[k]
        x, y, t = other[i, 0] - x0, other[i, 1] - y0, 0.0
        while True:
            # the triangle from where the vertex is projected to, along the edge, then on to the next vertex
            along = 1.0 if i == end else min(max((x * ux + y * uy) / squared, 0.0), 1.0)
            area += 0.5 * abs((along - t) * (ux * y - uy * x))
            t = along
            if i == end:
                break
            i = (i + step) % m
            passed += 1
            dx, dy = other[i, 0] - x0 - x, other[i, 1] - y0 - y
            area += 0.5 * abs((x - t * ux) * dy - (y - t * uy) * dx)
            x, y = x + dx, y + dy
    return area if passed == m else math.inf


def differ_by_more(ring: FloatArray, other: FloatArray, area: float) -> bool:
    """Whether more than an area is enclosed by only one of two sound rings, (n, 2) and (m, 2), not closed."""
    if _most_area_between(ring, other) < _CERTAINLY * area:
        return False
    return bool(shapely.symmetric_difference(shapely.Polygon(ring), shapely.Polygon(other)).area > area)


def on_grid(shape: shapely.Geometry) -> shapely.Geometry:
    """The same as `shapely.set_precision(shape, 1.0)` of a shape without curves, valid."""
    if isinstance(shape, shapely.Polygon) and shapely.get_num_interior_rings(shape) == 0:
        snapped = snapped_ring(shapely.get_coordinates(shape)[:-1])
        if len(snapped):
            return shapely.Polygon(snapped)
    return shapely.set_precision(shape, 1.0)
