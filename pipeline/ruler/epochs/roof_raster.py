"""The roofs of two epochs over one another: heights of both on a raster, and the parts that differ.

Every group of buildings that belong together gets a raster of its own, laid over its footprints from their lower left
corner on, so that nothing depends on where the scene lies. A cell takes the highest roof face over its middle. What
another building of an epoch covers is covered too: where neighbours share out one roof in another way nothing changed.
Parts count only where they are wide enough: each is opened (eroded, then dilated) by a disc as wide as the narrowest
part (J. Serra: Image analysis and mathematical morphology, 1982).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, FloatArray, IntArray

CELLS_A_WIDTH = 5
"""Cells across the narrowest part that counts: the disc is 5 x 5 cells without its corners."""
MAX_CELLS = 4_000_000
"""Of one group; a larger one gets larger cells, so that no hall of a kilometre takes all the memory."""

COMMON_M2, MEDIAN_M, UNIFORM_M, SHIFT_M, DIFFERENCE_M = 0, 1, 2, 3, 4
ADDED_M2, REMOVED_M2, RAISED_M2, LOWERED_M2, FORM_M2 = 5, 6, 7, 8, 9
GAINED_M3, LOST_M3, FORM_M3, MAX_RAISE_M, MAX_DROP_M, ROUGH_M2 = 10, 11, 12, 13, 14, 15
N_FIGURES = 16
"""Columns of the figures of `compare_roofs`."""

_NOTHING = -1.0e30


class RoofFaces(NamedTuple):
    """Roof faces of many buildings, in metres."""

    xy: FloatArray
    """(v, 2) float64, corners in plan, every ring closed."""
    rings: IntArray
    """(r + 1,) int64, where each ring begins in `xy`."""
    faces: IntArray
    """(f + 1,) int64, where each face begins in `rings`; the rings of a face are filled by the even-odd rule."""
    planes: FloatArray
    """(f, 5) float64: easting and northing of a place, elevation there, rise per metre of easting and of northing."""
    is_rough: BoolArray
    """(f,) bool, True where the points scatter about the face: it may stand on a tree."""


class RoofGroups(NamedTuple):
    """Which faces each group looks at, and how."""

    starts: IntArray
    """(g + 1,) int64, where each group begins in the three arrays below."""
    face: IntArray
    """(e,) int64, index of a face."""
    is_new: BoolArray
    """(e,) bool, True of a face of the later epoch."""
    is_own: BoolArray
    """(e,) bool, True where the face is of a building of the group and not of a neighbour."""
    boxes: FloatArray
    """(g, 4) float64, bounds of the group's own footprints in metres: west, south, east, north."""
    width_m: FloatArray
    """(g,) float64, the narrowest part that counts."""
    height_m: FloatArray
    """(g,) float64, the least difference of height that counts."""
    ground_m: FloatArray
    """(g, 2) float64, elevation of the ground in the earlier and the later epoch, from which added and removed parts
    are measured."""


def compare_roofs(faces: RoofFaces, groups: RoofGroups, uniform_share: float, vertical_shift_m: float) -> FloatArray:
    """Figures of each group, (g, 16) float64.

    Parameters
    ----------
    faces : RoofFaces
        All faces that the groups name.
    groups : RoofGroups
        The groups.
    uniform_share : float
        Share of the common roof that must be higher (lower) for a shift of the whole.
    vertical_shift_m : float
        Taken from every difference, later less earlier.

    Returns
    -------
    (g, 16) float64
        By column: area over which both epochs have a roof; the median difference there; the difference that
        `uniform_share` of it reaches or surpasses, 0 where it has no one sign; the same where it counts, else 0 (the
        shift); mean absolute difference; areas added, removed, raised, lowered, and with another form (off
        the shift); volume gained, lost, and of the parts with another form or outline; largest rise and drop of parts
        that count; area of parts with another form or outline on rough faces. Median and mean are nan where there is no
        common roof.
    """
    figures = np.zeros((len(groups.starts) - 1, N_FIGURES))
    _compare_all(faces, groups, uniform_share, vertical_shift_m, figures)
    return figures


@kernel
def _compare_all(faces: RoofFaces, groups: RoofGroups, share: float, shift: float, figures: FloatArray) -> None:
    """Kernel of `compare_roofs`."""
    starts, boxes = groups.starts, groups.boxes
    for group in range(len(starts) - 1):
        west, south = boxes[group, 0], boxes[group, 1]
        cell = groups.width_m[group] / CELLS_A_WIDTH
        columns = math.ceil((boxes[group, 2] - west) / cell) + 1
        rows = math.ceil((boxes[group, 3] - south) / cell) + 1
        while columns * rows > MAX_CELLS:
            cell *= 2.0
            columns, rows = columns // 2 + 1, rows // 2 + 1
        before, after = np.full((rows, columns), _NOTHING), np.full((rows, columns), _NOTHING)
        own = np.zeros((rows, columns), np.bool_)
        rough_before, rough_after = np.zeros((rows, columns), np.bool_), np.zeros((rows, columns), np.bool_)
        for entry in range(starts[group], starts[group + 1]):
            heights, rough = (after, rough_after) if groups.is_new[entry] else (before, rough_before)
            _fill(faces, groups.face[entry], heights, rough, own, groups.is_own[entry], west, south, cell)
        rough = rough_before | rough_after
        _figures_of(
            before,
            after,
            own,
            rough,
            cell,
            groups.height_m[group],
            groups.ground_m[group],
            share,
            shift,
            figures[group],
        )


@kernel
def _fill(
    roofs: RoofFaces,
    face: int,
    heights: FloatArray,
    rough: BoolArray,
    own: BoolArray,
    is_own: bool,
    west: float,
    south: float,
    cell: float,
) -> None:
    """The face into a raster of heights, cell middles by the even-odd rule; the highest stays."""
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


@kernel
def _figures_of(
    before: FloatArray,
    after: FloatArray,
    own: BoolArray,
    rough: BoolArray,
    cell: float,
    min_m: float,
    ground_m: FloatArray,
    share: float,
    shift: float,
    figures: FloatArray,
) -> None:
    """The row of figures of one group."""
    rows, columns = own.shape
    area = cell * cell
    difference = np.zeros((rows, columns))
    common = np.zeros((rows, columns), np.bool_)
    added, removed = np.zeros((rows, columns), np.bool_), np.zeros((rows, columns), np.bool_)
    values = np.empty(rows * columns)
    count, total = 0, 0.0
    for row in range(rows):
        for column in range(columns):
            if not own[row, column]:
                continue
            was, is_there = before[row, column] > _NOTHING, after[row, column] > _NOTHING
            if was and is_there:
                rise = after[row, column] - before[row, column] - shift
                difference[row, column], common[row, column] = rise, True
                values[count] = rise
                total += abs(rise)
                count += 1
            else:
                added[row, column], removed[row, column] = is_there, was
    figures[MEDIAN_M] = figures[DIFFERENCE_M] = np.nan
    moved = 0.0
    if count > 0:
        ordered = np.sort(values[:count])
        # of an even number the mean of the middle two, so that exchanging the epochs only turns the sign
        median = 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])
        rank = math.floor((1.0 - share) * (count - 1))
        lowest, highest = ordered[rank], ordered[count - 1 - rank]
        uniform = lowest if lowest > 0.0 else min(highest, 0.0)
        moved = uniform if abs(uniform) >= min_m else 0.0
        figures[COMMON_M2] = count * area
        figures[MEDIAN_M], figures[UNIFORM_M], figures[SHIFT_M] = median, uniform, moved
        figures[DIFFERENCE_M] = total / count
    raised, lowered = common & (difference >= min_m), common & (difference <= -min_m)
    higher, lower = common & (difference - moved >= min_m), common & (difference - moved <= -min_m)
    for mask in (added, removed, raised, lowered, higher, lower):
        _open(mask)
    for row in range(rows):
        for column in range(columns):
            rise = difference[row, column]
            if added[row, column]:
                height = max(after[row, column] - ground_m[1], 0.0)
                figures[ADDED_M2] += area
                figures[GAINED_M3] += height * area
                figures[FORM_M3] += height * area
            elif removed[row, column]:
                height = max(before[row, column] - ground_m[0], 0.0)
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
    """What of a mask a disc of 5 x 5 cells without corners fits into, in place."""
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
    """Whether the disc about a cell, two cells or more from the border, lies in the mask."""
    for i in range(-2, 3):
        for j in range(-2, 3):
            if abs(i) + abs(j) < 4 and not mask[row + i, column + j]:
                return False
    return True
