"""Thinning a cloud to the density of the papers: one point per cell of a fine lattice.

A TIN of all points of a dense multi-return cloud shatters, because each wall becomes many small facets. The highest
last return of each cell keeps roofs up to their edge, drops most of the facade, and lets trees fall apart. Sparse
clouds pass unchanged.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.kernels.sorting import radix_order
from pipeline.model import BoolArray, IntArray, KindArray
from pipeline.spatial_hash import slot_of_key


@kernel
def _highest_per_cell(
    x_mm: IntArray,
    y_mm: IntArray,
    z_mm: IntArray,
    preferred: KindArray,
    used: BoolArray,
    cell_mm: int,
    among_equals: KindArray,
) -> tuple[IntArray, IntArray]:
    """Kernel: the point of each cell that is preferred most, highest, southernmost, westernmost, first among equals.

    Returns (m,) points by the number of their cell, and (n,) the number of each point's cell, -1 where it is not used.
    """
    n = x_mm.size
    size = 2
    while size < 2 * n:
        size *= 2
    column0, row0, columns, rows = 0, 0, 0, 0
    if n > 0:
        column0, row0 = x_mm.min() // cell_mm, y_mm.min() // cell_mm
        columns, rows = x_mm.max() // cell_mm - column0 + 1, y_mm.max() // cell_mm - row0 + 1
    # where the lattice is no larger than a hash table it takes its place: neighbours in space are then near in memory
    is_lattice = columns * rows <= size
    mask = size - 1
    keys = np.empty(0 if is_lattice else size, np.int64)
    numbers = np.full(columns * rows if is_lattice else size, -1, np.int32)
    chosen = np.empty(n, np.int64)
    cell = np.full(n, -1, np.int64)
    count = 0
    for i in range(n):
        if not used[i]:
            continue
        key = (x_mm[i] // cell_mm - column0) * rows + y_mm[i] // cell_mm - row0
        s = key if is_lattice else slot_of_key(key, mask)
        while not is_lattice and numbers[s] >= 0 and keys[s] != key:
            s = (s + 1) & mask
        if numbers[s] < 0:
            numbers[s] = count
            if not is_lattice:
                keys[s] = key
            chosen[count], cell[i] = i, count
            count += 1
            continue
        cell[i] = numbers[s]
        j = chosen[cell[i]]
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
            chosen[cell[i]] = i
    return chosen[:count].copy(), cell


def highest_per_cell(
    x_mm: IntArray,
    y_mm: IntArray,
    z_mm: IntArray,
    preferred: KindArray,
    used: BoolArray,
    cell_m: float,
    among_equals: KindArray | None = None,
) -> tuple[IntArray, IntArray]:
    """Indices of one point per cell, ordered by (x, y), and the cell of each point.

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
    (n,) int64
        The cell of each point as an index into the first array; -1 where the point is not used.
    """
    tie = preferred if among_equals is None else among_equals
    found, cell = _highest_per_cell(x_mm, y_mm, z_mm, preferred, used, round(cell_m * 1000), tie)
    if len(found) == 0:
        return found, cell
    x, y = x_mm[found], y_mm[found]
    y -= y.min()
    # one whole number in place of two; all are different
    order = radix_order(((x - x.min()) << int(y.max()).bit_length()) | y)
    place = np.full(len(found) + 1, -1, np.int64)
    place[order] = np.arange(len(found))
    chosen: IntArray = found[order]
    of_point: IntArray = place[cell]
    return chosen, of_point


@kernel
def _lowest_below(
    x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, used: BoolArray, chosen: IntArray, cell: IntArray, level_mm: int
) -> IntArray:
    """Kernel of `lowest_below`."""
    lowest = chosen.copy()
    for i in range(x_mm.size):
        if not used[i]:
            continue
        k = cell[i]
        j = lowest[k]
        if z_mm[i] > z_mm[j] or z_mm[i] < z_mm[chosen[k]] - level_mm:
            continue
        if z_mm[i] < z_mm[j] or y_mm[i] < y_mm[j] or (y_mm[i] == y_mm[j] and x_mm[i] < x_mm[j]):
            lowest[k] = i
    return lowest


def lowest_below(
    x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, used: BoolArray, chosen: IntArray, cell: IntArray, level_m: float
) -> IntArray:
    """Index of the lowest used point in the cell of each chosen one, no more than `level_m` below it, (m,) int64.

    The chosen point itself where no used one lies lower. `chosen` (m,) and `cell` (n,) are those of `highest_per_cell`,
    and each used point has a cell; of points equally low the southernmost counts, then the westernmost.
    """
    found: IntArray = _lowest_below(x_mm, y_mm, z_mm, used, chosen, cell, round(level_m * 1000))
    return found
