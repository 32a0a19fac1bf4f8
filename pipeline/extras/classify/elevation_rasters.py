"""Terrain and surface at the cells of a raster: the terrain of the lattice, and the highest points with gaps filled."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.terrain.lattice import NO_DATA, Elevations, height_above

FILL_M = 3
"""Cells without points are filled from others up to this distance, and gaps up to twice as wide are closed."""


def terrain_at(x_mm: IntArray, y_mm: IntArray, terrain: Elevations, column0: int, row0: int) -> FloatArray:
    """Terrain elevation in mm, (r, c), at the crossings of eastings (c,) and northings (r,); nan without terrain.

    `terrain` (rows, columns) int32 is on the 1 m lattice; its first cell is `column0`, `row0`.
    """
    x, y = np.meshgrid(x_mm, y_mm)
    below = height_above(x.ravel(), y.ravel(), np.zeros(x.size, np.int64), terrain, column0, row0)
    return np.where(below == NO_DATA, np.nan, -below.astype(np.float64)).reshape(x.shape)


@kernel
def closed(occupied: BoolArray, cells: int) -> BoolArray:
    """Closing of a mask by a square of 2 cells + 1: gaps up to so wide are filled, the outer edge stays.

    Cells within 2 `cells` of the border of the array are not valid.
    """
    rows, columns = occupied.shape
    wide = np.zeros((rows, columns), np.bool_)
    for r in range(rows):
        for c in range(columns):
            if occupied[r, c]:
                wide[max(r - cells, 0) : r + cells + 1, max(c - cells, 0) : c + cells + 1] = True
    out = wide.copy()
    for r in range(rows):
        for c in range(columns):
            if not wide[r, c]:
                out[max(r - cells, 0) : r + cells + 1, max(c - cells, 0) : c + cells + 1] = False
    return out


@kernel
def highest_in_cells(column: IntArray, row: IntArray, z_mm: IntArray, shape: tuple[int, int]) -> FloatArray:
    """Elevation of the highest point of each cell, float64 (rows, columns), nan where there is none."""
    out = np.full(shape, np.nan)
    for i in range(z_mm.size):
        c, r = column[i], row[i]
        if 0 <= c < shape[1] and 0 <= r < shape[0] and not out[r, c] >= z_mm[i]:
            out[r, c] = z_mm[i]
    return out


@kernel
def filled(surface: FloatArray, wanted: BoolArray, reach: int) -> FloatArray:
    """Wanted cells without a value from the nearest square ring of cells that has one, by inverse squared distance."""
    rows, columns = surface.shape
    out = surface.copy()
    for r in range(rows):
        for c in range(columns):
            if not wanted[r, c] or not np.isnan(surface[r, c]):
                continue
            weight, total = 0.0, 0.0
            for ring in range(1, reach + 1):
                for dr in range(-ring, ring + 1):
                    step = 1 if abs(dr) == ring else 2 * ring
                    for dc in range(-ring, ring + 1, step):
                        rr, cc = r + dr, c + dc
                        if 0 <= rr < rows and 0 <= cc < columns and not np.isnan(surface[rr, cc]):
                            w = 1.0 / (dr * dr + dc * dc)
                            weight += w
                            total += w * surface[rr, cc]
                if weight > 0.0:
                    out[r, c] = total / weight
                    break
    return out


def columns_of(x_mm: IntArray, side_mm: float) -> npt.NDArray[np.int64]:
    """Column of each easting, or row of each northing, on a lattice of cells anchored at the CRS's origin."""
    return np.floor(x_mm / side_mm).astype(np.int64)
