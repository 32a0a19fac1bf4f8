"""The morphological ground filter: openings of growing size, first on elevations, then on heights above a trend.

One step of a growing opening cuts off an object (Zhang et al. 2003). A step may remove more the wider the opening is,
and gaps in the surface are closed first (SMRF: Pingel, Clarke and McBride 2013). On a slope an opening cannot see an
object that is lower than the slope rises between two points. Therefore openings run twice: the first give a provisional
ground, the second work on heights above its trend, without slopes. Wide objects and decks between two walls are found
separately. Brows, crests and terraces that were lost rejoin the ground beside them on the same level or plane, and
embankments as whole surfaces.
"""

from __future__ import annotations

import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, LabelArray
from pipeline.terrain.between_walls import between_walls
from pipeline.terrain.embankments import embankments
from pipeline.terrain.filter_settings import FoundGround, MorphologicalFilterSettings
from pipeline.terrain.lattice import NO_DATA, Elevations, Part, part_around
from pipeline.terrain.openings import cut_off
from pipeline.terrain.planar_fitting import plane_around, plane_sums, sum_within
from pipeline.terrain.reach import CLUMP_CELLS, GAP_CELLS
from pipeline.terrain.rejoining import rejoined
from pipeline.terrain.terrain_settings import GroundSettings
from pipeline.terrain.wide_objects import wide_objects, with_corners

_STEEPEST = 1.5
"""Rise over run beyond which a steeper trend does not allow the second openings more: ground is seldom steeper."""

_WALL_MM = 2000
"""Two neighbours of a cell, 2 m apart, lie on two sides of a wall if they differ by more: steeper than 45 degrees."""

_CLUMP_SHARE = 0.1
"""A clump holds at most this share of the cells around it, or four."""

_CLUMP_BAND_MM = 750
"""Cells up to this far above the one in question belong to its clump."""

_HOUSE_CELLS = 6
"""What openings up to this radius cut off is at most 13 m wide, as houses are, and not an embankment."""

_FEWEST_BESIDE = 2
"""Ground cells on the same level that a cell needs beside it to rejoin: one may be an outlier."""

_ENOUGH_BESIDE = 4
"""Ground cells that show what lies beside a cell: twice as many as must agree. Farther ones do not count."""


_LOW = np.int32(-(2**30))
"""Below all elevations in mm."""


@kernel
def _mean_beside(surface: Elevations, at: int, width: int, is_fill: bool) -> int:
    """Mean of the cells beside one that lie within `_WALL_MM` of its level, or NO_DATA without any; in mm.

    `surface` holds rows of `width` cells, one after the other. The eight cells around a cell fill it, at the level of
    the lowest; the four beside a filled cell smooth it.
    """
    level = surface[at]
    if is_fill:
        for row in range(at - width, at + width + 1, width):
            for k in range(row - 1, row + 2):
                level = min(level, surface[k])
    n = total = np.int64(0)
    for down in range(-1, 2):
        for across in range(-1, 2):
            if not is_fill and (down == 0) == (across == 0):
                continue
            beside = np.int64(surface[at + down * width + across])
            # without a branch: which cells count is hard to foresee
            counts = np.int64((beside != NO_DATA) & (abs(beside - level) <= _WALL_MM))
            n += counts
            total += counts * beside
    return int(total // n) if n > 0 else int(NO_DATA)


@kernel
def _queue_rims(queue: LabelArray, is_done: BoolArray, surface: Elevations, width: int) -> int:
    """Put the empty cells beside cells with data into the queue; how many these are. `surface` as in `_mean_beside`.

    `is_done` holds for the cells with data and in the queue, and for the frame.
    """
    end = 0
    for at in range(width, surface.size - width):
        if is_done[at]:
            continue
        lowest = NO_DATA
        for row in range(at - width, at + width + 1, width):
            lowest = min(lowest, surface[row - 1], surface[row], surface[row + 1])
        if lowest != NO_DATA:
            queue[end], is_done[at] = at, True
            end += 1
    return end


@kernel
def _queue_beside(queue: LabelArray, is_done: BoolArray, part: tuple[int, int], width: int) -> int:
    """Add the empty cells beside those of the queue's last part, its first member and its end; the new end."""
    end = part[1]
    for i in range(part[0], part[1]):
        for row in range(queue[i] - width, queue[i] + width + 1, width):
            for at in range(row - 1, row + 2):
                if not is_done[at]:
                    queue[end], is_done[at] = at, True
                    end += 1
    return end


@kernel
def closed_gaps(lowest: Elevations, reach: int) -> Elevations:
    """The surface of the lowest points with gaps closed up to reach cells from their rims; elevations are in mm.

    Round by round an empty cell takes the mean of the filled ones around it, from the lowest up to `_WALL_MM` higher.
    Then the fill is relaxed as often, and a cell takes no neighbour that lies farther than that from it. A wall in a
    gap thus stays a wall and becomes no ramp, and does not move to its foot. Beyond, and beyond the data's edge, there
    stays NO_DATA.
    """
    rows, columns = lowest.shape
    width = columns + 2
    # a frame of one cell spares tests for the edge
    framed = np.full((rows + 2, width), NO_DATA, np.int32)
    framed[1:-1, 1:-1] = lowest
    surface = framed.ravel()
    # the cells that are filled, round by round, and what they become when all cells of a round are known
    queue, becomes = np.empty(lowest.size, np.int32), np.empty(lowest.size, np.int32)
    is_queued = np.ones((rows + 2, width), np.bool_)
    is_queued[1:-1, 1:-1] = lowest != NO_DATA
    is_done = is_queued.ravel()
    first, end = 0, _queue_rims(queue, is_done, surface, width)
    for number in range(reach):
        for i in range(first, end):
            becomes[i] = _mean_beside(surface, queue[i], width, True)
        for i in range(first, end):
            surface[queue[i]] = becomes[i]
        if number == reach - 1:
            break
        # the next round fills the cells beside those of this one
        first, end = end, _queue_beside(queue, is_done, (first, end), width)
    for _ in range(reach):
        for i in range(end):
            becomes[i] = _mean_beside(surface, queue[i], width, False)
        for i in range(end):
            if becomes[i] != NO_DATA:
                surface[queue[i]] = becomes[i]
    return framed[1:-1, 1:-1].copy()


@kernel
def without_clumps(lowest: Elevations, level: Elevations, slope_mm: Elevations, deep_mm: int) -> Elevations:
    """Clear cells far below the trend that few around them share: clumps of low outliers.

    From the lowest points, the trend and its rise in mm a cell. Cells lie `deep_mm` below the trend on level ground,
    and as much more as the trend rises over a cell.
    """
    rows, columns = lowest.shape
    out = lowest.copy()
    for r in range(rows):
        for c in range(columns):
            if lowest[r, c] == NO_DATA or level[r, c] == NO_DATA:
                continue
            height = lowest[r, c] - level[r, c]
            if height >= -deep_mm - slope_mm[r, c]:
                continue
            cells, low = 0, 0
            for a in range(max(r - CLUMP_CELLS, 0), min(r + CLUMP_CELLS + 1, rows)):
                for b in range(max(c - CLUMP_CELLS, 0), min(c + CLUMP_CELLS + 1, columns)):
                    if lowest[a, b] != NO_DATA and level[a, b] != NO_DATA:
                        cells += 1
                        if lowest[a, b] - level[a, b] <= height + _CLUMP_BAND_MM:
                            low += 1
            if low <= max(4.0, _CLUMP_SHARE * cells):
                out[r, c] = NO_DATA
    return out


@kernel
def _heights(
    lowest: Elevations, level: Elevations, slope_mm: Elevations, limits: tuple[int, float]
) -> tuple[Elevations, Elevations]:
    """Heights of the lowest points above the trend, and what the second openings may always take; both in mm.

    `limits` are that base, and what the trend's slope adds to it as a length in mm.
    """
    base_mm, steepness_mm = limits
    rows, columns = lowest.shape
    height = np.full((rows, columns), NO_DATA, np.int32)
    base = np.zeros((rows, columns), np.int32)
    for r in range(rows):
        for c in range(columns):
            base[r, c] = base_mm + round(steepness_mm * min(slope_mm[r, c] / 1000.0, _STEEPEST))
            if lowest[r, c] != NO_DATA and level[r, c] != NO_DATA:
                height[r, c] = lowest[r, c] - level[r, c]
    return height, base


@kernel
def _highest_ground(lowest: Elevations, ground: BoolArray, reach: int) -> Elevations:
    """Elevation in mm of the highest ground in the square of 2 reach + 1 cells around each cell; `_LOW` without any."""
    rows, columns = lowest.shape
    own, out = np.empty((rows, columns), np.int32), np.full((rows, columns), _LOW, np.int32)
    for r in range(rows):
        for c in range(columns):
            z = lowest[r, c]
            own[r, c] = z if ground[r, c] else _LOW
    for r in range(rows):
        column = np.full(columns + 2 * reach, _LOW, np.int32)
        middle, square = column[reach : reach + columns], out[r]
        for a in range(max(r - reach, 0), min(r + reach + 1, rows)):
            other = own[a]
            for c in range(columns):
                middle[c] = max(middle[c], other[c])
        for shift in range(2 * reach + 1):
            other = column[shift : shift + columns]
            for c in range(columns):
                square[c] = max(square[c], other[c])
    return out


@kernel
def regrown(
    lowest: Elevations, ground: BoolArray, barred: BoolArray, passes: int, limits: tuple[int, int, float, float]
) -> BoolArray:
    """Ground, and the cells level with the nearest ground around them; elevations are in mm.

    Most of the ground beside a brow, the rim of a terrace or the crest of a dam lies along its contour; a roof has none
    on its level, and a bush on a slope only some of it, uphill. The nearest ground is that of the smallest square with
    at least `_ENOUGH_BESIDE` cells of it.

    Parameters
    ----------
    ground, barred : (rows, columns) bool
        Where it starts, and what never joins.
    passes : int
        How often.
    limits : tuple
        Half side of the largest square in cells; highest step up in mm; its increase in mm per cell of distance; least
        share of the nearest ground that lies no deeper.
    """
    reach, step_mm, rise_mm, share = limits
    rows, columns = lowest.shape
    most = step_mm + rise_mm * math.sqrt(2 * reach * reach)
    for _ in range(passes):
        out = ground.copy()
        highest = _highest_ground(lowest, ground, reach)
        for r in range(rows):
            for c in range(columns):
                # higher above all ground of the largest square than any of it allows; so are most trees and roofs
                if lowest[r, c] - highest[r, c] > most:
                    continue
                if ground[r, c] or lowest[r, c] == NO_DATA or barred[r, c]:
                    continue
                beside, level, half = 0, 0, 0
                while half < reach and beside < _ENOUGH_BESIDE:
                    half += 1
                    for a in range(max(r - half, 0), min(r + half + 1, rows)):
                        step = 1 if abs(a - r) == half else 2 * half
                        for b in range(c - half, c + half + 1, step):
                            if 0 <= b < columns and ground[a, b]:
                                beside += 1
                                away = math.sqrt((a - r) * (a - r) + (b - c) * (b - c))
                                if lowest[r, c] - lowest[a, b] <= step_mm + rise_mm * away:
                                    level += 1
                out[r, c] = level >= _FEWEST_BESIDE and level >= share * beside
        ground = out
    return ground


def found_ground(lowest: Elevations, corner: tuple[int, int], settings: GroundSettings, wanted: Part) -> FoundGround:
    """The cells that hold ground; see `morphological_ground`."""
    ground, steady = morphological_ground(lowest, corner, settings, (wanted, settings.reach_m))
    return FoundGround(ground, steady, (settings.rejoin_m, settings.rejoin_step_m * 1000.0))


def morphological_ground(
    lowest: Elevations,
    corner: tuple[int, int],
    settings: MorphologicalFilterSettings,
    wanted: tuple[Part, int] | None = None,
) -> tuple[BoolArray, BoolArray]:
    """Masks of the cells that hold ground, and of those among them that joined it before any did by planes.

    Both are False in cells without data.

    Parameters
    ----------
    lowest : (rows, columns) int32
        Elevation in mm of the lowest point of each cell, with single pits cleared and NO_DATA in empty cells.
    corner : tuple of int
        Absolute column and row of the first cell: coarse cells and blocks are anchored at the CRS's origin.
    wanted : tuple, optional
        The part where terrain is needed, everywhere by default, and how far it may be drawn, in cells. No step works
        where that cannot depend on it, and there the masks may miss ground.
    """
    shape, radius = lowest.shape, settings.max_window_m
    part, reach = wanted or ((slice(0, shape[0]), slice(0, shape[1])), 0)
    elevation = closed_gaps(lowest, GAP_CELLS)
    first = cut_off(elevation, np.zeros(shape, np.int32), settings.window_slope * 1000.0, radius)
    if settings.looks_for_wide:
        wide = wide_objects(lowest, corner, radius, settings.widest_m // 2, settings.wide_slope * 1000.0)
        wide = with_corners(lowest, wide, first)
    else:
        wide = np.zeros(shape, np.bool_)
    decks = between_walls(lowest, settings.deck_m, settings.wall_drop_m * 1000.0, settings.wide_slope * 1000.0)
    # the second openings, and before them the trend, only around what can still join
    late = part_around(part, settings.joining_support_m(reach), shape)
    around = part_around(late, settings.second_support_m, shape)
    lowest, cut = np.ascontiguousarray(lowest[around]), first[around]
    level, slope_mm = leaning_planes(lowest, (lowest != NO_DATA) & (cut == 0), settings.trend_m, 2 * settings.trend_m)
    lowest = without_clumps(lowest, level, slope_mm, round(settings.clump_depth_m * 1000))
    limits = (round(settings.residual_step_m * 1000), settings.residual_steepness_m * 1000.0)
    height, base = _heights(lowest, level, slope_mm, limits)
    narrow = settings.second_window_m
    second = cut_off(closed_gaps(height, GAP_CELLS), base, settings.residual_slope * 1000.0, narrow)
    inner = (
        slice(late[0].start - around[0].start, late[0].stop - around[0].start),
        slice(late[1].start - around[1].start, late[1].stop - around[1].start),
    )
    lowest, second = np.ascontiguousarray(lowest[inner]), second[inner]
    first, wide, decks = first[late], np.ascontiguousarray(wide[late]), np.ascontiguousarray(decks[late])
    # what only a wider opening sees is too wide for the second ones; on a slope it is high enough for the first
    ground = (lowest != NO_DATA) & (second == 0) & (first <= narrow) & ~wide & ~decks
    step_mm, share = round(settings.regrowth_step_m * 1000), settings.regrowth_share
    beside = (settings.regrowth_m, step_mm, 0.0, share)
    found, steady = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
    steady[late] = regrown(lowest, ground, wide | decks, settings.regrowth_passes, beside)
    limits_of_planes = (settings.rejoin_m, settings.rejoin_step_m * 1000.0)
    joined = rejoined(lowest, np.ascontiguousarray(steady[late]), decks, settings.rejoin_passes, limits_of_planes)
    beside = (settings.regrowth_m, step_mm, settings.berm_slope * 1000.0, share)
    last = min(settings.berm_passes, 1)
    joined = regrown(lowest, joined, decks, settings.berm_passes - last, beside)
    if settings.embankment_m2:
        houses = (second > 0) & (second <= _HOUSE_CELLS)
        place = (corner[0] + late[1].start, corner[1] + late[0].start)
        joined |= embankments(lowest, ground, (houses, wide), place, settings.embankment_m2) & ~decks
    found[late] = regrown(lowest, joined, decks, last, beside)
    return found, steady


_BLOCK = 64
"""Side in cells of the blocks of the trend, which have sums of their own: these stay in the processor's cache."""


MAX_LEAN = 0.6
"""Farthest that the centroid of a trend's square may lie from its middle, in half sides: 0.5 at a straight edge."""


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
