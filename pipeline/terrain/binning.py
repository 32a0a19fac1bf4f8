"""Points sorted by square cells, for windows around points."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.counting_sort import counting_sort
from pipeline.model import BoolArray, IntArray, LabelArray


@kernel
def points_by_cell(
    x: IntArray, y: IntArray, used: BoolArray, cell: int
) -> tuple[LabelArray, LabelArray, int, int, int, int]:
    """Used points sorted by square cells; coordinates (n,) in mm, of at least one point.

    Parameters
    ----------
    cell : int
        Side of a cell in mm; cells are anchored at the origin.

    Returns
    -------
    start : (rows * columns + 1,) int32
        Where the points of each cell begin, row by row.
    members : (m,) int32
        Indices of the used points; within a cell in their own order.
    column0, row0, columns, rows : int
        First column and row, and how many there are.
    """
    n = x.size
    column0, row0 = x.min() // cell, y.min() // cell
    columns, rows = x.max() // cell - column0 + 1, y.max() // cell - row0 + 1
    # quotients of whole numbers below 2^52 are exact when rounded down, and floats are divided several at a time
    west, south, side = column0 * cell, row0 * cell, float(cell)
    keys = np.empty(n, np.int32)
    for i in range(n):
        c, r = np.int32((x[i] - west) / side), np.int32((y[i] - south) / side)
        keys[i] = r * columns + c if used[i] else -1
    start, members = counting_sort(keys, columns * rows)
    return start, members, column0, row0, columns, rows
