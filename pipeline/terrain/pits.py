"""Pits in the lowest points of cells: low outliers."""

from __future__ import annotations

from pipeline.compiler import kernel
from pipeline.terrain.lattice import NO_DATA, Elevations
from pipeline.terrain.reach import PIT_CELLS

PIT_MATES = 2
"""At most this many neighbours of a pit are as deep: low outliers come alone or in small groups."""


@kernel
def without_pits(lowest: Elevations, depth_mm: int, mates: int = PIT_MATES) -> Elevations:
    """Clear cells that lie deeper than depth_mm below all but at most `mates` of the 24 cells around."""
    rows, columns = lowest.shape
    out = lowest.copy()
    for r in range(rows):
        for c in range(columns):
            z = lowest[r, c]
            if z == NO_DATA:
                continue
            near, filled = 0, 0
            for a in range(max(r - PIT_CELLS, 0), min(r + PIT_CELLS + 1, rows)):
                # most cells have enough cells near their level in the first row
                if near > mates:
                    break
                for b in range(max(c - PIT_CELLS, 0), min(c + PIT_CELLS + 1, columns)):
                    other = lowest[a, b]
                    if other != NO_DATA and (a != r or b != c):
                        filled += 1
                        if other - z <= depth_mm:
                            near += 1
            if filled > mates and near <= mates:
                out[r, c] = NO_DATA
    return out
