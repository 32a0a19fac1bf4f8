"""The roofs of two epochs on one raster: the heights of both, and the parts that differ.

Every group of buildings that belong together gets a raster of its own. It starts at the lower left corner of the
footprints, so the result does not depend on the location. A cell takes the highest roof face over its middle. Roofs of
neighbouring buildings count as covered too: if two epochs divide one roof differently between neighbours, nothing
changed. Parts must be wide enough to count: each is opened (eroded, then dilated) by a disc as wide as the narrowest
part (J. Serra: Image analysis and mathematical morphology, 1982).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, FloatArray, IntArray

CELLS_PER_WIDTH = 5
"""Cells across the narrowest part that counts: the disc is 5 x 5 cells without its corners."""
MAX_CELLS = 4_000_000
"""Bound on the memory of one group: a larger group gets larger cells."""

COMMON_M2, MEDIAN_M, UNIFORM_M, SHIFT_M, DIFFERENCE_M = 0, 1, 2, 3, 4
ADDED_M2, REMOVED_M2, RAISED_M2, LOWERED_M2, FORM_M2 = 5, 6, 7, 8, 9
GAINED_M3, LOST_M3, FORM_M3, MAX_RAISE_M, MAX_DROP_M, ROUGH_M2 = 10, 11, 12, 13, 14, 15
N_FIGURES = 16
"""Columns of the figures of `compare_roofs`."""

_NOTHING = -1.0e30
"""Height of a cell without a roof."""


class RoofFaces(NamedTuple):
    """Roof faces of many buildings, in metres."""

    xy: FloatArray
    """(v, 2) float64, corners in plan; every ring is closed."""
    rings: IntArray
    """(r + 1,) int64, where each ring begins in `xy`."""
    faces: IntArray
    """(f + 1,) int64, where each face begins in `rings`; the rings of a face are filled by the even-odd rule."""
    planes: FloatArray
    """(f, 5) float64: easting and northing of a place, elevation there, rise per metre of easting and of northing."""
    is_rough: BoolArray
    """(f,) bool, True where the points scatter about the face: it may stand on a tree."""


class RoofGroups(NamedTuple):
    """The faces of each group, and its limits."""

    starts: IntArray
    """(g + 1,) int64, where each group begins in the three arrays below."""
    face: IntArray
    """(e,) int64, index of a face."""
    is_new: BoolArray
    """(e,) bool, True for a face of the later epoch."""
    is_own: BoolArray
    """(e,) bool, True for a building of the group, False for a neighbour."""
    boxes: FloatArray
    """(g, 4) float64, bounds of the group's own footprints in metres: west, south, east, north."""
    width_m: FloatArray
    """(g,) float64, the narrowest part that counts."""
    height_m: FloatArray
    """(g,) float64, the least difference of height that counts."""
    ground_m: FloatArray
    """(g, 2) float64, elevation of the ground in the earlier and the later epoch: added and removed parts rise from
    it."""


class _Grid(NamedTuple):
    """The raster of one group, metres."""

    west: float
    """Easting of its lower left corner."""
    south: float
    cell: float


class _Limits(NamedTuple):
    """What counts in one group."""

    height: float
    """Least difference of height, metres."""
    ground_before: float
    """Elevation of the ground in the earlier epoch, metres."""
    ground_after: float
    """The same in the later epoch."""
    share: float
    """Share of the common roof that must be higher (lower) for a shift of the whole."""
    shift: float
    """Subtracted from every difference, metres."""


def compare_roofs(faces: RoofFaces, groups: RoofGroups, uniform_share: float, vertical_shift_m: float) -> FloatArray:
    """Figures of each group, (g, 16) float64.

    By column: area where both epochs have a roof; the median difference there; the difference that at least
    `uniform_share` of that area reaches, 0 without a common sign; the shift: the same if it counts, else 0; the mean
    absolute difference; the areas added, removed, raised, lowered, and with another form (besides the shift); the
    volume gained, lost, and of the parts with another form or outline; the largest rise and drop of parts that count;
    the area of parts with another form or outline on rough faces. Median and mean are nan without a common roof.

    `uniform_share` of the common roof must be higher (lower) for a shift of the whole. `vertical_shift_m` is subtracted
    from every difference, later less earlier.
    """
    figures = np.zeros((len(groups.starts) - 1, N_FIGURES))
    _compare_all(faces, groups, uniform_share, vertical_shift_m, figures)
    return figures


@kernel
def _compare_all(faces: RoofFaces, groups: RoofGroups, share: float, shift: float, figures: FloatArray) -> None:
    starts, boxes = groups.starts, groups.boxes
    for group in range(len(starts) - 1):
        west, south = boxes[group, 0], boxes[group, 1]
        cell = groups.width_m[group] / CELLS_PER_WIDTH
        columns = math.ceil((boxes[group, 2] - west) / cell) + 1
        rows = math.ceil((boxes[group, 3] - south) / cell) + 1
        while columns * rows > MAX_CELLS:
            cell *= 2.0
            columns, rows = columns // 2 + 1, rows // 2 + 1
        grid = _Grid(west, south, cell)
        before, after = np.full((rows, columns), _NOTHING), np.full((rows, columns), _NOTHING)
        own = np.zeros((rows, columns), np.bool_)
        rough_before, rough_after = np.zeros((rows, columns), np.bool_), np.zeros((rows, columns), np.bool_)
        for entry in range(starts[group], starts[group + 1]):
            heights, rough = (after, rough_after) if groups.is_new[entry] else (before, rough_before)
            _fill(faces, groups.face[entry], groups.is_own[entry], grid, heights, rough, own)
        limits = _Limits(groups.height_m[group], groups.ground_m[group, 0], groups.ground_m[group, 1], share, shift)
        _figures_of(before, after, own, rough_before | rough_after, cell * cell, limits, figures[group])


@kernel
def _fill(
    roofs: RoofFaces, face: int, is_own: bool, grid: _Grid, heights: FloatArray, rough: BoolArray, own: BoolArray
) -> None:
    """Draw a face into a raster of heights (rows, columns) by the even-odd rule at cell middles; the highest stays."""
    west, south, cell = grid
    xy, rings, faces, planes, is_rough = roofs.xy, roofs.rings, roofs.faces, roofs.planes, roofs.is_rough[face]
    rows, columns = heights.shape
    first, last = rings[faces[face]], rings[faces[face + 1]]
    if last - first < 3:
        return
    low, high = xy[first, 1], xy[first, 1]
    for corner in range(first, last):
        low, high = min(low, xy[corner, 1]), max(high, xy[corner, 1])
    row_from = max(0, math.floor((low - south) / cell - 0.5))
    row_to = min(rows, math.ceil((high - south) / cell + 0.5))
    crossings = np.empty(last - first)
    for row in range(row_from, row_to):
        y = south + (row + 0.5) * cell
        count = 0
        for ring in range(faces[face], faces[face + 1]):
            for corner in range(rings[ring], rings[ring + 1] - 1):
                y0, y1 = xy[corner, 1], xy[corner + 1, 1]
                if (y0 <= y) != (y1 <= y):
                    x0, x1 = xy[corner, 0], xy[corner + 1, 0]
                    crossings[count] = x0 + (y - y0) / (y1 - y0) * (x1 - x0)
                    count += 1
        if count < 2:
            continue
        crossings[:count].sort()
        for pair in range(0, count - 1, 2):
            column_from = max(0, math.ceil((crossings[pair] - west) / cell - 0.5))
            column_to = min(columns, math.ceil((crossings[pair + 1] - west) / cell - 0.5))
            for column in range(column_from, column_to):
                x = west + (column + 0.5) * cell
                z = planes[face, 2] + planes[face, 3] * (x - planes[face, 0]) + planes[face, 4] * (y - planes[face, 1])
                if z > heights[row, column]:
                    heights[row, column], rough[row, column] = z, is_rough
                own[row, column] |= is_own


@kernel(inline="always")
def _shift_of(values: FloatArray, share: float, min_m: float, figures: FloatArray) -> float:
    """Write median and uniform difference of values (n,) in metres, n > 0; returns the shift that counts, else 0."""
    ordered = np.sort(values)
    count = len(ordered)
    # The mean of the middle two of an even number: exchanging the epochs only turns the sign.
    figures[MEDIAN_M] = 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])
    rank = math.floor((1.0 - share) * (count - 1))
    lowest, highest = ordered[rank], ordered[count - 1 - rank]
    uniform = lowest if lowest > 0.0 else min(highest, 0.0)
    figures[UNIFORM_M] = uniform
    moved: float = uniform if abs(uniform) >= min_m else 0.0
    figures[SHIFT_M] = moved
    return moved


@kernel
def _figures_of(
    before: FloatArray,
    after: FloatArray,
    own: BoolArray,
    rough: BoolArray,
    area: float,
    limits: _Limits,
    figures: FloatArray,
) -> None:
    """Write the figures of one group from rasters (rows, columns) with cells of an area in square metres."""
    rows, columns = own.shape
    min_m = limits.height
    difference = np.zeros((rows, columns))
    common, added, removed = np.zeros_like(own), np.zeros_like(own), np.zeros_like(own)
    values = np.empty(rows * columns)
    count, total = 0, 0.0
    for row in range(rows):
        for column in range(columns):
            if not own[row, column]:
                continue
            was, is_there = before[row, column] > _NOTHING, after[row, column] > _NOTHING
            if was and is_there:
                rise = after[row, column] - before[row, column] - limits.shift
                difference[row, column], common[row, column] = rise, True
                values[count] = rise
                total += abs(rise)
                count += 1
            else:
                added[row, column], removed[row, column] = is_there, was
    figures[MEDIAN_M] = figures[DIFFERENCE_M] = np.nan
    moved = 0.0
    if count > 0:
        moved = _shift_of(values[:count], limits.share, min_m, figures)
        figures[COMMON_M2], figures[DIFFERENCE_M] = count * area, total / count
    raised, lowered = common & (difference >= min_m), common & (difference <= -min_m)
    higher, lower = common & (difference - moved >= min_m), common & (difference - moved <= -min_m)
    for mask in (added, removed, raised, lowered, higher, lower):
        _open(mask)
    for row in range(rows):
        for column in range(columns):
            rise = difference[row, column]
            if added[row, column]:
                height = max(after[row, column] - limits.ground_after, 0.0)
                figures[ADDED_M2] += area
                figures[GAINED_M3] += height * area
                figures[FORM_M3] += height * area
            elif removed[row, column]:
                height = max(before[row, column] - limits.ground_before, 0.0)
                figures[REMOVED_M2] += area
                figures[LOST_M3] += height * area
                figures[FORM_M3] += height * area
            if raised[row, column]:
                figures[RAISED_M2] += area
                figures[GAINED_M3] += rise * area
                figures[MAX_RAISE_M] = max(figures[MAX_RAISE_M], rise)
            elif lowered[row, column]:
                figures[LOWERED_M2] += area
                figures[LOST_M3] -= rise * area
                figures[MAX_DROP_M] = max(figures[MAX_DROP_M], -rise)
            formed = higher[row, column] or lower[row, column]
            if formed:
                figures[FORM_M2] += area
                figures[FORM_M3] += abs(rise - moved) * area
            if rough[row, column] and (formed or added[row, column] or removed[row, column]):
                figures[ROUGH_M2] += area


@kernel
def _open(mask: BoolArray) -> None:
    """Keep the cells of a mask that a disc of 5 x 5 cells without corners covers where it fits; in place."""
    rows, columns = mask.shape
    kept = np.zeros((rows, columns), np.bool_)
    for row in range(2, rows - 2):
        for column in range(2, columns - 2):
            if mask[row, column] and _fits(mask, row, column):
                for i in range(-2, 3):
                    for j in range(-2, 3):
                        if abs(i) + abs(j) < 4:
                            kept[row + i, column + j] = True
    for row in range(rows):
        for column in range(columns):
            mask[row, column] = kept[row, column]


@kernel
def _fits(mask: BoolArray, row: int, column: int) -> bool:
    """Whether the disc around a cell, at least two cells from the border, lies in the mask."""
    for i in range(-2, 3):
        for j in range(-2, 3):
            if abs(i) + abs(j) < 4 and not mask[row + i, column + j]:
                return False
    return True
