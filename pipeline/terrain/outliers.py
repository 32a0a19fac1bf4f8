"""Gross outliers: points that are nearly alone in a wide neighbourhood of space.

Birds, clouds and multipath echoes stand metres to hundreds of metres from everything else. A point
is an outlier where the 27 cubes around it hold too few points; the decision looks 2 cubes far and no
further, so that tiles agree on it.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numba import njit

from pipeline.model import BoolArray, IntArray
from pipeline.parameters import Parameters, parameter
from pipeline.spatial_hash import slot_of_key

# 21 bits a coordinate pack a cube into one key: 2^21 cubes are wider than any tile with its halo.
_BITS = 21
_EMPTY = -1


@dataclasses.dataclass(frozen=True, kw_only=True)
class OutlierSettings(Parameters):
    """When a point counts as a gross outlier."""

    cube_m: float = parameter(
        5.0, "Side of the cubes in which neighbours are counted.", unit="m", minimum=1.0, maximum=50.0
    )
    min_neighbours: int = parameter(
        4, "Fewest other points in the 27 cubes around a point that is kept.", minimum=0, maximum=100
    )

    @property
    def support_m(self) -> float:
        """How far the decision looks."""
        return 2.0 * self.cube_m


@njit(cache=True, nogil=True)
def _find(keys: IntArray, key: int, mask: int) -> np.int64:
    """Slot that holds a key, or the empty one where it belongs."""
    s = slot_of_key(key, mask)
    while keys[s] != _EMPTY and keys[s] != key:
        s = (s + 1) & mask
    return s


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _dense_enough(x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, cube_mm: int, min_neighbours: int) -> BoolArray:
    """Kernel: count points a cube, then sum the 27 cubes around each occupied cube once."""
    n = x_mm.size
    keep = np.zeros(n, np.bool_)
    if n == 0:
        return keep
    # far fewer cubes than points: the table starts small and grows
    keys = np.full(4096, _EMPTY, np.int64)
    counts = np.zeros(4096, np.int64)
    cubes = 0
    low_x, low_y, low_z = x_mm.min() // cube_mm - 1, y_mm.min() // cube_mm - 1, z_mm.min() // cube_mm - 1
    for i in range(n):
        a, b, c = x_mm[i] // cube_mm - low_x, y_mm[i] // cube_mm - low_y, z_mm[i] // cube_mm - low_z
        key = (a << (2 * _BITS)) | (b << _BITS) | c
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
        if keys[slot] == _EMPTY:
            continue
        total = 0
        for da in range(-1, 2):
            for db in range(-1, 2):
                for dc in range(-1, 2):
                    t = _find(keys, keys[slot] + (da << (2 * _BITS)) + (db << _BITS) + dc, mask)
                    if keys[t] != _EMPTY:
                        total += int(counts[t])
        enough[slot] = total > min_neighbours
    for i in range(n):
        a, b, c = x_mm[i] // cube_mm - low_x, y_mm[i] // cube_mm - low_y, z_mm[i] // cube_mm - low_z
        keep[i] = enough[_find(keys, (a << (2 * _BITS)) | (b << _BITS) | c, mask)]
    return keep


def dense_enough(x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, settings: OutlierSettings) -> BoolArray:
    """Mask of the points that are no gross outliers.

    Parameters
    ----------
    x_mm, y_mm, z_mm : (n,) int64
        Absolute coordinates in millimetres: the cubes are anchored at the CRS's origin.
    settings : OutlierSettings
        Side of the cubes and the fewest neighbours.

    Returns
    -------
    (n,) bool
        False for outliers; empty for no points.
    """
    kept: BoolArray = _dense_enough(x_mm, y_mm, z_mm, round(settings.cube_m * 1000), settings.min_neighbours)
    return kept
