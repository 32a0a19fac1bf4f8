"""The progressive morphological filter: openings of growing size cut off what stands on the ground.

A cell is an object where one step of the opening takes more than the terrain's slope allows (Zhang et al. 2003;
Pingel, Clarke and McBride 2013 use the same test in SMRF).
"""

from __future__ import annotations

import numpy as np
from numba import njit

from pipeline.model import BoolArray, IntArray
from pipeline.terrain.lattice import CELL_MM, NO_DATA, Elevations


@njit(cache=True, nogil=True)
def _extreme_along_rows(values: Elevations, half: int, want_low: bool) -> Elevations:
    """Sliding minimum (or maximum) over 2 half + 1 cells of each row, skipping NO_DATA (monotonic queue)."""
    rows, columns = values.shape
    out = np.full((rows, columns), NO_DATA, np.int32)
    queue = np.empty(columns, np.int64)
    for r in range(rows):
        head, tail, seen = 0, 0, 0
        for c in range(columns):
            while seen < columns and seen <= c + half:
                v = values[r, seen]
                if v != NO_DATA:
                    while tail > head and (
                        (want_low and values[r, queue[tail - 1]] >= v)
                        or (not want_low and values[r, queue[tail - 1]] <= v)
                    ):
                        tail -= 1
                    queue[tail] = seen
                    tail += 1
                seen += 1
            while tail > head and queue[head] < c - half:
                head += 1
            if tail > head:
                out[r, c] = values[r, queue[head]]
    return out


@njit(cache=True, nogil=True)
def opened(values: Elevations, half: int) -> Elevations:
    """Morphological opening by a square of 2 half + 1 cells; separable."""
    for low in (True, False):
        values = _extreme_along_rows(values, half, low)
        values = np.ascontiguousarray(_extreme_along_rows(np.ascontiguousarray(values.T), half, low).T)
    return values


@njit(cache=True, nogil=True)
def objects(lowest: Elevations, windows: IntArray, max_slope: float, min_step_mm: float) -> BoolArray:
    """Mask of the cells that some step of the growing opening cuts off by more than slope allows."""
    rows, columns = lowest.shape
    flagged = np.zeros((rows, columns), np.bool_)
    before = lowest
    half_before = 0
    for half in windows:
        after = opened(lowest, half)
        limit = min_step_mm + max_slope * CELL_MM * (half - half_before)
        for r in range(rows):
            for c in range(columns):
                if before[r, c] != NO_DATA and before[r, c] - after[r, c] > limit:
                    flagged[r, c] = True
        before = after
        half_before = half
    return flagged
