"""Candidate lines from the borders of coarse labels: where planes cross, else steps along the building's directions.

A border between two labels is a set of places, each amid two neighbouring cells. Those near to the line in which the
two planes cross are a ridge, hip or valley and support that line exactly. What is left is cut into steps: lines with a
direction of the outline, of a contour or of a fall line of one of the planes, as long as they find enough places;
each is then moved to where it parts the points of the two planes at the least cost.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.merge_sort import ascending_order, in_order
from pipeline.model import FloatArray, IntArray, LabelArray
from pipeline.roof.arrangement.raster_labels import vertical_distance_m

_MIN_SLOPE = 0.08
"""Planes whose slopes differ by less cross nowhere exactly."""
_NEAR_CROSSING_CELLS = 1.2
_NEAR_CROSSING_M = 0.1
"""A place this near to the planes' crossing belongs to it."""
_BAND_CELLS = 1.1
"""Width of the band in which the places of one step lie."""
_CROSSING_BONUS = 1.5
"""A crossing comes before a step with as many places: its position is exact."""
_MIN_EDGE_M = 1.0
_SAME_DIRECTION_RAD = math.radians(3.0)
_SEARCH_M = 1.0
"""How far from a step the points are that decide its position."""
_MIN_POINTS = 4
_MAX_DIRECTIONS = 24


@kernel
def _outline_directions(edges: FloatArray) -> FloatArray:
    """Directions of the long edges of the outline and those square to them, longest first, in [0, pi)."""
    shortness = np.empty(len(edges))
    for e in range(len(edges)):
        shortness[e] = -np.hypot(edges[e, 2] - edges[e, 0], edges[e, 3] - edges[e, 1])
    found = np.empty(_MAX_DIRECTIONS)
    n = 0
    for e in ascending_order(shortness):
        if -shortness[e] < _MIN_EDGE_M or n + 2 > _MAX_DIRECTIONS:
            break
        for quarter in range(2):
            angle = math.atan2(edges[e, 3] - edges[e, 1], edges[e, 2] - edges[e, 0]) + quarter * math.pi / 2
            n = _with_direction(found, n, angle % math.pi)
    return found[:n].copy()


@kernel
def _with_direction(found: FloatArray, n: int, angle: float) -> int:
    """Append a direction unless a like one is there; the new number of them."""
    for q in range(n):
        apart = abs(found[q] - angle)
        if min(apart, math.pi - apart) < _SAME_DIRECTION_RAD:
            return n
    if n < len(found):
        found[n] = angle
        n += 1
    return n


@kernel
def border_places(
    labels: LabelArray, place: LabelArray, low_x: float, low_y: float, cell_m: float, columns: int, n_planes: int
) -> tuple[FloatArray, IntArray]:
    """Places amid neighbouring cells of different labels, ordered by their pair of labels.

    Returns
    -------
    places : (m, 2) float64
        Metres.
    pairs : (m,) int64
        low * n_planes + high, ascending.
    """
    number = np.full(place[-1] + columns + 2 if len(place) > 0 else 1, -1, np.int32)
    for i in range(len(place)):
        number[place[i]] = i
    places = np.empty((2 * len(place), 2))
    pairs = np.empty(2 * len(place), np.int64)
    m = 0
    for i in range(len(place)):
        r, c = place[i] // columns, place[i] % columns
        for step in range(2):
            if step == 0 and c + 1 >= columns:
                continue
            j = number[place[i] + (1 if step == 0 else columns)]
            if j < 0 or labels[j] == labels[i]:
                continue
            places[m, 0] = low_x + (c + 0.5 + 0.5 * (step == 0)) * cell_m
            places[m, 1] = low_y + (r + 0.5 + 0.5 * (step == 1)) * cell_m
            pairs[m] = np.int64(min(labels[i], labels[j])) * n_planes + max(labels[i], labels[j])
            m += 1
    order = ascending_order(pairs[:m])
    ordered, ordered_pairs = np.empty((m, 2)), np.empty(m, np.int64)
    for s in range(m):
        ordered[s, 0], ordered[s, 1] = places[order[s], 0], places[order[s], 1]
        ordered_pairs[s] = pairs[order[s]]
    return ordered, ordered_pairs


@kernel
def _best_band(
    places: FloatArray, first: int, last: int, line_of: LabelArray, directions: FloatArray, n: int, band_m: float
) -> tuple[int, float, float]:
    """The direction and offset whose band holds most of the places first..last that have no line yet."""
    most, best_angle, best_offset = 0, 0.0, 0.0
    offsets = np.empty(last - first)
    for d in range(n):
        across_x, across_y = -math.sin(directions[d]), math.cos(directions[d])
        m = 0
        for q in range(first, last):
            if line_of[q] < 0:
                offsets[m] = across_x * places[q, 0] + across_y * places[q, 1]
                m += 1
        ordered = in_order(offsets[:m])
        end = 0
        for begin in range(m):
            while end < m and ordered[end] <= ordered[begin] + band_m:
                end += 1
            if end - begin > most:
                most = end - begin
                best_angle = directions[d]
                best_offset = 0.5 * (ordered[begin] + ordered[end - 1])
    return most, best_angle, best_offset


@kernel
def _parting_shift(
    points: FloatArray,
    planes: FloatArray,
    a: int,
    b: int,
    line: FloatArray,
    low: float,
    high: float,
    cap_m: float,
    reach_m: float,
) -> float:
    """How far to shift a step so that it parts the points of its two planes at the least capped cost.

    `low` and `high` bound the step along its direction (-ny, nx). nan where too few points tell.
    """
    offsets = np.empty(len(points))
    gains = np.empty(len(points))
    m = 0
    for i in range(len(points)):
        off = line[0] * points[i, 0] + line[1] * points[i, 1] + line[2]
        if abs(off) > _SEARCH_M:
            continue
        along = -line[1] * points[i, 0] + line[0] * points[i, 1]
        if along < low or along > high:
            continue
        to_a, to_b = vertical_distance_m(points[i], planes[a]), vertical_distance_m(points[i], planes[b])
        if to_a >= cap_m and to_b >= cap_m:
            continue
        offsets[m] = off
        gains[m] = (min(to_a, cap_m) - min(to_b, cap_m)) / cap_m
        m += 1
    if m < _MIN_POINTS:
        return math.nan
    order = ascending_order(offsets[:m])
    total = 0.0
    for q in range(m):
        total += gains[order[q]]
    best = 0.0
    least = math.inf
    below = 0.0
    for q in range(m - 1):
        below += gains[order[q]]
        shift = 0.5 * (offsets[order[q]] + offsets[order[q + 1]])
        if abs(shift) > reach_m:
            continue
        # plane a below the line and b above it, or the other way round
        cost = min(below, total - below)
        if cost < least - 1e-9 or (cost <= least + 1e-9 and abs(shift) < abs(best)):
            least = cost
            best = shift
    return best


@kernel
def candidate_lines(
    places: FloatArray,
    pairs: IntArray,
    points: FloatArray,
    planes: FloatArray,
    edges: FloatArray,
    cell_m: float,
    cap_m: float,
    min_length_m: float,
) -> tuple[FloatArray, FloatArray, LabelArray, LabelArray]:
    """Lines along the borders of coarse labels.

    Parameters
    ----------
    places, pairs
        From `border_places`.
    points : (n, 3) float64
        Roof points, metres.
    planes : (k, 3) float64
        Coefficients a, b, c.
    edges : (e, 4) float64
        Edges of the outline, metres.
    cell_m : float
        Cell of the labels.
    cap_m : float
        Residual from which a point is unexplained.
    min_length_m : float
        Shorter borders give no line.

    Returns
    -------
    lines : (l, 3) float64
        nx x + ny y + offset = 0 with unit normals.
    scores : (l,) float64
        Places on each; more for crossings.
    crossing : (l,) int32
        1 where two planes cross, 0 for a step.
    line_of : (m,) int32
        Line that each place supports, or -1.
    """
    k = len(planes)
    m = len(places)
    least = max(2, math.ceil(min_length_m / cell_m))
    lines = np.empty((m + 1, 3))
    scores = np.empty(m + 1)
    crossing = np.zeros(m + 1, np.int32)
    line_of = np.full(m, -1, np.int32)
    outline = _outline_directions(edges)
    directions = np.empty(len(outline) + 4)
    n_lines = 0
    first = 0
    while first < m:
        last = first
        while last < m and pairs[last] == pairs[first]:
            last += 1
        a, b = int(pairs[first] // k), int(pairs[first] % k)
        free = last - first
        da, db, dc = planes[a, 0] - planes[b, 0], planes[a, 1] - planes[b, 1], planes[a, 2] - planes[b, 2]
        turn = math.hypot(da, db)
        if turn > _MIN_SLOPE:
            # where the planes differ by less than the cap the points cannot tell on which side they are
            near_m = max(_NEAR_CROSSING_CELLS * cell_m + _NEAR_CROSSING_M, min(cap_m / turn, 4.0 * cell_m))
            on_line = 0
            for q in range(first, last):
                if abs(da * places[q, 0] + db * places[q, 1] + dc) < near_m * turn:
                    line_of[q] = n_lines
                    on_line += 1
            if on_line >= least:
                lines[n_lines, 0], lines[n_lines, 1], lines[n_lines, 2] = da / turn, db / turn, dc / turn
                scores[n_lines] = _CROSSING_BONUS * on_line
                crossing[n_lines] = 1
                free -= on_line
                n_lines += 1
            else:
                line_of[first:last] = -1
        n = len(outline)
        for q in range(n):
            directions[q] = outline[q]
        for plane in (a, b):
            if math.hypot(planes[plane, 0], planes[plane, 1]) > _MIN_SLOPE:
                fall = math.atan2(planes[plane, 1], planes[plane, 0])
                n = _with_direction(directions, n, fall % math.pi)
                n = _with_direction(directions, n, (fall + math.pi / 2) % math.pi)
        while free >= least:
            most, angle, offset = _best_band(places, first, last, line_of, directions, n, _BAND_CELLS * cell_m)
            if most < least:
                break
            line = lines[n_lines]
            line[0], line[1], line[2] = -math.sin(angle), math.cos(angle), -offset
            low, high = math.inf, -math.inf
            for q in range(first, last):
                off = line[0] * places[q, 0] + line[1] * places[q, 1] + line[2]
                if line_of[q] < 0 and abs(off) <= 0.5 * _BAND_CELLS * cell_m + 1e-9:
                    line_of[q] = n_lines
                    free -= 1
                    along = -line[1] * places[q, 0] + line[0] * places[q, 1]
                    low, high = min(low, along), max(high, along)
            reach_m = 0.6 * cell_m + _NEAR_CROSSING_M
            half = 0.5 * cell_m
            shift = _parting_shift(points, planes, a, b, line, low - half, high + half, cap_m, reach_m)
            if not math.isnan(shift):
                line[2] -= shift
            elif turn > _MIN_SLOPE:
                # a border in a gap of the points lies anywhere: the planes themselves tell where they meet
                line[0], line[1], line[2] = da / turn, db / turn, dc / turn
                crossing[n_lines] = 1
            scores[n_lines] = most
            n_lines += 1
        first = last
    return lines[:n_lines].copy(), scores[:n_lines].copy(), crossing[:n_lines].copy(), line_of
