"""The class of every point after buildings are known: ground, building, vegetation, noise, other.

Decisions look a few metres far and use integer millimetres: tiles agree on them. Codes are those of ASPRS, LAS
Specification 1.4 R15, table 17.
"""

from __future__ import annotations

import dataclasses
from enum import IntEnum

import numpy as np

from pipeline.compiler import kernel
from pipeline.extras.classify.sparse_points import FAR_MM, Role, SparsePoints, likely_building
from pipeline.model import BoolArray, ByteArray, IntArray, KindArray
from pipeline.spatial_hash import points_by_cell, slot_of_key
from pipeline.terrain.lattice import NO_DATA
from pipeline.terrain.pits import PIT_MATES
from pipeline.terrain.terrain_settings import VegetationSettings
from pipeline.terrain.thinning import highest_per_cell
from pipeline.terrain.vegetation import planarity


class PointClass(IntEnum):
    """The classes in the output."""

    OTHER = 1
    """None of the others: cars, poles, wires, garden walls."""
    GROUND = 2
    VEGETATION = 5
    BUILDING = 6
    """Roofs, walls and objects on roofs."""
    NOISE = 7
    """Points nearly alone in space, and a few far below the terrain."""
    BRIDGE_DECK = 17
    """Points of rejected objects that are decks of bridges; the label stage gives this class."""


# Not settings: dimensions of common objects on and beside buildings.
WALL_REACH_MM = 1000
"""A point this near to a building in plan, and no higher than it there, is its wall unless it is leafy."""
UNDER_ROOF_MM = 500
"""This near, it is always wall or lies under the roof: eaves scatter pulses as leaves do."""
ON_ROOF_MM = 2500
"""Largest height of chimneys, antennas and parapets above the roof."""
TALL_MM = 2000
"""Higher than cars and fences: rough points that are not building are vegetation."""
MAX_SPARSE_PER_M2 = 2
"""Where fewer points lie, `sparse_points` judges each one above the ground: its weights were fitted up to there."""
CROWD_MM = 10_000
"""Side of the cells over 3 x 3 of which points are counted for it. Where none of them is from a pulse of several
returns, the scanner may record one per pulse: then no point is judged so."""
CELL_M = 0.5
"""Side of the cells of which one point each is judged for smoothness."""
UNKNOWN, SMOOTH, LEAFY = -1, 0, 1
AROUND_MM = 1000
"""Side of the cells over 3 x 3 of which the evidence of vegetation is summed."""
DEEP_MM = 2000
"""A few points deeper than this below level terrain are noise: twice as deep as a pit by default."""
PIT_REACH_MM = 2000
"""Half side of the box in which points far below the terrain are counted."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PointEvidence:
    """Evidence on the points of a window; arrays of one length n."""

    x_mm: IntArray
    y_mm: IntArray
    z_mm: IntArray
    height_mm: IntArray
    """Height above the terrain; NO_DATA where there is none."""
    rise_mm: IntArray
    """Rise of the terrain over a metre."""
    ground: BoolArray
    """Close enough to the terrain for ground."""
    building: BoolArray
    """In a building's points."""
    outlier: BoolArray
    """Nearly alone in a wide neighbourhood of space."""
    echoes: BoolArray
    """The pulse has more than one return."""


def support_m(vegetation: VegetationSettings) -> float:
    """How far the classes look, beside the outliers' own search."""
    leafy_m = vegetation.support_m + CELL_M + 2 * AROUND_MM / 1000.0
    return max(leafy_m, 2 * CROWD_MM / 1000.0, FAR_MM / 1000.0) + PIT_REACH_MM / 1000.0


@kernel
def tops_nearby(x: IntArray, y: IntArray, z: IntArray, used: BoolArray, wanted: BoolArray, reach: int) -> IntArray:
    """Elevation of the highest used point within a distance in plan of each wanted one, int64 (n,).

    NO_DATA where it was not wanted or there is none.
    """
    n = x.size
    out = np.full(n, np.int64(NO_DATA), np.int64)
    if n == 0:
        return out
    start, members, column0, row0, columns, rows = points_by_cell(x, y, used, reach)
    for i in range(n):
        if not wanted[i]:
            continue
        c, r = x[i] // reach - column0, y[i] // reach - row0
        top = np.int64(-(2**62))
        for rr in range(max(r - 1, 0), min(r + 2, rows)):
            for cc in range(max(c - 1, 0), min(c + 2, columns)):
                for m in range(start[rr * columns + cc], start[rr * columns + cc + 1]):
                    j = members[m]
                    if z[j] > top and (x[j] - x[i]) ** 2 + (y[j] - y[i]) ** 2 <= reach * reach:
                        top = z[j]
        if top > -(2**62):
            out[i] = top
    return out


@kernel
def counts_nearby(x: IntArray, y: IntArray, used: BoolArray, reach: int) -> IntArray:
    """How many used points, itself included, lie within `reach` in x and in y of each used point; 0 for others."""
    n = x.size
    out = np.zeros(n, np.int64)
    if n == 0:
        return out
    start, members, column0, row0, columns, rows = points_by_cell(x, y, used, reach)
    for i in range(n):
        if not used[i]:
            continue
        c, r = x[i] // reach - column0, y[i] // reach - row0
        for rr in range(max(r - 1, 0), min(r + 2, rows)):
            for cc in range(max(c - 1, 0), min(c + 2, columns)):
                for m in range(start[rr * columns + cc], start[rr * columns + cc + 1]):
                    j = members[m]
                    if abs(x[j] - x[i]) <= reach and abs(y[j] - y[i]) <= reach:
                        out[i] += 1
    return out


@kernel
def sums_around(x: IntArray, y: IntArray, used: BoolArray, values: IntArray, cell: int) -> IntArray:
    """Sums (n, k) of int64 values over the used points in the 3 x 3 cells around each used point; zeros for others.

    Places (n,) and the side of a cell are in mm; cells are anchored at the CRS's origin.
    """
    n, k = values.shape
    out = np.zeros((n, k), np.int64)
    if n == 0:
        return out
    column0, row0 = x.min() // cell - 1, y.min() // cell - 1
    columns, rows = x.max() // cell - column0 + 2, y.max() // cell - row0 + 2
    sums = np.zeros((rows, columns, k), np.int64)
    for i in range(n):
        if used[i]:
            sums[y[i] // cell - row0, x[i] // cell - column0] += values[i]
    for i in range(n):
        if used[i]:
            r, c = y[i] // cell - row0, x[i] // cell - column0
            for rr in range(r - 1, r + 2):
                for cc in range(c - 1, c + 2):
                    out[i] += sums[rr, cc]
    return out


@kernel
def index_of_each(
    x: IntArray, y: IntArray, z: IntArray, number: ByteArray, of_x: IntArray, of_y: IntArray, of_z: IntArray,
    of_number: ByteArray,
) -> IntArray:  # fmt: skip
    """For each point the first of the others that has its coordinates and return number, int64 (n,); -1 where none."""
    m = of_x.size
    size = 2
    while size < 2 * m:
        size *= 2
    mask = size - 1
    holder = np.full(size, -1, np.int64)
    for j in range(m):
        s = slot_of_key((of_x[j] * 73856093) ^ (of_y[j] * 19349663) ^ (of_z[j] * 83492791) ^ of_number[j], mask)
        while True:
            k = holder[s]
            if k < 0:
                holder[s] = j
                break
            if of_x[k] == of_x[j] and of_y[k] == of_y[j] and of_z[k] == of_z[j] and of_number[k] == of_number[j]:
                break
            s = (s + 1) & mask
    out = np.full(x.size, -1, np.int64)
    for i in range(x.size):
        s = slot_of_key((x[i] * 73856093) ^ (y[i] * 19349663) ^ (z[i] * 83492791) ^ number[i], mask)
        while holder[s] >= 0:
            k = holder[s]
            if of_x[k] == x[i] and of_y[k] == y[i] and of_z[k] == z[i] and of_number[k] == number[i]:
                out[i] = k
                break
            s = (s + 1) & mask
    return out


def classes_of(
    evidence: PointEvidence, wanted: BoolArray, vegetation: VegetationSettings, *, given: bool = False
) -> ByteArray:
    """`PointClass` of every wanted point, (n,) uint8; 0 for the others.

    `evidence` holds the points of a window that reaches `support_m` beyond the wanted ones. Buildings that are `given`,
    by classes or footprints, keep their points; others may lose and gain points where the survey is sparse.
    """
    e = evidence
    x, y, z = e.x_mm, e.y_mm, e.z_mm
    known = e.height_mm != NO_DATA
    noise = noise_of(x, y, e.height_mm, e.rise_mm, e.outlier)
    # a lonely point on the terrain is ground: sparse surveys are full of them
    noise &= ~(e.outlier & e.ground & (e.height_mm >= -DEEP_MM))
    ground = e.ground & ~noise
    held = e.building & ~noise
    open_ = ~(noise | ground | held)
    top = tops_nearby(x, y, z, held, open_ & wanted, WALL_REACH_MM)
    beside = (top != NO_DATA) & (z <= top)
    close = tops_nearby(x, y, z, held, beside, UNDER_ROOF_MM)
    # where points lie farther apart than that, the roof's edge is known no better than to their spacing
    crowd = sums_around(x, y, np.ones(len(x), np.bool_), np.ones((len(x), 1), np.int64), AROUND_MM)[:, 0]
    sparse = crowd * UNDER_ROOF_MM**2 < 9 * AROUND_MM**2
    under = beside & (sparse | ((close != NO_DATA) & (z <= close)))
    over = (top != NO_DATA) & ~beside & (z <= top + ON_ROOF_MM)
    tall = ~known | (e.height_mm >= TALL_MM)
    leafy = leafiness(e, open_, tall, vegetation)
    building = held | (open_ & (under | ((beside | over) & (leafy != LEAFY))))
    if not given:
        building = _with_sparse(e, building, (held, ground, noise), wanted)
    # what stands alone on a roof is part of it; in the open it is not known to be anything smooth
    unknown = leafy == UNKNOWN
    out = np.full(len(x), PointClass.OTHER, np.uint8)
    out[(leafy == LEAFY) | (unknown & tall)] = PointClass.VEGETATION
    out[building] = PointClass.BUILDING
    out[ground] = PointClass.GROUND
    out[noise] = PointClass.NOISE
    out[~wanted] = 0
    return out


def _with_sparse(
    evidence: PointEvidence, building: BoolArray, parts: tuple[BoolArray, BoolArray, BoolArray], wanted: BoolArray
) -> BoolArray:
    """The points of buildings, (n,); where the survey is sparse, the likely ones among all above the ground.

    `parts` are the points of candidates, of the ground, and the noise: neighbours count by these, not by a judgement.
    """
    x, y = evidence.x_mm, evidence.y_mm
    held, ground, noise = parts
    values = np.column_stack((np.ones(len(x), np.int64), evidence.echoes.astype(np.int64)))
    crowd, echoes = sums_around(x, y, np.ones(len(x), np.bool_), values, CROWD_MM).T
    judged = wanted & (evidence.height_mm != NO_DATA) & ~ground & ~noise & (echoes > 0)
    judged &= crowd * 1_000_000 < MAX_SPARSE_PER_M2 * 9 * CROWD_MM**2
    role = np.full(len(x), Role.OTHER, np.int8)
    role[held], role[ground], role[noise] = Role.HELD, Role.GROUND, Role.NOISE
    points = SparsePoints(
        x_mm=x, y_mm=y, z_mm=evidence.z_mm, height_mm=evidence.height_mm, role=role, several=evidence.echoes
    )
    return np.where(judged, likely_building(points, judged), building)


def noise_of(x_mm: IntArray, y_mm: IntArray, height_mm: IntArray, rise_mm: IntArray, outlier: BoolArray) -> BoolArray:
    """Mask of the noise: gross outliers, which are nearly alone in space, and a few points far below the terrain.

    Places and heights above the terrain are in mm, NO_DATA where there is none. `rise_mm` is the rise of the terrain
    over a metre: on a slope a point may lie lower by what the terrain rises over the box.
    """
    limit = DEEP_MM + rise_mm * PIT_REACH_MM // 1000
    deep = (height_mm != NO_DATA) & (height_mm < -limit)
    noise: BoolArray = outlier | (deep & (counts_nearby(x_mm, y_mm, deep, PIT_REACH_MM) <= 1 + PIT_MATES))
    return noise


def leafiness(evidence: PointEvidence, among: BoolArray, tall: BoolArray, vegetation: VegetationSettings) -> KindArray:
    """Whether points are vegetation by what lies around them: pulses that go on, or a surface that is not smooth.

    Points that are `tall`, higher than cars and fences, need one of them, low points both: cars and fences scatter
    pulses, too. Points `among` are looked at, and judged: neither ground nor building. Returns `LEAFY`, `SMOOTH`, or
    `UNKNOWN` where there are too few points for a judgement or the point is not looked at.
    """
    # most points are ground or building: the sums are held for the others only
    index = np.flatnonzero(among)
    x, y, z = evidence.x_mm[index], evidence.y_mm[index], evidence.z_mm[index]
    all_of_them = np.ones(len(index), np.bool_)
    chosen, _ = highest_per_cell(x, y, z, np.zeros(len(index), np.int8), all_of_them, CELL_M)
    flat = planarity(x[chosen], y[chosen], z[chosen], np.ones(len(chosen), np.bool_), vegetation)
    values = np.zeros((len(index), 4), np.int64)
    values[:, 0] = 1
    values[:, 1] = evidence.echoes[index]
    values[chosen, 2] = flat > 0
    values[chosen, 3] = flat == 0
    points, echoes, smooth, rough = sums_around(x, y, all_of_them, values, AROUND_MM).T
    often, uneven = 2 * echoes >= points, rough >= smooth
    leafy = np.where(tall[index], often | uneven, often & uneven)
    found = np.full(len(among), UNKNOWN, np.int8)
    unknown = (points < vegetation.min_neighbours) | (~often & (smooth + rough == 0))
    found[index] = np.where(unknown, UNKNOWN, np.where(leafy, LEAFY, SMOOTH))
    return found
