"""Cells that continue the ground beside them: brows, benches and terraces that the openings took for objects.

An object ends at walls on nearly all of its sides. Terrain continues on some side without a step: there the plane
through the ground beside a cell, drawn on to the cell, meets it. The test is local, and ground that joined continues
it, so a bench comes back from the side where it is connected with the ground.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, LabelArray
from pipeline.terrain.lattice import NO_DATA, Elevations
from pipeline.terrain.planar_fitting import FEWEST_SIDES, meeting_sides, plane_sums, sum_within

_BLOCK = 64
"""Side in cells of the blocks whose planes are summed and tested together; no plane depends on it. Small enough for the
processor's cache, and most blocks need only one pass."""


@kernel(inline="always")
def _join_block(
    out: BoolArray,
    lowest: Elevations,
    ground: BoolArray,
    barred: BoolArray,
    tested: LabelArray,
    block: tuple[int, int],
    limits: tuple[int, float],
) -> None:
    """Mark in `out` the cells of a block, by its first row and column, that planes on `FEWEST_SIDES` sides meet.

    `tested` (rows, columns) is the number of ground cells in the squares beside each cell at its last test, or 0.
    """
    half = limits[0]
    first, left = max(block[0] - 2 * half, 0), max(block[1] - 2 * half, 0)
    last, right = block[0] + _BLOCK + 2 * half, block[1] + _BLOCK + 2 * half
    sums = plane_sums(lowest[first:last, left:right].copy(), ground[first:last, left:right].copy())
    for r in range(block[0], min(block[0] + _BLOCK, lowest.shape[0])):
        for c in range(block[1], min(block[1] + _BLOCK, lowest.shape[1])):
            if ground[r, c] or barred[r, c] or lowest[r, c] == NO_DATA:
                continue
            # ground only grows: with as much as then it is the same
            r0, r1 = max(r - first - 2 * half, 0), min(r - first + 2 * half + 1, sums.shape[0] - 1)
            c0, c1 = max(c - left - 2 * half, 0), min(c - left + 2 * half + 1, sums.shape[1] - 1)
            beside = sum_within(sums, r0, r1, c0, c1, 0)
            if beside == tested[r, c]:
                continue
            tested[r, c] = beside
            met = meeting_sides(sums, (r - first, c - left), limits, 0, lowest[r, c])
            out[r, c] = met >= FEWEST_SIDES


@kernel
def _joined(
    lowest: Elevations,
    ground: BoolArray,
    barred: BoolArray,
    counts: tuple[LabelArray, LabelArray],
    limits: tuple[int, float],
) -> BoolArray:
    """Ground, and the cells that the planes through the ground of at least `FEWEST_SIDES` squares beside them meet.

    `counts` are of the ground cells in and around each block and beside each cell at its last test. Ground only grows:
    a block or a cell with as many as then needs no test. `limits` as in `rejoined`.
    """
    seen, tested = counts
    margin = 2 * limits[0]
    out = ground.copy()
    for i in range(seen.shape[0]):
        for j in range(seen.shape[1]):
            r, c = i * _BLOCK, j * _BLOCK
            r0, c0 = max(r - margin, 0), max(c - margin, 0)
            around = np.count_nonzero(ground[r0 : r + _BLOCK + margin, c0 : c + _BLOCK + margin])
            if around != seen[i, j]:
                seen[i, j] = around
                _join_block(out, lowest, ground, barred, tested, (r, c), limits)
    return out


def rejoined(
    lowest: Elevations, ground: BoolArray, barred: BoolArray, passes: int, limits: tuple[int, float]
) -> BoolArray:
    """Ground, and the cells that planes through the ground beside them meet; elevations are in mm.

    Parameters
    ----------
    ground, barred : (rows, columns) bool
        Where it starts, and what never joins.
    passes : int
        How often. Each pass looks two half sides far.
    limits : tuple
        Half side in cells of the eight squares that touch a cell; farthest that a plane may pass above or below it, mm.
    """
    seen = np.zeros((-(-lowest.shape[0] // _BLOCK), -(-lowest.shape[1] // _BLOCK)), np.int32)
    tested = np.zeros(lowest.shape, np.int32)
    for _ in range(passes):
        out = _joined(lowest, ground, barred, (seen, tested), limits)
        if np.array_equal(out, ground):
            break
        ground = out
    return ground
