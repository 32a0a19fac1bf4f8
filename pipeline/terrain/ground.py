"""The ground filter: a progressive morphological filter on a lattice of lowest last returns.

The lattice has cells of 1 m, anchored at the CRS's origin, and holds integer millimetres. Square
openings of growing size cut off what stands on the ground; a cell is an object where one step of the
opening takes more than the terrain's slope allows (Zhang et al. 2003; Pingel, Clarke and McBride
2013 use the same test in SMRF). The terrain is then drawn through the remaining cells by local
planes. Everything looks a bounded distance far: no statistic of a whole tile decides.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt
from numba import njit

from pipeline.model import BoolArray, IntArray
from pipeline.parameters import Parameters, parameter

CELL_MM = 1000
"""Side of a cell of the terrain lattice."""

NO_DATA = np.int32(2**31 - 1)
"""Elevation of a cell without one."""

Elevations = npt.NDArray[np.int32]

_PIT_CELLS = 2


@dataclasses.dataclass(frozen=True, kw_only=True)
class GroundSettings(Parameters):
    """How ground is told from objects."""

    max_window_m: int = parameter(
        20,
        "Largest half side of the opening: buildings up to twice as wide are cut off the ground.",
        unit="m",
        minimum=2,
        maximum=60,
    )
    max_slope: float = parameter(
        0.25, "Steepest terrain, as rise over run, that the opening does not cut off.", minimum=0.01, maximum=2.0
    )
    min_step_m: float = parameter(
        0.35, "Least height of an object above what the opening leaves.", unit="m", minimum=0.05, maximum=3.0
    )
    pit_depth_m: float = parameter(
        1.0,
        "A cell that lies deeper than this below all but two of its 24 neighbours is a low outlier.",
        unit="m",
        minimum=0.2,
        maximum=20.0,
    )
    bridge_m: int = parameter(
        24,
        "Farthest that the terrain is drawn under objects, where max_window_m asks for no more.",
        unit="m",
        minimum=4,
        maximum=80,
    )
    tolerance_m: float = parameter(
        0.5, "Points closer than this to the terrain are ground.", unit="m", minimum=0.05, maximum=3.0
    )

    @property
    def windows(self) -> tuple[int, ...]:
        """Half sides of the openings in cells, growing to the largest."""
        sizes = [1]
        while sizes[-1] < self.max_window_m:
            sizes.append(min(self.max_window_m, sizes[-1] + max(1, sizes[-1] // 2)))
        return tuple(sizes)

    @property
    def reach_m(self) -> int:
        """Farthest that the terrain is drawn under objects: at least to the middle of the widest that are cut off."""
        return max(self.bridge_m, self.max_window_m + 1)

    @property
    def support_m(self) -> float:
        """How far a terrain elevation looks: the pit test, erosion and dilation, the local planes, cell sizes."""
        return float(_PIT_CELLS + 2 * self.max_window_m + self.reach_m + 3)


@njit(cache=True, nogil=True)
def lowest_per_cell(
    x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, used: BoolArray, column0: int, row0: int, columns: int, rows: int
) -> Elevations:
    """Elevation of the lowest used point of each cell, int32 (rows, columns), NO_DATA where there is none."""
    lowest = np.full((rows, columns), NO_DATA, np.int32)
    for i in range(x_mm.size):
        if used[i]:
            c = x_mm[i] // CELL_MM - column0
            r = y_mm[i] // CELL_MM - row0
            if 0 <= c < columns and 0 <= r < rows and z_mm[i] < lowest[r, c]:
                lowest[r, c] = z_mm[i]
    return lowest


@njit(cache=True, nogil=True)
def _without_pits(lowest: Elevations, depth_mm: int) -> Elevations:
    """Clear cells that lie deeper than depth_mm below all but at most two of the 24 cells around."""
    rows, columns = lowest.shape
    out = lowest.copy()
    for r in range(rows):
        for c in range(columns):
            z = lowest[r, c]
            if z == NO_DATA:
                continue
            near, filled = 0, 0
            for dr in range(-2, 3):
                for dc in range(-2, 3):
                    if (dr != 0 or dc != 0) and 0 <= r + dr < rows and 0 <= c + dc < columns:
                        other = lowest[r + dr, c + dc]
                        if other != NO_DATA:
                            filled += 1
                            if other - z <= depth_mm:
                                near += 1
            if filled > 2 and near <= 2:
                out[r, c] = NO_DATA
    return out


@njit(cache=True, nogil=True)
def _extreme_along_rows(values: Elevations, half: int, want_low: bool) -> Elevations:
    """Sliding minimum (or maximum) over 2 half + 1 cells of each row, skipping NO_DATA (monotonic queue)."""
    rows, columns = values.shape
    out = np.full((rows, columns), NO_DATA, np.int32)
    queue = np.empty(columns, np.int64)
    for r in range(rows):
        head, tail, seen = 0, 0, 0
        for c in range(columns):
            while seen < columns and seen <= c + half:
                v = values[r, seen]
                if v != NO_DATA:
                    while tail > head and (
                        (want_low and values[r, queue[tail - 1]] >= v)
                        or (not want_low and values[r, queue[tail - 1]] <= v)
                    ):
                        tail -= 1
                    queue[tail] = seen
                    tail += 1
                seen += 1
            while tail > head and queue[head] < c - half:
                head += 1
            if tail > head:
                out[r, c] = values[r, queue[head]]
    return out


@njit(cache=True, nogil=True)
def _opened(values: Elevations, half: int) -> Elevations:
    """Morphological opening by a square of 2 half + 1 cells; separable."""
    for low in (True, False):
        values = _extreme_along_rows(values, half, low)
        values = np.ascontiguousarray(_extreme_along_rows(np.ascontiguousarray(values.T), half, low).T)
    return values


@njit(cache=True, nogil=True)
def _objects(lowest: Elevations, windows: IntArray, max_slope: float, min_step_mm: float) -> BoolArray:
    """Mask of the cells that some step of the growing opening cuts off by more than slope allows."""
    rows, columns = lowest.shape
    flagged = np.zeros((rows, columns), np.bool_)
    before = lowest
    half_before = 0
    for half in windows:
        after = _opened(lowest, half)
        limit = min_step_mm + max_slope * CELL_MM * (half - half_before)
        for r in range(rows):
            for c in range(columns):
                if before[r, c] != NO_DATA and before[r, c] - after[r, c] > limit:
                    flagged[r, c] = True
        before = after
        half_before = half
    return flagged


@njit(cache=True, nogil=True)
def _terrain(lowest: Elevations, is_ground: BoolArray, bridge: int, max_slope: float) -> Elevations:
    """Draw local least-squares planes through the ground cells of the smallest box that holds enough.

    All sums are integers about the box's own centre: the result does not depend on where the lattice's
    window begins.
    """
    rows, columns = lowest.shape
    # integral images: count, x, y, z, xx, xy, yy, xz, yz with cell indices as x and y
    sums = np.zeros((9, rows + 1, columns + 1), np.int64)
    for r in range(rows):
        run = np.zeros(9, np.int64)
        for c in range(columns):
            if is_ground[r, c]:
                z = np.int64(lowest[r, c])
                run[0] += 1
                run[1] += c
                run[2] += r
                run[3] += z
                run[4] += c * c
                run[5] += c * r
                run[6] += r * r
                run[7] += c * z
                run[8] += r * z
            for k in range(9):
                sums[k, r + 1, c + 1] = sums[k, r, c + 1] + run[k]
    terrain = np.full((rows, columns), NO_DATA, np.int32)
    m = np.empty(9, np.int64)
    for r in range(rows):
        for c in range(columns):
            half = 1
            while True:
                r0, r1 = max(r - half, 0), min(r + half, rows - 1) + 1
                c0, c1 = max(c - half, 0), min(c + half, columns - 1) + 1
                for k in range(9):
                    m[k] = sums[k, r1, c1] - sums[k, r0, c1] - sums[k, r1, c0] + sums[k, r0, c0]
                n = m[0]
                # moments about the cell (r, c), exact
                sx = m[1] - n * c
                sy = m[2] - n * r
                xx = m[4] - 2 * c * m[1] + n * c * c
                xy = m[5] - c * m[2] - r * m[1] + n * c * r
                yy = m[6] - 2 * r * m[2] + n * r * r
                vxx, vxy, vyy, det = 0.0, 0.0, 0.0, 0.0
                if n >= 5:
                    vxx, vxy, vyy = xx - sx * sx / n, xy - sx * sy / n, yy - sy * sy / n
                    det = vxx * vyy - vxy * vxy
                # cells in a row carry no plane: under an object a wider box is needed
                carries = n >= 5 and det > 0.05 * (vxx + vyy) * (vxx + vyy)
                if carries or half == bridge or (n >= 5 and is_ground[r, c]):
                    break
                half = min(2 * half, bridge)
            if n == 0:
                continue
            mean = m[3] / n
            # about the centroid; z about its mean to keep the float products small
            vxz = (m[7] - c * m[3]) - sx * mean
            vyz = (m[8] - r * m[3]) - sy * mean
            level = float(mean)
            if carries:
                a = (vxz * vyy - vyz * vxy) / det
                b = (vyz * vxx - vxz * vxy) / det
                # a plane is trusted as far as the terrain may rise within the box, not farther
                level = mean - (a * sx + b * sy) / n
                low, high = 1e12, -1e12
                for rr in range(r0, r1):
                    for cc in range(c0, c1):
                        if is_ground[rr, cc]:
                            low = min(low, float(lowest[rr, cc]))
                            high = max(high, float(lowest[rr, cc]))
                slack = max_slope * CELL_MM * half
                level = min(max(level, low - slack), high + slack)
            terrain[r, c] = np.int32(round(level))
    return terrain


@njit(cache=True, nogil=True)
def height_above(
    x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, terrain: Elevations, column0: int, row0: int
) -> IntArray:
    """Heights of points above the bilinear terrain in mm, int64 (n,); NO_DATA where there is no terrain."""
    rows, columns = terrain.shape
    out = np.empty(x_mm.size, np.int64)
    half = CELL_MM // 2
    for i in range(x_mm.size):
        gx, gy = x_mm[i] - half, y_mm[i] - half
        c, r = gx // CELL_MM, gy // CELL_MM
        fx, fy = (gx - c * CELL_MM) / CELL_MM, (gy - r * CELL_MM) / CELL_MM
        c -= column0
        r -= row0
        weight, total = 0.0, 0.0
        for dr in range(2):
            for dc in range(2):
                if 0 <= r + dr < rows and 0 <= c + dc < columns and terrain[r + dr, c + dc] != NO_DATA:
                    w = (fx if dc == 1 else 1.0 - fx) * (fy if dr == 1 else 1.0 - fy)
                    weight += w
                    total += w * terrain[r + dr, c + dc]
        if weight > 1e-9:
            out[i] = z_mm[i] - round(total / weight)
        else:
            out[i] = NO_DATA
    return out


@dataclasses.dataclass(frozen=True, kw_only=True)
class Terrain:
    """The ground of a window, on the 1 m lattice."""

    elevation_mm: Elevations
    """(rows, columns) int32, terrain elevation at the cells' centres; NO_DATA where unknown."""
    measured: BoolArray
    """(rows, columns), True where a ground point lies in the cell."""
    column0: int
    """Absolute index of the first column: floor(easting / 1 m)."""
    row0: int
    """Absolute index of the first row."""


def ground_of(
    x_mm: IntArray,
    y_mm: IntArray,
    z_mm: IntArray,
    usable: BoolArray,
    window: tuple[int, int, int, int],
    settings: GroundSettings,
    *,
    trusted: bool,
) -> Terrain:
    """Terrain under a window of points.

    Parameters
    ----------
    x_mm, y_mm, z_mm : (n,) int64
        Absolute coordinates in millimetres.
    usable : (n,) bool
        The points that may be ground: last returns without outliers, or the file's own ground class.
    window : tuple of int
        column0, row0, columns, rows of the lattice.
    settings : GroundSettings
        Windows, slope and tolerances.
    trusted : bool
        The usable points are ground by the file's classes: no filter, only interpolation.

    Returns
    -------
    Terrain
        Elevations where there is ground within `bridge_m`; NO_DATA elsewhere.
    """
    column0, row0, columns, rows = window
    lowest = lowest_per_cell(x_mm, y_mm, z_mm, usable, column0, row0, columns, rows)
    if trusted:
        is_ground = lowest != NO_DATA
    else:
        lowest = _without_pits(lowest, round(settings.pit_depth_m * 1000))
        windows = np.array(settings.windows, np.int64)
        flagged = _objects(lowest, windows, settings.max_slope, settings.min_step_m * 1000.0)
        is_ground = (lowest != NO_DATA) & ~flagged
    return Terrain(
        elevation_mm=_terrain(lowest, is_ground, settings.reach_m, settings.max_slope),
        measured=is_ground,
        column0=column0,
        row0=row0,
    )
