"""Corners where a roof plane departs from all points around it: they are cut off and given to a plane that fits.

If two lines meet far beyond the end of a ridge, or a slope continues into a part of the outline that holds something
else, one cell spans an explained and an unexplained part. The few points there count too little, and the roof gets a
fin. Such a cell is cut once more, along the line in which its plane meets the plane of the part beyond, or else where
its edges come near the points again. Then a plane costs extra in every cell at whose corners another plane is nearer to
the points.

Down an eave or up to the top of a pent roof a plane may continue beyond its last points: by its slope (at most 1) times
the search distance for points. Down an eave without points nearby, the distance to the next points counts instead.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray
from pipeline.roof.arrangement.raster_labels import COST_SCALE, Limits, vertical_distance_m
from pipeline.roof.arrangement.subdivision import (
    CELLS,
    EDGES,
    FACE,
    NEXT,
    ORIGIN,
    PREVIOUS,
    SNAP_CROSSING_MM,
    VERTICES,
    Subdivision,
    cut_by_line,
    insert_chord,
    insert_vertex,
)


class HeightsRaster(NamedTuple):
    """Lowest and highest points by the cells of a raster, metres."""

    lowest: FloatArray
    """(r, c), inf where there is none."""
    highest: FloatArray
    """(r, c), -inf where there is none."""
    west: float
    south: float
    side: float
    """Side of a cell: 0.75 m or a spacing, the larger."""


class HeightsAround(NamedTuple):
    """Lowest and highest points around every vertex, metres, with room for more."""

    lowest: FloatArray
    """(v,), inf where there is none."""
    highest: FloatArray
    """(v,), -inf where there is none."""
    within: FloatArray
    """(v,), how far from the vertex they were looked for."""
    raster: HeightsRaster
    """Where they come from."""


_AROUND_M = 0.75
"""Points at least this near to a corner count as around it: they show how high a roof may be there."""
_NEAR_RINGS, _FAR_RINGS = 1, 2
"""Rings of cells around a place in which points are searched for: the far ones where the near ones are empty."""
_FAR_SIDES = _FAR_RINGS + 1.0
"""Sides of a cell within which all far rings lie."""
_MAX_CONTINUED_SLOPE = 1.0
"""Planes that are steeper go on no farther beyond their points than one of this slope."""
_COST_PER_M = 20.0
_MAX_COST = 40.0
"""Points that a plane costs per metre, and at most: more than a face, less than a large cell holds."""
_SAME_SLOPE = 1e-6
"""Planes whose slopes differ by less meet nowhere near."""
_STEP_MM = 250.0
"""Step along an edge: a third of the raster's cells, which have no finer heights."""
_MAX_LEVEL_PLANES = 8
"""Most horizontal planes added at a time: a roof with more places where nothing fits is not made of planes."""


@kernel
def heights_raster(points: FloatArray, spacing_m: float) -> HeightsRaster:
    """Lowest and highest point of every cell of a raster."""
    side = max(_AROUND_M, spacing_m)
    if len(points) == 0:
        return HeightsRaster(np.full((1, 1), math.inf), np.full((1, 1), -math.inf), 0.0, 0.0, side)
    west, south, east, north = math.inf, math.inf, -math.inf, -math.inf
    for i in range(len(points)):
        west, south = min(west, points[i, 0]), min(south, points[i, 1])
        east, north = max(east, points[i, 0]), max(north, points[i, 1])
    columns, rows = int((east - west) / side) + 1, int((north - south) / side) + 1
    low, high = np.full((rows, columns), math.inf), np.full((rows, columns), -math.inf)
    for i in range(len(points)):
        r, c = int((points[i, 1] - south) / side), int((points[i, 0] - west) / side)
        low[r, c] = min(low[r, c], points[i, 2])
        high[r, c] = max(high[r, c], points[i, 2])
    return HeightsRaster(low, high, west, south, side)


@kernel
def _heights_at(raster: HeightsRaster, x_mm: float, y_mm: float) -> tuple[float, float, float]:
    """Lowest and highest point around a place, and the distance within which they were looked for, metres.

    All points within the side of a cell count, none at three times that distance; where there are none, those up to as
    far again. The lowest is above the highest where there are none either.
    """
    low, high, side = raster.lowest, raster.highest, raster.side
    r, c = math.floor((y_mm * 1e-3 - raster.south) / side), math.floor((x_mm * 1e-3 - raster.west) / side)
    lowest, highest, within = math.inf, -math.inf, side
    for reach in (_NEAR_RINGS, _FAR_RINGS):
        within = side if reach == _NEAR_RINGS else _FAR_SIDES * side
        for row in range(max(r - reach, 0), min(r + reach + 1, low.shape[0])):
            for column in range(max(c - reach, 0), min(c + reach + 1, low.shape[1])):
                lowest = min(lowest, low[row, column])
                highest = max(highest, high[row, column])
        if lowest <= highest:
            break
    return lowest, highest, within


@kernel
def _add_heights(plan: Subdivision, first: int, around: HeightsAround) -> None:
    """Fill in the heights around the vertices from `first` on."""
    for v in range(first, plan.counts[VERTICES]):
        lowest, highest, within = _heights_at(around.raster, float(plan.xy[v, 0]), float(plan.xy[v, 1]))
        around.lowest[v], around.highest[v], around.within[v] = lowest, highest, within


@kernel(inline="always")
def heights_around(plan: Subdivision, raster: HeightsRaster) -> HeightsAround:
    """Lowest and highest point around every vertex."""
    room = len(plan.xy)
    lowest, highest, within = np.empty(room), np.empty(room), np.empty(room)
    lowest[:], highest[:], within[:] = math.inf, -math.inf, raster.side
    around = HeightsAround(lowest, highest, within, raster)
    _add_heights(plan, 0, around)
    return around


@kernel
def _outside_m(
    plane: FloatArray, x_mm: float, y_mm: float, lowest: float, highest: float, within: float, side: float
) -> float:
    """By how many metres a plane exceeds the heights around a place, negative below them; 0 without heights."""
    if lowest > highest:
        return 0.0
    z = plane[0] * x_mm * 1e-3 + plane[1] * y_mm * 1e-3 + plane[2]
    slope = min(math.hypot(plane[0], plane[1]), _MAX_CONTINUED_SLOPE)
    outside: float = max(z - highest - slope * side, 0.0) if z > highest else min(z - lowest + slope * within, 0.0)
    return outside


@kernel
def _vertex_outside_m(plane: FloatArray, plan: Subdivision, v: int, around: HeightsAround) -> float:
    """The same at a vertex."""
    x, y = float(plan.xy[v, 0]), float(plan.xy[v, 1])
    return _outside_m(plane, x, y, around.lowest[v], around.highest[v], around.within[v], around.raster.side)


@kernel
def add_costs_of_far_planes(
    plan: Subdivision,
    planes: FloatArray,
    around: HeightsAround,
    far_m: float,
    costs: IntArray,
    misfits: IntArray,
) -> None:
    """Raise the cost of planes in the cells at whose corners they are farther from the points than another.

    `far_m` is how far a plane may go above or below the points without cost; `costs` and `misfits` (c, k), from
    `cell_costs`, change in place.
    """
    farthest = np.zeros(costs.shape)
    for h in range(plan.counts[EDGES]):
        cell = plan.graph[h, FACE]
        if cell >= 0:
            for k in range(len(planes)):
                outside = abs(_vertex_outside_m(planes[k], plan, plan.graph[h, ORIGIN], around))
                farthest[cell, k] = max(farthest[cell, k], outside)
    for cell in range(len(costs)):
        least = math.inf
        for k in range(len(planes)):
            least = min(least, farthest[cell, k])
        least = max(least, far_m)
        for k in range(len(planes)):
            if farthest[cell, k] > least:
                cost = int(COST_SCALE * min(_COST_PER_M * (farthest[cell, k] - least), _MAX_COST))
                costs[cell, k] += cost
                misfits[cell, k] += cost


@kernel
def with_level_planes(
    plan: Subdivision, planes: FloatArray, labels: LabelArray, around: HeightsAround, far_m: float
) -> FloatArray:
    """The planes, and horizontal ones where none of them fits a corner that the plane of its cell is far from.

    `labels` (c,) are the planes of the cells; `far_m` as in `add_costs_of_far_planes`. The given planes come first.
    """
    extended = np.empty((len(planes) + _MAX_LEVEL_PLANES, 3))
    k = len(planes)
    for q in range(k):
        for axis in range(3):
            extended[q, axis] = planes[q, axis]
    for h in range(plan.counts[EDGES]):
        cell, v = plan.graph[h, FACE], plan.graph[h, ORIGIN]
        if k == len(extended):
            break
        if cell < 0 or abs(_vertex_outside_m(planes[labels[cell]], plan, v, around)) <= far_m:
            continue
        fits = False
        for q in range(k):
            fits = fits or abs(_vertex_outside_m(extended[q], plan, v, around)) <= far_m
        if not fits:
            extended[k, 0], extended[k, 1], extended[k, 2] = 0.0, 0.0, 0.5 * (around.lowest[v] + around.highest[v])
            k += 1
    return extended[:k].copy()


@kernel
def _plane_beyond(
    points: FloatArray,
    cells: IntArray,
    planes: FloatArray,
    cell: int,
    own: int,
    fits: BoolArray,
    up: float,
    cap_m: float,
) -> int:
    """The plane, among those that fit all far corners, that explains most points below the cell's own plane.

    Above it if `up` is negative; -1 where none fits, or none explains them better than the cell's own.
    """
    best, saved = -1, 0.0
    for k in range(len(planes)):
        if not fits[k]:
            continue
        a, b, c = planes[own, 0] - planes[k, 0], planes[own, 1] - planes[k, 1], planes[own, 2] - planes[k, 2]
        gain = 0.0
        for i in range(len(points)):
            if cells[i] == cell and up * (a * points[i, 0] + b * points[i, 1] + c) > 0.0:
                gain += min(vertical_distance_m(points, i, planes, own), cap_m)
                gain -= min(vertical_distance_m(points, i, planes, k), cap_m)
        if gain > saved:
            best, saved = k, gain
    return best


@kernel
def _cut_where_planes_meet(
    plan: Subdivision, cell: int, one: FloatArray, other: FloatArray, line: int, snap_mm: float
) -> None:
    """Cut a cell along the line in which two planes meet, where it crosses the cell."""
    slope = math.hypot(one[0] - other[0], one[1] - other[1])
    if slope < _SAME_SLOPE:
        return
    meeting = np.empty(3)
    for axis in range(3):
        meeting[axis] = (one[axis] - other[axis]) / slope
    meeting[2] *= 1e3
    spans = np.empty((1, 2))
    spans[0, 0], spans[0, 1] = math.inf, -math.inf
    for h in range(plan.counts[EDGES]):
        if plan.graph[h, FACE] == cell:
            v = plan.graph[h, ORIGIN]
            along = -meeting[1] * plan.xy[v, 0] + meeting[0] * plan.xy[v, 1]
            spans[0, 0], spans[0, 1] = min(spans[0, 0], along), max(spans[0, 1], along)
    cut_by_line(plan, meeting, line, snap_mm, spans, cell)


@kernel
def _end_of_chord(
    plan: Subdivision, edge: int, is_far_first: bool, plane: FloatArray, raster: HeightsRaster, far_m: float
) -> int:
    """The vertex where an edge with one far end gets near the points: a new one, else its near end."""
    xy, counts = plan.xy, plan.counts
    u, w = plan.graph[edge, ORIGIN], plan.graph[edge ^ 1, ORIGIN]
    if not is_far_first:
        u, w = w, u
    dx, dy = float(xy[w, 0] - xy[u, 0]), float(xy[w, 1] - xy[u, 1])
    length = math.hypot(dx, dy)
    at = _STEP_MM
    while at < length:
        x, y = xy[u, 0] + at / length * dx, xy[u, 1] + at / length * dy
        lowest, highest, within = _heights_at(raster, x, y)
        if abs(_outside_m(plane, x, y, lowest, highest, within, raster.side)) <= far_m:
            break
        at += _STEP_MM
    if at > length - _STEP_MM or counts[VERTICES] >= len(xy) or counts[EDGES] + 2 > len(plan.graph):
        return int(w)
    x, y = xy[u, 0] + at / length * dx, xy[u, 1] + at / length * dy
    if not insert_vertex(plan, edge, int(np.rint(x)), int(np.rint(y))):
        return int(w)
    return int(counts[VERTICES] - 1)


@kernel
def _cut_by_chord(
    plan: Subdivision, cell: int, plane: FloatArray, around: HeightsAround, far_m: float, first: int, line: int
) -> None:
    """Cut corners that are too far off, where the edges beside them get near enough; from the corner `first` on."""
    graph = plan.graph
    h = first
    while True:
        last, g = h, graph[h, NEXT]
        while g != first and abs(_vertex_outside_m(plane, plan, graph[g, ORIGIN], around)) > far_m:
            last, g = g, graph[g, NEXT]
        if last != h:
            start = _end_of_chord(plan, h, False, plane, around.raster, far_m)
            end = _end_of_chord(plan, last, True, plane, around.raster, far_m)
            has_room = start != end and plan.counts[EDGES] + 2 <= len(graph)
            if has_room and insert_chord(plan, start, end, cell, line) >= 0:
                return
        h = g
        if h == first:
            return


@kernel
def cut_off_far_corners(
    plan: Subdivision,
    points: FloatArray,
    cells: IntArray,
    planes: FloatArray,
    labels: LabelArray,
    around: HeightsAround,
    limits: Limits,
    line: int,
) -> int:
    """Cut corners of cells off where the plane of the cell leaves the heights of all points around.

    Returns how many cells have such corners, cut or not.

    Parameters
    ----------
    plan : Subdivision
        Changed in place.
    points, cells : (n, 3) float64 and (n,) int64
        Metres; the cell of each.
    limits : Limits
        How far a plane may go above or below the points, and the cap of residuals.
    line : int
        Number of the first line that is drawn.
    """
    far_m = limits.overshoot_m
    graph, counts = plan.graph, plan.counts
    n_cells, known = counts[CELLS], counts[VERTICES]
    found = 0
    fits = np.empty(len(planes), np.bool_)
    for cell in range(n_cells):
        # cuts of other cells put vertices on the borders of this one
        _add_heights(plan, known, around)
        known = counts[VERTICES]
        plane = planes[labels[cell]]
        farthest, far_corner = 0.0, -1
        fits[:] = True
        for h in range(counts[EDGES]):
            if graph[h, FACE] != cell:
                continue
            v = graph[h, ORIGIN]
            outside = _vertex_outside_m(plane, plan, v, around)
            if abs(outside) <= far_m:
                continue
            if abs(outside) > abs(farthest):
                farthest, far_corner = outside, h
            for k in range(len(planes)):
                fits[k] = fits[k] and abs(_vertex_outside_m(planes[k], plan, v, around)) <= far_m
        if far_corner < 0:
            continue
        found += 1
        near_corner = graph[far_corner, PREVIOUS]
        while (
            near_corner != far_corner
            and abs(_vertex_outside_m(plane, plan, graph[near_corner, ORIGIN], around)) > far_m
        ):
            near_corner = graph[near_corner, PREVIOUS]
        if near_corner == far_corner:
            continue
        n_before = counts[CELLS]
        up = math.copysign(1.0, farthest)
        other = _plane_beyond(points, cells, planes, cell, labels[cell], fits, up, limits.cap_m)
        if other >= 0:
            snap_mm = limits.clearance * SNAP_CROSSING_MM
            _cut_where_planes_meet(plan, cell, plane, planes[other], line + found, snap_mm)
        if counts[CELLS] == n_before:
            _cut_by_chord(plan, cell, plane, around, far_m, near_corner, line + found)
    return found
