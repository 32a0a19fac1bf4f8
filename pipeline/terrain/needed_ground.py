"""The ground vertices that a scene's TIN needs lie near objects. Open fields and wide streets need none.

Surfaces consist of facets whose vertices are all above the ground, and are judged by the facets beside them. Such a
facet depends only on the vertices in its circumcircle, and facets with a wide circumcircle are gaps in any case. So all
facets with a vertex above the ground are the same without the ground that lies farther away.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, IntArray, KindArray
from pipeline.terrain.facets import VertexKind

_SIDE_MM = 1000
"""Side of the smaller cells; the larger ones are twice as wide."""


@kernel(inline="always")
def _sums(marked: BoolArray) -> IntArray:
    """Number of marked cells before each row and column, (rows + 1, columns + 1)."""
    rows, columns = marked.shape
    out = np.zeros((rows + 1, columns + 1), np.int64)
    for r in range(rows):
        own = 0
        for c in range(columns):
            own += marked[r, c]
            out[r + 1, c + 1] = out[r, c + 1] + own
    return out


@kernel(inline="always")
def _are_all(sums: IntArray, r: int, c: int, reach: int) -> bool:
    """Whether all cells at most `reach` rows and columns from one are marked; beyond the edge none is."""
    low_r, low_c, high_r, high_c = r - reach, c - reach, r + reach + 1, c + reach + 1
    if low_r < 0 or low_c < 0 or high_r >= sums.shape[0] or high_c >= sums.shape[1]:
        return False
    count = sums[high_r, high_c] - sums[low_r, high_c] - sums[high_r, low_c] + sums[low_r, low_c]
    return bool(count == (high_r - low_r) * (high_c - low_c))


@kernel(inline="always")
def _filled(rows_of: IntArray, columns_of: IntArray, rows: int, columns: int) -> BoolArray:
    """The cells that hold a vertex."""
    filled = np.zeros((rows, columns), np.bool_)
    for i in range(rows_of.size):
        filled[rows_of[i], columns_of[i]] = True
    return filled


@kernel
def _needed(x_mm: IntArray, y_mm: IntArray, kind: KindArray, farthest: int, reaches: tuple[int, int, int]) -> BoolArray:
    """Kernel of `needed_vertices`. How far to look, in cells: at gaps; if the cells near are full; the larger cells."""
    near, middle, coarse_reach = reaches
    row, column = (y_mm - y_mm.min()) // _SIDE_MM, (x_mm - x_mm.min()) // _SIDE_MM
    rows, columns = row.max() + 1, column.max() + 1
    full = _sums(_filled(row, column, rows, columns))
    coarse = _sums(_filled(row >> 1, column >> 1, (rows + 1) // 2, (columns + 1) // 2))
    stands = np.zeros((rows, columns), np.bool_)
    for i in range(x_mm.size):
        if kind[i] != VertexKind.GROUND:
            stands[row[i], column[i]] = True
    # boxes around the cells with objects, by their corners
    boxes = np.zeros((rows + 1, columns + 1), np.int32)
    for r in range(rows):
        for c in range(columns):
            if not stands[r, c]:
                continue
            reach = farthest
            if _are_all(full, r, c, near):
                reach = min(reach, near)
            elif _are_all(coarse, r >> 1, c >> 1, coarse_reach):
                reach = min(reach, middle)
            south, north = max(0, r - reach), min(rows, r + reach + 1)
            west, east = max(0, c - reach), min(columns, c + reach + 1)
            boxes[south, west] += 1
            boxes[south, east] -= 1
            boxes[north, west] -= 1
            boxes[north, east] += 1
    for r in range(rows):
        for c in range(1, columns):
            boxes[r, c] += boxes[r, c - 1]
        for c in range(columns if r > 0 else 0):
            boxes[r, c] += boxes[r - 1, c]
    out = np.empty(x_mm.size, np.bool_)
    for i in range(x_mm.size):
        out[i] = boxes[row[i], column[i]] > 0
    return out


def needed_vertices(
    x_mm: IntArray, y_mm: IntArray, kind: KindArray, max_circumradius_mm: float, far_mm: int
) -> BoolArray:
    """Which vertices (n,) a TIN needs so that nothing beside objects changes: all objects, and ground near them.

    A facet around a point near an object reaches 2 circumradii far from the point. That is 2 `max_circumradius_mm` at
    most, else it is a gap. If the vertices lie close the circle is smaller: one whose radius is the diagonal of a cell
    holds the whole cell around its centre, so no circle as large is empty where every cell holds a vertex.

    Parameters
    ----------
    x_mm, y_mm, kind : (n,)
        All vertices of the TIN, and their VertexKind.
    max_circumradius_mm : float
        Facets with a wider circumcircle are gaps.
    far_mm : int
        How far from an object points refer to it, or ground beside a thin one is looked for.
    """
    if len(x_mm) == 0:
        return np.zeros(0, np.bool_)
    diagonal_mm = math.sqrt(2.0) * _SIDE_MM
    near_mm, middle_mm = 2.0 * diagonal_mm + far_mm, 4.0 * diagonal_mm + far_mm
    reaches = (math.ceil(near_mm / _SIDE_MM), math.ceil(middle_mm / _SIDE_MM), math.ceil(middle_mm / (2 * _SIDE_MM)))
    farthest = math.ceil((2.0 * max_circumradius_mm + far_mm) / _SIDE_MM)
    needed: BoolArray = _needed(x_mm, y_mm, kind, farthest, reaches)
    return needed
