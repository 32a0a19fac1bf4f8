"""Counts in squares that rule out glass nearly everywhere: the neighbours of vertices (`sparse_glass`) take longer."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, IntArray, KindArray, LabelArray
from pipeline.spatial_hash import points_by_cell
from pipeline.terrain.facets import SceneVertices, VertexKind
from pipeline.terrain.reach import GLASS_NEAR as NEAR
from pipeline.terrain.reach import GLASS_SQUARE_MM as SQUARE_MM

# Not settings: they say what glass is, in neighbours.
_FEWEST_NEAR = 64
"""Vertices in the squares around, two for 3 m2: where there are fewer, houses are mixed with what surrounds them."""
_MOST_POINTS = 700
"""Points in the squares around, 7 per m2: where there are more, the squares of `terrain.glass` hold enough."""
_LEVEL_SHARE = 0.8
"""Share of the higher vertices whose surroundings are planar."""
_PAIR_SHARE = 0.12
"""Least share of the pairs of vertices in one quarter of a square, of a higher one and another, that have a low one. As
large is the share of the pulses that go through glass; straight walls beside open ground make half as many."""
FEWEST, FEWEST_LOW = 12, 8
"""Surrounded higher vertices, and low ones: fewer show nothing."""


class Part(IntEnum):
    """What a vertex is."""

    OTHER = 0
    """As high as roofs, but no roof by its class."""
    LOW = 1
    """Below the height of roofs."""
    ROUGH = 2
    """At the height of roofs, with rough or unknown surroundings."""
    ROOF = 3
    """At the height of roofs, with planar surroundings, or building by its class."""


_PARTS = len(Part)
_QUARTER_MM = SQUARE_MM // 2


class Cells(NamedTuple):
    """Some of the vertices by squares."""

    start: LabelArray
    members: LabelArray
    column0: int
    row0: int
    columns: int
    rows: int


@kernel
def parts_of(vertices: SceneVertices, least_mm: int) -> KindArray:
    """`Part` of each vertex: by itself and how planar its surroundings are, as other tiles judge it, too."""
    out = np.empty(len(vertices.x_mm), np.int8)
    for v in range(out.size):
        kind = vertices.kind[v]
        if kind == VertexKind.BUILDING:
            out[v] = Part.ROOF
        elif kind == VertexKind.GROUND or vertices.height_mm[v] < least_mm:
            out[v] = Part.LOW
        elif kind == VertexKind.EXCLUDED:
            out[v] = Part.OTHER
        else:
            out[v] = Part.ROOF if vertices.planar[v] > 0 else Part.ROUGH
    return out


@kernel
def count_in(x_mm: IntArray, y_mm: IntArray, counted: BoolArray, cells: Cells) -> IntArray:
    """How many of the counted places (n,) lie in each square (rows, columns)."""
    out = np.zeros((cells.rows, cells.columns), np.int64)
    for i in range(counted.size):
        if counted[i]:
            r, c = y_mm[i] // SQUARE_MM - cells.row0, x_mm[i] // SQUARE_MM - cells.column0
            if 0 <= r < cells.rows and 0 <= c < cells.columns:
                out[r, c] += 1
    return out


@kernel
def _held(vertices: SceneVertices, part: KindArray, cells: Cells) -> IntArray:
    """What the squares hold (layers, rows, columns): vertices of each `Part`, and two layers of their quarters.

    These are the higher vertices with others in the same quarter, and the share of low ones among these others, summed,
    in thousandths.
    """
    rows, columns = cells.rows, cells.columns
    out = np.zeros((_PARTS + 2, rows, columns), np.int64)
    quarters = np.zeros((2, 2 * rows, 2 * columns), np.int64)
    for v in range(part.size):
        r, c = vertices.y_mm[v] // _QUARTER_MM - 2 * cells.row0, vertices.x_mm[v] // _QUARTER_MM - 2 * cells.column0
        out[part[v], r // 2, c // 2] += 1
        if part[v] != Part.OTHER:
            quarters[1 if part[v] == Part.LOW else 0, r, c] += 1
    for r in range(2 * rows):
        for c in range(2 * columns):
            high, low = quarters[0, r, c], quarters[1, r, c]
            if high + low > 1:
                out[_PARTS, r // 2, c // 2] += high
                out[_PARTS + 1, r // 2, c // 2] += 1000 * high * low // (high + low - 1)
    return out


@kernel
def box_sums(squares: IntArray, near: int) -> IntArray:
    """Sums of squares (rows, columns) up to `near` squares around each."""
    rows, columns = squares.shape
    sums = np.zeros((rows + 1, columns + 1), np.int64)
    for r in range(rows):
        for c in range(columns):
            sums[r + 1, c + 1] = squares[r, c] + sums[r, c + 1] + sums[r + 1, c] - sums[r, c]
    out = np.empty((rows, columns), np.int64)
    for r in range(rows):
        south, north = max(r - near, 0), min(r + near + 1, rows)
        for c in range(columns):
            west, east = max(c - near, 0), min(c + near + 1, columns)
            out[r, c] = sums[north, east] - sums[south, east] - sums[north, west] + sums[south, west]
    return out


def possible_glass(
    vertices: SceneVertices, x_mm: IntArray, y_mm: IntArray, used: BoolArray, least_mm: int
) -> tuple[KindArray, Cells, BoolArray]:
    """What each vertex is (v,), the higher ones by squares, and which squares (rows, columns) may be of glass.

    Parameters
    ----------
    vertices : SceneVertices
        Thinned points with their kinds and how planar their surroundings are, at least one, sorted by (x, y).
    x_mm, y_mm, used : (n,)
        All points, and which of them may be ground or roof.
    least_mm : int
        Height from which a vertex may be of a roof.
    """
    part = parts_of(vertices, least_mm)
    high = Cells(*points_by_cell(vertices.x_mm, vertices.y_mm, part >= Part.ROUGH, SQUARE_MM))
    other, low, rough, roof, paired, mixed = (box_sums(layer, NEAR) for layer in _held(vertices, part, high))
    may_be = (low >= FEWEST_LOW) & (rough + roof >= FEWEST) & (other + low + rough + roof >= _FEWEST_NEAR)
    may_be &= (roof >= _LEVEL_SHARE * (other + rough + roof)) & (mixed >= 1000 * _PAIR_SHARE * paired)
    may_be &= box_sums(count_in(x_mm, y_mm, used, high), NEAR) <= _MOST_POINTS
    return part, high, may_be
