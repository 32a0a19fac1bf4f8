"""The morphological ground filter: openings of growing size, first on elevations, then on heights above a trend.

An object is what one step of a growing opening cuts off (Zhang et al. 2003; the rule that the step may take more the
wider the opening, and the surface with its gaps closed, are those of SMRF: Pingel, Clarke and McBride 2013). On a slope
an opening cannot see an object lower than the slope rises between two points. So the openings run twice: the first
gives a provisional ground, and the second works on heights above its trend, where slopes are gone. Wide objects and
decks between two walls are told apart beside that. What brows, crests and terraces lose comes back from the ground
beside it on the same level.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray
from pipeline.parameters import Parameters, parameter
from pipeline.terrain.between_walls import between_walls, between_walls_support_m
from pipeline.terrain.lattice import NO_DATA, PIT_CELLS, Elevations
from pipeline.terrain.openings import cut_off
from pipeline.terrain.planar_fitting import leaning_planes
from pipeline.terrain.wide_objects import wide_objects, wide_support_m, with_corners

_GAP_CELLS = 4
"""Gaps between points are closed from their rims so far, and as many rounds of relaxation smooth the fill."""

_STEEPEST = 1.5
"""Rise over run from which on the trend's slope allows the second openings no more."""

_CLUMP_CELLS = 6
"""Half side of the square in which a clump of low outliers must be rare."""

_CLUMP_SHARE = 0.1
"""A clump holds at most this share of the cells around it, or four."""

_CLUMP_BAND_MM = 750
"""Cells count as of the clump up to so far above the one in question."""

_FEWEST_BESIDE = 2
"""Ground cells on its level that a cell needs beside it to come back."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class MorphologicalFilterSettings(Parameters):
    """Sizes of the openings and what they may take; read only where the filter is morphological."""

    max_window_m: int = parameter(
        20,
        "Largest radius of the openings on the terrain lattice; wider objects are looked for on a coarse one.",
        unit="m",
        minimum=2,
        maximum=60,
    )
    window_slope: float = parameter(
        0.15,
        "What a step of the first openings may take, for each metre of their radius.",
        minimum=0.01,
        maximum=2.0,
    )
    residual_slope: float = parameter(
        0.1,
        "The same of the second openings, which work on heights above the trend of the first ground.",
        minimum=0.01,
        maximum=2.0,
    )
    residual_step_m: float = parameter(
        0.15, "What a step of the second openings may always take.", unit="m", minimum=0.0, maximum=3.0
    )
    residual_steepness_m: float = parameter(
        0.3,
        "What it may take more where the trend rises by 45 degrees, in proportion elsewhere: steep ground is rough.",
        unit="m",
        minimum=0.0,
        maximum=3.0,
    )
    trend_m: int = parameter(
        10,
        "Half side of the squares of the trend's planes; twice as much where they hold little ground.",
        unit="m",
        minimum=4,
        maximum=40,
    )
    clump_depth_m: float = parameter(
        4.0,
        "Few cells that lie deeper below the trend are a clump of low outliers.",
        unit="m",
        minimum=0.5,
        maximum=50.0,
    )
    widest_m: int = parameter(
        102,
        "Objects up to this width are cut off on a coarse lattice, where they are high enough for wide_slope.",
        unit="m",
        minimum=0,
        maximum=240,
    )
    wide_slope: float = parameter(
        0.12,
        "What a step of these openings may take, for each metre of their radius: so high are wide objects at least.",
        minimum=0.01,
        maximum=2.0,
    )
    wall_drop_m: float = parameter(
        1.0,
        "Decks and roofs between two parallel drops are no ground where both are deeper than this, and than wide_slope "
        "times half the width between them; up to widest_m wide.",
        unit="m",
        minimum=0.2,
        maximum=20.0,
    )
    regrowth_passes: int = parameter(
        3, "How often what lies level with the ground beside it joins the ground.", minimum=0, maximum=10
    )
    regrowth_m: int = parameter(3, "Half side of the square that is beside.", unit="m", minimum=1, maximum=10)
    regrowth_step_m: float = parameter(
        0.2, "Highest that a cell may lie above ground beside it.", unit="m", minimum=0.0, maximum=3.0
    )
    regrowth_share: float = parameter(
        0.3, "Least share of the ground beside it above which it lies no higher.", minimum=0.0, maximum=1.0
    )
    terrace_passes: int = parameter(
        2, "How often wide objects join the ground after that, which are terraces then.", minimum=0, maximum=10
    )
    terrace_share: float = parameter(
        0.7, "The share of the ground beside it that this asks for.", minimum=0.0, maximum=1.0
    )

    @property
    def morphological_support_m(self) -> float:
        """How far the filter looks: the sum of its chain, or the wide objects beside it."""
        chain = 4 * _GAP_CELLS + 4 * self.max_window_m + 2 * self.trend_m + _CLUMP_CELLS
        wide = wide_support_m(self.widest_m // 2) if self.looks_for_wide else 0.0
        walls = between_walls_support_m(self.deck_m)
        grown = (self.regrowth_passes + self.terrace_passes) * self.regrowth_m
        return PIT_CELLS + max(float(chain), wide, walls) + grown

    @property
    def looks_for_wide(self) -> bool:
        """Whether there are objects to cut off that max_window_m leaves."""
        return self.widest_m > 2 * self.max_window_m

    @property
    def deck_m(self) -> int:
        """Widest that a deck between two walls may be."""
        return max(self.widest_m, 2 * self.max_window_m)


@kernel
def closed_gaps(lowest: Elevations, reach: int) -> Elevations:
    """The surface of the lowest points with gaps closed up to reach cells from their rims.

    Round by round a cell takes the mean of the filled ones around it, then the fill is relaxed as often. Beyond, and
    beyond the data's edge, there stays NO_DATA.
    """
    rows, columns = lowest.shape
    out = lowest.copy()
    for number in range(2 * reach):
        before = out.copy()
        changed = False
        for r in range(rows):
            for c in range(columns):
                # the first half of the rounds fills, the second smooths what was filled
                if lowest[r, c] != NO_DATA or (before[r, c] == NO_DATA) != (number < reach):
                    continue
                n, total = 0, 0
                for a in range(max(r - 1, 0), min(r + 2, rows)):
                    for b in range(max(c - 1, 0), min(c + 2, columns)):
                        if before[a, b] != NO_DATA and (number < reach or (a == r) != (b == c)):
                            n += 1
                            total += before[a, b]
                if n > 0:
                    out[r, c] = total // n
                    changed = True
        if not changed and number >= reach:
            break
    return out


@kernel
def without_clumps(lowest: Elevations, level: Elevations, slope_mm: Elevations, deep_mm: int) -> Elevations:
    """Clear cells far below the trend that few around them share: clumps of low outliers.

    Parameters
    ----------
    lowest, level, slope_mm : (rows, columns) int32
        Lowest points, the trend and its rise in mm a cell.
    deep_mm : int
        Depth below the trend, on level ground; as much more as the trend rises over a cell.
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
            for a in range(max(r - _CLUMP_CELLS, 0), min(r + _CLUMP_CELLS + 1, rows)):
                for b in range(max(c - _CLUMP_CELLS, 0), min(c + _CLUMP_CELLS + 1, columns)):
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
def regrown(
    lowest: Elevations, ground: BoolArray, barred: BoolArray, passes: int, limits: tuple[int, int, float]
) -> BoolArray:
    """Ground, and the cells level with the ground beside them.

    Most of the ground beside a brow, the rim of a terrace or the crest of a dam lies along its contour; a roof has
    none on its level, and a bush on a slope only some of it, uphill.

    Parameters
    ----------
    lowest : (rows, columns) int32
        Elevations in mm.
    ground, barred : (rows, columns) bool
        Where it starts, and what never joins.
    passes : int
        How often.
    limits : tuple
        Half side of the square beside in cells, highest step up in mm, least share of the square's ground on the level.
    """
    reach, step_mm, share = limits
    rows, columns = lowest.shape
    for _ in range(passes):
        out = ground.copy()
        for r in range(rows):
            for c in range(columns):
                if ground[r, c] or lowest[r, c] == NO_DATA or barred[r, c]:
                    continue
                beside, level = 0, 0
                for a in range(max(r - reach, 0), min(r + reach + 1, rows)):
                    for b in range(max(c - reach, 0), min(c + reach + 1, columns)):
                        if ground[a, b]:
                            beside += 1
                            if lowest[r, c] - lowest[a, b] <= step_mm:
                                level += 1
                out[r, c] = level >= _FEWEST_BESIDE and level >= share * beside
        ground = out
    return ground


def morphological_ground(
    lowest: Elevations, corner: tuple[int, int], settings: MorphologicalFilterSettings
) -> BoolArray:
    """Mask of the cells that hold ground.

    Parameters
    ----------
    lowest : (rows, columns) int32
        Elevation in mm of the lowest point of each cell, single pits cleared; NO_DATA where there is none.
    corner : tuple of int
        Absolute column and row of the first cell: coarse cells are anchored at the CRS's origin.
    settings : MorphologicalFilterSettings
        Openings and tests.

    Returns
    -------
    (rows, columns) bool
        Ground; none where there is no data.
    """
    radius = settings.max_window_m
    elevation = closed_gaps(lowest, _GAP_CELLS)
    nothing = np.zeros(lowest.shape, np.int32)
    first = cut_off(elevation, nothing, settings.window_slope * 1000.0, radius)
    is_first = (lowest != NO_DATA) & (first == 0)
    level, slope_mm = leaning_planes(lowest, is_first, settings.trend_m, 2 * settings.trend_m)
    if settings.looks_for_wide:
        wide = wide_objects(lowest, corner, radius, settings.widest_m // 2, settings.wide_slope * 1000.0)
        wide = with_corners(lowest, wide, first)
    else:
        wide = np.zeros(lowest.shape, np.bool_)
    decks = between_walls(lowest, settings.deck_m, settings.wall_drop_m * 1000.0, settings.wide_slope * 1000.0)
    lowest = without_clumps(lowest, level, slope_mm, round(settings.clump_depth_m * 1000))
    limits = (round(settings.residual_step_m * 1000), settings.residual_steepness_m * 1000.0)
    height, base = _heights(lowest, level, slope_mm, limits)
    second = cut_off(closed_gaps(height, _GAP_CELLS), base, settings.residual_slope * 1000.0, radius)
    ground = (lowest != NO_DATA) & (second == 0) & ~wide & ~decks
    step_mm = round(settings.regrowth_step_m * 1000)
    beside = (settings.regrowth_m, step_mm, settings.regrowth_share)
    ground = regrown(lowest, ground, wide | decks, settings.regrowth_passes, beside)
    beside = (settings.regrowth_m, step_mm, settings.terrace_share)
    found: BoolArray = regrown(lowest, ground, decks, settings.terrace_passes, beside)
    return found
