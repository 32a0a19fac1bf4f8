"""Places of a roof that no point is near to, on a raster."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, FloatArray


class Raster(NamedTuple):
    """Square cells over a roof in plan."""

    low_x: float
    low_y: float
    """Lower left corner, metres."""
    cell: float
    """Side of a cell, metres."""
    columns: int
    rows: int


@kernel(inline="always")
def middles_of_cells(raster: Raster) -> tuple[FloatArray, FloatArray]:
    """Middles of a raster's cells, line by line, x and y, (rows * columns,) metres."""
    low_x, low_y, cell, columns, rows = raster
    x = np.empty(rows * columns)
    y = np.empty(rows * columns)
    for row in range(rows):
        for column in range(columns):
            x[row * columns + column] = low_x + (column + 0.5) * cell
            y[row * columns + column] = low_y + (row + 0.5) * cell
    return x, y


@kernel
def unseen_cells(
    points: FloatArray,
    residuals: FloatArray,
    on_roof: BoolArray,
    raster: Raster,
    tolerance_m: float,
    gap_m: float,
    far_m: float,
) -> tuple[int, int, int, float]:
    """Cells on the roof, those of them far from points on it and from all, and the largest square to any point, m2.

    As `TopSurface.seen`; `on_roof` (rows * columns,) are the cells, line by line, whose middle has a roof.
    """
    squares = _nearest_squares(points, residuals, tolerance_m, raster)
    places = 0
    unseen = 0
    far = 0
    largest = 0.0
    for k in range(len(on_roof)):
        if on_roof[k]:
            places += 1
            unseen += squares[k, 1] > gap_m * gap_m
            far += squares[k, 0] > far_m * far_m
            largest = max(largest, squares[k, 0])
    return places, unseen, far, largest


@kernel
def _nearest_squares(
    points: FloatArray,
    residuals: FloatArray,
    tolerance_m: float,
    raster: Raster,
) -> FloatArray:
    """Squared distance in plan from every cell's middle to the nearest point over or under a roof, and to one on it.

    The result is (rows * columns, 2) m2, infinite without points.

    Each cell keeps the point nearest to its middle, and cells hand theirs on to their neighbours, in two sweeps of the
    raster with two of each line (Danielsson 1980): distances are too large by less than a cell, most not at all. Both
    searches run side by side: each step waits for the one before it, so two take hardly longer than one.
    """
    low_x, low_y, cell, columns, rows = raster
    n = rows * columns
    # per cell: the square to any point, its x and y, in cells; the same of a point on the roof
    kept = np.full((n, 6), np.inf)
    for i in range(len(points)):
        off = abs(residuals[i])
        if not off <= np.inf:
            continue
        x, y = (points[i, 0] - low_x) / cell, (points[i, 1] - low_y) / cell
        column = min(max(math.floor(x), 0), columns - 1)
        row = min(max(math.floor(y), 0), rows - 1)
        dx, dy = x - (column + 0.5), y - (row + 0.5)
        square = dx * dx + dy * dy
        own = kept[row * columns + column]
        if square < own[0]:
            own[0], own[1], own[2] = square, x, y
        if square < own[3] and off <= tolerance_m:
            own[3], own[4], own[5] = square, x, y
    for sweep in range(2):
        for line in range(rows):
            row = line if sweep == 0 else rows - 1 - line
            before = row - 1 if sweep == 0 else row + 1
            first = row * columns
            if 0 <= before < rows:
                for column in range(columns):
                    j = before * columns + column
                    _offer(kept, first + column, column, row, kept[j, 1], kept[j, 2], kept[j, 4], kept[j, 5])
            x, y, on_x, on_y = kept[first, 1], kept[first, 2], kept[first, 4], kept[first, 5]
            for column in range(1, columns):
                x, y, on_x, on_y = _offer(kept, first + column, column, row, x, y, on_x, on_y)
            for column in range(columns - 2, -1, -1):
                x, y, on_x, on_y = _offer(kept, first + column, column, row, x, y, on_x, on_y)
    squares = np.empty((n, 2))
    for k in range(n):
        squares[k, 0], squares[k, 1] = kept[k, 0] * (cell * cell), kept[k, 3] * (cell * cell)
    return squares


@kernel
def _offer(
    kept: FloatArray, k: int, column: int, row: int, x: float, y: float, on_x: float, on_y: float
) -> tuple[float, float, float, float]:
    """Take points, in cells, for cell k where they are nearer to its middle than those that it has; those it has then.

    Written without branches: which is nearer cannot be foretold.
    """
    middle_x, middle_y = column + 0.5, row + 0.5
    dx, dy = x - middle_x, y - middle_y
    on_dx, on_dy = on_x - middle_x, on_y - middle_y
    square, on_square = dx * dx + dy * dy, on_dx * on_dx + on_dy * on_dy
    old, old_x, old_y = kept[k, 0], kept[k, 1], kept[k, 2]
    on_old, on_old_x, on_old_y = kept[k, 3], kept[k, 4], kept[k, 5]
    nearer, on_nearer = square < old, on_square < on_old
    new_x = x if nearer else old_x
    new_y = y if nearer else old_y
    on_new_x = on_x if on_nearer else on_old_x
    on_new_y = on_y if on_nearer else on_old_y
    kept[k, 0] = square if nearer else old
    kept[k, 1] = new_x
    kept[k, 2] = new_y
    kept[k, 3] = on_square if on_nearer else on_old
    kept[k, 4] = on_new_x
    kept[k, 5] = on_new_y
    return new_x, new_y, on_new_x, on_new_y
