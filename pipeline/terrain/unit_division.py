"""Units: separates touching buildings in one candidate by their roofs.

A candidate is everything connected above the ground; a row of houses is one. Its roof is divided into planar patches
(`terrain.roof_patches`). Patches whose planes meet along their border (ridges, hips, valleys of L-shaped houses,
dormers) belong to one unit; patches with a step between them do not. A part that is small, enclosed by another one
(dormers, towers), or a lower annex of another one joins it again. Two exceptions follow from how houses are built:

- a step along the contour lines of the roof, as in offset pent roofs and saw-tooth halls, lies within a house: party
  walls run up the slope;
- a valley between two parallel ridges is the gutter between two houses, but not between alike teeth of a saw-tooth
  hall, whose backs are steep.

Patches of one curved surface (`terrain.curved_surfaces`) are one unit, whatever the folds between them.

Houses of one height under one ridge show none of this and stay one unit.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import FloatArray, IntArray, LabelArray
from pipeline.terrain.ridge_steps import Rows, cut_at_ridge_steps
from pipeline.terrain.roof_patches import (
    MIN_COSINE,
    MIN_POINTS,
    Borders,
    GrownPatches,
    Patches,
    RoofVertices,
    grown_patches,
    has_directions,
    measured_patches,
)
from pipeline.terrain.terrain_settings import UnitSettings
from pipeline.terrain.thinning import highest_per_cell
from pipeline.tin.delaunay import MAX_WINDOW_MM, triangulate

# Not settings: they define what a border, a ridge and a valley are. How units are split and joined can be set.
THINNING_M = 0.5
"""Side of the cells of which one point each enters the TIN, as in the split of a scene."""
_PART_M2 = 6.0
"""Smaller patches, as chimneys and dormers, connect nothing."""
_LEVEL_SHARE = 0.5
"""Share of a border along which planes that meet are level."""
_SHORTEST_BORDER_M = 2.0
"""Shorter borders join nothing: at a step, opposite slopes of two houses touch over a metre or so."""
_SHORTEST_VALLEY_M = 3.0
"""Shorter valleys lie between dormers, or where two houses touch at the inner corner of a block."""
_SLOPED = math.tan(math.radians(10.0))
"""Rise over run from which a patch has a direction: flat roofs drain at less."""
_ALONG = 0.5
"""Sine of 30 deg: a border closer than this to a contour line runs along it."""
_OPPOSITE = -0.87
"""Cosine of 150 deg: slopes that face each other."""


@dataclasses.dataclass(frozen=True)
class _Facing:
    """How two sloped patches face their common border."""

    along_contours: bool
    """The border runs along the contour lines of both."""
    opposite: bool
    """They slope in opposite directions."""
    ridge: bool
    """Both rise towards the border."""
    valley: bool
    """Both fall towards the border."""
    alike: bool
    """They slope in one direction, about as steeply: one slope goes on in the other."""


def _facing(patches: Patches, borders: Borders, row: int) -> _Facing | None:
    """How the patches of a border face it; None where one of them is flat or no plane."""
    p, q = int(borders.first[row]), int(borders.second[row])
    (ax, ay), (bx, by) = patches.slopes[p].tolist(), patches.slopes[q].tolist()
    steep_p, steep_q = math.hypot(ax, ay), math.hypot(bx, by)
    if not (steep_p >= _SLOPED and steep_q >= _SLOPED):
        return None
    dx, dy = borders.direction[row].tolist()
    # across the border, from the first to the second
    nx, ny = -dy, dx
    cx, cy, _ = (patches.centres_m[q] - patches.centres_m[p]).tolist()
    if nx * cx + ny * cy < 0.0:
        nx, ny = -nx, -ny
    rise_p, rise_q = (ax * nx + ay * ny) / steep_p, (bx * nx + by * ny) / steep_q
    along = abs(ax * dx + ay * dy) <= _ALONG * steep_p and abs(bx * dx + by * dy) <= _ALONG * steep_q
    opposite = (ax * bx + ay * by) / (steep_p * steep_q) <= _OPPOSITE
    ridge, valley = along and rise_p > 0.0 > rise_q, along and rise_p < 0.0 < rise_q
    between = (1.0 + ax * bx + ay * by) / math.sqrt((1.0 + steep_p**2) * (1.0 + steep_q**2))
    return _Facing(along, opposite, ridge, valley, between >= MIN_COSINE)


def _clear_borders(patches: Patches, borders: Borders) -> dict[int, _Facing | None]:
    """Rows of the borders that are long enough, between patches that are large enough, and how these face them."""
    large = (patches.areas_m2 >= _PART_M2) & ~np.isnan(patches.levels_mm)
    is_clear = large[borders.first] & large[borders.second] & (borders.extent_m >= _SHORTEST_BORDER_M)
    return {row: _facing(patches, borders, row) for row in np.flatnonzero(is_clear).tolist()}


def _meets(borders: Borders, row: int) -> bool:
    """Whether the planes of two patches meet along their border."""
    return bool(borders.level_m[row] >= _LEVEL_SHARE * borders.length_m[row])


def _joins(seen: _Facing | None, meets: bool, extent_m: float) -> bool:
    """Whether two patches that face their border like this belong to one unit."""
    if seen is None:
        return meets
    return seen.along_contours or (meets and (seen.alike or extent_m >= _SHORTEST_VALLEY_M))


def units_of_patches(
    patches: Patches, borders: Borders, roof: IntArray, house: IntArray, curve: LabelArray, settings: UnitSettings
) -> LabelArray:
    """The unit of every patch of a candidate's roof, (k,) int32, numbered by one of its patches.

    `roof` and `house` (k,) are those of `cut_at_ridge_steps`: two houses of one roof are two units. `curve` (k,) is
    that of `curved_surfaces`: its patches are of one unit.
    """
    count = len(patches.areas_m2)
    unit = np.where(curve >= 0, curve, np.arange(count))
    facing = _clear_borders(patches, borders)
    across: dict[int, set[int]] = {}
    for row, seen in facing.items():
        if seen is not None and seen.ridge and seen.opposite:
            p, q = int(borders.first[row]), int(borders.second[row])
            across.setdefault(p, set()).add(q)
            across.setdefault(q, set()).add(p)
    apart: dict[int, set[int]] = {k: set() for k in set(unit.tolist())}
    joining = []
    for row, seen in facing.items():
        p, q = int(borders.first[row]), int(borders.second[row])
        if unit[p] == unit[q]:
            continue
        is_gutter = (
            settings.split == "ridges"
            and seen is not None
            and seen.valley
            and seen.opposite
            and p in across
            and q in across
            and borders.extent_m[row] >= _SHORTEST_VALLEY_M
        )
        if is_gutter:
            from pipeline.terrain.saw_teeth import are_teeth  # few candidates have a gutter

            is_gutter = not are_teeth(patches, p, q, across)
        if is_gutter or (roof[p] == roof[q] and house[p] != house[q]):
            apart[int(unit[p])].add(int(unit[q]))
            apart[int(unit[q])].add(int(unit[p]))
        elif _joins(seen, _meets(borders, row), float(borders.extent_m[row])):
            joining.append(row)
    # the longest first, so that what runs along several houses does not unite them across their gutters
    for row in sorted(joining, key=lambda row: (-borders.length_m[row], row)):
        p, q = sorted((int(unit[borders.first[row]]), int(unit[borders.second[row]])))
        if p == q or q in apart[p]:
            continue
        unit[unit == q] = p
        apart[p] |= apart[q]
        for other in apart.pop(q):
            apart[other].discard(q)
            apart[other].add(p)
    if (unit == unit[0]).all():
        return unit.astype(np.int32)
    from pipeline.terrain.absorbed_parts import absorbed  # most candidates are one building

    return absorbed(unit, patches, borders, settings)


@kernel
def _unit_of_points(
    x: IntArray,
    y: IntArray,
    z: IntArray,
    vertices: RoofVertices,
    cell_mm: int,
    unit: LabelArray,
    patch: LabelArray,
    planes: FloatArray,
) -> LabelArray:
    """Unit of every point (n,), mm: that of its cell's vertex, or beside a border that of the nearest plane around it.

    `unit` and `patch` (v,) are those of the vertices; `planes` (k, 3) are slopes and levels in mm, nan where none.
    """
    vx, vy, vz, start, others = vertices
    n = x.size
    out = np.empty(n, np.int32)
    column0, row0 = vx.min() // cell_mm, vy.min() // cell_mm
    columns = vx.max() // cell_mm - column0 + 1
    rows = vy.max() // cell_mm - row0 + 1
    holder = np.full(columns * rows, -1, np.int32)
    at_border = np.zeros(vx.size, np.bool_)
    for v in range(vx.size):
        holder[(vy[v] // cell_mm - row0) * columns + vx[v] // cell_mm - column0] = v
        for e in range(start[v], start[v + 1]):
            at_border[v] |= unit[others[e]] != unit[v]
    for i in range(n):
        v = holder[(y[i] // cell_mm - row0) * columns + x[i] // cell_mm - column0]
        out[i] = unit[v]
        if not at_border[v]:
            continue
        best = -1.0
        for e in range(start[v] - 1, start[v + 1]):
            w = others[e] if e >= start[v] else v
            p = patch[w]
            if np.isnan(planes[p, 2]):
                away = float(abs(z[i] - vz[w]))
            else:
                away = abs(z[i] - planes[p, 2] - planes[p, 0] * x[i] - planes[p, 1] * y[i])
            if best < 0.0 or away < best:
                best = away
                out[i] = unit[w]
    return out


@kernel
def smallest_points(x: IntArray, y: IntArray, z: IntArray, label: LabelArray) -> IntArray:
    """Index of the lexicographically smallest point of every label from 0 on, int64; -1 for a label without points."""
    found = np.full(label.max() + 1, -1, np.int64)
    for i in range(x.size):
        j = found[label[i]]
        if j < 0 or x[i] < x[j] or (x[i] == x[j] and (y[i] < y[j] or (y[i] == y[j] and z[i] < z[j]))):
            found[label[i]] = i
    return found


def _rows(patches: Patches, borders: Borders) -> Rows:
    """The borders along which a row of houses goes on."""
    ridges, continued = [], []
    for row, seen in _clear_borders(patches, borders).items():
        if seen is None:
            continue
        if seen.ridge and seen.opposite:
            ridges.append(row)
        elif _meets(borders, row) and (seen.alike or (seen.along_contours and not seen.opposite)):
            continued.append(row)
    return Rows(ridges=np.array(ridges, np.int64), continued=np.array(continued, np.int64))


def _curves(grown: GrownPatches, patches: Patches, borders: Borders) -> LabelArray:
    """The curved surface of each patch, (k,) int32 as the number of one of its patches; -1 for none."""
    count = len(patches.areas_m2)
    normals = np.column_stack((-patches.slopes, np.ones(count)))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    if not has_directions(normals):
        return np.full(count, -1, np.int32)
    from pipeline.terrain.curved_surfaces import curved_surfaces  # roofs of a few planes have no curve

    return curved_surfaces(grown, patches, borders, normals)


def units_of(
    x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, settings: UnitSettings, strips: IntArray | None = None
) -> LabelArray:
    """Unit of every point of one candidate, (n,) int32, numbered by their lexicographically smallest points.

    All its points are in absolute millimetres, in any order. `strips` (n,) are their flight strips; without them, all
    are taken for one.
    """
    n = len(x_mm)
    strips = np.zeros(n, np.int64) if strips is None else strips
    one = np.zeros(n, np.int32)
    if settings.split == "nothing" or n < 2 * MIN_POINTS:
        return one
    if max(int(np.ptp(x_mm)), int(np.ptp(y_mm))) >= MAX_WINDOW_MM:
        return one
    chosen, cell = highest_per_cell(x_mm, y_mm, z_mm, np.zeros(n, np.int8), np.ones(n, np.bool_), THINNING_M)
    # points of several strips may lie at one place, in any order
    top = chosen[cell]
    at_top = np.flatnonzero((x_mm == x_mm[top]) & (y_mm == y_mm[top]) & (z_mm == z_mm[top]))
    strip = np.full(len(chosen), np.iinfo(np.int64).max)
    np.minimum.at(strip, cell[at_top], strips[at_top])
    cell_mm = round(THINNING_M * 1000)
    # whole cells are left out, so that the lattice keeps its place
    x0, y0 = int(x_mm.min()) // cell_mm * cell_mm, int(y_mm.min()) // cell_mm * cell_mm
    x, y, z = x_mm - x0, y_mm - y0, z_mm - int(z_mm.min())
    vx, vy, vz = x[chosen], y[chosen], z[chosen]
    tin = triangulate(np.column_stack((vx, vy)))
    if len(tin) == 0:
        return one
    grown = grown_patches(vx, vy, vz, tin)
    patches, borders = measured_patches(grown, settings.min_step_m)
    rows = _rows(patches, borders)
    grown, roof, house = cut_at_ridge_steps(grown, borders, rows, strip, settings.min_ridge_step_m)
    if len(roof) > len(patches.areas_m2):
        patches, borders = measured_patches(grown, settings.min_step_m)
    curve = _curves(grown, patches, borders)
    unit_of_patch = units_of_patches(patches, borders, roof, house, curve, settings)
    if (unit_of_patch == unit_of_patch[0]).all():
        return one
    planes = np.column_stack((patches.slopes, patches.levels_mm))
    unit = unit_of_patch[patches.of_vertex]
    label = _unit_of_points(x, y, z, grown.vertices, cell_mm, unit, patches.of_vertex, planes)
    first = smallest_points(x, y, z, label)
    present = np.flatnonzero(first >= 0)
    smallest = first[present]
    rank = np.empty(len(first), np.int32)
    rank[present[np.lexsort((z[smallest], y[smallest], x[smallest]))]] = np.arange(len(present), dtype=np.int32)
    numbered: LabelArray = rank[label]
    return numbered
