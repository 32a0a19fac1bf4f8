"""Cells that continue the ground beside them: brows, benches and terraces that the openings took for objects.

An object ends at walls on nearly all of its sides. Terrain continues on some side without a step: there the plane
through the ground beside a cell, drawn on to the cell, meets it. The test is local, and ground that joined carries it
on, so a bench comes back from the side where it hangs together with the ground.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, LabelArray
from pipeline.terrain.lattice import CELL_MM, NO_DATA, Elevations
from pipeline.terrain.planar_fitting import plane_around, plane_sums

_SIDES = np.array([(-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)])
"""Directions of the squares beside a cell."""

_FEWEST_SIDES = 2
"""Sides whose planes must meet a cell: a ridge that happens to end at the level of the ground meets only one."""

_STEEPEST_MM = 1.0 * CELL_MM
"""Rise per cell of the steepest plane that is drawn on: beyond 45 degrees it says little of the next cell's level."""


@kernel
def _joined(
    lowest: Elevations, ground: BoolArray, barred: BoolArray, seen: LabelArray, limits: tuple[int, float]
) -> BoolArray:
    """Ground, and the cells that the planes through the ground of at least `_FEWEST_SIDES` squares beside them meet.

    `seen` counts the ground cells around each cell at its last test. Ground only grows: a cell around which there are
    as many as then needs no test. `limits` as in `rejoined`.
    """
    half, step_mm = limits
    rows, columns = lowest.shape
    sums = plane_sums(lowest, ground)
    out = ground.copy()
    for r in range(rows):
        for c in range(columns):
            if ground[r, c] or barred[r, c] or lowest[r, c] == NO_DATA:
                continue
            r0, r1 = max(r - 2 * half, 0), min(r + 2 * half, rows - 1) + 1
            c0, c1 = max(c - 2 * half, 0), min(c + 2 * half, columns - 1) + 1
            around = sums[0, r1, c1] - sums[0, r0, c1] - sums[0, r1, c0] + sums[0, r0, c0]
            if around == seen[r, c]:
                continue
            seen[r, c] = around
            met = 0
            for k in range(len(_SIDES)):
                down, across = _SIDES[k, 0] * half, _SIDES[k, 1] * half
                _, level, east, north, carries = plane_around(sums, r + down, c + across, half)
                if not carries or math.sqrt(east * east + north * north) > _STEEPEST_MM:
                    continue
                if abs(lowest[r, c] - (level - east * across - north * down)) <= step_mm:
                    met += 1
            out[r, c] = met >= _FEWEST_SIDES
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
    seen = np.zeros(lowest.shape, np.int32)
    for _ in range(passes):
        out = _joined(lowest, ground, barred, seen, limits)
        if np.array_equal(out, ground):
            break
        ground = out
    return ground
