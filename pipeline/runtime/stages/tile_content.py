"""The content of a tile as a few sums: equal sums mean equal points, from whatever files, in any order.

A tile's neighbours see only the points near their common border, so there is one sum per zone: a tile is cut at the
halo's width from each side into three by three zones. A neighbour's window depends only on the zones that face it, so a
change elsewhere in the tile does not concern it.

The sum of a zone is a multiset hash: every point is mixed to two words of 64 bits, and the words of all points are
added. Adding is blind to order and lets files be summed apart (Bellare and Micciancio 1997, AdHash). It guards against
chance (2^-128), not against points chosen to collide.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.tiling import Tile, TileGrid, Window

ZoneSums: TypeAlias = npt.NDArray[np.uint64]
"""(3, 3, 3) uint64: by column and row of the zone, from the south-west on, points and the two words of their sum."""

# the finalizer of splitmix64 (Steele, Lea, Flood 2014): every bit of the input changes half of those of the output
_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_SECOND = np.uint64(0xD6E8FEB86659FD93)
_S30, _S27, _S31 = np.uint64(30), np.uint64(27), np.uint64(31)
_S32, _S40, _S48, _S56 = np.uint64(32), np.uint64(40), np.uint64(48), np.uint64(56)


@kernel
def mixed(state: np.uint64, word: np.uint64) -> np.uint64:
    """A 64-bit state mixed with one more word; each state permutes the words differently."""
    z = (state ^ word) + _GAMMA
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    return z ^ (z >> _S31)


@kernel
def zone_sums(
    records: npt.NDArray[np.void], gps_bits: npt.NDArray[np.uint64], x0: int, y0: int, x1: int, y1: int, halo: int
) -> ZoneSums:
    """Number and two 64-bit hash sums of the points of one tile, by zone: (3, 3, 3) uint64.

    `gps_bits` (n,) are the bits of the points' GPS times. The tile's core, half-open, and the width `halo` of the outer
    zones are in mm.
    """
    sums = np.zeros((3, 3, 3), np.uint64)
    for i in range(records.size):
        point = records[i]
        column = 0 if point.x < x0 + halo else 2 if point.x >= x1 - halo else 1
        row = 0 if point.y < y0 + halo else 2 if point.y >= y1 - halo else 1
        small = (
            np.uint64(point.source)
            | (np.uint64(point.return_number) << _S32)
            | (np.uint64(point.return_count) << _S40)
            | (np.uint64(point.classification) << _S48)
        )
        first = mixed(np.uint64(0), np.uint64(point.x))
        first = mixed(first, np.uint64(point.y))
        first = mixed(first, np.uint64(point.z))
        first = mixed(first, gps_bits[i])
        first = mixed(first, small)
        sums[column, row, 0] += np.uint64(1)
        sums[column, row, 1] += first
        sums[column, row, 2] += mixed(_SECOND, first)
    return sums


def zone_sums_of(stored: bytes) -> ZoneSums:
    """Sums from their bytes, as they travel."""
    return np.frombuffer(stored, np.uint64).reshape(3, 3, 3)


def are_apart(grid: TileGrid) -> bool:
    """Whether the zones of a tile do not overlap; else neighbours depend on the whole tile."""
    return 2 * grid.halo_mm <= grid.size_mm


def content_of_window(sums: Mapping[Tile, ZoneSums], grid: TileGrid, window: Window, tile: Tile) -> list[object]:
    """The content of a tile's window, for its key: the tile's own sums, and those of each neighbour that face it.

    Sums are those of all tiles with points, over all inputs, made with the halo of `grid`. The window is the tile's
    core and a halo at most as wide as that of the lattice.
    """
    found: list[object] = []
    apart = are_apart(grid)
    for other in grid.tiles_over(window):
        own = sums.get(other)
        if own is None:
            continue
        columns, rows = other.column - tile.column, other.row - tile.row
        if apart and (columns, rows) != (0, 0):
            own = own[_facing(columns), _facing(rows)]
        if own[..., 0].any():
            found.append((other.key, own))
    return found


def _facing(offset: int) -> slice:
    """The zones of a neighbour that lie towards the tile, along one axis."""
    return {-1: slice(2, 3), 0: slice(0, 3), 1: slice(0, 1)}[offset]
