"""The raster of the detection measures: cells of 0.5 m, anchored at whole multiples of their side, in windows.

A cell is building if class 6 has more than half of its points, after two closings and one opening by the 3 x 3 cross. A
polygon fills the cells whose centres lie in it. Windows of 250 m bound the memory of a city.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np
import shapely
from scipy.ndimage import binary_closing, binary_dilation, binary_erosion, binary_opening
from shapely import MultiPolygon, Polygon

from pipeline.compiler import kernel
from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray

CELL_M = 0.5
"""Side of a cell."""
WINDOW_CELLS = 500
"""Side of a window."""
_CLOSINGS = 2
"""Part of the definition of the raster."""
_REACH_CELLS = 2 * _CLOSINGS + 2
"""Reach of closing and opening."""


@dataclasses.dataclass(frozen=True, kw_only=True, order=True)
class CellWindow:
    """A rectangle of cells, half-open. Cell (0, 0) begins at the origin of the CRS."""

    row: int
    """First row; rows grow north."""
    column: int
    """First column; columns grow east."""
    rows: int = WINDOW_CELLS
    columns: int = WINDOW_CELLS

    def grown(self, cells: int) -> CellWindow:
        """With a margin on all sides."""
        return CellWindow(
            row=self.row - cells,
            column=self.column - cells,
            rows=self.rows + 2 * cells,
            columns=self.columns + 2 * cells,
        )

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """x_min, y_min, x_max, y_max in metres."""
        return (
            self.column * CELL_M,
            self.row * CELL_M,
            (self.column + self.columns) * CELL_M,
            (self.row + self.rows) * CELL_M,
        )


def windows_over(bounds: Sequence[float]) -> Iterator[CellWindow]:
    """The windows of the lattice that meet x_min, y_min, x_max, y_max, row by row."""
    side = WINDOW_CELLS * CELL_M
    for row in range(math.floor(bounds[1] / side), math.floor(bounds[3] / side) + 1):
        for column in range(math.floor(bounds[0] / side), math.floor(bounds[2] / side) + 1):
            yield CellWindow(row=row * WINDOW_CELLS, column=column * WINDOW_CELLS)


def windows_of(bounds: FloatArray) -> list[CellWindow]:
    """The windows that any of (n, 4) rectangles meets, or comes within a cell of, sorted."""
    found: set[CellWindow] = set()
    for x0, y0, x1, y1 in bounds.tolist():
        found.update(windows_over((x0 - CELL_M, y0 - CELL_M, x1 + CELL_M, y1 + CELL_M)))
    return sorted(found)


def edge_ring(cells: BoolArray) -> BoolArray:
    """The cells on either side of the borders of the set cells: dilation without erosion by the 3 x 3 cross."""
    ring: BoolArray = binary_dilation(cells) & ~binary_erosion(cells, border_value=1)
    return ring


# ---------------------------------------------------------------------------------------------------------- polygons


@kernel
def _fill(
    cells: BoolArray, edges: FloatArray, starts: IntArray, chosen: IntArray, x_min: float, y_min: float, cell: float
) -> None:
    """Set the cells (rows, columns) with centres in a chosen polygon, by pairs of crossings per row of centres.

    `edges` (e, 4) are x, y of start and end in metres; `starts` (polygons + 1,) is the first edge of each polygon.
    """
    rows, columns = cells.shape
    for polygon in chosen:
        first, last = starts[polygon], starts[polygon + 1]
        low, high = np.inf, -np.inf
        for e in range(first, last):
            low = min(low, edges[e, 1], edges[e, 3])
            high = max(high, edges[e, 1], edges[e, 3])
        crossings = np.empty(last - first)
        r0 = max(0, math.floor((low - y_min) / cell - 0.5))
        r1 = min(rows - 1, math.ceil((high - y_min) / cell))
        for r in range(r0, r1 + 1):
            y = (r + 0.5) * cell
            n = 0
            for e in range(first, last):
                y0 = edges[e, 1] - y_min
                y1 = edges[e, 3] - y_min
                if (y0 > y) == (y1 > y):
                    continue
                x0 = edges[e, 0] - x_min
                x1 = edges[e, 2] - x_min
                if y0 > y1:
                    x0, x1 = x1, x0
                    y0, y1 = y1, y0
                crossings[n] = x0 + (y - y0) * (x1 - x0) / (y1 - y0)
                n += 1
            crossings[:n].sort()
            for k in range(0, n - 1, 2):
                c0 = max(0, math.ceil(crossings[k] / cell - 0.5))
                c1 = min(columns, math.ceil(crossings[k + 1] / cell - 0.5))
                for c in range(c0, c1):
                    cells[r, c] = True


class PlanRaster:
    """Polygons in metres as one raster, window by window."""

    def __init__(self, polygons: Sequence[Polygon | MultiPolygon]) -> None:
        parts, owner = shapely.get_parts(np.asarray(polygons, dtype=object), return_index=True)
        rings, part = shapely.get_rings(parts, return_index=True)
        xy, ring = shapely.get_coordinates(rings, return_index=True)
        joined = ring[:-1] == ring[1:]
        self._edges = np.ascontiguousarray(np.hstack((xy[:-1][joined], xy[1:][joined]))).reshape(-1, 4)
        face = owner[part[ring[:-1][joined]]]
        self._starts = np.searchsorted(face, np.arange(len(polygons) + 1)).astype(np.int64)
        self._tree = shapely.STRtree(polygons)

    def window(self, window: CellWindow) -> BoolArray:
        """(rows, columns) bool, True for cells with their centre in a polygon; borders count at their lower left."""
        cells = np.zeros((window.rows, window.columns), np.bool_)
        chosen = np.sort(self._tree.query(shapely.box(*window.bounds))).astype(np.int64)
        if len(chosen):
            _fill(cells, self._edges, self._starts, chosen, window.bounds[0], window.bounds[1], CELL_M)
        return cells


# ------------------------------------------------------------------------------------------------------------ points


class PointRaster:
    """Building cells by the classes of points, added tile by tile.

    A cell stores only the balance: points of buildings less the others. A window becomes bits as soon as no further
    tile reaches it.
    """

    def __init__(self) -> None:
        self._open: dict[tuple[int, int], LabelArray] = {}
        self._done: dict[tuple[int, int], np.ndarray[tuple[int], np.dtype[np.uint8]]] = {}

    def add(self, xyz: FloatArray, is_building: BoolArray) -> None:
        """Count the points of a tile, (n, 3) metres and (n,) bool."""
        side = WINDOW_CELLS
        column, row = np.floor(xyz[:, :2] / CELL_M).astype(np.int64).T
        places, window = np.unique(((row // side) << 32) + column // side, return_inverse=True)
        cell = (window.ravel() * side + row % side) * side + column % side
        votes = np.where(is_building, 1.0, -1.0)
        balance = np.bincount(cell, votes, len(places) * side * side).astype(np.int32).reshape(-1, side, side)
        for place, of_window in zip(places.tolist(), balance, strict=True):
            at = (place + (1 << 31)) >> 32, ((place + (1 << 31)) & 0xFFFFFFFF) - (1 << 31)
            self._open[at] = self._open.get(at, 0) + of_window

    def finish(self, still_to_come: Sequence[Sequence[float]] = ()) -> None:
        """Close the windows that no tile to come reaches, given x_min, y_min, x_max, y_max of each of them."""
        side = WINDOW_CELLS * CELL_M
        for row, column in list(self._open):
            x0, y0 = column * side - CELL_M, row * side - CELL_M
            x1, y1 = x0 + side + 2 * CELL_M, y0 + side + 2 * CELL_M
            if not any(b[0] <= x1 and b[2] >= x0 and b[1] <= y1 and b[3] >= y0 for b in still_to_come):
                self._done[row, column] = np.packbits(self._open.pop((row, column)) > 0)

    def window(self, window: CellWindow) -> BoolArray:
        """(rows, columns) bool, True if buildings have more than half of the points, after closing and opening.

        Every tile must have been added and finished.
        """
        inner = window.grown(_REACH_CELLS)
        cells = np.zeros((inner.rows, inner.columns), np.bool_)
        for place in windows_over((*inner.bounds[:2], inner.bounds[2] - CELL_M, inner.bounds[3] - CELL_M)):
            bits = self._done.get((place.row // WINDOW_CELLS, place.column // WINDOW_CELLS))
            if bits is None:
                continue
            block = np.unpackbits(bits, count=WINDOW_CELLS**2).astype(np.bool_).reshape(WINDOW_CELLS, WINDOW_CELLS)
            r0, r1 = max(place.row, inner.row), min(place.row + WINDOW_CELLS, inner.row + inner.rows)
            c0, c1 = max(place.column, inner.column), min(place.column + WINDOW_CELLS, inner.column + inner.columns)
            cells[r0 - inner.row : r1 - inner.row, c0 - inner.column : c1 - inner.column] = block[
                r0 - place.row : r1 - place.row, c0 - place.column : c1 - place.column
            ]
        cleaned: BoolArray = binary_opening(binary_closing(cells, iterations=_CLOSINGS))
        return cleaned[_REACH_CELLS:-_REACH_CELLS, _REACH_CELLS:-_REACH_CELLS]

    def outlines(self) -> list[Polygon]:
        """The exact outlines of 4-connected cells, with holes, from the south west."""
        return outlines_of(self._runs())

    def _runs(self) -> IntArray:
        """(n, 3) int64, row, first column and the column behind the last of every run of set cells in a window."""
        found = [np.zeros((0, 3), np.int64)]
        # Closing reaches into windows without points.
        places = {(row + i, column + j) for row, column in self._done for i in (-1, 0, 1) for j in (-1, 0, 1)}
        for row, column in sorted(places):
            window = CellWindow(row=row * WINDOW_CELLS, column=column * WINDOW_CELLS)
            cells = self.window(window)
            if cells.any():
                steps = np.diff(np.pad(cells.astype(np.int8), ((0, 0), (1, 1))), axis=1)
                starts, ends = np.nonzero(steps == 1), np.nonzero(steps == -1)
                columns = window.column + np.column_stack((starts[1], ends[1]))
                found.append(np.column_stack((window.row + starts[0], columns)))
        return np.concatenate(found)


def outlines_of(runs: IntArray) -> list[Polygon]:
    """Outlines in metres of the 4-connected components of runs of cells, with vertices only at corners.

    Runs (n, 3) are row, first column, column after the last; those of one row may abut and must not overlap. Outlines
    are in the order of each component's first run.
    """
    if len(runs) == 0:
        return []
    # All coordinates are multiples of 0.5, so the union is exact; areas that share a corner alone stay apart.
    boxes = shapely.box(*(CELL_M * np.column_stack((runs[:, 1], runs[:, 0], runs[:, 2], runs[:, 0] + 1))).T)
    outlines = shapely.get_parts(shapely.simplify(shapely.normalize(shapely.union_all(boxes)), 0.0)).tolist()

    def first_run(outline: Polygon) -> tuple[float, float]:
        x, y = shapely.get_coordinates(outline.exterior).T
        return float(y.min()), float(x[y == y.min()].min())

    return sorted(outlines, key=first_run)
