"""Ground that is seen through a roof of glass: it does not divide the roof.

Half of the pulses go through the panes of a greenhouse. In a TIN of the highest points each of them makes a pit with
walls around it, and the roof falls apart. A square of the lattice with points of a level roof above, and of the ground
below lies under glass if all squares around it hold roof, too, and most of those near it are like it. Along alleys and
in courtyards few are. In a wood the upper points are rough.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, IntArray
from pipeline.terrain.facets import SceneVertices, VertexKind

# Not settings: they say what glass is, in squares that hold a few points each.
_WINDOWS = ((1000, 4), (2000, 2))
"""Sides of the squares in mm, and how many squares around one are compared: the larger ones are for sparse points."""
_MOST_POINTS = 20.0
"""Points in one of the larger squares, on average: where there are more, the smaller ones hold enough, and only these
distinguish glass from yards."""
_MIXED_SHARE = 0.5
"""Share of the inner squares with ground below: where half of the pulses go through, three points show both."""
_LEVEL_SHARE = 0.8
"""Share of the upper vertices that lie on a level, smooth or planar, surface."""
_FEWEST = 6
"""Inner squares: fewer show nothing."""
_ROOFED = 5
"""Of the eight squares around one without roof so many hold roof: it is a larger gap between pulses."""


class _Squares(NamedTuple):
    """What the squares of a lattice (rows, columns) hold."""

    planar: IntArray
    """Upper vertices with planar surroundings, or of buildings by their class."""
    upper: IntArray
    """All upper vertices."""
    points: IntArray
    """All points that may be ground or roof."""
    ground: BoolArray
    """Some point of the ground."""
    column0: int
    row0: int


@kernel
def _squares(
    vertices: SceneVertices,
    x_mm: IntArray,
    y_mm: IntArray,
    used: BoolArray,
    is_low: BoolArray,
    least_mm: int,
    side_mm: int,
) -> _Squares:
    """The squares over all vertices; of the points (n,), mm, those `used` count, on the ground where `is_low`."""
    vx, vy = vertices.x_mm, vertices.y_mm
    # a ring of empty squares more, so that it does not matter where the vertices end
    column0, row0 = vx.min() // side_mm - 1, vy.min() // side_mm - 1
    columns, rows = vx.max() // side_mm - column0 + 2, vy.max() // side_mm - row0 + 2
    planar, upper = np.zeros((rows, columns), np.int64), np.zeros((rows, columns), np.int64)
    points = np.zeros((rows, columns), np.int64)
    ground = np.zeros((rows, columns), np.bool_)
    for v in range(len(vx)):
        is_building = vertices.kind[v] == VertexKind.BUILDING or vertices.kind[v] == VertexKind.JOINED
        if (is_building or vertices.kind[v] == VertexKind.OBJECT) and vertices.height_mm[v] >= least_mm:
            r, c = vy[v] // side_mm - row0, vx[v] // side_mm - column0
            upper[r, c] += 1
            # not what was joined to a building: whether far vertices are, another tile decides
            planar[r, c] += vertices.kind[v] == VertexKind.BUILDING or vertices.planar[v] > 0
    for i in range(len(x_mm)):
        r, c = y_mm[i] // side_mm - row0, x_mm[i] // side_mm - column0
        if used[i] and 0 <= r < rows and 0 <= c < columns:
            points[r, c] += 1
            ground[r, c] |= is_low[i]
    return _Squares(planar, upper, points, ground, column0, row0)


@kernel
def _glass(squares: _Squares, near: int, most_points: float) -> BoolArray:
    """Which squares (rows, columns) lie under glass, by those up to `near` around each; none among too many points."""
    planar, upper, ground = squares.planar, squares.upper, squares.ground
    rows, columns = planar.shape
    roofed = np.zeros((rows, columns), np.int64)
    for r in range(1, rows - 1):
        for c in range(1, columns - 1):
            for dr in range(-1, 2):
                for dc in range(-1, 2):
                    roofed[r, c] += (dr != 0 or dc != 0) and planar[r + dr, c + dc] > 0
    glass = np.zeros((rows, columns), np.bool_)
    for r in range(1, rows - 1):
        for c in range(1, columns - 1):
            if not ground[r, c] or roofed[r, c] < _ROOFED:
                continue
            inner, mixed, level, all_upper, held = 0, 0, 0, 0, 0
            for rr in range(max(r - near, 0), min(r + near + 1, rows)):
                for cc in range(max(c - near, 0), min(c + near + 1, columns)):
                    level += planar[rr, cc]
                    all_upper += upper[rr, cc]
                    if planar[rr, cc] > 0 and roofed[rr, cc] == 8:
                        inner += 1
                        held += squares.points[rr, cc]
                        mixed += ground[rr, cc]
            is_level = level >= _LEVEL_SHARE * all_upper and held <= most_points * inner
            glass[r, c] = is_level and inner >= _FEWEST and mixed >= _MIXED_SHARE * inner
    return glass


@kernel
def _in_squares(vertices: SceneVertices, squares: _Squares, glass: BoolArray, side_mm: int, out: BoolArray) -> None:
    """Mark the vertices of the ground in squares under glass."""
    for v in range(len(vertices.x_mm)):
        r, c = vertices.y_mm[v] // side_mm - squares.row0, vertices.x_mm[v] // side_mm - squares.column0
        if vertices.kind[v] == VertexKind.GROUND and glass[r, c]:
            out[v] = True


def under_glass(
    vertices: SceneVertices, x_mm: IntArray, y_mm: IntArray, used: BoolArray, is_low: BoolArray, least_mm: int
) -> BoolArray:
    """Which vertices (v,) of the ground lie under a roof that half of the pulses go through.

    Parameters
    ----------
    vertices : SceneVertices
        Thinned points with their kinds and how planar their surroundings are.
    x_mm, y_mm, used, is_low : (n,)
        All points, which of them may be ground or roof, and which are at the level of the ground.
    least_mm : int
        Height from which a vertex may be of a roof.
    """
    found = np.zeros(len(vertices.x_mm), np.bool_)
    if len(vertices.x_mm):
        for side_mm, near in _WINDOWS:
            squares = _squares(vertices, x_mm, y_mm, used, is_low, least_mm, side_mm)
            most = math.inf if side_mm == _WINDOWS[0][0] else _MOST_POINTS
            _in_squares(vertices, squares, _glass(squares, near, most), side_mm, found)
    return found
