"""Decks and roofs between two walls: surfaces with drops on opposite sides, along parallel edges.

Openings take a bridge that meets the road on its level for ground, and a house on a slope whose roof meets the ground
uphill: on one side there is no step. Across the deck, and across the roof along the contour, the surface ends at a drop
to the left and to the right, and both edges are parallel. A spur of ground between two brows or the corner of a terrace
seldom has such edges.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.model import BoolArray
from pipeline.terrain.lattice import CELL_MM, NO_DATA, Elevations
from pipeline.terrain.support import ALONG_CELLS

_DIRECTIONS = np.array([(1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2)])
"""Rows and columns of a stride: every 18 to 27 degrees, so one of them is nearly perpendicular to any edge.

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


@kernel
def _drops(
    lowest: Elevations, stride: tuple[int, int, float], farthest: int, drop_mm: float
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """Strides from each cell to the first drop along a direction, 0 where there is none, and the drop's depth in mm.

    The walk passes over objects that rise more steeply than 45 degrees: parapets, cars, trees, houses. It does so for
    `farthest` strides at most. From the first cell that it stands on, it goes on as the walk of that cell does.
    """
    rows, columns = lowest.shape
    down, across, length = stride
    strides = np.zeros((rows, columns), np.int32)
    falls = np.zeros((rows, columns), np.int32)
    for k in range(rows):
        # cells that lie ahead come first
        r = rows - 1 - k if down > 0 else k
        for m in range(columns):
            c = columns - 1 - m if across > 0 else m
            here = lowest[r, c]
            if here == NO_DATA:
                continue
            last = 0
            for number in range(1, farthest + 1):
                a, b = r + number * down, c + number * across
                if a < 0 or a >= rows or b < 0 or b >= columns:
                    break
                z = lowest[a, b]
                if z == NO_DATA:
                    continue
                if z - here <= _STEEPEST * CELL_MM * length * (number - last):
                    if here - z > drop_mm + _STEEPEST * CELL_MM * length * number:
                        strides[r, c], falls[r, c] = number, here - z
                    elif strides[a, b] > 0:
                        strides[r, c], falls[r, c] = number + strides[a, b], falls[a, b]
                    break
                last = number
    return strides, falls


@kernel
def _widths(
    lowest: Elevations, stride: tuple[int, int, float], widest: float, drop_mm: float, rise_mm: float
) -> tuple[Distances, Distances]:
    """Cells to the drops on both sides along a direction; -1 without drops, or if they are too low for the width."""
    rows, columns = lowest.shape
    ahead = np.full((rows, columns), -1.0, np.float32)
    behind = np.full((rows, columns), -1.0, np.float32)
    length = stride[2]
    farthest = int(widest / length)
    strides, falls = _drops(lowest, stride, farthest, drop_mm)
    back, back_falls = _drops(lowest, (-stride[0], -stride[1], length), farthest, drop_mm)
    for r in range(rows):
        for c in range(columns):
            far, other_far = strides[r, c] * length, back[r, c] * length
            if strides[r, c] == 0 or back[r, c] == 0 or far + other_far > widest:
                continue
            if min(falls[r, c], back_falls[r, c]) > rise_mm * (far + other_far) / 2:
                ahead[r, c], behind[r, c] = far, other_far
    return ahead, behind


@kernel
def _mark(out: BoolArray, lowest: Elevations, ahead: Distances, behind: Distances, along: tuple[float, float]) -> None:
    """Mark the cells whose two edges continue in parallel, on one side at least."""
    rows, columns = out.shape
    for r in range(rows):
        for c in range(columns):
            if ahead[r, c] < 0 or out[r, c]:
                continue
            for side in (-1, 1):
                seen, same = 0, 0
                for t in range(1, ALONG_CELLS + 1):
                    a, b = r + round(side * t * along[0]), c + round(side * t * along[1])
                    if a < 0 or a >= rows or b < 0 or b >= columns or lowest[a, b] == NO_DATA:
                        continue
                    if lowest[a, b] - lowest[r, c] > _OVER_MM + _OVER_RISE_MM * t:
                        continue
                    seen += 1
                    off = max(abs(ahead[a, b] - ahead[r, c]), abs(behind[a, b] - behind[r, c]))
                    if ahead[a, b] >= 0 and off <= _SAME_EDGE_M + _TURN * t:
                        same += 1
                if same >= _FEWEST and same >= _SHARE * seen:
                    out[r, c] = True


def between_walls(lowest: Elevations, widest: int, drop_mm: float, rise_mm: float) -> BoolArray:
    """Mask (rows, columns) of the cells of decks and roofs between two drops; none where there is no data.

    `lowest` is the elevation in mm of the lowest point of each cell, NO_DATA where there is none. The drops lie at most
    `widest` cells apart. The least drop is `drop_mm` and `rise_mm` per cell of half the width: wider decks must be
    higher.
    """
    out = np.zeros(lowest.shape, np.bool_)
    for down, across in _DIRECTIONS.tolist():
        length = math.hypot(down, across)
        ahead, behind = _widths(lowest, (down, across, length), float(widest), drop_mm, rise_mm)
        _mark(out, lowest, ahead, behind, (-across / length, down / length))
    return out
