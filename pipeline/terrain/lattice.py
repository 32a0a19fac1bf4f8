"""The lattice of the ground: cells of 1 m, anchored at the CRS's origin, that hold integer millimetres."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.model import BoolArray, IntArray

CELL_MM = 1000
"""Side of a cell of the terrain lattice."""
HALF_DIAGONAL_M = 0.71
"""Half of a cell: cells that an area touches have their centres this near to it, cells within it so far inside."""

NO_DATA = np.int32(2**31 - 1)
"""Elevation of a cell without one."""

Elevations = npt.NDArray[np.int32]

Part = tuple[slice, slice]
"""Rows and columns of a lattice."""


def part_around(part: Part, margin: int, shape: tuple[int, ...]) -> Part:
    """A part of a lattice and a margin around it in cells, as far as a lattice of this shape goes.

    >>> part_around((slice(5, 8), slice(-3, 40)), 2, (20, 30))
    (slice(3, 10, None), slice(0, 30, None))
    """
    down, across = (
        slice(min(max(along.start - margin, 0), size), max(min(along.stop + margin, size), 0))
        for along, size in zip(part, shape, strict=True)
    )
    return down, across


@kernel
def lowest_per_cell(
    x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, used: BoolArray, column0: int, row0: int, columns: int, rows: int
) -> Elevations:
    """Elevation of the lowest used point of each cell, int32 (rows, columns), NO_DATA where there is none."""
    lowest = np.full((rows, columns), NO_DATA, np.int32)
    for i in range(x_mm.size):
        if used[i]:
            c = x_mm[i] // CELL_MM - column0
            r = y_mm[i] // CELL_MM - row0
            if 0 <= c < columns and 0 <= r < rows and z_mm[i] < lowest[r, c]:
                lowest[r, c] = z_mm[i]
    return lowest


@kernel
def height_above(
    x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, terrain: Elevations, column0: int, row0: int
) -> IntArray:
    """Heights of points above the bilinear terrain in mm, int64 (n,); NO_DATA where there is no terrain."""
    rows, columns = terrain.shape
    out = np.empty(x_mm.size, np.int64)
    half = CELL_MM // 2
    for i in range(x_mm.size):
        gx, gy = x_mm[i] - half, y_mm[i] - half
        c, r = gx // CELL_MM, gy // CELL_MM
        fx, fy = (gx - c * CELL_MM) / CELL_MM, (gy - r * CELL_MM) / CELL_MM
        c -= column0
        r -= row0
        weight, total = 0.0, 0.0
        for dr in range(2):
            for dc in range(2):
                if 0 <= r + dr < rows and 0 <= c + dc < columns and terrain[r + dr, c + dc] != NO_DATA:
                    w = (fx if dc == 1 else 1.0 - fx) * (fy if dr == 1 else 1.0 - fy)
                    weight += w
                    total += w * terrain[r + dr, c + dc]
        if weight > 1e-9:
            out[i] = z_mm[i] - round(total / weight)
        else:
            out[i] = NO_DATA
    return out
