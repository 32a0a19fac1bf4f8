"""Ground and terrain on a lattice of lowest last returns.

The lattice has cells of 1 m, anchored at the CRS's origin, and holds integer millimetres. The morphological or the
hierarchical filter finds the cells that hold ground. Local planes through them make the terrain, and the points near it
are the ground points. Every step looks a bounded distance far: no statistic of a whole tile decides.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, IntArray
from pipeline.registry import loaded
from pipeline.terrain.filter_settings import FILTERS, FoundGround
from pipeline.terrain.lattice import CELL_MM, NO_DATA, Elevations, Part, lowest_per_cell, part_around
from pipeline.terrain.planar_fitting import FEWEST_SIDES, MIN_CELLS, meeting_sides, plane_around, plane_sums, sum_within
from pipeline.terrain.reach import NEAR_CELLS
from pipeline.terrain.terrain_settings import GroundSettings

_BLOCK = 64
"""Least side in cells of the blocks that are drawn from sums of their own, which stay in the processor's cache."""


@kernel
def _draw_block(
    terrain: Elevations,
    lowest: Elevations,
    ground: BoolArray,
    block: tuple[int, int, int, int],
    halves: tuple[int, int, bool],
    max_slope: float,
    beside: tuple[int, float],
) -> None:
    """Draw the cells of a block, its first and one past its last row and column; the rest as in `_draw`."""
    first, last, is_final = halves
    south, west = max(block[0] - last, 0), max(block[2] - last, 0)
    seen = (slice(south, block[1] + last), slice(west, block[3] + last))
    sums = plane_sums(lowest[seen].copy(), ground[seen].copy())
    rows, columns = sums.shape[0] - 1, sums.shape[1] - 1
    for r in range(block[0] - south, block[1] - south):
        for c in range(block[2] - west, block[3] - west):
            at = (south + r, west + c)
            if terrain[at] != NO_DATA:
                continue
            half = first
            while True:
                n, level, _, _, carries = plane_around(sums, r, c, half)
                # cells in a row carry no plane: under an object a wider square is needed
                found = carries or (n >= MIN_CELLS and ground[at])
                if found or half == last:
                    break
                half = min(2 * half, last)
            if n == 0 or not (found or is_final):
                continue
            if carries:
                # a plane is trusted no steeper from the middle of its cells than terrain may be
                r0, r1 = max(r - half, 0), min(r + half, rows - 1) + 1
                c0, c1 = max(c - half, 0), min(c + half, columns - 1) + 1
                # about the cell itself, in whole numbers: the same wherever the window begins
                east = (sum_within(sums, r0, r1, c0, c1, 1) - n * c) / n
                north = (sum_within(sums, r0, r1, c0, c1, 2) - n * r) / n
                mean = sum_within(sums, r0, r1, c0, c1, 3) / n
                slack = max_slope * CELL_MM * math.sqrt(east * east + north * north)
                level = min(max(level, mean - slack), mean + slack)
            terrain[at] = np.int32(round(level))
            above = beside[0] > 0 and ground[at] and lowest[at] - level > beside[1]
            # squares that do not touch the cell: it must not agree with itself
            if above and meeting_sides(sums, (r, c), beside, 1, lowest[at]) >= FEWEST_SIDES:
                terrain[at] = lowest[at]


@kernel
def _draw(
    terrain: Elevations,
    lowest: Elevations,
    ground: BoolArray,
    halves: tuple[int, int, bool],
    max_slope: float,
    drawn: tuple[int, int, int, int],
    beside: tuple[int, float],
) -> None:
    """Terrain in mm where there is none yet: the plane through the ground of the smallest square that determines one.

    `halves` are the half sides of the first and the last square in cells, and whether the last one must suffice. Only
    the cells of `drawn`, first and one past the last row and column, get an elevation. `beside` are the half side of
    the squares beside a cell and a step in mm: ground that lies farther than the step above its plane, as at a brow or
    a crest, is terrain itself if the planes of `meeting_sides` meet it. A half side of 0 leaves them out.
    """
    side = max(_BLOCK, 2 * halves[1])
    for r in range(drawn[0], drawn[1], side):
        for c in range(drawn[2], drawn[3], side):
            block = (r, min(r + side, drawn[1]), c, min(c + side, drawn[3]))
            if np.any(terrain[r : block[1], c : block[3]] == NO_DATA):
                _draw_block(terrain, lowest, ground, block, halves, max_slope, beside)


def _terrain(
    lowest: Elevations,
    grounds: tuple[BoolArray, BoolArray],
    reach: int,
    max_slope: float,
    wanted: Part,
    beside: tuple[int, float] = (0, 0.0),
) -> Elevations:
    """Terrain in mm (rows, columns) through two masks of ground: that of squares up to `NEAR_CELLS`, and of wider ones.

    No square reaches farther than `reach` cells. Only the `wanted` part gets elevations; `beside` as in `_draw`.
    """
    near = min(NEAR_CELLS, reach)
    down, across = part_around(wanted, 0, lowest.shape)
    drawn = (down.start, down.stop, across.start, across.stop)
    terrain = np.full(lowest.shape, NO_DATA, np.int32)
    # the squares beside a cell reach twice their half side and one cell
    sides = (min(beside[0], (near - 1) // 2), beside[1])
    _draw(terrain, lowest, grounds[0], (1, near, near == reach), max_slope, drawn, sides)
    if near < reach:
        _draw(terrain, lowest, grounds[1], (min(2 * near, reach), reach, True), max_slope, drawn, (0, 0.0))
    return terrain


@kernel
def slopes_of(terrain: Elevations) -> Elevations:
    """Steepest rise in mm over a metre (rows, columns): central differences, one-sided beside unknown cells."""
    rows, columns = terrain.shape
    out = np.zeros((rows, columns), np.int32)
    for r in range(rows):
        for c in range(columns):
            if terrain[r, c] == NO_DATA:
                continue
            north, south = min(r + 1, rows - 1), max(r - 1, 0)
            east, west = min(c + 1, columns - 1), max(c - 1, 0)
            north = north if terrain[north, c] != NO_DATA else r
            south = south if terrain[south, c] != NO_DATA else r
            east = east if terrain[r, east] != NO_DATA else c
            west = west if terrain[r, west] != NO_DATA else c
            along = (terrain[north, c] - terrain[south, c]) / max(north - south, 1)
            across = (terrain[r, east] - terrain[r, west]) / max(east - west, 1)
            out[r, c] = round(math.sqrt(along * along + across * across))
    return out


@dataclasses.dataclass(frozen=True, kw_only=True)
class Terrain:
    """The ground of a window, on the 1 m lattice."""

    elevation_mm: Elevations
    """(rows, columns) int32, terrain elevation at the cells' centres; NO_DATA where unknown."""
    slope_mm: Elevations
    """(rows, columns) int32, steepest rise of the terrain in mm over a metre; 0 where unknown."""
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
        The points that may be ground: last returns without outliers, or the ground class of the file.
    window : tuple of int
        column0, row0, columns, rows of the lattice.
    trusted : bool
        The usable points are ground by the classes of the file: they are only interpolated.

    Returns
    -------
    Terrain
        Elevations where there is ground within `reach_m`; NO_DATA elsewhere.
    """
    column0, row0, columns, rows = window
    lowest = lowest_per_cell(x_mm, y_mm, z_mm, usable, column0, row0, columns, rows)
    elevation, measured = ground_on(lowest, (column0, row0), settings, trusted=trusted)
    return Terrain(elevation_mm=elevation, slope_mm=slopes_of(elevation), measured=measured, column0=column0, row0=row0)


def ground_on(
    lowest: Elevations,
    corner: tuple[int, int],
    settings: GroundSettings,
    *,
    trusted: bool,
    wanted: tuple[slice, slice] | None = None,
) -> tuple[Elevations, BoolArray]:
    """Terrain in mm through the lowest usable points of cells, and the cells that hold ground: (rows, columns) each.

    Parameters
    ----------
    lowest : (rows, columns) int32
        Elevations in mm, NO_DATA where a cell holds no usable point.
    corner : tuple of int
        Absolute column and row of the first cell.
    settings, trusted
        As for `ground_of`.
    wanted : tuple of slices, optional
        Rows and columns whose elevations are needed; all by default. The others only serve them, and may stay
        without.
    """
    column0, row0 = corner
    rows, columns = lowest.shape
    elevation = np.full((rows, columns), NO_DATA, np.int32)
    measured = np.zeros((rows, columns), np.bool_)
    seen = _part_with_data(lowest, settings.reach_m + 1)
    part = np.ascontiguousarray(lowest[seen])
    if part.size:
        down, across = (slice(0, rows), slice(0, columns)) if wanted is None else wanted
        south, west = seen[0].start, seen[1].start
        drawn = (slice(down.start - south, down.stop - south), slice(across.start - west, across.stop - west))
        if trusted:
            found = FoundGround(part != NO_DATA, part != NO_DATA)
        else:
            from pipeline.terrain.pits import without_pits

            part = without_pits(part, round(settings.pit_depth_m * 1000))
            found = loaded(FILTERS[settings.filter].find)(part, (column0 + west, row0 + south), settings, drawn)
        grounds = (found.near, found.wide)
        elevation[seen] = _terrain(part, grounds, settings.reach_m, settings.max_slope, drawn, found.beside)
        measured[seen] = found.near
    return elevation, measured


def _part_with_data(lowest: Elevations, margin: int) -> tuple[slice, slice]:
    """Rows and columns with data and a margin around them: only these get terrain."""
    filled = lowest != NO_DATA
    rows, columns = np.flatnonzero(filled.any(axis=1)), np.flatnonzero(filled.any(axis=0))
    if len(rows) == 0:
        return slice(0, 0), slice(0, 0)
    return (
        slice(max(int(rows[0]) - margin, 0), int(rows[-1]) + 1 + margin),
        slice(max(int(columns[0]) - margin, 0), int(columns[-1]) + 1 + margin),
    )


@kernel
def _near_terrain(
    x_mm: IntArray,
    y_mm: IntArray,
    z_mm: IntArray,
    lattices: tuple[Elevations, Elevations],
    corner: tuple[int, int],
    limits: tuple[int, float],
) -> BoolArray:
    """Mask of the points lower than a base and a share of the slope above the terrain, both bilinear."""
    terrain, slope_mm = lattices
    base_mm, rise = limits
    rows, columns = terrain.shape
    out = np.zeros(x_mm.size, np.bool_)
    half = CELL_MM // 2
    for i in range(x_mm.size):
        gx, gy = x_mm[i] - half, y_mm[i] - half
        c, r = gx // CELL_MM, gy // CELL_MM
        fx, fy = (gx - c * CELL_MM) / CELL_MM, (gy - r * CELL_MM) / CELL_MM
        c -= corner[0]
        r -= corner[1]
        weight, limit = 0.0, 0.0
        for dr in range(2):
            for dc in range(2):
                if 0 <= r + dr < rows and 0 <= c + dc < columns and terrain[r + dr, c + dc] != NO_DATA:
                    w = (fx if dc == 1 else 1.0 - fx) * (fy if dr == 1 else 1.0 - fy)
                    weight += w
                    limit += w * (terrain[r + dr, c + dc] + rise * slope_mm[r + dr, c + dc])
        out[i] = weight > 1e-9 and z_mm[i] < base_mm + limit / weight
    return out


def ground_points(
    x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, terrain: Terrain, settings: GroundSettings
) -> BoolArray:
    """Which points (n,), in absolute millimetres, lie on the ground of a window that holds them.

    A point is ground if it lies less than `tolerance_m`, plus `tolerance_slope` times the terrain's rise over a metre,
    above the terrain (the rule of SMRF: Pingel, Clarke and McBride 2013), or anywhere below it: the lattice follows the
    lowest points, and steep ground rises far above them within a cell. Returns and outliers do not matter here; points
    without terrain are not ground.
    """
    rise = settings.tolerance_slope if FILTERS[settings.filter].widens_on_slopes else 0.0
    found: BoolArray = _near_terrain(
        x_mm,
        y_mm,
        z_mm,
        (terrain.elevation_mm, terrain.slope_mm),
        (terrain.column0, terrain.row0),
        (round(settings.tolerance_m * 1000), rise),
    )
    return found
