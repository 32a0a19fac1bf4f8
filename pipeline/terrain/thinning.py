"""Thinning a cloud to the density of the papers: one point per cell of a fine lattice.

A TIN of all points of a dense multi-return cloud shatters, because each wall becomes many small facets. The highest
last return of each cell keeps roofs up to their edge, drops most of the façade, and lets trees fall apart. Sparse
clouds pass unchanged.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, IntArray, KindArray
from pipeline.spatial_hash import slot_of_key

_BITS = 31
"""Bits per column or row in one key: a lattice of millimetres fits."""


@kernel
def _highest_per_cell(
    x_mm: IntArray,
    y_mm: IntArray,
    z_mm: IntArray,
    preferred: KindArray,
    used: BoolArray,
    cell_mm: int,
    among_equals: KindArray,
) -> IntArray:
    """Kernel: the point of each cell that is preferred most, highest, southernmost, westernmost, first among equals."""
    n = x_mm.size
    size = 2
    while size < 2 * n:
        size *= 2
    mask = size - 1
    keys = np.full(size, -1, np.int64)
    holder = np.full(size, -1, np.int64)
    filled = np.empty(n, np.int64)
    count = 0
    column0, row0 = 0, 0
    if n > 0:
        column0, row0 = x_mm.min() // cell_mm, y_mm.min() // cell_mm
    for i in range(n):
        if not used[i]:
            continue
        key = ((x_mm[i] // cell_mm - column0) << _BITS) | (y_mm[i] // cell_mm - row0)
        s = slot_of_key(key, mask)
        while keys[s] != -1 and keys[s] != key:
            s = (s + 1) & mask
        j = holder[s]
        if j < 0:
            keys[s] = key
            holder[s] = i
            filled[count] = s
            count += 1
            continue
        if preferred[i] != preferred[j]:
            better = preferred[i] > preferred[j]
        elif z_mm[i] != z_mm[j]:
            better = z_mm[i] > z_mm[j]
        elif y_mm[i] != y_mm[j]:
            better = y_mm[i] < y_mm[j]
        elif x_mm[i] != x_mm[j]:
            better = x_mm[i] < x_mm[j]
        else:
            better = among_equals[i] > among_equals[j]
        if better:
            holder[s] = i
    chosen = np.empty(count, np.int64)
    for k in range(count):
        chosen[k] = holder[filled[k]]
    return chosen


def highest_per_cell(
    x_mm: IntArray,
    y_mm: IntArray,
    z_mm: IntArray,
    preferred: KindArray,
    used: BoolArray,
    cell_m: float,
    among_equals: KindArray | None = None,
) -> IntArray:
    """Indices of one point per cell, ordered by (x, y).

    Parameters
    ----------
    x_mm, y_mm, z_mm : (n,) int64
        Absolute coordinates in millimetres; the lattice is anchored at the CRS's origin.
    preferred : (n,) int8
        Points of the greater number win their cell whatever their height (by the file's classes where trusted).
    used : (n,) bool
        Points that may be chosen at all.
    cell_m : float
        Side of a cell in metres.
    among_equals : (n,) int8, optional
        Of points at one place in space the one with the greater number wins: other attributes of the chosen points
        must not depend on the order of the points.

    Returns
    -------
    (m,) int64
        At most one index per cell, so all (x, y) differ; the order does not depend on that of the points.
    """
    tie = preferred if among_equals is None else among_equals
    chosen = _highest_per_cell(x_mm, y_mm, z_mm, preferred, used, round(cell_m * 1000), tie)
    if len(chosen) == 0:
        return np.empty(0, np.int64)
    x, y = x_mm[chosen], y_mm[chosen]
    # one sort of one whole number in place of two; all are different
    result: IntArray = chosen[np.argsort(((x - x.min()) << _BITS) | (y - y.min()))]
    return result


@kernel
def _lowest_below(
    x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, used: BoolArray, chosen: IntArray, cell_mm: int, level_mm: int
) -> IntArray:
    """Kernel of `lowest_below`."""
    size = 2
    while size < 2 * chosen.size:
        size *= 2
    mask = size - 1
    holder = np.full(size, -1, np.int64)
    lowest = chosen.copy()
    for k in range(chosen.size):
        i = chosen[k]
        s = slot_of_key(((x_mm[i] // cell_mm) << _BITS) ^ (y_mm[i] // cell_mm), mask)
        while holder[s] >= 0:
            s = (s + 1) & mask
        holder[s] = k
    for i in range(x_mm.size):
        if not used[i]:
            continue
        column, row = x_mm[i] // cell_mm, y_mm[i] // cell_mm
        s = slot_of_key((column << _BITS) ^ row, mask)
        while holder[s] >= 0:
            top = chosen[holder[s]]
            if x_mm[top] // cell_mm == column and y_mm[top] // cell_mm == row:
                j = lowest[holder[s]]
                lower = z_mm[i] < z_mm[j]
                if z_mm[i] == z_mm[j]:
                    lower = y_mm[i] < y_mm[j] or (y_mm[i] == y_mm[j] and x_mm[i] < x_mm[j])
                if lower and z_mm[i] >= z_mm[top] - level_mm:
                    lowest[holder[s]] = i
                break
            s = (s + 1) & mask
    return lowest


def lowest_below(
    x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, used: BoolArray, chosen: IntArray, cell_m: float, level_m: float
) -> IntArray:
    """Index of the lowest used point in the cell of each chosen one, no more than `level_m` below it, (m,) int64.

    The chosen point itself where no used one lies lower. Cells are those of `highest_per_cell`; of points equally low
    the southernmost counts, then the westernmost.
    """
    found: IntArray = _lowest_below(x_mm, y_mm, z_mm, used, chosen, round(cell_m * 1000), round(level_m * 1000))
    return found
