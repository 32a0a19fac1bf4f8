"""Decks and roofs between two walls: surfaces with drops on opposite sides, along parallel edges.

Openings take two things for ground, since they have no step on one side: a bridge that meets the road on its level, and
a house on a slope whose roof meets the ground uphill. Across the deck, and across the roof along the contour, the
surface ends at a drop to the left and to the right, and both edges are parallel. A spur of ground between two brows or
the corner of a terrace seldom has such edges.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.model import BoolArray, IntArray, LabelArray
from pipeline.terrain.lattice import CELL_MM, NO_DATA, Elevations
from pipeline.terrain.reach import ALONG_CELLS

_DIRECTIONS = np.array([(1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2)])
"""Rows and columns of a stride to a later cell: every 18 to 27 degrees, so one of them is nearly perpendicular to any
edge.

This and the following define what parallel edges are; how deep drops and how wide decks are can be set."""

_STEEPEST = 1.0
"""Rise over run of ground: a drop must fall by this much more per distance between the points on its two sides."""

_SAME_EDGE_M = 2.0
"""Two cells are at one edge if their distances to it differ by at most this, and `_TURN` per metre between them."""

_TURN = 0.2
"""Tangent of about half the angle between two directions."""

_SHARE = 0.5
"""Share of the cells along the edges that must lie between the same two."""

_FEWEST = 2
"""Least number of such cells."""

_OVER_MM = 1000.0
"""Cells along the edges that are higher than this above the deck do not count: trees."""

_OVER_RISE_MM = 300.0
"""Increase of that height per metre along the edges."""

Distances = npt.NDArray[np.float32]


class _Cells(NamedTuple):
    """The cells with data, row by row: walks lead from one to the next without the empty ones between."""

    number: LabelArray
    """(rows, columns) int32, index of each cell in the other arrays; -1 in empty cells."""
    row: LabelArray
    """(n,) int32."""
    column: LabelArray
    """(n,) int32."""
    z_mm: Elevations
    """(n,) int32, elevations."""


@kernel
def _cells_of(lowest: Elevations) -> _Cells:
    """The cells with data of a lattice."""
    rows, columns = lowest.shape
    number = np.full((rows, columns), -1, np.int32)
    row, column, z_mm = (
        np.empty(lowest.size, np.int32),
        np.empty(lowest.size, np.int32),
        np.empty(lowest.size, np.int32),
    )
    n = 0
    for r in range(rows):
        for c in range(columns):
            if lowest[r, c] != NO_DATA:
                number[r, c], row[n], column[n], z_mm[n] = n, r, c, lowest[r, c]
                n += 1
    return _Cells(number, row[:n].copy(), column[:n].copy(), z_mm[:n].copy())


@kernel
def _next_cells(cells: _Cells, down: int, across: int) -> LabelArray:
    """The next cell with data along a stride from each, (n,) int32; -1 where there is none."""
    rows, columns = cells.number.shape
    follows = np.full(len(cells.row), -1, np.int32)
    if down == 0:
        for i in range(max(-across, 0), min(len(follows) - across, len(follows))):
            if cells.row[i + across] == cells.row[i]:
                follows[i] = i + across
        return follows
    # the cell itself, or the first one with data ahead
    first = cells.number.copy()
    left, right = max(-across, 0), max(min(columns - across, columns), 0)
    for k in range(abs(down), rows):
        # rows that lie ahead come first
        r = rows - 1 - k if down > 0 else k
        here, there = first[r, left:right], first[r + down, left + across : right + across]
        for c in range(here.size):
            own, other = here[c], there[c]
            here[c] = own if own >= 0 else other
    for i in range(len(follows)):
        r, c = cells.row[i] + down, cells.column[i] + across
        if 0 <= r < rows and 0 <= c < columns:
            follows[i] = first[r, c]
    return follows


@kernel
def _drops(
    z_mm: Elevations,
    place: LabelArray,
    onward: LabelArray,
    backward: LabelArray,
    limits: tuple[IntArray, IntArray],
    is_up: bool,
) -> tuple[LabelArray, LabelArray]:
    """Strides from each cell to the first drop along a direction, 0 where there is none, and the drop's depth in mm.

    The walk passes over objects that rise more steeply than 45 degrees: parapets, cars, trees, houses. From the first
    cell that it stands on, it goes on as the walk of that cell does.

    Parameters
    ----------
    z_mm, place : (n,) int32
        Elevations of the cells with data, and where they lie along the direction, in strides.
    onward, backward : (n,) int32
        Next cells with data along the direction and against it, -1 where there are none.
    limits : tuple of (strides + 1,) int64
        Two limits in mm for each number of strides, up to the longest walk. A walk stands on a cell that rises no more
        than the first. A fall is a drop if it is deeper than the second.
    is_up : bool
        Whether the direction leads to later cells.
    """
    n, farthest = len(z_mm), len(limits[0]) - 1
    strides, falls = np.zeros(n, np.int32), np.zeros(n, np.int32)
    # a walk that comes to a cell stands there if it began at this level or higher
    level_mm = np.empty(n, np.int32)
    for k in range(n):
        # cells that lie ahead come first
        i = n - 1 - k if is_up else k
        here, at, number = z_mm[i], onward[i], 0
        while at >= 0:
            number = abs(place[at] - place[i])
            if number > farthest:
                at = -1
            elif level_mm[at] > here:
                at = onward[at]
            else:
                break
        if at >= 0:
            # without branches: which of the three it is is hard to foresee
            fall, known, depth = here - z_mm[at], strides[at], falls[at]
            is_drop = fall > limits[1][number]
            strides[i] = number if is_drop else number + known if known > 0 else 0
            falls[i] = fall if is_drop else depth
        before = backward[i]
        apart = min(abs(place[before] - place[i]), farthest) if before >= 0 else 0
        level = np.int32(here - limits[0][apart])
        level_mm[i] = level
    return strides, falls


@kernel
def _widths(
    cells: _Cells, stride: tuple[int, int, float], widest: float, drop_mm: float, rise_mm: float
) -> tuple[Distances, Distances]:
    """Cells to the drops on both sides along a direction; -1 without drops, or if they are too low for the width."""
    down, across, length = stride
    onward, backward = _next_cells(cells, down, across), _next_cells(cells, -down, -across)
    place = cells.column.copy()
    if down > 0:
        for i in range(len(place)):
            place[i] = cells.row[i] // down
    climbs, drops = np.empty(int(widest / length) + 1, np.int64), np.empty(int(widest / length) + 1, np.int64)
    for number in range(len(climbs)):
        rise = _STEEPEST * CELL_MM * length * number
        climbs[number], drops[number] = math.floor(rise), math.floor(drop_mm + rise)
    strides, falls = _drops(cells.z_mm, place, onward, backward, (climbs, drops), True)
    back, back_falls = _drops(cells.z_mm, place, backward, onward, (climbs, drops), False)
    ahead, behind = np.empty(len(back), np.float32), np.empty(len(back), np.float32)
    for i in range(len(back)):
        far, other_far = strides[i] * length, back[i] * length
        is_deep = min(falls[i], back_falls[i]) > rise_mm * (far + other_far) / 2
        is_deck = is_deep & (far + other_far <= widest) & (strides[i] > 0) & (back[i] > 0)
        ahead[i] = far if is_deck else -1.0
        behind[i] = other_far if is_deck else -1.0
    return ahead, behind


@kernel
def _mark(out: BoolArray, cells: _Cells, ahead: Distances, behind: Distances, along: tuple[float, float]) -> None:
    """Mark the cells whose two edges continue in parallel, on one side at least."""
    rows, columns = cells.number.shape
    offsets = np.empty((2, ALONG_CELLS, 2), np.int64)
    for side in range(2):
        for t in range(ALONG_CELLS):
            for k in range(2):
                offsets[side, t, k] = round((2 * side - 1) * (t + 1) * along[k])
    for i in range(len(ahead)):
        r, c = cells.row[i], cells.column[i]
        if ahead[i] < 0 or out[r, c]:
            continue
        for side in range(2):
            seen, same = 0, 0
            for t in range(1, ALONG_CELLS + 1):
                a, b = r + offsets[side, t - 1, 0], c + offsets[side, t - 1, 1]
                if a < 0 or a >= rows or b < 0 or b >= columns:
                    continue
                j = cells.number[a, b]
                if j < 0 or cells.z_mm[j] - cells.z_mm[i] > _OVER_MM + _OVER_RISE_MM * t:
                    continue
                seen += 1
                off = max(abs(ahead[j] - ahead[i]), abs(behind[j] - behind[i]))
                if ahead[j] >= 0 and off <= _SAME_EDGE_M + _TURN * t:
                    same += 1
                elif seen - same > (1 - _SHARE) * ALONG_CELLS:
                    break  # too many others, whatever follows
            if same >= _FEWEST and same >= _SHARE * seen:
                out[r, c] = True


def between_walls(lowest: Elevations, widest: int, drop_mm: float, rise_mm: float) -> BoolArray:
    """Mask (rows, columns) of the cells of decks and roofs between two drops; none where there is no data.

    `lowest` is the elevation in mm of the lowest point of each cell, NO_DATA where there is none. The drops lie at most
    `widest` cells apart. The least drop is `drop_mm` and `rise_mm` per cell of half the width: wider decks must be
    higher.
    """
    out = np.zeros(lowest.shape, np.bool_)
    cells = _cells_of(lowest)
    for down, across in _DIRECTIONS.tolist():
        length = math.hypot(down, across)
        ahead, behind = _widths(cells, (down, across, length), float(widest), drop_mm, rise_mm)
        _mark(out, cells, ahead, behind, (-across / length, down / length))
    return out
