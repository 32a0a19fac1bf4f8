"""Candidate lines from the borders of coarse labels: where planes cross, else steps along the building's directions.

A border between two labels is a set of places, each half-way between two neighbouring cells. Places near the line in
which the two planes cross are a ridge, hip or valley and support that line exactly. The others are steps
(`step_lines`): along the outline, a contour or a fall line of one of the planes where that describes them well. Each
line then moves to where it separates the points of the two planes at the least cost.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.sorting import ascending_order
from pipeline.model import FloatArray, IntArray, LabelArray
from pipeline.roof.arrangement.raster_labels import Limits, vertical_distance_m
from pipeline.roof.arrangement.step_lines import Border, chains_of, steps_of

_MIN_SLOPE = 0.08
"""Difference of slopes below which two planes cross nowhere exactly: their noise moves the line by metres."""
_NEAR_CROSSING_CELLS = 1.2
"""A place this near to the planes' crossing belongs to it: labels are no finer than a cell."""
_MAX_CROSSING_CELLS = 4.0
"""Farthest such place where planes differ so little that the points do not show their side; others are steps."""
_NOISE_M = 0.1
"""Added to distances in cells: where cells are small, the noise of the points decides where a border lies."""
_SHIFT_CELLS = 0.6
"""How far a step may move from the middle of its places."""
_CROSSING_BONUS = 1.5
"""A crossing comes before a step with as many places, since its position is exact. Decides only an order."""
_MIN_EDGE_M = 1.0
"""Shorter edges of the outline do not give a direction."""
_SAME_DIRECTION_RAD = math.radians(3.0)
"""Directions closer than this are one: over a few metres they differ by less than a cell."""
_SEARCH_M = 1.0
"""How far from a step the points are that decide its position."""
_MIN_STEP_POINTS = 4
"""Fewer points do not show where a step is."""
_MAX_DIRECTIONS = 24
"""Bounds the work for outlines with very many edges; the longest come first."""
_DIRECTIONS_OF_PLANES = 4
"""Room for the fall lines and contours of two planes."""
_ROUNDING = 1e-9
"""Costs and distances (metres) closer than this are equal: their last bits depend on the order of sums."""


class CandidateLines(NamedTuple):
    """Lines that may cut an outline, with the places on the borders of coarse labels that support them."""

    lines: FloatArray
    """(l, 3) float64, nx x + ny y + offset = 0 with unit normals, metres."""
    scores: FloatArray
    """(l,) float64, places on each; more for crossings."""
    crossing: LabelArray
    """(l,) int32, 1 where two planes cross, 0 for a step."""
    places: FloatArray
    """(m, 2) float64, metres."""
    line_of: LabelArray
    """(m,) int32, line that each place supports, or -1."""


@kernel
def outline_directions(edges: FloatArray) -> FloatArray:
    """Directions of the long edges (e, 4) of an outline and those square to them, longest first, in [0, pi), (n,)."""
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
    """Append a direction in [0, pi) unless a similar one is among the first n; the new number of them."""
    for q in range(n):
        apart = abs(found[q] - angle)
        if min(apart, math.pi - apart) < _SAME_DIRECTION_RAD:
            return n
    if n < len(found):
        found[n] = angle
        n += 1
    return n


@kernel
def _with_directions_of(plane: FloatArray, directions: FloatArray, n: int) -> int:
    """Append the directions of a plane's fall line and contour; the new number of directions."""
    if math.hypot(plane[0], plane[1]) > _MIN_SLOPE:
        fall = math.atan2(plane[1], plane[0])
        n = _with_direction(directions, n, fall % math.pi)
        n = _with_direction(directions, n, (fall + math.pi / 2) % math.pi)
    return n


@kernel
def _parting_shift(
    points: FloatArray,
    planes: FloatArray,
    pair: tuple[int, int],
    line: FloatArray,
    low: float,
    high: float,
    cap_m: float,
    reach_m: float,
) -> float:
    """How far to shift a step, in metres, to part the points of its two planes at the least sum of capped residuals.

    `low` and `high` bound the step along its direction (-ny, nx). nan where too few points show it.
    """
    one, other = pair
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
        to_one, to_other = vertical_distance_m(points, i, planes, one), vertical_distance_m(points, i, planes, other)
        if to_one >= cap_m and to_other >= cap_m:
            continue
        offsets[m] = off
        gains[m] = (min(to_one, cap_m) - min(to_other, cap_m)) / cap_m
        m += 1
    if m < _MIN_STEP_POINTS:
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
        # one plane below the line and the other above it, or the other way round
        cost = min(below, total - below)
        if cost < least - _ROUNDING or (cost <= least + _ROUNDING and abs(shift) < abs(best)):
            least = cost
            best = shift
    return best


@kernel(inline="always")
def _take_places(
    places: FloatArray, first: int, last: int, line: FloatArray, near_m: float, line_of: LabelArray, number: int
) -> int:
    """Give the places first..last nearer to a line than a distance its number; how many there are."""
    taken = 0
    for q in range(first, last):
        if abs(line[0] * places[q, 0] + line[1] * places[q, 1] + line[2]) < near_m:
            line_of[q] = number
            taken += 1
    return taken


@kernel(inline="always")
def _take_step(
    places: FloatArray,
    chain: IntArray,
    begin: int,
    end: int,
    angle: float,
    line: FloatArray,
    line_of: LabelArray,
    number: int,
) -> tuple[float, float]:
    """Give places of a chain the number of their step, and draw its line amid them; its begin and end along it."""
    line[0], line[1], line[2] = -math.sin(angle), math.cos(angle), 0.0
    low, high = math.inf, -math.inf
    for s in range(begin, end + 1):
        q = chain[s % len(chain)]
        line_of[q] = number
        line[2] -= (line[0] * places[q, 0] + line[1] * places[q, 1]) / (end + 1 - begin)
        along = -line[1] * places[q, 0] + line[0] * places[q, 1]
        low, high = min(low, along), max(high, along)
    return low, high


@kernel
def candidate_lines(
    border: Border, points: FloatArray, planes: FloatArray, edges: FloatArray, cell_m: float, limits: Limits
) -> CandidateLines:
    """Lines along the `border_places` of coarse labels of planes (k, 3) through roof points (n, 3).

    `edges` (e, 4) are those of the outline in metres, `cell_m` is the cell of the labels.
    """
    places, pairs = border.places, border.pairs
    k = len(planes)
    m = len(places)
    cap_m, spacing_m = limits.cap_m, 1.0 / math.sqrt(limits.points_per_m2)
    least = max(2, math.ceil(limits.line_length_m / cell_m))
    at = np.zeros((border.corners, 3), np.int64)
    lines = np.empty((m + 1, 3))
    scores = np.empty(m + 1)
    crossing = np.zeros(m + 1, np.int32)
    line_of = np.full(m, -1, np.int32)
    outline = outline_directions(edges)
    directions = np.empty(len(outline) + _DIRECTIONS_OF_PLANES)
    difference = np.empty(3)
    n_lines = 0
    first = 0
    while first < m:
        last = first
        while last < m and pairs[last] == pairs[first]:
            last += 1
        one, other = pairs[first] // k, pairs[first] % k
        for axis in range(3):
            difference[axis] = planes[one, axis] - planes[other, axis]
        turn = math.hypot(difference[0], difference[1])
        if turn > _MIN_SLOPE:
            # where the planes differ by less than the cap the points do not show on which side they are
            near_m = max(_NEAR_CROSSING_CELLS * cell_m + _NOISE_M, min(cap_m / turn, _MAX_CROSSING_CELLS * cell_m))
            on_line = _take_places(places, first, last, difference, near_m * turn, line_of, n_lines)
            if on_line >= least:
                for axis in range(3):
                    lines[n_lines, axis] = difference[axis] / turn
                scores[n_lines] = _CROSSING_BONUS * on_line
                crossing[n_lines] = 1
                n_lines += 1
            else:
                line_of[first:last] = -1
        n = len(outline)
        for q in range(n):
            directions[q] = outline[q]
        n = _with_directions_of(planes[one], directions, n)
        n = _with_directions_of(planes[other], directions, n)
        order, starts = chains_of(border, first + np.flatnonzero(line_of[first:last] < 0), at)
        for c in range(len(starts) - 1):
            chain = order[starts[c] : starts[c + 1]]
            if len(chain) < least:
                continue
            ends, angles = steps_of(border, chain, directions[:n], spacing_m)
            for e in range(len(angles)):
                line = lines[n_lines]
                low, high = _take_step(places, chain, ends[e], ends[e + 1], angles[e], line, line_of, n_lines)
                reach_m = _SHIFT_CELLS * cell_m + _NOISE_M
                half = 0.5 * cell_m
                shift = _parting_shift(points, planes, (one, other), line, low - half, high + half, cap_m, reach_m)
                if not math.isnan(shift):
                    line[2] -= shift
                elif turn > _MIN_SLOPE:
                    # a border in a gap of the points lies anywhere: it is where the planes themselves meet
                    for axis in range(3):
                        line[axis] = difference[axis] / turn
                    crossing[n_lines] = 1
                scores[n_lines] = ends[e + 1] - ends[e] + 1
                n_lines += 1
        first = last
    return CandidateLines(lines[:n_lines].copy(), scores[:n_lines].copy(), crossing[:n_lines].copy(), places, line_of)
