"""An octree of points: each node holds an even sample of the points in its cube, and no point lies in two nodes.

The sample of a node has one point per cell of a grid of 128 cells a side: the one nearest to the cell's centre. What is
left goes on to its eight children, until few enough are left for one node. This is the order of Potree (Schütz 2016,
"Potree: Rendering Large Point Clouds in Web Browsers", section 3.2), with the centre of a cell in place of a smallest
distance. Cells are ranges of the Morton code (Morton 1966), so one sort makes all nodes.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import IntArray, KindArray

CELL_BITS = 7
"""Binary logarithm of the cells of a node along a side: 128."""
CAPACITY = 40_000
"""So many points, or fewer, stay undivided. Not a setting: it weighs the number of requests against their size."""
FEW = 2_000
"""A child with fewer points is not made: its points stay with its parent."""
_BITS = 21
"""Bits of a coordinate in a Morton code: three of them fit 63 bits."""
_UNSET = 127


@dataclasses.dataclass(frozen=True, kw_only=True)
class OctreeNode:
    """A node that holds points."""

    path: str
    """The octants from the root to it, such as r04: bit 0 of an octant is east, 1 north, 2 up."""
    index: IntArray
    """(m,) int64, its points, at least one."""
    low_mm: IntArray
    """(3,) int64, smallest coordinates of all points in its cube, also those of its parents and children."""
    high_mm: IntArray
    """(3,) int64, the largest."""
    spacing_m: float
    """Typical distance of neighbouring points once this node is drawn; 0 where no finer node follows."""

    @property
    def parent(self) -> str:
        """The path of the parent; empty for the root."""
        return self.path[:-1]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Octree:
    """The nodes over some points, and the points that are left to coarser levels above them."""

    nodes: tuple[OctreeNode, ...]
    """Parents before their children; empty where all points went to the levels above."""
    above: tuple[IntArray, ...]
    """By level, the next one first: (m,) int64, the points that it takes."""


@kernel
def _spread(value: int) -> int:
    """The lower 21 bits of a number, with two zeros between each."""
    v = value & 0x1FFFFF
    v = (v | (v << 32)) & 0x1F00000000FFFF
    v = (v | (v << 16)) & 0x1F0000FF0000FF
    v = (v | (v << 8)) & 0x100F00F00F00F00F
    v = (v | (v << 4)) & 0x10C30C30C30C30C3
    return (v | (v << 2)) & 0x1249249249249249


@kernel
def _codes(xyz_mm: IntArray, side_mm: int) -> tuple[IntArray, IntArray]:
    """Places (n, 3) in a cube of that side as integers of 21 bits, and their Morton codes (n,)."""
    places = np.empty_like(xyz_mm)
    codes = np.empty(len(xyz_mm), np.int64)
    for i in range(len(xyz_mm)):
        for axis in range(3):
            places[i, axis] = (xyz_mm[i, axis] << _BITS) // side_mm
        codes[i] = _spread(places[i, 0]) | (_spread(places[i, 1]) << 1) | (_spread(places[i, 2]) << 2)
    return places, codes


@kernel
def _sample(
    codes: IntArray, places: IntArray, levels: KindArray, start: int, stop: int, cell_bits: int, level: int
) -> None:
    """Give a level to one point of each cell, among those from start to stop that have none: the nearest to the centre.

    A cell has the upper `cell_bits` bits of a place in common. The first of points that are equally near is taken.
    """
    shift = _BITS - cell_bits
    mask, half = (1 << shift) - 1, (1 << shift) >> 1
    cell, best, nearest = np.int64(-1), -1, np.int64(0)
    for i in range(start, stop):
        if levels[i] != _UNSET:
            continue
        own = codes[i] >> (3 * shift)
        if own != cell:
            if best >= 0:
                levels[best] = level
            cell, best = own, -1
        distance = np.int64(0)
        for axis in range(3):
            away = (places[i, axis] & mask) - half
            distance += away * away
        if best < 0 or distance < nearest:
            best, nearest = i, distance
    if best >= 0:
        levels[best] = level


@kernel
def _divided(codes: IntArray, places: IntArray, above: int, capacity: int, few: int) -> tuple[KindArray, IntArray]:
    """The level of each of n sorted points, and the nodes.

    Levels (n,) int8 begin with 0 at the root; -1 to -above belong to coarser nodes. Nodes (m, 4) int64 are level, first
    and last point of the cube, and 1 where points were left for children.
    """
    n = len(codes)
    levels = np.full(n, _UNSET, np.int8)
    for k in range(above, 0, -1):
        _sample(codes, places, levels, 0, n, CELL_BITS - k, -k)
    room = n // few + 2
    nodes = np.empty((room * (_BITS - CELL_BITS + 1), 4), np.int64)
    active, following = np.empty((room, 2), np.int64), np.empty((room, 2), np.int64)
    active[0, 0], active[0, 1] = 0, n
    n_active, m = 1 if n > 0 else 0, 0
    for level in range(_BITS - CELL_BITS + 1):
        n_following = 0
        for a in range(n_active):
            start, stop = active[a]
            left = 0
            for i in range(start, stop):
                left += levels[i] == _UNSET
            if left == 0:
                continue
            nodes[m, 0], nodes[m, 1], nodes[m, 2], nodes[m, 3] = level, start, stop, 0
            m += 1
            if left <= capacity or level == _BITS - CELL_BITS:
                for i in range(start, stop):
                    if levels[i] == _UNSET:
                        levels[i] = level
                continue
            _sample(codes, places, levels, start, stop, level + CELL_BITS, level)
            shift = 3 * (_BITS - level - 1)
            first = start
            while first < stop:
                octant, last, left = codes[first] >> shift, first, 0
                while last < stop and codes[last] >> shift == octant:
                    left += levels[last] == _UNSET
                    last += 1
                if left < few:
                    for i in range(first, last):
                        if levels[i] == _UNSET:
                            levels[i] = level
                else:
                    following[n_following, 0], following[n_following, 1] = first, last
                    n_following += 1
                    nodes[m - 1, 3] = 1
                first = last
        active, following, n_active = following, active, n_following
    return levels, nodes[:m].copy()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cube:
    """The cube of an octree's root."""

    corner_mm: tuple[int, int, int]
    """Its smallest coordinates."""
    side_mm: int
    """Its side."""

    def cell_m(self, level: int = 0) -> float:
        """Side of the cells of a node of a level, in metres; negative levels lie above the root."""
        return self.side_mm / 1000.0 / 2.0 ** (CELL_BITS + level)


def octree_of(xyz_mm: IntArray, ties: IntArray, cube: Cube, above: int = 0, capacity: int = CAPACITY) -> Octree:
    """The octree over points in a cube; it does not depend on their order.

    Parameters
    ----------
    xyz_mm : (n, 3) int64
        Millimetres; inside the cube, whose upper sides do not belong to it.
    ties : (n,) int64
        Order among points of one place, for instance by what they carry.
    cube : Cube
        The cube of the root.
    above : int
        Number of coarser levels, 0 to 7, to which the points leave a share: each has cells of twice the side.
    capacity : int
        Most points that are left undivided.
    """
    if not 0 <= above <= CELL_BITS:
        raise ValueError(f"above is {above}: use 0 to {CELL_BITS}")
    places, codes = _codes(xyz_mm - np.array(cube.corner_mm), cube.side_mm)
    order = np.argsort(codes, kind="stable")
    codes = codes[order]
    tied = np.flatnonzero(np.diff(codes) == 0)
    if len(tied):
        rows = np.unique(np.concatenate((tied, tied + 1)))
        among = order[rows]
        x, y, z = xyz_mm[among].T
        order[rows] = among[np.lexsort((ties[among], z, y, x, codes[rows]))]
    levels, found = _divided(codes, places[order], above, capacity, min(FEW, capacity))
    sorted_mm = xyz_mm[order]
    nodes = []
    for level, start, stop, divided in found.tolist():
        within = sorted_mm[start:stop]
        nodes.append(
            OctreeNode(
                path=_path(int(codes[start]), level),
                index=order[start + np.flatnonzero(levels[start:stop] == level)],
                low_mm=within.min(axis=0),
                high_mm=within.max(axis=0),
                spacing_m=cube.cell_m(level) if divided else 0.0,
            )
        )
    return Octree(nodes=tuple(nodes), above=tuple(order[np.flatnonzero(levels == -k)] for k in range(1, above + 1)))


def _path(code: int, level: int) -> str:
    """The path of the node of a level that holds a code.

    >>> _path(0b101 << 60, 1), _path(0b101_010 << 57, 2)
    ('r5', 'r52')
    """
    return "r" + "".join(str(code >> (3 * (_BITS - step)) & 7) for step in range(1, level + 1))
