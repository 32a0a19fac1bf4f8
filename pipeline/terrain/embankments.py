"""Embankments, piers and benches: wide, smooth surfaces that slopes lead up to from the ground.

An opening takes a dam with a retaining wall on one side for a row of houses, and a bench that the edge of the data
cuts off for a hall. No test of a few cells sees the difference. It lies in the whole surface and its foot: a building
rises from the ground by walls nearly everywhere, and crowns fall into many surfaces. A surface is terrain if it is
large, if most of it is wider than a house, and if slopes of about 45 degrees at most lead up to a good part of it.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.kernels.normal_equations import solve_plane_moments
from pipeline.kernels.union_find import root_of, unite
from pipeline.model import BoolArray, IntArray, LabelArray
from pipeline.terrain.lattice import CELL_MM, NO_DATA, Elevations
from pipeline.terrain.planar_fitting import MIN_SPREAD
from pipeline.terrain.support import BLOCK_CELLS, LINK_CELLS

_STRIDE = 16
"""Cells from one block to the next: each cell lies in nine blocks, so no surface is cut at one place only."""

_NOISE_MM = 300.0
"""Two points of one smooth surface may differ by this much: the noise of ranges and low plants."""

_ALONG = 0.7
"""Rise over run between neighbouring cells of one surface, 35 degrees: a steeper step parts two surfaces."""

_STEEPEST = 1.0
"""Rise over run between points of ground, as in `between_walls`: what is steeper is a wall."""

_OFF_CELLS = 0.6
"""Points may lie this much farther apart than the middles of their cells."""

_LEVEL = 0.2
"""Rise over run up to which a surface meets the ground on a level, as decks and roofs beside a hill do: no slope."""

_LEVEL_MM = 250.0
"""The same as a height, with which ground rejoins by planes."""

_SMOOTH_MM = 500.0
"""Farthest that a cell may lie from the plane of its neighbours to join: crowns and bushes are rougher."""

_SLOPED_SHARE = 0.45
"""Share of the links to lower ground that must be slopes. A dam with a wall on one side has about half of them."""

_WIDE_SHARE = 2 / 3
"""The same for cells of wide objects: a hall that the data's edge cuts may have half of them where points are few."""

_NARROW_SHARE = 1 / 3
"""Largest share of a surface's cells that may lie on narrow objects: more is a row of houses and hedges."""

_NEIGHBOURS = 8
"""A plane goes through so many cells at most: the eight around a cell if all hold a point."""

_FEWEST = 4
"""Fewest of them: one more than determine a plane."""

_PLANE_CELLS = 5
"""Farthest of them."""

_VORONOI = 0.87
"""Ground that a point stands for, in squares of the distance to its neighbours: six equal triangles meet at it. Cells
without gaps have neighbours across their corners, too, and count 1.27 of their area; where points are few, less."""

_MOST_LINKS = 12
"""Room for the links of one cell. A cell has 8 if all cells around it hold a point."""


def _offsets(reach: int) -> npt.NDArray[np.int64]:
    """Rows and columns to all cells within reach, the nearest first."""
    square = range(-reach, reach + 1)
    found = [(a, b) for a in square for b in square if 0 < a * a + b * b <= reach * reach]
    return np.array(sorted(found, key=lambda at: (at[0] ** 2 + at[1] ** 2, at)), np.int64)


_OFFSETS = _offsets(LINK_CELLS)
_NONE = np.uint8(255)

_CELLS, _SLOPES, _WALLS, _DM2, _NARROW, _WIDE = range(6)
"""Columns of `Counts`: one; links up from the ground by slopes and by walls; area if not narrow; flags."""

Counts = npt.NDArray[np.int64]
"""(objects, 6) int64: what a cell adds to the sums of its surface."""

Links = npt.NDArray[np.uint8]
"""(objects, `_MOST_LINKS`) uint8, rows of `_OFFSETS` from a cell to its neighbours, then `_NONE`."""


@kernel
def _linked(lowest: Elevations, cells: IntArray) -> Links:
    """The neighbours of some cells with data, given by row times columns plus column.

    A cell is a neighbour if no nearer neighbour lies in the circle between the two (Gabriel and Sokal 1969): the links
    are the same everywhere, whatever the distance of the points.
    """
    rows, columns = lowest.shape
    links = np.full((len(cells), _MOST_LINKS), _NONE, np.uint8)
    for i in range(len(cells)):
        r, c = cells[i] // columns, cells[i] % columns
        found = 0
        for k in range(len(_OFFSETS)):
            down, across = _OFFSETS[k, 0], _OFFSETS[k, 1]
            a, b = r + down, c + across
            if a < 0 or a >= rows or b < 0 or b >= columns or lowest[a, b] == NO_DATA:
                continue
            is_free = True
            for m in range(found):
                y, x = _OFFSETS[links[i, m], 0], _OFFSETS[links[i, m], 1]
                if y * y + x * x < y * down + x * across:
                    is_free = False
                    break
            if is_free:
                links[i, found] = k
                found += 1
                if found == _MOST_LINKS:
                    break
    return links


@kernel
def _is_smooth(lowest: Elevations, r: int, c: int) -> bool:
    """Whether a cell lies within `_SMOOTH_MM` of the plane through those around it that continue the surface."""
    rows, columns = lowest.shape
    n, x, y, z, xx, xy, yy, xz, yz = 0, 0, 0, 0, 0, 0, 0, 0, 0
    for k in range(len(_OFFSETS)):
        down, across = _OFFSETS[k, 0], _OFFSETS[k, 1]
        apart = down * down + across * across
        if n == _NEIGHBOURS or apart > _PLANE_CELLS * _PLANE_CELLS:
            break
        a, b = r + down, c + across
        if a < 0 or a >= rows or b < 0 or b >= columns or lowest[a, b] == NO_DATA:
            continue
        h = np.int64(lowest[a, b]) - lowest[r, c]
        if abs(h) > _NOISE_MM + _ALONG * CELL_MM * math.sqrt(apart):
            continue
        n += 1
        x, y, z = x + across, y + down, z + h
        xx, xy, yy = xx + across * across, xy + across * down, yy + down * down
        xz, yz = xz + across * h, yz + down * h
    if n < _FEWEST:
        return False
    vxx, vxy, vyy = xx - x * x / n, xy - x * y / n, yy - y * y / n
    det = vxx * vyy - vxy * vxy
    if det <= MIN_SPREAD * (vxx + vyy) * (vxx + vyy):
        return False
    vxz, vyz = xz - x * z / n, yz - y * z / n
    east, north = solve_plane_moments(vxx, vxy, vyy, vxz, vyz)
    return abs((z - east * x - north * y) / n) <= _SMOOTH_MM


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
            if rise > _NOISE_MM + _STEEPEST * CELL_MM * (far + _OFF_CELLS):
                out[i, _WALLS] += 1
            elif rise > _LEVEL_MM + _LEVEL * CELL_MM * far:
                out[i, _SLOPES] += 1
        if number > 0:
            out[i, _DM2] = round(100 * _VORONOI * (total / number) ** 2)
    return out


@kernel
def _continued(lowest: Elevations, cells: IntArray, links: Links) -> BoolArray:
    """Whether a surface continues along each link, (n, links)."""
    columns = lowest.shape[1]
    out = np.zeros(links.shape, np.bool_)
    for i in range(len(cells)):
        r, c = cells[i] // columns, cells[i] % columns
        for m in range(_MOST_LINKS):
            k = links[i, m]
            if k == _NONE:
                break
            down, across = _OFFSETS[k, 0], _OFFSETS[k, 1]
            step = abs(lowest[r, c] - lowest[r + down, c + across])
            out[i, m] = step <= _NOISE_MM + _ALONG * CELL_MM * math.sqrt(down * down + across * across)
    return out


@kernel
def _surfaces(place: LabelArray, at: LabelArray, links: Links, gentle: BoolArray) -> IntArray:
    """The first member of each member's surface, (members,) int64; `place` and `at` as in `_mark`."""
    rows, columns = place.shape
    parent = np.arange(len(at))
    for r in range(rows):
        for c in range(columns):
            i = place[r, c]
            if i < 0:
                continue
            for m in range(_MOST_LINKS):
                k = links[at[i], m]
                if k == _NONE:
                    break
                a, b = r + _OFFSETS[k, 0], c + _OFFSETS[k, 1]
                if gentle[at[i], m] and 0 <= a < rows and 0 <= b < columns and place[a, b] >= 0:
                    unite(parent, i, place[a, b])
    for i in range(len(at)):
        parent[i] = root_of(parent, i)
    return parent


@kernel
def _mark(out: BoolArray, number: LabelArray, links: Links, gentle: BoolArray, counts: Counts, least_dm2: int) -> None:
    """Mark the cells of a block's surfaces that are terrain, those on narrow objects left out.

    `out` and `number` are the block's part of the lattice; `number` is the row of an object's cell in the other arrays,
    -1 in other cells. `gentle` (objects, links) is whether the surface continues along a link; links that leave the
    block are cut. `least_dm2` is the least area.
    """
    rows, columns = number.shape
    place = np.full((rows, columns), -1, np.int32)
    at = np.empty(rows * columns, np.int32)
    members, area, slopes = 0, 0, 0
    for r in range(rows):
        for c in range(columns):
            if number[r, c] >= 0:
                place[r, c] = members
                at[members] = number[r, c]
                area += counts[number[r, c], _DM2]
                slopes += counts[number[r, c], _SLOPES]
                members += 1
    if area < least_dm2 or slopes == 0:
        return
    at = at[:members]
    surface = _surfaces(place, at, links, gentle)
    sums = np.zeros((members, 6), np.int64)
    for i in range(members):
        for k in range(6):
            sums[surface[i], k] += counts[at[i], k]
    for r in range(rows):
        for c in range(columns):
            i = place[r, c]
            if i < 0 or counts[at[i], _NARROW] > 0:
                continue
            whole = sums[surface[i]]
            share = _WIDE_SHARE if counts[at[i], _WIDE] > 0 else _SLOPED_SHARE
            if (
                whole[_DM2] >= least_dm2
                and whole[_NARROW] <= _NARROW_SHARE * whole[_CELLS]
                and whole[_SLOPES] > 0
                and whole[_SLOPES] >= share * (whole[_SLOPES] + whole[_WALLS])
            ):
                out[r, c] = True


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
    out = np.zeros((rows, columns), np.bool_)
    south = corner[1] // _STRIDE * _STRIDE - corner[1] - BLOCK_CELLS + _STRIDE
    west = corner[0] // _STRIDE * _STRIDE - corner[0] - BLOCK_CELLS + _STRIDE
    for r in range(south, rows, _STRIDE):
        for c in range(west, columns, _STRIDE):
            r0, c0, r1, c1 = max(r, 0), max(c, 0), min(r + BLOCK_CELLS, rows), min(c + BLOCK_CELLS, columns)
            _mark(out[r0:r1, c0:c1], number[r0:r1, c0:c1], links, gentle, counts, 100 * least_m2)
    for i in range(n):
        r, c = cells[i] // columns, cells[i] % columns
        out[r, c] = out[r, c] and _is_smooth(lowest, r, c)
    return out
