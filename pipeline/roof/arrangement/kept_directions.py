"""Steps along the outline keep their direction when vertices merge: they pay for another, or move as a whole.

A step in a direction of its own has a longer description than one along the outline. Where a vertex merges with a
neighbour, the steps that end in it turn, which costs as much as corners. Or the other end of the step slides along its
own borders by as much: a jog goes, or a step ends in a corner of the outline, and stays parallel.
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
    Buckets,
    Ends,
    are_parallel,
    cost_of_moving,
    edges_at,
    star_is_sound,
)
from pipeline.roof.arrangement.raster_labels import Limits

TURN = 2.0
"""Corners that a step along the outline must save to lose its direction: as many as one end of it is."""
_OWN = 0.5
"""A step's own direction is that of an edge at least this part as long."""
_ASIDE_MM = 60.0
"""A step has a direction if its ends lie this near to a line along it: chords pass through vertices this near."""
_ASIDE = 0.05
"""The same for long steps, as a share of their length; about 3 degrees."""
_LEAST_TURN = 0.3
"""Sine of the angle between two edges from which on the place where they cross is known."""
_MOST = 0.9
"""A vertex slides by no more than this part of an edge."""


@kernel(inline="always")
def _is_step(borders: Borders, planes: FloatArray, edge: int, gap_m: float) -> bool:
    """Whether the planes beside an edge are more than a gap apart amid it."""
    xy, edges = borders.xy, borders.edges
    if edges[edge, 3] < 0:
        return False
    a, b = edges[edge, 0], edges[edge, 1]
    one, other = planes[borders.plane_of_face[edges[edge, 2]]], planes[borders.plane_of_face[edges[edge, 3]]]
    x, y = 0.5e-3 * (xy[a, 0] + xy[b, 0]), 0.5e-3 * (xy[a, 1] + xy[b, 1])
    return bool(abs((one[0] - other[0]) * x + (one[1] - other[1]) * y + one[2] - other[2]) > gap_m)


@kernel(inline="always")
def _is_along(borders: Borders, v: int, w: int) -> bool:
    """Whether an edge between two vertices runs along one of the directions."""
    dx, dy = float(borders.xy[w, 0] - borders.xy[v, 0]), float(borders.xy[w, 1] - borders.xy[v, 1])
    aside = max(_ASIDE_MM, _ASIDE * math.hypot(dx, dy))
    is_along = False
    for angle in borders.directions:
        is_along = is_along or abs(math.cos(angle) * dy - math.sin(angle) * dx) <= aside
    return is_along


@kernel(inline="always")
def turned_steps(borders: Borders, planes: FloatArray, u: int, v: int, found: IntArray, gap_m: float) -> int:
    """How many of the found edges at u are steps that get a direction of their own if they start from v.

    A much shorter one that has its own direction now is as if it were along the others: noise turns it.
    """
    xy = borders.xy
    turned = 0
    for e in found:
        w = borders.edges[e, 0] + borders.edges[e, 1] - u
        if w != v and _is_step(borders, planes, e, gap_m):
            before = math.hypot(float(xy[w, 0] - xy[u, 0]), float(xy[w, 1] - xy[u, 1]))
            after = math.hypot(float(xy[w, 0] - xy[v, 0]), float(xy[w, 1] - xy[v, 1]))
            is_own = before >= _OWN * after and not _is_along(borders, u, w)
            turned += not is_own and not _is_along(borders, v, w)
    return turned


@kernel(inline="always")
def slid_end(borders: Borders, ends: Ends, planes: FloatArray, edge: int, u: int, v: int, limits: Limits) -> int:
    """The other end of the one step at u that would turn if u were merged into v; -1 if it cannot slide with it.

    It slides along its other edges; the last row of `borders.xy` becomes its new place.
    """
    xy, edges = borders.xy, borders.edges
    found = np.empty(MAX_DEGREE, np.int64)
    m = edges_at(edges, ends, u, found)
    step = -1
    for s in range(min(m, MAX_DEGREE)):
        if found[s] != edge and not are_parallel(xy, edges, edge, found[s]):
            if step >= 0:
                return -1
            step = found[s]
    if (
        m > MAX_DEGREE
        or step < 0
        or edges[step, KEEPS] != 0
        or not _is_step(borders, planes, step, limits.corner_gap_m)
    ):
        return -1
    w = edges[step, 0] + edges[step, 1] - u
    m = edges_at(edges, ends, w, found)
    if borders.is_fixed[w] or m < 2 or m > 3 or w == v or not _is_along(borders, u, w):
        return -1
    along = found[0] if found[0] != step else found[1]
    for s in range(m):
        if found[s] != step and not are_parallel(xy, edges, along, found[s]):
            return -1
    sx, sy = float(xy[w, 0] - xy[u, 0]), float(xy[w, 1] - xy[u, 1])
    a, b = edges[along, 0], edges[along, 1]
    ax, ay = float(xy[b, 0] - xy[a, 0]), float(xy[b, 1] - xy[a, 1])
    turn = ax * sy - ay * sx
    if abs(turn) < _LEAST_TURN * math.hypot(ax, ay) * math.hypot(sx, sy):
        return -1
    # from w along its other edge to the line through v
    share = ((xy[v, 0] - xy[w, 0]) * sy - (xy[v, 1] - xy[w, 1]) * sx) / turn
    if abs(share) * math.hypot(ax, ay) > limits.corner_reach_m * 1e3:
        return -1
    for s in range(m):
        r = edges[found[s], 0] + edges[found[s], 1] - w
        rx, ry = float(xy[r, 0] - xy[w, 0]), float(xy[r, 1] - xy[w, 1])
        if found[s] != step and share * (ax * rx + ay * ry) > _MOST * (rx * rx + ry * ry):
            return -1
    trial = len(xy) - 1
    xy[trial, 0], xy[trial, 1] = xy[w, 0] + round(share * ax), xy[w, 1] + round(share * ay)
    return int(w)


@kernel(inline="always")
def cost_of_sliding(
    borders: Borders, ends: Ends, buckets: Buckets, planes: FloatArray, w: int, limits: Limits
) -> float:
    """Unexplained points more if w goes where `slid_end` puts it; infinite where it cannot."""
    found = np.empty(MAX_DEGREE, np.int64)
    m = edges_at(borders.edges, ends, w, found)
    trial = len(borders.xy) - 1
    if borders.xy[w, 0] == borders.xy[trial, 0] and borders.xy[w, 1] == borders.xy[trial, 1]:
        return 0.0
    cost = cost_of_moving(borders, buckets, planes, w, trial, found[:m], limits.cap_m)
    return cost if star_is_sound(borders, planes, trial, w, found, m) else math.inf
