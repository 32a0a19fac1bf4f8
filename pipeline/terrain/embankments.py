"""Embankments, piers and benches: wide, smooth surfaces that slopes connect with the ground.

An opening takes a dam with a retaining wall on one side for a row of houses, and a bench that the edge of the data cuts
off for a hall. No test of a few cells sees the difference. It lies in the whole surface and its foot: a building rises
from the ground by walls nearly everywhere, and crowns fall into many surfaces. A surface is terrain if it is large, if
most of it is wider than a house, and if slopes of about 45 degrees at most lead up to a good part of it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.kernels.normal_equations import solve_plane_moments
from pipeline.kernels.sorting import counting_sort
from pipeline.kernels.union_find import numbered_sets, root_of, unite
from pipeline.model import BoolArray, IntArray, LabelArray
from pipeline.terrain.lattice import CELL_MM, NO_DATA, Elevations
from pipeline.terrain.planar_fitting import MIN_SPREAD
from pipeline.terrain.reach import BLOCK_CELLS, LINK_CELLS

_STRIDE = 16
"""Cells from one block to the next: each cell lies in nine blocks, so no surface is cut at one place only.

This and the following define what an embankment is; how large one must be can be set."""

_SQUARES = BLOCK_CELLS // _STRIDE
"""Squares of that side along a side of a block."""

_NOISE_MM = 300.0
"""Two points of one smooth surface may differ by this much: the noise of ranges and low plants."""

_MAX_SURFACE_SLOPE = 0.7
"""Rise over run between neighbouring cells of one surface, 35 degrees: a steeper step parts two surfaces."""

_MAX_GROUND_SLOPE = 1.0
"""Rise over run between points of ground, as in `between_walls`: what is steeper is a wall."""

_POINT_OFFSET_CELLS = 0.6
"""Points may lie this much farther apart than the middles of their cells."""

_LEVEL_SLOPE = 0.2
"""Rise over run up to which a surface meets the ground on a level, as decks and roofs beside a hill do: no slope."""

_LEVEL_STEP_MM = 250.0
"""Added to it, the same step with which ground rejoins by planes."""

_MAX_ROUGHNESS_MM = 500.0
"""Farthest that a cell may lie from the plane of its neighbours to join: crowns and bushes are rougher."""

_MIN_SLOPED_SHARE = 0.45
"""Share of the links to lower ground that must be slopes. A dam with a wall on one side has about half of them."""

_MIN_SLOPED_SHARE_WIDE = 2 / 3
"""The same for cells of wide objects: a hall that the data's edge cuts may have half of them where points are few."""

_MAX_NARROW_SHARE = 1 / 3
"""Largest share of a surface's cells that may lie on narrow objects: more is a row of houses and hedges."""

_MAX_PLANE_CELLS = 8
"""Most cells that the plane around a cell is fitted to: the eight around it if all hold a point."""

_MIN_PLANE_CELLS = 4
"""Fewest such cells: one more than determine a plane."""

_PLANE_REACH_CELLS = 5
"""Farthest such cell."""

_AREA_OF_DISTANCE2 = 0.87
"""Ground that a point stands for, in squares of the distance to its neighbours: six equal triangles meet at it. Cells
without gaps have neighbours across their corners, too, and count 1.27 of their area; where points are few, less."""

_DM2_PER_M2 = 100
"""Areas are added up as whole numbers, so that their order does not matter."""

_MAX_LINKS = 12
"""Room for the links of one cell. A cell has 8 if all cells around it hold a point."""


def _offsets(reach: int) -> npt.NDArray[np.int64]:
    """Rows and columns to all cells within reach, the nearest first."""
    square = range(-reach, reach + 1)
    found = [(a, b) for a in square for b in square if 0 < a * a + b * b <= reach * reach]
    return np.array(sorted(found, key=lambda at: (at[0] ** 2 + at[1] ** 2, at)), np.int64)


_OFFSETS = _offsets(LINK_CELLS)
_NONE = np.uint8(255)

_WORD_BITS = 62
"""Offsets in a word of a set of offsets: shifts by fewer bits keep an int64 positive."""


def _hidden(offsets: npt.NDArray[np.int64]) -> IntArray:
    """Which offsets each offset hides, (offsets, words) sets: those with it in the circle between them and a cell."""
    hides = offsets @ offsets.T > np.sum(offsets * offsets, axis=1)[:, None]
    words = [
        [sum(1 << k for k in np.flatnonzero(row[i : i + _WORD_BITS]).tolist()) for row in hides]
        for i in range(0, len(offsets), _WORD_BITS)
    ]
    return np.ascontiguousarray(np.array(words, np.int64).T)


_HIDDEN = _hidden(_OFFSETS)

_CELLS, _SLOPES, _WALLS, _DM2, _NARROW, _WIDE = range(6)
"""Columns of `Counts`: one; links up from the ground by slopes and by walls; area if not narrow; flags."""

Counts = npt.NDArray[np.int64]
"""(objects, 6) int64: what a cell adds to the sums of its surface."""

Links = npt.NDArray[np.uint8]
"""(objects, `_MAX_LINKS`) uint8, rows of `_OFFSETS` from a cell to its neighbours, then `_NONE`."""


@kernel
def _link(links: Links, hidden: IntArray, lowest: Elevations, r: int, c: int) -> None:
    """Write the neighbours of one cell to `links` (`_MAX_LINKS`,); `hidden` (words,) is scratch."""
    rows, columns = lowest.shape
    found = 0
    hidden[:] = 0
    for word in range(len(hidden)):
        first = word * _WORD_BITS
        # the offsets from `k` on that no neighbour hides, as bits: few are left when neighbours lie on all sides
        left, k = ((1 << min(_WORD_BITS, len(_OFFSETS) - first)) - 1) & ~hidden[word], first
        while left != 0:
            if left & 1 == 1:
                a, b = r + _OFFSETS[k, 0], c + _OFFSETS[k, 1]
                if 0 <= a < rows and 0 <= b < columns and lowest[a, b] != NO_DATA:
                    links[found] = k
                    found += 1
                    if found == _MAX_LINKS:
                        return
                    left &= ~(_HIDDEN[k, word] >> (k - first))
                    for later in range(word + 1, len(hidden)):
                        hidden[later] |= _HIDDEN[k, later]
            left >>= 1
            k += 1


@kernel
def _linked(lowest: Elevations, cells: IntArray) -> Links:
    """The neighbours of some cells with data, given by row times columns plus column.

    A cell is a neighbour if no nearer neighbour lies in the circle between the two (Gabriel and Sokal 1969): the links
    are the same everywhere, whatever the distance of the points.
    """
    columns = lowest.shape[1]
    links = np.full((len(cells), _MAX_LINKS), _NONE, np.uint8)
    hidden = np.zeros(_HIDDEN.shape[1], np.int64)
    for i in range(len(cells)):
        _link(links[i], hidden, lowest, cells[i] // columns, cells[i] % columns)
    return links


@kernel
def _is_smooth(lowest: Elevations, r: int, c: int) -> bool:
    """Whether a cell lies within `_MAX_ROUGHNESS_MM` of the plane through those around it that continue the surface."""
    rows, columns = lowest.shape
    n, x, y, z, xx, xy, yy, xz, yz = 0, 0, 0, 0, 0, 0, 0, 0, 0
    for k in range(len(_OFFSETS)):
        down, across = _OFFSETS[k, 0], _OFFSETS[k, 1]
        apart = down * down + across * across
        if n == _MAX_PLANE_CELLS or apart > _PLANE_REACH_CELLS * _PLANE_REACH_CELLS:
            break
        a, b = r + down, c + across
        if a < 0 or a >= rows or b < 0 or b >= columns or lowest[a, b] == NO_DATA:
            continue
        h = np.int64(lowest[a, b]) - lowest[r, c]
        if abs(h) > _NOISE_MM + _MAX_SURFACE_SLOPE * CELL_MM * math.sqrt(apart):
            continue
        n += 1
        x, y, z = x + across, y + down, z + h
        xx, xy, yy = xx + across * across, xy + across * down, yy + down * down
        xz, yz = xz + across * h, yz + down * h
    if n < _MIN_PLANE_CELLS:
        return False
    vxx, vxy, vyy = xx - x * x / n, xy - x * y / n, yy - y * y / n
    det = vxx * vyy - vxy * vxy
    if det <= MIN_SPREAD * (vxx + vyy) * (vxx + vyy):
        return False
    vxz, vyz = xz - x * z / n, yz - y * z / n
    east, north = solve_plane_moments(vxx, vxy, vyy, vxz, vyz)
    return abs((z - east * x - north * y) / n) <= _MAX_ROUGHNESS_MM


@kernel
def _counted(lowest: Elevations, ground: BoolArray, cells: IntArray, links: Links) -> Counts:
    """Links to the ground below and area of each cell; the other columns are zero."""
    columns = lowest.shape[1]
    out = np.zeros((len(cells), 6), np.int64)
    for i in range(len(cells)):
        r, c = cells[i] // columns, cells[i] % columns
        number, total = 0, 0.0
        for k in links[i]:
            if k == _NONE:
                break
            a, b = r + _OFFSETS[k, 0], c + _OFFSETS[k, 1]
            far = math.sqrt(_OFFSETS[k, 0] ** 2 + _OFFSETS[k, 1] ** 2)
            number += 1
            total += far
            rise = lowest[r, c] - lowest[a, b]
            if not ground[a, b]:
                continue
            if rise > _NOISE_MM + _MAX_GROUND_SLOPE * CELL_MM * (far + _POINT_OFFSET_CELLS):
                out[i, _WALLS] += 1
            elif rise > _LEVEL_STEP_MM + _LEVEL_SLOPE * CELL_MM * far:
                out[i, _SLOPES] += 1
        if number > 0:
            out[i, _DM2] = round(_DM2_PER_M2 * _AREA_OF_DISTANCE2 * (total / number) ** 2)
    return out


@kernel
def _continued(lowest: Elevations, cells: IntArray, links: Links) -> BoolArray:
    """Whether a surface continues along each link, (n, links)."""
    columns = lowest.shape[1]
    out = np.zeros(links.shape, np.bool_)
    for i in range(len(cells)):
        r, c = cells[i] // columns, cells[i] % columns
        for m in range(_MAX_LINKS):
            k = links[i, m]
            if k == _NONE:
                break
            down, across = _OFFSETS[k, 0], _OFFSETS[k, 1]
            step = abs(lowest[r, c] - lowest[r + down, c + across])
            out[i, m] = step <= _NOISE_MM + _MAX_SURFACE_SLOPE * CELL_MM * math.sqrt(down * down + across * across)
    return out


@kernel
def _parts(
    number: LabelArray, cells: IntArray, links: Links, gentle: BoolArray, square: LabelArray
) -> tuple[LabelArray, int, LabelArray]:
    """The part of each object's cell, (n,) int32; how many there are; and the pairs of parts that links connect.

    A part is what is connected within a square. `number` is the row of an object's cell in the other arrays, -1 in
    other cells. `gentle` is whether the surface continues along a link, `square` (n,) is the square of each cell.
    """
    columns = number.shape[1]
    parent = np.arange(len(cells))
    between = np.empty((np.count_nonzero(gentle), 2), np.int32)
    pairs = 0
    for i in range(len(cells)):
        r, c = cells[i] // columns, cells[i] % columns
        for m in range(_MAX_LINKS):
            k = links[i, m]
            if k == _NONE:
                break
            other = number[r + _OFFSETS[k, 0], c + _OFFSETS[k, 1]]
            if not gentle[i, m] or other < 0:
                continue
            if square[i] == square[other]:
                unite(parent, i, other)
            else:
                between[pairs, 0], between[pairs, 1] = i, other
                pairs += 1
    part, count = numbered_sets(parent)
    for i in range(pairs):
        between[i, 0], between[i, 1] = part[between[i, 0]], part[between[i, 1]]
    return part, count, between[:pairs].copy()


class _Squares(NamedTuple):
    """The parts of all surfaces, by their squares."""

    sums: Counts
    """(parts, 6) int64, sums of the counts of their cells."""
    starts: LabelArray
    """(squares + 1,) int32, where the parts of each square start in `members`."""
    members: LabelArray
    """(parts,) int32."""
    between: LabelArray
    """(pairs, 2) int32, parts of two squares that a surface connects, by the square of the first."""
    pair_starts: LabelArray
    """(squares + 1,) int32, where those of each square start."""


@kernel
def _judge_block(
    joins: BoolArray, squares: _Squares, within: LabelArray, surface: IntArray, whole: Counts, least_dm2: int
) -> None:
    """Mark in `joins` the parts of a block's terrain; `within` are its squares. The rest as in `_joining`.

    `surface` and `whole` (parts,) are scratch: the first part of each part's surface, and sums over it. Both are reset
    here, and `surface` is -1 for all parts at the end.
    """
    sums, starts, members = squares.sums, squares.starts, squares.members
    for at in within:
        for i in members[starts[at] : starts[at + 1]]:
            surface[i] = i
            whole[i] = 0
    for at in within:
        for pair in range(squares.pair_starts[at], squares.pair_starts[at + 1]):
            one, other = squares.between[pair]
            # links that leave the block are cut
            if surface[other] >= 0:
                unite(surface, one, other)
    for at in within:
        for i in members[starts[at] : starts[at + 1]]:
            surface[i] = root_of(surface, i)
            whole[surface[i]] += sums[i]
    for at in within:
        for i in members[starts[at] : starts[at + 1]]:
            of = whole[surface[i]]
            if of[_DM2] < least_dm2 or of[_NARROW] > _MAX_NARROW_SHARE * of[_CELLS] or of[_SLOPES] == 0:
                continue
            for is_wide, share in enumerate((_MIN_SLOPED_SHARE, _MIN_SLOPED_SHARE_WIDE)):
                if of[_SLOPES] >= share * (of[_SLOPES] + of[_WALLS]):
                    joins[i, is_wide] = True
    for at in within:
        surface[members[starts[at] : starts[at + 1]]] = -1


@kernel
def _joining(squares: _Squares, shape: tuple[int, int], least_dm2: int) -> BoolArray:
    """Whether the cells of each part join the ground, (parts, 2): those beyond wide objects, and those on them.

    The parts of a block's squares make its surfaces. `shape` is rows and columns of squares, which are numbered row by
    row; `least_dm2` is the least area of a surface.
    """
    rows, columns = shape
    parts = len(squares.sums)
    joins = np.zeros((parts, 2), np.bool_)
    surface, whole = np.full(parts, -1, np.int64), np.zeros((parts, 6), np.int64)
    totals = np.zeros((rows * columns, 6), np.int64)
    for at in range(rows * columns):
        for i in squares.members[squares.starts[at] : squares.starts[at + 1]]:
            totals[at] += squares.sums[i]
    within = np.empty(_SQUARES * _SQUARES, np.int32)
    for down in range(1 - _SQUARES, rows):
        for across in range(1 - _SQUARES, columns):
            n, area, slopes = 0, 0, 0
            for r in range(max(down, 0), min(down + _SQUARES, rows)):
                for c in range(max(across, 0), min(across + _SQUARES, columns)):
                    at = r * columns + c
                    within[n] = at
                    n, area, slopes = n + 1, area + totals[at, _DM2], slopes + totals[at, _SLOPES]
            if area >= least_dm2 and slopes > 0:
                _judge_block(joins, squares, within[:n], surface, whole, least_dm2)
    return joins


@kernel
def embankments(
    lowest: Elevations,
    ground: BoolArray,
    objects: tuple[BoolArray, BoolArray],
    corner: tuple[int, int],
    least_m2: int,
) -> BoolArray:
    """Mask (rows, columns) of the cells of embankments among those that are not ground yet.

    A surface is a connected part of these cells in a block of `BLOCK_CELLS`, so no decision looks farther than a block
    and a link. Blocks overlap, and one of them suffices.

    Parameters
    ----------
    lowest : (rows, columns) int32
        Elevation in mm of the lowest point of each cell, NO_DATA where there is none.
    ground : (rows, columns) bool
        The ground that slopes may lead up from.
    objects : tuple of (rows, columns) bool
        The cells of objects as narrow as houses, which never join, and those of wide objects.
    corner : tuple of int
        Absolute column and row of the first cell: blocks are anchored at the CRS's origin.
    least_m2 : int
        Least area of a surface in a block, without narrow objects.
    """
    narrow, wide = objects
    rows, columns = lowest.shape
    number = np.full((rows, columns), -1, np.int32)
    cells = np.empty(rows * columns, np.int64)
    n = 0
    for r in range(rows):
        for c in range(columns):
            if lowest[r, c] != NO_DATA and not ground[r, c]:
                number[r, c] = n
                cells[n] = r * columns + c
                n += 1
    cells = cells[:n]
    links = _linked(lowest, cells)
    counts = _counted(lowest, ground, cells, links)
    for i in range(n):
        r, c = cells[i] // columns, cells[i] % columns
        counts[i, _CELLS], counts[i, _NARROW], counts[i, _WIDE] = 1, narrow[r, c], wide[r, c]
        if narrow[r, c]:
            counts[i, _DM2] = 0
    gentle = _continued(lowest, cells, links)
    # blocks are made of squares, and surfaces of the parts in them: nine blocks share a square
    south, west = corner[1] % _STRIDE, corner[0] % _STRIDE
    high, broad = (south + rows - 1) // _STRIDE + 1, (west + columns - 1) // _STRIDE + 1
    square = np.empty(n, np.int32)
    for i in range(n):
        r, c = cells[i] // columns, cells[i] % columns
        square[i] = (south + r) // _STRIDE * broad + (west + c) // _STRIDE
    part, parts, between = _parts(number, cells, links, gentle, square)
    sums, square_of = np.zeros((parts, 6), np.int64), np.empty(parts, np.int32)
    for i in range(n):
        sums[part[i]] += counts[i]
        square_of[part[i]] = square[i]
    starts, members = counting_sort(square_of, high * broad)
    pair_starts, pairs = counting_sort(square_of[between[:, 0]], high * broad)
    squares = _Squares(sums, starts, members, between[pairs], pair_starts)
    joins = _joining(squares, (high, broad), _DM2_PER_M2 * least_m2)
    out = np.zeros((rows, columns), np.bool_)
    for i in range(n):
        if counts[i, _NARROW] == 0 and joins[part[i], counts[i, _WIDE]]:
            r, c = cells[i] // columns, cells[i] % columns
            out[r, c] = _is_smooth(lowest, r, c)
    return out
