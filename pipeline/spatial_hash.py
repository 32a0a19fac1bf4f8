"""Hashing of lattice cells and points, to find duplicates and neighbours in space."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.kernels.sorting import counting_sort
from pipeline.model import BoolArray, ByteArray, FloatArray, IntArray, LabelArray

# Constants of the hash; they change the speed, not the result.
# 2^64 / golden ratio: Fibonacci hashing (Knuth, TAOCP 3, 6.4). Unsigned, since only that wraps safely.
_GOLDEN = np.uint64(11400714819323198485)
_SHIFT = np.uint64(20)
_FOLD = np.uint64(32)
_PRIMES = (np.uint64(73856093), np.uint64(19349663), np.uint64(83492791), np.uint64(2654435761))


@kernel
def slot_of_key(key: int | np.int64, mask: int) -> np.int64:
    """First slot of a key in an open-addressing table of mask + 1 (a power of two) slots."""
    mixed = np.uint64(key) * _GOLDEN
    # bits of a product hang on lower bits of the key only: fold, so that a column packed high counts in small tables
    mixed = (mixed ^ (mixed >> _FOLD)) * _GOLDEN
    return np.int64(mixed >> _SHIFT) & mask


@kernel
def _first_of_each(
    x_mm: IntArray,
    y_mm: IntArray,
    z_mm: IntArray,
    return_number: ByteArray,
    gps_bits: IntArray,
    source_id: npt.NDArray[np.uint16],
    classification: ByteArray,
    return_count: ByteArray,
) -> BoolArray:
    """Kernel: open addressing; of equal points the one with the lowest source, then class, then return count, stays."""
    n = x_mm.size
    keep = np.zeros(n, np.bool_)
    size = 2
    while size < 2 * n:
        size *= 2
    mask = size - 1
    holder = np.full(size, -1, np.int32)
    for i in range(n):
        mixed = (np.uint64(x_mm[i]) * _PRIMES[0]) ^ (np.uint64(y_mm[i]) * _PRIMES[1])
        mixed ^= (np.uint64(z_mm[i]) * _PRIMES[2]) ^ (np.uint64(gps_bits[i]) * _PRIMES[3]) ^ np.uint64(return_number[i])
        s = slot_of_key(np.int64(mixed), mask)
        while True:
            j = holder[s]
            if j < 0:
                holder[s] = i
                keep[i] = True
                break
            same = (
                x_mm[i] == x_mm[j]
                and y_mm[i] == y_mm[j]
                and z_mm[i] == z_mm[j]
                and return_number[i] == return_number[j]
                and gps_bits[i] == gps_bits[j]
            )
            if same:
                mine = (source_id[i], classification[i], return_count[i])
                if mine < (source_id[j], classification[j], return_count[j]):
                    holder[s] = i
                    keep[i] = True
                    keep[j] = False
                break
            s = (s + 1) & mask
    return keep


def first_of_each(
    x_mm: IntArray,
    y_mm: IntArray,
    z_mm: IntArray,
    return_number: ByteArray,
    gps_time: FloatArray,
    source_id: npt.NDArray[np.uint16],
    classification: ByteArray,
    return_count: ByteArray,
) -> BoolArray:
    """Mask that keeps one of each set of equal points, as in `PointCloud`, with coordinates in millimetres.

    Points are equal if coordinates, return number and GPS time are; overlapping inputs repeat them. Which one stays
    depends on the values alone, not on their order.
    """
    gps_bits = np.ascontiguousarray(gps_time).view(np.int64)
    kept: BoolArray = _first_of_each(x_mm, y_mm, z_mm, return_number, gps_bits, source_id, classification, return_count)
    return kept


@kernel
def points_by_cell(
    x: IntArray, y: IntArray, used: BoolArray, cell: int
) -> tuple[LabelArray, LabelArray, int, int, int, int]:
    """Used points sorted by square cells; coordinates (n,) in mm, of at least one point.

    Parameters
    ----------
    cell : int
        Side of a cell in mm; cells are anchored at the origin.

    Returns
    -------
    start : (rows * columns + 1,) int32
        Where the points of each cell begin, row by row.
    members : (m,) int32
        Indices of the used points; within a cell in their own order.
    column0, row0, columns, rows : int
        First column and row, and how many there are.
    """
    n = x.size
    column0, row0 = x.min() // cell, y.min() // cell
    columns, rows = x.max() // cell - column0 + 1, y.max() // cell - row0 + 1
    # quotients of whole numbers below 2^52 are exact when rounded down, and floats are divided several at a time
    west, south, side = column0 * cell, row0 * cell, float(cell)
    keys = np.empty(n, np.int32)
    for i in range(n):
        c, r = np.int32((x[i] - west) / side), np.int32((y[i] - south) / side)
        keys[i] = r * columns + c if used[i] else -1
    start, members = counting_sort(keys, columns * rows)
    return start, members, column0, row0, columns, rows
