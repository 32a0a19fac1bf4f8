"""The point nearest to each of other places in plan."""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.geometry import bounds_of
from pipeline.kernels.sorting import counting_sort
from pipeline.model import FloatArray, IntArray, LabelArray

_MAX_CELLS = 4_000_000
"""Most cells of a raster: bounds the memory for points strewn over a wide area."""

_FARTHEST = 2**63 - 1  # no squared distance reaches it


@kernel
def _bucket(x: IntArray, y: IntArray, cell: int) -> tuple[LabelArray, LabelArray, int, int, int, int]:
    """Points by square cells in row-major order: starts, order, columns, rows, low x, low y."""
    low_x = x.min()
    low_y = y.min()
    columns = (x.max() - low_x) // cell + 1
    rows = (y.max() - low_y) // cell + 1
    keys = np.empty(len(x), np.int32)
    for i in range(len(x)):
        keys[i] = (y[i] - low_y) // cell * columns + (x[i] - low_x) // cell
    starts, order = counting_sort(keys, columns * rows)
    return starts, order, columns, rows, low_x, low_y


@kernel
def _filled_beside(starts: LabelArray, columns: int, rows: int) -> tuple[LabelArray, LabelArray]:
    """The nearest column to the west and to the east of every cell, itself included, that holds points; -1 for none."""
    west, east = np.full(columns * rows, -1, np.int32), np.full(columns * rows, -1, np.int32)
    for r in range(rows):
        before, after = -1, -1
        for k in range(columns):
            c = columns - 1 - k
            if starts[r * columns + k + 1] > starts[r * columns + k]:
                before = k
            if starts[r * columns + c + 1] > starts[r * columns + c]:
                after = c
            west[r * columns + k] = before
            east[r * columns + c] = after
    return west, east


@kernel
def _nearest(x: IntArray, y: IntArray, query_x: IntArray, query_y: IntArray, cell: int) -> tuple[LabelArray, IntArray]:
    """The nearest point of every query (q,) and its squared distance, mm2; the lowest of equally near ones."""
    starts, order, columns, rows, low_x, low_y = _bucket(x, y, cell)
    west, east = _filled_beside(starts, columns, rows)
    n = len(query_x)
    found = np.full(n, -1, np.int32)
    squared = np.full(n, _FARTHEST, np.int64)
    for q in range(n):
        px, py = query_x[q] - low_x, query_y[q] - low_y
        column, row = px // cell, py // cell
        best, index = squared[q], -1
        if q > 0:
            # queries mostly follow each other: what was near to the one before bounds the search
            index = found[q - 1]
            best = (x[index] - query_x[q]) ** 2 + (y[index] - query_y[q]) ** 2
        # rows of cells to both sides, the nearest first; in each the cells that hold points, from the query's column on
        for away in range(max(abs(row), abs(rows - 1 - row)) + 1):
            beyond = max(0, (away - 1) * cell + 1)
            if index >= 0 and beyond * beyond > best:
                break
            for side in range(2 if away > 0 else 1):
                r = row + away if side == 0 else row - away
                if r < 0 or r >= rows:
                    continue
                dy = max(0, r * cell - py, py - (r + 1) * cell + 1)
                if index >= 0 and dy * dy > best:
                    continue
                for eastward in range(2):
                    if eastward:
                        c = east[r * columns + max(column, 0)] if column < columns else -1
                    else:
                        c = west[r * columns + min(column - 1, columns - 1)] if column > 0 else -1
                    while c >= 0:
                        dx = max(0, c * cell - px, px - (c + 1) * cell + 1)
                        if index >= 0 and dx * dx + dy * dy > best:
                            break
                        for s in range(starts[r * columns + c], starts[r * columns + c + 1]):
                            i = order[s]
                            d = (x[i] - query_x[q]) ** 2 + (y[i] - query_y[q]) ** 2
                            if d < best or (d == best and i < index):
                                best = d
                                index = i
                        if eastward:
                            c = east[r * columns + c + 1] if c + 1 < columns else -1
                        else:
                            c = west[r * columns + c - 1] if c > 0 else -1
        found[q] = index
        squared[q] = best
    return found, squared


def _cell_size(xy_mm: IntArray) -> int:
    """Side in mm of a cell that holds about two points, without exceeding `_MAX_CELLS`."""
    low, high = bounds_of(np.ascontiguousarray(xy_mm, dtype=np.int64))
    width, depth = (int(v) + 1 for v in high - low)
    cell = max(50, int((2.0 * width * depth / len(xy_mm)) ** 0.5))
    while (width // cell + 1) * (depth // cell + 1) > _MAX_CELLS:
        cell *= 2
    return cell


def nearest_points(xy_mm: IntArray, query_mm: IntArray) -> tuple[LabelArray, FloatArray]:
    """The nearest of points (n, 2), at least one, in plan of every query (q, 2), all in millimetres.

    Returns its row, of equally near points the lowest, and the distance in metres, (q,).
    """
    index, squared = _nearest(
        np.ascontiguousarray(xy_mm[:, 0]),
        np.ascontiguousarray(xy_mm[:, 1]),
        np.ascontiguousarray(query_mm[:, 0]),
        np.ascontiguousarray(query_mm[:, 1]),
        _cell_size(xy_mm),
    )
    return index, np.sqrt(squared.astype(np.float64)) * 1e-3
