"""Planar fitting: least-squares planes through the ground cells of a square, from integral images.

All sums are integers, and the moments are taken about the place in question: a plane does not depend on where the
lattice's window begins, nor on the order of anything.

Three stages use them: the terrain is drawn by such planes, they are the trend of the morphological filter
(`leaning_planes`), and the hierarchical filter judges by them the points that no facet of its TIN holds
(`join_planes`): beyond the hull of the ground found so far, and where facets are too wide.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.kernels.normal_equations import solve_plane_moments
from pipeline.model import BoolArray
from pipeline.terrain.lattice import CELL_MM, Elevations

Sums = npt.NDArray[np.int64]
"""(rows + 1, columns + 1, 9) integral images of 1, x, y, z, xx, xy, yy, xz, yz; x and y are cell indices, z in mm."""

MIN_CELLS = 5
"""Fewest cells of a plane: two more than determine it."""

MIN_SPREAD = 0.05
"""Numerical guard: det(scatter) over trace(scatter)^2 of a plane, 0 for cells in a row and 0.25 at most."""


@kernel
def plane_sums(elevation: Elevations, used: BoolArray) -> Sums:
    """Integral images of the used cells."""
    rows, columns = elevation.shape
    sums = np.empty((rows + 1, columns + 1, 9), np.int64)
    sums[0] = 0
    for r in range(rows):
        below, here = sums[r], sums[r + 1]
        here[0] = 0
        # sums over the row; y is the same in all of it
        n = x = z = xx = xz = np.int64(0)
        for c in range(columns):
            # without a branch: which cells are used is hard to foresee
            one = np.int64(used[r, c])
            height = one * np.int64(elevation[r, c])
            n, x, z, xx, xz = n + one, x + one * c, z + height, xx + one * c * c, xz + height * c
            old, new = below[c + 1], here[c + 1]
            new[0], new[1], new[2], new[3] = old[0] + n, old[1] + x, old[2] + n * r, old[3] + z
            new[4], new[5], new[6] = old[4] + xx, old[5] + x * r, old[6] + n * r * r
            new[7], new[8] = old[7] + xz, old[8] + z * r
    return sums


@kernel(inline="always")
def sum_within(sums: Sums, r0: int, r1: int, c0: int, c1: int, k: int) -> int:
    """One of the sums over the rows from r0 and the columns from c0, up to but without r1 and c1."""
    return int(sums[r1, c1, k] - sums[r0, c1, k] - sums[r1, c0, k] + sums[r0, c0, k])


@kernel
def plane_around(sums: Sums, r: int, c: int, half: int) -> tuple[int, float, float, float, bool]:
    """The plane through the used cells of the square of 2 half + 1 cells around a cell.

    Returns
    -------
    cells : int
        Used cells in the square.
    level : float
        Elevation of the plane at (r, c) in mm; where the cells carry no plane, their mean.
    along_columns, along_rows : float
        Rise in mm a cell; where the cells carry no plane, how far their centroid lies from (r, c) in cells.
    carries : bool
        At least `MIN_CELLS` cells that spread to both sides.
    """
    rows, columns = sums.shape[0] - 1, sums.shape[1] - 1
    r0, r1 = max(r - half, 0), min(r + half, rows - 1) + 1
    c0, c1 = max(c - half, 0), min(c + half, columns - 1) + 1
    n = sum_within(sums, r0, r1, c0, c1, 0)
    if n == 0:
        return 0, 0.0, 0.0, 0.0, False
    # not in an array of nine: making one took a third of the time
    mx = sum_within(sums, r0, r1, c0, c1, 1)
    my = sum_within(sums, r0, r1, c0, c1, 2)
    mz = sum_within(sums, r0, r1, c0, c1, 3)
    # moments about the cell (r, c), exact
    sx = mx - n * c
    sy = my - n * r
    mean = mz / n
    if n >= MIN_CELLS:
        xx = sum_within(sums, r0, r1, c0, c1, 4) - 2 * c * mx + n * c * c
        xy = sum_within(sums, r0, r1, c0, c1, 5) - c * my - r * mx + n * c * r
        yy = sum_within(sums, r0, r1, c0, c1, 6) - 2 * r * my + n * r * r
        vxx, vxy, vyy = xx - sx * sx / n, xy - sx * sy / n, yy - sy * sy / n
        det = vxx * vyy - vxy * vxy
        if det > MIN_SPREAD * (vxx + vyy) * (vxx + vyy):
            # about the centroid; z about its mean to keep the float products small
            vxz = (sum_within(sums, r0, r1, c0, c1, 7) - c * mz) - sx * mean
            vyz = (sum_within(sums, r0, r1, c0, c1, 8) - r * mz) - sy * mean
            a, b = solve_plane_moments(vxx, vxy, vyy, vxz, vyz)
            return n, mean - (a * sx + b * sy) / n, a, b, True
    return n, mean, sx / n, sy / n, False


_SIDES = np.array([(-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)])
"""Directions of the squares beside a cell."""


FEWEST_SIDES = 2
"""Sides whose planes must meet a cell: a ridge that happens to end at the level of the ground meets only one."""


_STEEPEST_MM = 1.0 * CELL_MM
"""Rise per cell of the steepest plane that is drawn on: beyond 45 degrees it says little of the next cell's level."""


_ROUNDING_MM = 1.0
"""Far more than the rounding of a plane's elevation."""


@kernel(inline="always")
def meeting_sides(sums: Sums, cell: tuple[int, int], limits: tuple[int, float], gap: int, level_mm: int) -> int:
    """Number of squares beside a cell whose planes meet an elevation there, counted up to `FEWEST_SIDES`.

    `cell` is its row and column in `sums`; `limits` as in `rejoined`. The eight squares touch the cell with a gap of 0,
    and leave it out with a gap of 1.
    """
    half, step_mm = limits
    rows, columns = sums.shape[0] - 1, sums.shape[1] - 1
    met = 0
    for k in range(len(_SIDES)):
        down, across = _SIDES[k, 0] * (half + gap), _SIDES[k, 1] * (half + gap)
        r0, r1 = max(cell[0] + down - half, 0), min(cell[0] + down + half, rows - 1) + 1
        c0, c1 = max(cell[1] + across - half, 0), min(cell[1] + across + half, columns - 1) + 1
        n = sum_within(sums, r0, r1, c0, c1, 0)
        if n < MIN_CELLS:
            continue
        east, north = (
            sum_within(sums, r0, r1, c0, c1, 1) / n - cell[1],
            sum_within(sums, r0, r1, c0, c1, 2) / n - cell[0],
        )
        # from its middle no plane rises or falls more than the steepest
        most = step_mm + _STEEPEST_MM * math.sqrt(east * east + north * north) + _ROUNDING_MM
        if abs(level_mm - sum_within(sums, r0, r1, c0, c1, 3) / n) > most:
            continue
        _, level, east, north, carries = plane_around(sums, cell[0] + down, cell[1] + across, half)
        if not carries or math.sqrt(east * east + north * north) > _STEEPEST_MM:
            continue
        if abs(level_mm - (level - east * across - north * down)) <= step_mm:
            met += 1
            if met == FEWEST_SIDES:
                break
    return met
