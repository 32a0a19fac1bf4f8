"""Roofs alone: given footprints around which nothing was seen, as in points that were clipped to them.

The ground filter takes the lowest points for ground. If these are eaves, the roof itself would become ground, so the
filter does not get such cells. If the points were clipped with a margin, the ground lies at the rim, a wall's height
below the roofs: a roof falls to its eaves by its slope, and to the ground by a step. The least height of a step depends
on the slope of the roof, so that steep eaves are not ground and the ground beside low sheds is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.model import BoolArray
from pipeline.terrain.lattice import CELL_MM, NO_DATA, Elevations, Part, part_around

# None of these is a setting: they define what a roof alone is, in cells of 1 m.
_OVERHANG = 2
"""Cells this near to a footprint hold its eaves, or the margin with which points were clipped."""
_REACHES = (20, 60)
"""Around the box of a footprint, points are looked for so far. The wider square counts where the other meets footprints
only, as inside a block of houses."""
_OPEN = 0.1
"""Least share of such a square that lies outside all footprints, so that ground could have been seen."""
_SEEN = 0.1
"""Less than this share of the cells with points lies outside: stray points."""
_RIMS = (15, 60)
"""So far around a footprint the rim is judged as a whole, since an annex is lower than its house along a part of it.
The wider square counts where the other holds no rim."""
_LEVEL = 2
"""Cells of the rim this near to the foot of a step lie below it, too, if they are level with it."""
_STEP = 3
"""Cells this far apart are compared, since points leave gaps."""
_LEAST_MM, _SPARE_MM, _UNSURE = 1800, 600, 1.2
"""A step is higher than the first, and by the second higher than the roof's slope, times the third, explains."""
_STEEP, _FEWEST, _UNKNOWN_STEEP = 0.8, 12, 2.0
"""The roof is as steep as the first share of its cells at most. Fewer cells than the second do not tell: then it is as
steep as the third."""
_LEVEL_MM = 1000
"""Differs so much at most from the foot of a step."""
_PIECE = 64
"""Footprints wider than this are judged by the squares of a lattice, so that no verdict looks farther than known."""

SUPPORT_CELLS = _PIECE + max(_REACHES[-1], _RIMS[-1]) + _STEP + _LEVEL
"""How far the verdict on a cell looks."""

Counts = npt.NDArray[np.int32]


class _Piece(NamedTuple):
    """The cells of a footprint, or of a wide one in a square."""

    part: Part
    """Where they lie in the window."""
    cells: BoolArray
    """Which cells of the part have their centre in the footprint."""


def roofs_alone(
    lowest: Elevations, occupied: BoolArray, corner: tuple[int, int], outlines: Sequence[Polygon | MultiPolygon]
) -> BoolArray:
    """Which cells (rows, columns) belong to footprints around which nothing was seen, and hold no ground.

    Parameters
    ----------
    lowest : (rows, columns) int32
        Elevations in mm of the lowest points that may be ground; NO_DATA where there is none.
    occupied : (rows, columns) bool
        Cells that hold points.
    corner : tuple of int
        Absolute column and row of the first cell.
    outlines : sequence of Polygon or MultiPolygon
        The given footprints, in metres of the CRS.
    """
    pieces = [piece for outline in outlines for piece in _pieces(outline, corner, occupied.shape)]
    inside, alone = np.zeros_like(occupied), np.zeros_like(occupied)
    for part, cells in pieces:
        inside[part] |= cells
    near = _grown(inside, _OVERHANG)
    outside, beside, held = (_sums(mask) for mask in (~near, occupied & ~near, occupied & inside))
    bare = [_is_unsurrounded(piece.part, outside, beside, held) for piece in pieces]
    if not any(bare):
        return alone
    rim = near & (lowest != NO_DATA) & _grown(~inside, 1)
    rims = _sums(rim)
    for k, (part, cells) in enumerate(pieces):
        if bare[k]:
            reach = next((reach for reach in _RIMS if _count(rims, part, reach)), _OVERHANG)
            seen = part_around(part, reach, occupied.shape)
            below = _below_steps(lowest, part, cells, reach)
            rim_cells = np.count_nonzero(rim[seen])
            if rim_cells and 2 * np.count_nonzero(rim[seen] & below) >= rim_cells:
                bare[k] = False
                continue
            wide = part_around(part, _OVERHANG, occupied.shape)
            own = np.zeros_like(alone[wide])
            own[_within(part, wide)] = cells
            # beside a footprint lie eaves, and the ground of a yard
            alone[wide] |= _grown(own, _OVERHANG) & (inside[wide] | ~below[_within(wide, seen)])
    for found, (part, cells) in zip(bare, pieces, strict=True):
        if not found:
            alone[part] &= ~cells
    return alone


def _pieces(outline: Polygon | MultiPolygon, corner: tuple[int, int], shape: tuple[int, ...]) -> Iterator[_Piece]:
    """The pieces of a footprint in a window, from its first column and row and its shape."""
    shapely.prepare(outline)
    west, south, east, north = (math.floor(edge * 1000 / CELL_MM) for edge in outline.bounds)
    is_wide = max(east - west, north - south) >= _PIECE
    for row, last_row in _spans(south, north, is_wide=is_wide):
        for column, last_column in _spans(west, east, is_wide=is_wide):
            part = (
                slice(max(row - corner[1], 0), min(last_row + 1 - corner[1], shape[0])),
                slice(max(column - corner[0], 0), min(last_column + 1 - corner[0], shape[1])),
            )
            if part[0].start < part[0].stop and part[1].start < part[1].stop:
                y, x = (
                    np.arange(along.start, along.stop) + first for along, first in zip(part, corner[::-1], strict=True)
                )
                centres = np.meshgrid((x + 0.5) * CELL_MM / 1000, (y + 0.5) * CELL_MM / 1000)
                yield _Piece(part, shapely.contains_xy(outline, *centres))


def _spans(first: int, last: int, *, is_wide: bool) -> list[tuple[int, int]]:
    """First and last cells of the pieces along an axis."""
    if not is_wide:
        return [(first, last)]
    squares = range(first // _PIECE, last // _PIECE + 1)
    return [(max(first, k * _PIECE), min(last, (k + 1) * _PIECE - 1)) for k in squares]


def _is_unsurrounded(part: Part, outside: Counts, beside: Counts, held: Counts) -> bool:
    """Whether (nearly) no points lie around a part, farther than the overhang from all footprints; by `_sums`."""
    for reach in _REACHES:
        if _count(outside, part, reach) >= _OPEN * _area(part, reach):
            break
    return _count(beside, part, reach) < _SEEN * _count(held, part, reach)


def _below_steps(lowest: Elevations, part: Part, cells: BoolArray, reach: int) -> BoolArray:
    """Cells in and so far around a piece that lie beside, and level with, one a step below a cell near it."""
    steep = _UNSURE * _steepness(lowest, part, cells)
    window = part_around(part, reach + _STEP + _LEVEL, lowest.shape)
    known = lowest[window] != NO_DATA
    z = np.where(known, lowest[window], 0)
    foot = np.zeros_like(known)
    for rows, columns in _offsets(_STEP):
        # the lowest points of cells may lie a cell farther apart than their centres
        least = max(_LEAST_MM, _SPARE_MM + round(steep * CELL_MM * (1.0 + float(np.hypot(rows, columns)))))
        here, there = _shifted(known.shape, rows, columns)
        foot[here] |= known[here] & known[there] & (z[there] - z[here] > least)
    below = foot.copy()
    for rows, columns in _offsets(_LEVEL):
        here, there = _shifted(known.shape, rows, columns)
        below[here] |= known[here] & foot[there] & (np.abs(z[there] - z[here]) <= _LEVEL_MM)
    found: BoolArray = below[_within(part_around(part, reach, lowest.shape), window)]
    return found


def _steepness(lowest: Elevations, part: Part, cells: BoolArray) -> float:
    """Rise per metre of the roof on a piece.

    Along each axis, the smaller of the rises to both sides counts, which leaves out steps. Cells of which one side is
    unknown count where few others are left.
    """
    window = part_around(part, 2, lowest.shape)
    z = np.where(lowest[window] != NO_DATA, lowest[window], np.nan)
    rises = []
    for rows, columns in ((1, 0), (0, 1)):
        sides = []
        for sign in (-1, 1):
            side = np.full(z.shape, np.nan)
            for cell in (2, 1):
                here, there = _shifted(z.shape, sign * cell * rows, sign * cell * columns)
                rise = np.abs(z[there] - z[here]) / (cell * CELL_MM)
                side[here] = np.where(np.isnan(rise), side[here], rise)
            sides.append(side)
        rises.append(sides)
    for smaller in (np.minimum, np.fmin):
        found = np.hypot(*(smaller(*sides) for sides in rises))[_within(part, window)][cells]
        found = found[~np.isnan(found)]
        if len(found) >= _FEWEST:
            return float(np.quantile(found, _STEEP))
    return _UNKNOWN_STEEP


def _within(part: Part, wide: Part) -> Part:
    """A part of the window, in a wider one."""
    down, across = (slice(a.start - b.start, a.stop - b.start) for a, b in zip(part, wide, strict=True))
    return down, across


def _offsets(reach: int) -> list[tuple[int, int]]:
    """Rows and columns from a cell to all others of a square."""
    steps = range(-reach, reach + 1)
    return [(rows, columns) for rows in steps for columns in steps if (rows, columns) != (0, 0)]


def _shifted(shape: tuple[int, ...], rows: int, columns: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """The parts of a lattice of cells that have another one so many rows and columns away, and of these others."""
    pairs = [
        (slice(max(-by, 0), max(size - max(by, 0), 0)), slice(max(by, 0), max(size + min(by, 0), 0)))
        for by, size in zip((rows, columns), shape, strict=True)
    ]
    return (pairs[0][0], pairs[1][0]), (pairs[0][1], pairs[1][1])


def _grown(mask: BoolArray, cells: int) -> BoolArray:
    """Dilation of (rows, columns) by a square of 2 cells + 1."""
    sums = _sums(mask)
    for axis in (0, 1):
        size = mask.shape[axis]
        place = np.arange(size)
        ends = np.minimum(place + cells + 1, size), np.maximum(place - cells, 0)
        sums = np.take(sums, ends[0], axis=axis) - np.take(sums, ends[1], axis=axis)
    return np.asarray(sums > 0, np.bool_)


def _sums(mask: BoolArray) -> Counts:
    """Cells of a mask south-west of each corner of its cells: (rows + 1, columns + 1)."""
    sums = np.zeros((mask.shape[0] + 1, mask.shape[1] + 1), np.int32)
    np.cumsum(mask, axis=0, dtype=np.int32, out=sums[1:, 1:])
    np.cumsum(sums[1:, 1:], axis=1, out=sums[1:, 1:])
    return sums


def _count(sums: Counts, part: Part, reach: int) -> int:
    """Cells of a mask in a part of the window and so far around it, by its `_sums`."""
    down, across = part_around(part, reach, (sums.shape[0] - 1, sums.shape[1] - 1))
    return int(
        sums[down.stop, across.stop]
        - sums[down.start, across.stop]
        - sums[down.stop, across.start]
        + sums[down.start, across.start]
    )


def _area(part: Part, reach: int) -> int:
    """Cells in a part and so far around it, also beyond the window."""
    return math.prod(along.stop - along.start + 2 * reach for along in part)
