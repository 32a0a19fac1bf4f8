"""Gross outliers: points that are nearly alone in a wide neighbourhood of space.

Birds, clouds and multipath echoes are metres to hundreds of metres away from everything else. A point is an outlier if
the 27 cubes around it hold too few points. Where a survey is so sparse that few points are usual, they are compared
with all points above and below: a tree top holds a fair share of those, a bird does not. The decision looks two cubes
far, and neighbouring tiles agree on it.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, IntArray
from pipeline.spatial_hash import slot_of_key
from pipeline.terrain.terrain_settings import OutlierSettings

_BITS = 21
"""Bits per coordinate in the key of a cube: 2^21 cubes are wider than any tile with its halo."""
_COLUMN = 2**_BITS - 1
"""In place of the level of a cube: the key is that of all cubes above each other. No cube lies so high."""
_EMPTY = -1
"""Key of a free slot of the table."""
_CUBES_A_POINT = 4.0
"""Up to this many cubes per point are held in an array; more are looked up in a table. A matter of speed."""


@kernel
def _find(keys: IntArray, key: int, mask: int) -> np.int64:
    """Slot that holds a key, or the empty one where it belongs."""
    s = slot_of_key(key, mask)
    while keys[s] != _EMPTY and keys[s] != key:
        s = (s + 1) & mask
    return s


@kernel
def _grown(keys: IntArray, counts: IntArray) -> tuple[IntArray, IntArray]:
    """The table in twice the slots."""
    size = 2 * keys.size
    new_keys = np.full(size, _EMPTY, np.int64)
    new_counts = np.zeros(size, np.int64)
    for s in range(keys.size):
        if keys[s] != _EMPTY:
            t = _find(new_keys, keys[s], size - 1)
            new_keys[t] = keys[s]
            new_counts[t] = counts[s]
    return new_keys, new_counts


@kernel(inline="always")
def _are_enough(total: int, column: int, limits: tuple[int, float]) -> bool:
    """Whether a point is kept, given how many lie in the cubes around it, and in those above and below, too."""
    min_neighbours, min_share = limits
    least = min(float(min_neighbours), max(1.0, min_share * (column - 1)))
    return column > min_neighbours and total - 1 >= least


@kernel
def _by_table(
    x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, cube_mm: int, limits: tuple[int, float], low: tuple[int, int, int]
) -> BoolArray:
    """The points that are kept, (n,) bool, from a table of the occupied cubes: far strays do not enlarge it."""
    n = x_mm.size
    keep = np.zeros(n, np.bool_)
    # far fewer cubes than points: the table starts small and grows
    keys = np.full(4096, _EMPTY, np.int64)
    counts = np.zeros(4096, np.int64)
    cubes = 0
    low_x, low_y, low_z = low
    for i in range(n):
        a, b, c = x_mm[i] // cube_mm - low_x, y_mm[i] // cube_mm - low_y, z_mm[i] // cube_mm - low_z
        for level in (c, _COLUMN):
            key = (a << (2 * _BITS)) | (b << _BITS) | level
            s = _find(keys, key, keys.size - 1)
            if keys[s] == _EMPTY:
                keys[s] = key
                cubes += 1
            counts[s] += 1
            if 2 * cubes > keys.size:
                keys, counts = _grown(keys, counts)
    mask = keys.size - 1
    enough = np.zeros(keys.size, np.bool_)
    for slot in range(keys.size):
        level = keys[slot] & _COLUMN
        if keys[slot] == _EMPTY or level == _COLUMN:
            continue
        total, column = 0, 0
        for da in range(-1, 2):
            for db in range(-1, 2):
                key = keys[slot] + (da << (2 * _BITS)) + (db << _BITS)
                for dc in range(-1, 2):
                    t = _find(keys, key + dc, mask)
                    if keys[t] != _EMPTY:
                        total += int(counts[t])
                t = _find(keys, key - level + _COLUMN, mask)
                if keys[t] != _EMPTY:
                    column += int(counts[t])
        enough[slot] = _are_enough(total, column, limits)
    for i in range(n):
        a, b, c = x_mm[i] // cube_mm - low_x, y_mm[i] // cube_mm - low_y, z_mm[i] // cube_mm - low_z
        keep[i] = enough[_find(keys, (a << (2 * _BITS)) | (b << _BITS) | c, mask)]
    return keep


@kernel
def _by_grid(
    x_mm: IntArray,
    y_mm: IntArray,
    z_mm: IntArray,
    cube_mm: int,
    limits: tuple[int, float],
    low: tuple[int, int, int],
    shape: tuple[int, int, int],
) -> BoolArray:
    """The same from an array of all cubes with empty ones around them: many times faster than a table."""
    n = x_mm.size
    x0, y0, z0 = low[0] * cube_mm, low[1] * cube_mm, low[2] * cube_mm
    cube_of = np.empty(n, np.int64)
    inverse = 1.0 / cube_mm
    for i in range(n):
        # quotients in place of divisions: coordinates are whole, so half a millimetre outweighs all rounding
        a = np.int64((x_mm[i] - x0 + 0.5) * inverse)
        b = np.int64((y_mm[i] - y0 + 0.5) * inverse)
        c = np.int64((z_mm[i] - z0 + 0.5) * inverse)
        cube_of[i] = (a * shape[1] + b) * shape[2] + c
    counts = np.zeros(shape[0] * shape[1] * shape[2], np.int32)
    for i in range(n):
        counts[cube_of[i]] += 1
    columns = counts.reshape(shape[0] * shape[1], shape[2]).sum(axis=1)
    enough = np.zeros(counts.size, np.bool_)
    for cube in range(counts.size):
        if counts[cube] > 0:
            total, column = 0, 0
            for da in range(-1, 2):
                for db in range(-1, 2):
                    middle = cube + (da * shape[1] + db) * shape[2]
                    total += counts[middle - 1] + counts[middle] + counts[middle + 1]
                    column += columns[middle // shape[2]]
            enough[cube] = _are_enough(total, column, limits)
    keep = np.empty(n, np.bool_)
    for i in range(n):
        keep[i] = enough[cube_of[i]]
    return keep


@kernel
def _dense_enough(x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, cube_mm: int, limits: tuple[int, float]) -> BoolArray:
    """Kernel: count the points per cube, then sum the 27 cubes around each occupied one."""
    n = x_mm.size
    if n == 0:
        return np.zeros(0, np.bool_)
    low = x_mm.min() // cube_mm - 1, y_mm.min() // cube_mm - 1, z_mm.min() // cube_mm - 1
    shape = (
        x_mm.max() // cube_mm - low[0] + 2,
        y_mm.max() // cube_mm - low[1] + 2,
        z_mm.max() // cube_mm - low[2] + 2,
    )
    if float(shape[0]) * float(shape[1]) * float(shape[2]) <= _CUBES_A_POINT * n:
        return _by_grid(x_mm, y_mm, z_mm, cube_mm, limits, low, shape)
    return _by_table(x_mm, y_mm, z_mm, cube_mm, limits, low)


def dense_enough(x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, settings: OutlierSettings) -> BoolArray:
    """Mask (n,) of the points that are not gross outliers; absolute millimetres, as cubes start at the CRS's origin."""
    kept: BoolArray = _dense_enough(
        x_mm, y_mm, z_mm, round(settings.cube_m * 1000), (settings.min_neighbours, settings.min_share)
    )
    return kept
