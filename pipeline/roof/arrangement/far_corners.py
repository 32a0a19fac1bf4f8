"""Corners where a roof plane leaves all points around it: cut off, and given to a plane that does not.

Where two lines meet far beyond the end of a ridge, or a slope runs on into a part of the outline that holds something
else, one cell spans what a plane explains and what it does not, and the few points there are too weak a voice: the roof
gets a fin. Such a cell is cut once more, along the line in which its plane meets that of the part beyond, else where
its edges come near the points again. Then a plane costs in every cell at whose corners it is farther from the points
than another.

Down an eave or up to the top of a pent roof a plane may go on beyond its last points: by its slope, up to 1, over the
distance within which points are looked for; down an eave also over the distance of the next ones where there are none.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray
from pipeline.roof.arrangement.raster_labels import COST_SCALE, vertical_distance_m
from pipeline.roof.arrangement.subdivision import (
    FACE,
    NEXT,
    ORIGIN,
    PREVIOUS,
    SNAP_CROSSING_MM,
    cut_by_line,
    insert_chord,
    insert_vertex,
)

HeightsRaster: TypeAlias = tuple[FloatArray, FloatArray, float, float, float]
"""From `heights_raster`."""
HeightsAround: TypeAlias = tuple[FloatArray, FloatArray, FloatArray, float]
"""From `heights_around`."""

_AROUND_M = 0.75
"""Points at least so near to a corner tell how high a roof may be there."""
_FAR_SIDES = 3.0
"""Sides of a cell of the raster within which points are looked for where there are none nearer."""
_STEEPEST = 1.0
"""Planes that are steeper go on no farther beyond their points than one of this slope."""
_COST_PER_M = 20.0
_MOST_COST = 40.0
"""Points that a plane costs by the metre, and at most: more than a face, less than what a large cell holds."""
_STEP_MM = 250.0
"""A third of the raster's cells: its heights say no more."""
_MOST_LEVEL = 8
"""Horizontal planes that are added at a time: more places where nothing fits are no roof that planes can tell."""


@kernel
def heights_raster(points: FloatArray, spacing_m: float) -> HeightsRaster:
    """Lowest and highest point of every cell of a raster, (r, c) metres, inf and -inf where there is none.

    Behind them the west and south end and the side of the cells, 0.75 m or a spacing.
    """
    side = max(_AROUND_M, spacing_m)
    if len(points) == 0:
        return np.full((1, 1), math.inf), np.full((1, 1), -math.inf), 0.0, 0.0, side
    west, south = points[:, 0].min(), points[:, 1].min()
    columns = int((points[:, 0].max() - west) / side) + 1
    rows = int((points[:, 1].max() - south) / side) + 1
    low, high = np.full((rows, columns), math.inf), np.full((rows, columns), -math.inf)
    for i in range(len(points)):
        r, c = int((points[i, 1] - south) / side), int((points[i, 0] - west) / side)
        low[r, c] = min(low[r, c], points[i, 2])
        high[r, c] = max(high[r, c], points[i, 2])
    return low, high, west, south, side


@kernel
def _heights_at(raster: HeightsRaster, x_mm: float, y_mm: float) -> tuple[float, float, float]:
    """Lowest and highest point around a place, and within what distance of it they were looked for, metres.

    All within the side of a cell count, none at three times that distance, but where there are none those up to as far
    again; the lowest is above the highest where there are none either.
    """
    low, high, west, south, side = raster
    r, c = math.floor((y_mm * 1e-3 - south) / side), math.floor((x_mm * 1e-3 - west) / side)
    lowest, highest, within = math.inf, -math.inf, side
    for reach in (1, 2):
        within = side if reach == 1 else _FAR_SIDES * side
        for row in range(max(r - reach, 0), min(r + reach + 1, low.shape[0])):
            for column in range(max(c - reach, 0), min(c + reach + 1, low.shape[1])):
                lowest = min(lowest, low[row, column])
                highest = max(highest, high[row, column])
        if lowest <= highest:
            break
    return lowest, highest, within


@kernel
def _add_heights(xy: IntArray, first: int, last: int, raster: HeightsRaster, around: HeightsAround) -> None:
    """The heights around vertices that are new."""
    for v in range(first, last):
        around[0][v], around[1][v], around[2][v] = _heights_at(raster, float(xy[v, 0]), float(xy[v, 1]))


@kernel
def heights_around(xy: IntArray, n_vertices: int, raster: HeightsRaster) -> HeightsAround:
    """Lowest and highest point around every vertex and within what distance, (v,) metres each, with room for more.

    Behind them the side of the raster.
    """
    around = np.full(len(xy), math.inf), np.full(len(xy), -math.inf), np.full(len(xy), raster[4]), raster[4]
    _add_heights(xy, 0, n_vertices, raster, around)
    return around


@kernel
def _outside_m(plane: FloatArray, x_mm: float, y_mm: float, heights: tuple[float, float, float], side: float) -> float:
    """How far a plane lies above (or, negative, below) what the heights around a place allow; 0 without heights."""
    lowest, highest, within = heights
    if lowest > highest:
        return 0.0
    z = plane[0] * x_mm * 1e-3 + plane[1] * y_mm * 1e-3 + plane[2]
    slope = min(math.hypot(plane[0], plane[1]), _STEEPEST)
    outside: float = max(z - highest - slope * side, 0.0) if z > highest else min(z - lowest + slope * within, 0.0)
    return outside


@kernel
def _vertex_outside_m(plane: FloatArray, xy: IntArray, v: int, around: HeightsAround) -> float:
    """The same at a vertex."""
    lowest, highest, within, side = around
    return _outside_m(plane, float(xy[v, 0]), float(xy[v, 1]), (lowest[v], highest[v], within[v]), side)


@kernel
def _is_far(plane: FloatArray, xy: IntArray, v: int, around: HeightsAround, far_m: float) -> bool:
    return abs(_vertex_outside_m(plane, xy, v, around)) > far_m


@kernel
def add_costs_of_far_planes(
    xy: IntArray,
    graph: LabelArray,
    n_edges: int,
    planes: FloatArray,
    around: HeightsAround,
    far_m: float,
    costs: IntArray,
    misfits: IntArray,
) -> None:
    """Make planes dearer in the cells at whose corners they are farther from the points than another.

    Parameters
    ----------
    xy, graph, n_edges : arrays and int
        The subdivision.
    planes : (k, 3) float64
        Coefficients a, b, c.
    around : HeightsAround
        From `heights_around`.
    far_m : float
        How far a plane may go above or below the points.
    costs, misfits : (c, k) int64
        From `cell_costs`; changed in place.
    """
    farthest = np.zeros(costs.shape)
    for h in range(n_edges):
        cell = graph[h, FACE]
        if cell >= 0:
            for k in range(len(planes)):
                outside = abs(_vertex_outside_m(planes[k], xy, graph[h, ORIGIN], around))
                farthest[cell, k] = max(farthest[cell, k], outside)
    for cell in range(len(costs)):
        least = max(farthest[cell].min(), far_m)
        for k in range(len(planes)):
            if farthest[cell, k] > least:
                cost = int(COST_SCALE * min(_COST_PER_M * (farthest[cell, k] - least), _MOST_COST))
                costs[cell, k] += cost
                misfits[cell, k] += cost


@kernel
def with_level_planes(
    xy: IntArray,
    graph: LabelArray,
    n_edges: int,
    planes: FloatArray,
    labels: LabelArray,
    around: HeightsAround,
    far_m: float,
) -> FloatArray:
    """The planes, and horizontal ones where none of them fits a corner that the plane of its cell is far from.

    Parameters
    ----------
    xy, graph, n_edges, planes, around, far_m : arrays, int and float
        As in `add_costs_of_far_planes`.
    labels : (c,) int32
        Plane of every cell.

    Returns
    -------
    (k + l, 3) float64
        The given ones first.
    """
    lowest, highest, _, _ = around
    extended = np.empty((len(planes) + _MOST_LEVEL, 3))
    extended[: len(planes)] = planes
    k = len(planes)
    for h in range(n_edges):
        cell, v = graph[h, FACE], graph[h, ORIGIN]
        if k == len(extended):
            break
        if cell < 0 or not _is_far(planes[labels[cell]], xy, v, around, far_m):
            continue
        fits = False
        for q in range(k):
            fits = fits or not _is_far(extended[q], xy, v, around, far_m)
        if not fits:
            extended[k, 0], extended[k, 1], extended[k, 2] = 0.0, 0.0, 0.5 * (lowest[v] + highest[v])
            k += 1
    return extended[:k].copy()


@kernel
def _plane_beyond(
    points: FloatArray,
    cells: LabelArray,
    planes: FloatArray,
    cell: int,
    own: int,
    fits: BoolArray,
    up: float,
    cap_m: float,
) -> int:
    """Of the planes that fit all far corners, the one that explains most points where the cell's own plane is above it.

    Where `up` is negative: below it; -1 where none fits, or none explains them better than the cell's own.
    """
    best, saved = -1, 0.0
    for k in range(len(planes)):
        if not fits[k]:
            continue
        apart = planes[own] - planes[k]
        gain = 0.0
        for i in range(len(points)):
            if cells[i] == cell and up * (apart[0] * points[i, 0] + apart[1] * points[i, 1] + apart[2]) > 0.0:
                gain += min(vertical_distance_m(points[i], planes[own]), cap_m)
                gain -= min(vertical_distance_m(points[i], planes[k]), cap_m)
        if gain > saved:
            best, saved = k, gain
    return best


@kernel
def _cut_where_planes_meet(
    xy: IntArray,
    graph: LabelArray,
    counts: LabelArray,
    cell: int,
    one: FloatArray,
    other: FloatArray,
    line: int,
    snap_mm: float,
) -> None:
    """Cut a cell along the line in which two planes meet, where it crosses the cell."""
    meeting = one - other
    slope = math.hypot(meeting[0], meeting[1])
    if slope < 1e-6:
        return
    meeting /= slope
    meeting[2] *= 1e3
    spans = np.array([[math.inf, -math.inf]])
    for h in range(counts[1]):
        if graph[h, FACE] == cell:
            v = graph[h, ORIGIN]
            along = -meeting[1] * xy[v, 0] + meeting[0] * xy[v, 1]
            spans[0, 0], spans[0, 1] = min(spans[0, 0], along), max(spans[0, 1], along)
    cut_by_line(xy, graph, counts, meeting, line, snap_mm, spans, cell)


@kernel
def _end_of_chord(
    xy: IntArray,
    graph: LabelArray,
    counts: LabelArray,
    edge: int,
    is_far_first: bool,
    plane: FloatArray,
    raster: HeightsRaster,
    far_m: float,
) -> int:
    """The vertex where an edge from what is far to what is not gets near enough: a new one, else its near end."""
    u, w = graph[edge, ORIGIN], graph[edge ^ 1, ORIGIN]
    if not is_far_first:
        u, w = w, u
    dx, dy = float(xy[w, 0] - xy[u, 0]), float(xy[w, 1] - xy[u, 1])
    length = math.hypot(dx, dy)
    at = _STEP_MM
    while at < length:
        x, y = xy[u, 0] + at / length * dx, xy[u, 1] + at / length * dy
        if abs(_outside_m(plane, x, y, _heights_at(raster, x, y), raster[4])) <= far_m:
            break
        at += _STEP_MM
    if at > length - _STEP_MM or counts[0] >= len(xy) or counts[1] + 2 > len(graph):
        return int(w)
    x, y = xy[u, 0] + at / length * dx, xy[u, 1] + at / length * dy
    if not insert_vertex(xy, counts[0], graph, counts[1], edge, int(np.rint(x)), int(np.rint(y))):
        return int(w)
    counts[0] += 1
    counts[1] += 2
    return int(counts[0] - 1)


@kernel
def _cut_by_chord(
    xy: IntArray,
    graph: LabelArray,
    counts: LabelArray,
    cell: int,
    plane: FloatArray,
    around: HeightsAround,
    raster: HeightsRaster,
    far_m: float,
    first: int,
    line: int,
) -> None:
    """Cut corners that are too far off, where the edges beside them get near enough; from the corner `first` on."""
    h = first
    while True:
        last, g = h, graph[h, NEXT]
        while g != first and _is_far(plane, xy, graph[g, ORIGIN], around, far_m):
            last, g = g, graph[g, NEXT]
        if last != h:
            start = _end_of_chord(xy, graph, counts, h, False, plane, raster, far_m)
            end = _end_of_chord(xy, graph, counts, last, True, plane, raster, far_m)
            if start != end and counts[1] + 2 <= len(graph):
                made = insert_chord(xy, graph, counts[1], counts[2], start, end, cell, line)
                if made >= 0:
                    counts[1] += 2
                    counts[2] += made
                    return
        h = g
        if h == first:
            return


@kernel
def cut_off_far_corners(
    xy: IntArray,
    graph: LabelArray,
    counts: LabelArray,
    points: FloatArray,
    cells: LabelArray,
    planes: FloatArray,
    labels: LabelArray,
    around: HeightsAround,
    raster: HeightsRaster,
    far_m: float,
    cap_m: float,
    line: int,
    clearance: float,
) -> int:
    """Cut corners of cells off where the plane of the cell leaves the heights of all points around.

    Parameters
    ----------
    xy, graph, counts : arrays
        From `subdivide`; changed in place.
    points, cells : (n, 3) float64 and (n,) int32
        Metres; the cell of each.
    planes : (k, 3) float64
        Coefficients a, b, c.
    labels : (c,) int32
        Plane of every cell.
    around, raster : tuples
        From `heights_around` and `heights_raster`.
    far_m : float
        How far a plane may go above or below the points.
    cap_m : float
        A point farther than this from a plane is not explained by it.
    line : int
        Number of the first line that is drawn.
    clearance : float
        Times the usual distance within which a line passes through a vertex.

    Returns
    -------
    int
        Cells that have such corners, cut or not.
    """
    n_cells, known = counts[2], counts[0]
    found = 0
    fits = np.empty(len(planes), np.bool_)
    for cell in range(n_cells):
        # cuts of other cells put vertices on the borders of this one
        _add_heights(xy, known, counts[0], raster, around)
        known = counts[0]
        plane = planes[labels[cell]]
        farthest, far_corner = 0.0, -1
        fits[:] = True
        for h in range(counts[1]):
            if graph[h, FACE] != cell:
                continue
            v = graph[h, ORIGIN]
            outside = _vertex_outside_m(plane, xy, v, around)
            if abs(outside) <= far_m:
                continue
            if abs(outside) > abs(farthest):
                farthest, far_corner = outside, h
            for k in range(len(planes)):
                fits[k] = fits[k] and not _is_far(planes[k], xy, v, around, far_m)
        if far_corner < 0:
            continue
        found += 1
        near_corner = graph[far_corner, PREVIOUS]
        while near_corner != far_corner and _is_far(plane, xy, graph[near_corner, ORIGIN], around, far_m):
            near_corner = graph[near_corner, PREVIOUS]
        if near_corner == far_corner:
            continue
        n_before = counts[2]
        other = _plane_beyond(points, cells, planes, cell, labels[cell], fits, math.copysign(1.0, farthest), cap_m)
        if other >= 0:
            snap_mm = clearance * SNAP_CROSSING_MM
            _cut_where_planes_meet(xy, graph, counts, cell, plane, planes[other], line + found, snap_mm)
        if counts[2] == n_before:
            _cut_by_chord(xy, graph, counts, cell, plane, around, raster, far_m, near_corner, line + found)
    return found
