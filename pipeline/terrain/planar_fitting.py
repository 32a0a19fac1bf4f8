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
from pipeline.terrain.lattice import CELL_MM, NO_DATA, Elevations

Sums = npt.NDArray[np.int64]
"""(rows + 1, columns + 1, 9) integral images of 1, x, y, z, xx, xy, yy, xz, yz; x and y are cell indices, z in mm."""

MIN_CELLS = 5
"""Fewest cells of a plane: two more than determine it."""

MIN_SPREAD = 0.05
"""Numerical guard: det(scatter) over trace(scatter)^2 of a plane, 0 for cells in a row and 0.25 at most."""

_BLOCK = 64
"""Side in cells of the blocks of the trend, which have sums of their own: these stay in the processor's cache."""

MAX_LEAN = 0.6
"""Farthest that the centroid of a trend's square may lie from its middle, in half sides: 0.5 at a straight edge."""


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


@kernel
def join_planes(
    elevation: Elevations,
    ground: BoolArray,
    asked: BoolArray,
    joined: BoolArray,
    reach: int,
    limits: tuple[float, float, float],
) -> None:
    """Mark in `joined` the asked cells that fit the plane through the ground within reach, or lie below it; all in mm.

    Parameters
    ----------
    ground, asked : (rows, columns) bool
        What the planes go through, and what is judged.
    reach : int
        Half side of the squares in cells; nothing farther is looked at.
    limits : tuple of float
        Farthest perpendicular distance above a plane in mm; where the ground around carries no plane, highest step
        above its mean in mm, and rise over run to its centroid.
    """
    max_distance, max_step, max_slope = limits
    sums = plane_sums(elevation, ground)
    rows, columns = elevation.shape
    for r in range(rows):
        for c in range(columns):
            if not asked[r, c]:
                continue
            cells, level, across, along, carries = plane_around(sums, r, c, reach)
            if cells == 0:
                continue
            above = elevation[r, c] - level
            if carries:
                joined[r, c] = above <= max_distance * math.sqrt(1.0 + (across * across + along * along) / CELL_MM**2)
            else:
                far = math.sqrt(across * across + along * along)
                joined[r, c] = above <= max_step + max_slope * CELL_MM * far


@kernel
def _lean_block(
    elevation: Elevations,
    used: BoolArray,
    halves: tuple[int, int],
    block: tuple[int, int],
    out: tuple[Elevations, Elevations],
) -> None:
    """Write the trend of a block of cells, by its first row and column; the rest as in `leaning_planes`."""
    half, widest = halves
    south, west = max(block[0] - widest, 0), max(block[1] - widest, 0)
    seen = (slice(south, block[0] + _BLOCK + widest), slice(west, block[1] + _BLOCK + widest))
    sums = plane_sums(elevation[seen].copy(), used[seen].copy())
    rows, columns = sums.shape[0] - 1, sums.shape[1] - 1
    for r in range(block[0] - south, min(block[0] + _BLOCK, elevation.shape[0]) - south):
        for c in range(block[1] - west, min(block[1] + _BLOCK, elevation.shape[1]) - west):
            side = half
            while side < widest:
                r0, r1 = max(r - side, 0), min(r + side, rows - 1) + 1
                c0, c1 = max(c - side, 0), min(c + side, columns - 1) + 1
                n = sum_within(sums, r0, r1, c0, c1, 0)
                if n >= half:
                    east = sum_within(sums, r0, r1, c0, c1, 1) - n * c
                    north = sum_within(sums, r0, r1, c0, c1, 2) - n * r
                    if max(abs(east), abs(north)) <= MAX_LEAN * side * n:
                        break
                side = min(2 * side, widest)
            n, at, across, along, carries = plane_around(sums, r, c, side)
            if n > 0:
                out[0][south + r, west + c] = round(at)
                if carries:
                    out[1][south + r, west + c] = round(math.sqrt(across * across + along * along))


@kernel
def leaning_planes(elevation: Elevations, used: BoolArray, half: int, widest: int) -> tuple[Elevations, Elevations]:
    """The trend at every cell: level and rise of the plane through the used cells of a square around it.

    A square that holds fewer used cells than `half`, or all of them to one side, would carry its plane too far: there
    the square grows. Half sides go from `half` to `widest` cells. Returns two lattices (rows, columns). The first has
    the plane's elevation at the cell in mm. It is NO_DATA where the largest square holds nothing. The second has the
    plane's steepest rise in mm a cell. It is 0 where there is no plane.
    """
    rows, columns = elevation.shape
    level = np.full((rows, columns), NO_DATA, np.int32)
    slope_mm = np.zeros((rows, columns), np.int32)
    for r in range(0, rows, _BLOCK):
        for c in range(0, columns, _BLOCK):
            _lean_block(elevation, used, (half, widest), (r, c), (level, slope_mm))
    return level, slope_mm
