"""Ground that is seen through a roof of glass: it does not divide the roof.

Half of the pulses go through the panes of a greenhouse. In a TIN of the highest points each of them makes a pit with
walls around it, and the roof falls apart. A square of the lattice with points of a level roof above, and of the ground
below lies under glass if all squares around it hold roof, too, and most of those near it are like it. Along
alleys and in courtyards, few are. In a wood the upper points are rough.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, IntArray, KindArray
from pipeline.terrain.facets import SceneVertices, VertexKind
from pipeline.terrain.glass_squares import Part, parts_of, possible_glass

# Not settings: they say what glass is, in squares that hold a few points each.
_SIDE_MM, _NEAR = 1000, 4
"""Side of the squares, and how many squares around one are compared."""
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
    is_ground: BoolArray,
    least_mm: int,
) -> _Squares:
    """The squares over all vertices; of the points (n,), mm, those `used` count, on the ground where `is_ground`."""
    vx, vy = vertices.x_mm, vertices.y_mm
    # a ring of empty squares more, so that it does not matter where the vertices end
    column0, row0 = vx.min() // _SIDE_MM - 1, vy.min() // _SIDE_MM - 1
    columns, rows = vx.max() // _SIDE_MM - column0 + 2, vy.max() // _SIDE_MM - row0 + 2
    planar, upper = np.zeros((rows, columns), np.int64), np.zeros((rows, columns), np.int64)
    ground = np.zeros((rows, columns), np.bool_)
    for v in range(len(vx)):
        is_building = vertices.kind[v] == VertexKind.BUILDING or vertices.kind[v] == VertexKind.JOINED
        if (is_building or vertices.kind[v] == VertexKind.OBJECT) and vertices.height_mm[v] >= least_mm:
            r, c = vy[v] // _SIDE_MM - row0, vx[v] // _SIDE_MM - column0
            upper[r, c] += 1
            # not what was joined to a building: whether far vertices are, another tile decides
            planar[r, c] += vertices.kind[v] == VertexKind.BUILDING or vertices.planar[v] > 0
    for i in range(len(x_mm)):
        r, c = y_mm[i] // _SIDE_MM - row0, x_mm[i] // _SIDE_MM - column0
        if used[i] and 0 <= r < rows and 0 <= c < columns:
            ground[r, c] |= is_ground[i]
    return _Squares(planar, upper, ground, column0, row0)


@kernel
def _glass(squares: _Squares) -> BoolArray:
    """Which squares (rows, columns) lie under glass, by those around each."""
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
            inner, mixed, level, all_upper = 0, 0, 0, 0
            for rr in range(max(r - _NEAR, 0), min(r + _NEAR + 1, rows)):
                for cc in range(max(c - _NEAR, 0), min(c + _NEAR + 1, columns)):
                    level += planar[rr, cc]
                    all_upper += upper[rr, cc]
                    if planar[rr, cc] > 0 and roofed[rr, cc] == 8:
                        inner += 1
                        mixed += ground[rr, cc]
            is_level = level >= _LEVEL_SHARE * all_upper
            glass[r, c] = is_level and inner >= _FEWEST and mixed >= _MIXED_SHARE * inner
    return glass


@kernel
def _in_squares(x_mm: IntArray, y_mm: IntArray, squares: _Squares, glass: BoolArray) -> BoolArray:
    """Which places (n,) lie in squares under glass."""
    out = np.zeros(x_mm.size, np.bool_)
    rows, columns = glass.shape
    for i in range(x_mm.size):
        r, c = y_mm[i] // _SIDE_MM - squares.row0, x_mm[i] // _SIDE_MM - squares.column0
        out[i] = 0 <= r < rows and 0 <= c < columns and glass[r, c]
    return out


class Glass(NamedTuple):
    """What lies at roofs that pulses go through."""

    roof: BoolArray
    """(v,) vertices of the roofs."""
    under: BoolArray
    """(v,) vertices of ground and plants below."""
    seen_through: BoolArray
    """(n,) points of ground and plants below."""


def glass_of(
    vertices: SceneVertices,
    over_plants: KindArray,
    places_mm: tuple[IntArray, IntArray],
    height_mm: IntArray,
    used: BoolArray,
    limits_mm: tuple[int, int],
) -> Glass:
    """Roofs that pulses go through, and what was seen through them.

    Parameters
    ----------
    vertices : SceneVertices
        Thinned points with their kinds and how planar their surroundings are.
    over_plants : (v,) int8
        How planar these are without what is lower than roofs.
    places_mm, height_mm, used : (n,)
        All points: x and y, their heights above the terrain, and which may be ground or roof.
    limits_mm : tuple of int
        The heights up to which a point is ground, and from which it may be of a roof.
    """
    (x_mm, y_mm), (ground_mm, least_mm) = places_mm, limits_mm
    at, under, seen = (np.zeros(n, np.bool_) for n in (len(vertices.x_mm), len(vertices.x_mm), len(x_mm)))
    low = parts_of(vertices, least_mm) == Part.LOW
    if len(vertices.x_mm):
        over = vertices._replace(planar=over_plants)
        part, high, may_be = possible_glass(over, x_mm, y_mm, used, least_mm)
        if may_be.any():
            from pipeline.terrain.sparse_glass import under_sparse_glass

            at, under, seen = under_sparse_glass(over, part, high, may_be, x_mm, y_mm)
        squares = _squares(vertices, x_mm, y_mm, used, height_mm < ground_mm, least_mm)
        glass = _glass(squares)
        in_squares = _in_squares(vertices.x_mm, vertices.y_mm, squares, glass)
        at |= in_squares
        under |= in_squares & low
        seen |= _in_squares(x_mm, y_mm, squares, glass)
    return Glass(roof=at & ~low, under=under, seen_through=seen & used & (height_mm < least_mm))
