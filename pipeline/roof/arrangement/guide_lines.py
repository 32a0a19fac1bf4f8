"""Guides among the candidate lines: given straight pieces of ridges, hips, valleys, steps and eaves.

A guide supports itself over its whole length, so it cuts cells also where the points show no border. Places of the
coarse labels near it support the guide instead of the line that was found there; that line is dropped if nothing else
supports it. Borders on guides cost nothing, and corners on them move along them only. The points still decide whether a
border runs there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FloatArray, IntArray
from pipeline.roof.arrangement.candidate_lines import CandidateLines
from pipeline.roof.arrangement.movable_borders import KEEPS

MAX_TURN = math.sin(math.radians(10.0))
"""Sine of the angle between a guide and the lines whose place it takes, at most."""
_FIRST = 1e9
"""Score of a guide: above that of any line that was found, since chords keep their distance from earlier ones."""
_ON_GUIDE_MM = 61.0
"""A border this near to a guide is on it: chords pass through vertices within 60 mm, and corners are rounded."""


class Guides(NamedTuple):
    """Given lines, in straight pieces."""

    pieces: FloatArray
    """(g, 4) float64, x0, y0, x1, y1 of each, metres; none is a point."""
    distance_m: float
    """How far lines and outlines may lie from a guide that takes their place."""


NO_GUIDES = Guides(np.empty((0, 4)), 0.0)
"""Where none is given."""


@kernel
def line_through(guide: FloatArray) -> tuple[float, float, float, float]:
    """Unit normal nx, ny and offset of the line through a piece x0, y0, x1, y1, and the length of the piece."""
    dx, dy = guide[2] - guide[0], guide[3] - guide[1]
    length = math.hypot(dx, dy)
    nx, ny = -dy / length, dx / length
    return nx, ny, -nx * guide[0] - ny * guide[1], length


@kernel
def with_guides(found: CandidateLines, given: Guides, cell_m: float, min_length_m: float) -> CandidateLines:
    """The guides as the first lines, then those found.

    A guide takes the places near it whose line runs its way. A found line that is left with places over less than
    `min_length_m` loses these, too.
    """
    guides, near_m = given.pieces, given.distance_m
    g, n_lines, m = len(guides), len(found.lines), len(found.places)
    if g == 0:
        return found
    lines, scores = np.empty((g + n_lines, 3)), np.full(g + n_lines, _FIRST)
    crossing = np.zeros(g + n_lines, np.int32)
    lines[g:], scores[g:], crossing[g:] = found.lines, found.scores, found.crossing
    line_of = found.line_of.copy()
    off = np.full(m, near_m)
    own = 0
    for k in range(g):
        nx, ny, offset, length = line_through(guides[k])
        lines[k, 0], lines[k, 1], lines[k, 2] = nx, ny, offset
        own += 2 + int(length / cell_m)
        for q in range(m):
            x, y, line = found.places[q, 0], found.places[q, 1], found.line_of[q]
            away = abs(nx * x + ny * y + offset)
            along = ny * (x - guides[k, 0]) - nx * (y - guides[k, 1])
            is_beside = away <= off[q] and -near_m <= along <= length + near_m
            if is_beside and (line < 0 or abs(nx * found.lines[line, 1] - ny * found.lines[line, 0]) <= MAX_TURN):
                off[q], line_of[q] = away, -2 - k
    left = np.zeros(n_lines, np.int64)
    for q in range(m):
        if line_of[q] >= 0:
            left[line_of[q]] += 1
    least = max(2, math.ceil(min_length_m / cell_m))
    for q in range(m):
        if line_of[q] < -1:
            line_of[q] = -2 - line_of[q]
        elif line_of[q] >= 0:
            line_of[q] = line_of[q] + g if left[line_of[q]] >= least else -1
    places, all_lines = np.empty((m + own, 2)), np.empty(m + own, np.int32)
    places[:m], all_lines[:m] = found.places, line_of
    s = m
    for k in range(g):
        pieces = 1 + int(line_through(guides[k])[3] / cell_m)
        for step in range(pieces + 1):
            for axis in range(2):
                places[s, axis] = guides[k, axis] + (guides[k, 2 + axis] - guides[k, axis]) * (step / pieces)
            all_lines[s] = k
            s += 1
    return CandidateLines(lines, scores, crossing, places, all_lines)


@kernel
def length_on_guide(xy: IntArray, p: int, q: int, guide: FloatArray) -> float:
    """How much of the edge between two vertices lies on a piece of a guide, metres, if it runs along it; else 0."""
    nx, ny, offset, length = line_through(guide)
    low, high = math.inf, -math.inf
    for v in (p, q):
        x, y = xy[v, 0] * 1e-3, xy[v, 1] * 1e-3
        if abs(nx * x + ny * y + offset) * 1e3 > _ON_GUIDE_MM:
            return 0.0
        along = ny * (x - guide[0]) - nx * (y - guide[1])
        low, high = min(low, along), max(high, along)
    return max(min(high, length) - max(low, 0.0), 0.0)


@kernel
def mark_edges_on_guides(xy: IntArray, edges: IntArray, guides: FloatArray) -> None:
    """Set `KEEPS` of the edges of `Borders` of which at least half lies on one of the pieces (g, 4)."""
    for e in range(len(edges)):
        p, q = edges[e, 0], edges[e, 1]
        whole = 1e-3 * math.hypot(float(xy[q, 0] - xy[p, 0]), float(xy[q, 1] - xy[p, 1]))
        for k in range(len(guides)):
            if length_on_guide(xy, p, q, guides[k]) >= 0.5 * whole:
                edges[e, KEEPS] = 1
