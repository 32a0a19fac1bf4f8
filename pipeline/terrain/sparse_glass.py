"""Ground and plants that are seen through a roof of glass, with few points per square metre.

In a greenhouse it is chance whether a point lies on the roof or beneath it, whatever its neighbours are. In alleys,
yards and around houses a low point has low neighbours. So a low vertex lies under glass if higher ones surround it, if
most of the surrounded higher vertices near it have a low one among their nearest, and if low vertices do not cluster.
Crowns, through which pulses pass by chance as well, are rough.

Counts in squares (`terrain.glass_squares`) rule out nearly all of a town or a wood before any neighbour is searched
for.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, IntArray, KindArray
from pipeline.spatial_hash import points_by_cell
from pipeline.terrain.facets import SceneVertices
from pipeline.terrain.glass_squares import FEWEST, FEWEST_LOW, Cells, Part, box_sums
from pipeline.terrain.reach import GLASS_NEAR as NEAR
from pipeline.terrain.reach import GLASS_SQUARE_MM as SQUARE_MM
from pipeline.terrain.reach import GLASS_SQUARES as REACH

# Not settings: they say what glass is, in neighbours.
_AROUND = 8
"""The nearest higher vertices, which surround a vertex or do not."""
_AT_EDGES = 24
"""As many surround what lies under the edges of a roof that is known to be of glass."""
_FEWEST_AROUND = 5
"""Fewer surround nothing."""
_NEAREST = 6
"""The nearest vertices of any kind: where 30 % of the pulses go through, seven in eight of a roof have a low one among
as many."""
_MIXED_SHARE = 0.6
"""Surrounded higher vertices that have a low one among their nearest. A sixth of the pulses make as many."""
_COMPANY = 0.35
"""How much of the way from chance to keeping to itself the low vertices may have gone."""
_BELOW_MM = 1000
"""How far what is seen through a roof lies below it at least."""


class _Found(IntEnum):
    """Layers of what is counted in squares."""

    HIGH = 0
    """Surrounded ones at the height of roofs."""
    MIXED = 1
    """Those of them with a low one, itself surrounded, among their nearest."""
    LOW = 2
    """Surrounded low ones."""
    LOW_NEIGHBOURS = 3
    """Nearest vertices of these that are surrounded and low."""
    NEIGHBOURS = 4
    """Nearest vertices of these that are surrounded."""


_LAYERS = len(_Found)


@kernel
def _nearest(v: int, vertices: SceneVertices, cells: Cells, found: IntArray) -> int:
    """Fill `found` with the members of cells that are nearest to v, without v itself; how many there are within reach.

    Equal distances by number: vertices come sorted by (x, y).
    """
    x, y = vertices.x_mm, vertices.y_mm
    distance = np.empty(found.size, np.int64)
    count, farthest = 0, (REACH * SQUARE_MM) ** 2
    c, r = x[v] // SQUARE_MM - cells.column0, y[v] // SQUARE_MM - cells.row0
    for ring in range(REACH + 1):
        for rr in range(max(r - ring, 0), min(r + ring + 1, cells.rows)):
            step = 1 if abs(rr - r) == ring else 2 * ring
            for cc in range(c - ring, c + ring + 1, step):
                if not 0 <= cc < cells.columns:
                    continue
                cell = rr * cells.columns + cc
                for m in range(cells.start[cell], cells.start[cell + 1]):
                    w = cells.members[m]
                    away = (x[w] - x[v]) ** 2 + (y[w] - y[v]) ** 2
                    if w == v or away > farthest:
                        continue
                    k = min(count, found.size - 1)
                    if count == found.size and away == farthest and w > found[k]:
                        continue
                    while k > 0 and (away < distance[k - 1] or (away == distance[k - 1] and w < found[k - 1])):
                        distance[k], found[k] = distance[k - 1], found[k - 1]
                        k -= 1
                    distance[k], found[k] = away, w
                    count = min(count + 1, found.size)
                    if count == found.size:
                        farthest = distance[count - 1]
        # what lies beyond this ring is farther
        if count == found.size and distance[count - 1] <= (ring * SQUARE_MM) ** 2:
            break
    return count


@kernel
def _are_around(v: int, vertices: SceneVertices, around: IntArray) -> bool:
    """Whether no straight line through vertex v has all of some others on one side."""
    x, y = vertices.x_mm, vertices.y_mm
    for i in around:
        ux, uy = x[i] - x[v], y[i] - y[v]
        is_open = True
        for j in around:
            if ux * (y[j] - y[v]) - uy * (x[j] - x[v]) > 0:
                is_open = False
                break
        if is_open:
            return False
    return True


@kernel
def _surrounded(
    wanted: BoolArray, vertices: SceneVertices, part: KindArray, high: Cells, most: int, out: BoolArray
) -> None:
    """Which wanted vertices (v,) lie among the nearest higher ones, up to `most`; low ones also lie well below them."""
    around = np.empty(most, np.int64)
    for v in range(part.size):
        if not wanted[v]:
            continue
        count = _nearest(v, vertices, high, around)
        near, rise = min(count, _AROUND), 0
        for w in around[:near]:
            rise += vertices.z_mm[w] - vertices.z_mm[v]
        if count >= _FEWEST_AROUND and (part[v] != Part.LOW or rise >= near * _BELOW_MM):
            out[v] = _are_around(v, vertices, around[:count])


@kernel
def _mixture(wanted: BoolArray, vertices: SceneVertices, part: KindArray, inner: BoolArray, every: Cells) -> IntArray:
    """What the squares (layers, rows, columns) hold by their wanted vertices (v,), layers as in `_Found`."""
    out = np.zeros((_LAYERS, every.rows, every.columns), np.int64)
    near = np.empty(_NEAREST, np.int64)
    for v in range(part.size):
        if not (wanted[v] and inner[v]):
            continue
        r, c = vertices.y_mm[v] // SQUARE_MM - every.row0, vertices.x_mm[v] // SQUARE_MM - every.column0
        low, known = 0, 0
        for w in near[: _nearest(v, vertices, every, near)]:
            known += inner[w]
            low += inner[w] and part[w] == Part.LOW
        if part[v] == Part.LOW:
            out[_Found.LOW, r, c] += 1
            out[_Found.LOW_NEIGHBOURS, r, c] += low
            out[_Found.NEIGHBOURS, r, c] += known
        else:
            out[_Found.HIGH, r, c] += 1
            out[_Found.MIXED, r, c] += low > 0
    return out


@kernel
def _inside(x_mm: IntArray, y_mm: IntArray, squares: BoolArray, cells: Cells) -> BoolArray:
    """Which places (n,) lie in marked squares (rows, columns)."""
    out = np.zeros(x_mm.size, np.bool_)
    for i in range(x_mm.size):
        r, c = y_mm[i] // SQUARE_MM - cells.row0, x_mm[i] // SQUARE_MM - cells.column0
        out[i] = 0 <= r < cells.rows and 0 <= c < cells.columns and squares[r, c]
    return out


def _near(squares: BoolArray, near: int) -> BoolArray:
    """Squares (rows, columns) up to `near` squares from marked ones."""
    marked: BoolArray = box_sums(squares.astype(np.int64), near) > 0
    return marked


def _glass(vertices: SceneVertices, part: KindArray, every: Cells, high: Cells, may_be: BoolArray) -> BoolArray:
    """Which squares (rows, columns) lie under glass, of those that may by what the squares around them hold."""
    x, y, is_low = vertices.x_mm, vertices.y_mm, part == Part.LOW
    inner, no = np.zeros((2, part.size), np.bool_)
    # the higher ones first, as if all low ones were surrounded: few squares are left, and most vertices are low
    for least, reach, taken in ((Part.ROUGH, 0, is_low), (Part.LOW, REACH, no)):
        # the squares around, and at last as far beyond them as their vertices have neighbours
        searched = (part >= least) & _inside(x, y, _near(may_be, NEAR + reach), every)
        _surrounded(searched, vertices, part, high, _AROUND, inner)
        counted = ~taken & _inside(x, y, _near(may_be, NEAR), every)
        layers = _mixture(counted, vertices, part, inner | taken, every)
        inner_high, mixed, low, low_neighbours, neighbours = (box_sums(layer, NEAR) for layer in layers)
        may_be &= (inner_high >= FEWEST) & (mixed >= _MIXED_SHARE * inner_high)
        if not may_be.any():
            return may_be
    share = low / np.maximum(low + inner_high, 1)
    company = low_neighbours / np.maximum(neighbours, 1)
    by_chance = company <= share + _COMPANY * (1.0 - share)
    found: BoolArray = may_be & (low >= FEWEST_LOW) & by_chance
    return found


def under_sparse_glass(
    vertices: SceneVertices, part: KindArray, high: Cells, may_be: BoolArray, x_mm: IntArray, y_mm: IntArray
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Which vertices (v,) lie in squares of glass, which low ones of them under it, and which points (n,) in squares.

    Parameters
    ----------
    vertices : SceneVertices
        Thinned points with their kinds and how planar their surroundings are, at least one, sorted by (x, y).
    part, high, may_be
        As by `possible_glass`; some square may be of glass.
    x_mm, y_mm : (n,)
        All points.
    """
    x, y = vertices.x_mm, vertices.y_mm
    every = Cells(*points_by_cell(x, y, np.ones(len(x), np.bool_), SQUARE_MM))
    glass = _glass(vertices, part, every, high, may_be)
    at, under = np.zeros((2, len(x)), np.bool_)
    if not glass.any():
        return at, under, np.zeros(len(x_mm), np.bool_)
    at = _inside(x, y, glass, high)
    _surrounded(at & (part == Part.LOW), vertices, part, high, _AT_EDGES, under)
    return at, under, _inside(x_mm, y_mm, glass, high)
