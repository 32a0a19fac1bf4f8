"""The hierarchical ground filter: TIN densification and planar fitting, from coarse cells to fine ones.

It follows the "TIN filtering and planar-fitting filtering with the hierarchical filtering strategy" with which Zeng et
al. (2008) prepare their scenes; their own description is not public. The lowest point of every coarse cell is ground.
Level by level the lowest points of finer cells join it, judged by the TIN of the ground found so far, or by a plane
through it where no facet decides. Every pass looks one reach far, and the whole filter as far as their sum.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.extras.hierarchical_filter.tin_densification import join_facets
from pipeline.model import BoolArray
from pipeline.terrain.filter_settings import FoundGround, HierarchicalFilterSettings
from pipeline.terrain.lattice import CELL_MM, NO_DATA, Elevations, Part
from pipeline.terrain.pits import without_pits
from pipeline.terrain.planar_fitting import plane_around, plane_sums
from pipeline.terrain.reach import PIT_CELLS
from pipeline.terrain.terrain_settings import GroundSettings

# Not settings: they guard against bad seeds, and pits, cells and steps themselves can be set.
_CLUMP_MATES = 3
"""A clump no wider than a cell may lie in four of them."""

_WHOLE_SHARE = 2 / 3
"""The edge of the data cuts a cell of seeds if its points extend over less than this share of its side."""

_WALL_CELLS = 2
"""Cells over which a wall's step is taken."""

_CUT_SLOPE = 0.2
"""Rise over run of ground between the foot of a wall and the seed on it."""


@kernel
def _lowest_of_cells(lowest: Elevations, size: int, column0: int, row0: int) -> BoolArray:
    """Mask of the lowest lattice cell in each cell of `size` anchored at the origin; of equal ones the first by row."""
    rows, columns = lowest.shape
    corner_c, corner_r = column0 // size, row0 // size
    coarse = np.full(((row0 + rows - 1) // size - corner_r + 1, (column0 + columns - 1) // size - corner_c + 1), -1)
    for r in range(rows):
        for c in range(columns):
            if lowest[r, c] != NO_DATA:
                i, j = (row0 + r) // size - corner_r, (column0 + c) // size - corner_c
                best = coarse[i, j]
                if best < 0 or lowest[r, c] < lowest[best // columns, best % columns]:
                    coarse[i, j] = r * columns + c
    out = np.zeros((rows, columns), np.bool_)
    for best in coarse.ravel():
        if best >= 0:
            out[best // columns, best % columns] = True
    return out


@kernel
def _is_cut(lowest: Elevations, r: int, c: int, size: int, corner: tuple[int, int]) -> bool:
    """Whether the data of the cell of seeds that holds (r, c) extend over less than _WHOLE_SHARE of a side."""
    rows, columns = lowest.shape
    r0, c0 = r - (corner[1] + r) % size, c - (corner[0] + c) % size
    low_r, high_r, low_c, high_c = r, r, c, c
    for k in range(max(r0, 0), min(r0 + size, rows)):
        for m in range(max(c0, 0), min(c0 + size, columns)):
            if lowest[k, m] != NO_DATA:
                low_r, high_r = min(low_r, k), max(high_r, k)
                low_c, high_c = min(low_c, m), max(high_c, m)
    return min(high_r - low_r, high_c - low_c) + 1 < _WHOLE_SHARE * size


@kernel
def _stands_on_a_wall(lowest: Elevations, r: int, c: int, reach: int, step_mm: float) -> bool:
    """Whether within reach something at the level of (r, c) ends in a step down of more than step_mm.

    The foot must also lie lower than a slope of _CUT_SLOPE from (r, c) leads.
    """
    rows, columns = lowest.shape
    near = reach - _WALL_CELLS
    for k in range(max(r - near, 0), min(r + near + 1, rows)):
        for m in range(max(c - near, 0), min(c + near + 1, columns)):
            z = float(lowest[k, m])
            if lowest[k, m] == NO_DATA or abs(z - lowest[r, c]) > step_mm:
                continue
            for kk in range(max(k - _WALL_CELLS, 0), min(k + _WALL_CELLS + 1, rows)):
                for mm in range(max(m - _WALL_CELLS, 0), min(m + _WALL_CELLS + 1, columns)):
                    fall = min(z, float(lowest[r, c])) - lowest[kk, mm]
                    far = math.sqrt((kk - r) * (kk - r) + (mm - c) * (mm - c))
                    if fall > step_mm + _CUT_SLOPE * CELL_MM * far:
                        return True
    return False


@kernel
def _without_cut_off(lowest: Elevations, seeds: BoolArray, size: int, corner: tuple[int, int], step_mm: float) -> None:
    """Clear seeds on walls in cells that the edge of the data cuts: such a cell may hold nothing but roof.

    A wall is a step down of more than step_mm, at the seed's level, within one cell of seeds.
    """
    rows, columns = lowest.shape
    for r in range(rows):
        for c in range(columns):
            if seeds[r, c] and _is_cut(lowest, r, c, size, corner):
                seeds[r, c] = not _stands_on_a_wall(lowest, r, c, size - 1, step_mm)


@kernel
def _without_clumps(lowest: Elevations, size: int, column0: int, row0: int, depth_mm: int) -> Elevations:
    """Clear what lies deeper than depth_mm below all but three of the 24 cells of `size` around its own.

    The test of `without_pits` on coarser cells; in a cell only the points that are too deep are cleared.
    """
    rows, columns = lowest.shape
    corner_c, corner_r = column0 // size, row0 // size
    coarse_rows = (row0 + rows - 1) // size - corner_r + 1
    coarse_columns = (column0 + columns - 1) // size - corner_c + 1
    coarse = np.full((coarse_rows, coarse_columns), NO_DATA, np.int32)
    for r in range(rows):
        for c in range(columns):
            i, j = (row0 + r) // size - corner_r, (column0 + c) // size - corner_c
            coarse[i, j] = min(coarse[i, j], lowest[r, c])
    cleared = without_pits(coarse, depth_mm, _CLUMP_MATES)
    out = lowest.copy()
    for r in range(rows):
        for c in range(columns):
            i, j = (row0 + r) // size - corner_r, (column0 + c) // size - corner_c
            if lowest[r, c] == NO_DATA or cleared[i, j] != NO_DATA:
                continue
            near = 0
            for k in range(max(i - PIT_CELLS, 0), min(i + PIT_CELLS + 1, coarse_rows)):
                for m in range(max(j - PIT_CELLS, 0), min(j + PIT_CELLS + 1, coarse_columns)):
                    if (k != i or m != j) and coarse[k, m] - np.int64(lowest[r, c]) <= depth_mm:
                        near += 1
            if near <= _CLUMP_MATES:
                out[r, c] = NO_DATA
    return out


def found_ground(lowest: Elevations, corner: tuple[int, int], settings: GroundSettings, _: Part) -> FoundGround:
    """The cells that hold ground; see `hierarchical_ground`."""
    ground = hierarchical_ground(lowest, corner, settings, round(settings.pit_depth_m * 1000))
    return FoundGround(ground, ground)


def hierarchical_ground(
    lowest: Elevations, corner: tuple[int, int], settings: HierarchicalFilterSettings, pit_depth_mm: int
) -> BoolArray:
    """Mask of the cells that hold ground; none where there is no data.

    `lowest` is the elevation in mm of the lowest point of each cell, single pits of `pit_depth_mm` cleared, NO_DATA
    where there is none. `corner` is the absolute column and row of the first cell: coarse cells are anchored at the
    CRS's origin.
    """
    lowest = _without_clumps(lowest, settings.clump_m, *corner, pit_depth_mm)
    ground = _lowest_of_cells(lowest, settings.seed_cell_m, *corner)
    step = 1000.0 * (settings.max_distance_m + settings.distance_rise * settings.seed_cell_m / settings.level_ratio)
    _without_cut_off(lowest, ground, settings.seed_cell_m, corner, step)
    noise, sine = 1000.0 * settings.noise_m, math.sin(math.radians(settings.max_angle_deg))
    for level in settings.levels():
        distance = 1000.0 * (settings.max_distance_m + settings.distance_rise * level.cell)
        asked = _lowest_of_cells(lowest, level.cell, *corner) & ~ground
        joined, judged = join_facets(lowest, ground, asked, level.reach, (distance, noise, sine))
        join_planes(lowest, ground, asked & ~judged, joined, level.reach, (distance, noise, settings.lone_slope))
        ground = ground | joined
    return ground


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
