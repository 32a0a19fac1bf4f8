"""Points sorted by square cells: what windows around points are gathered from."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, IntArray


@kernel
def points_by_cell(
    x: IntArray, y: IntArray, used: BoolArray, cell: int
) -> tuple[IntArray, IntArray, int, int, int, int]:
    """Used points sorted by square cells.

    Parameters
    ----------
    x, y : (n,) int64
        Coordinates in mm, at least one point.
    used : (n,) bool
        The points that are wanted.
    cell : int
        Side of a cell in mm; cells are anchored at the origin.

    Returns
    -------
    start : (rows * columns + 1,) int64
        Where the points of each cell begin, row by row.
    members : (m,) int64
        Indices of the used points; within a cell in their own order.
    column0, row0, columns, rows : int
        First column and row, and how many there are.
    """
    n = x.size
    column0, row0 = x.min() // cell, y.min() // cell
    columns, rows = x.max() // cell - column0 + 1, y.max() // cell - row0 + 1
    start = np.zeros(columns * rows + 1, np.int64)
    for i in range(n):
        if used[i]:
            start[(y[i] // cell - row0) * columns + x[i] // cell - column0 + 1] += 1
    for k in range(columns * rows):
        start[k + 1] += start[k]
    position = start[:-1].copy()
    members = np.empty(start[-1], np.int64)
    for i in range(n):
        if used[i]:
            k = (y[i] // cell - row0) * columns + x[i] // cell - column0
            members[position[k]] = i
            position[k] += 1
    return start, members, column0, row0, columns, rows
