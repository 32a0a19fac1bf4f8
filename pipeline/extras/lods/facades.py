"""Outlines at the facades: the eaves drawn back to where points beneath them put the walls.

An oblique scan meets walls beneath the eaves. Such facade points lie in one upright sheet along a line of the outline,
from the ground up to the eave. Where a sheet stands out, the line is moved there. Walls that face away from the scanner
have none: a line with open ground before it is then drawn back by the mean overhang of the lines of the same outline
whose walls are known, else by a usual overhang from the settings. A line without open ground before it, as along a
neighbour, stays.

If a pulse is split at the eave, a part of its beam passes the edge and meets the wall. Its last return is recorded on
the axis of the beam, too far inside by about the reach of the mixed pulses. The last of several returns therefore move
outwards by that reach before a sheet is searched for.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon
from shapely.geometry.polygon import orient

from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.roof.footprint import polygons_of
from pipeline.roof.lines import Run, corners

# The thresholds below describe what walls, eaves and their surroundings look like in a survey; `outline = "walls"` is
# one switch, and they are not known for a tile.
_MIN_LINE_M = 2.0
"""A shorter line takes the mean overhang."""
_STRIP_M = 1.0
"""Length of the strips along a line in which the eave's height is taken."""
_EAVE_DEPTH_M = 1.2
"""The lowest roof point within this of the line is the eave."""
_END_MARGIN_M = 0.3
"""Left out at either end of a line: there the next wall begins."""
_MAX_OVERHANG_M = 1.0
"""The widest overhang."""
_OUTSIDE_EAVE_M = 0.5
"""Points as far outside the eave are looked at too: where most are there, they are plants, not a wall."""
_SHEET_M = 0.3
"""Thickness of a facade with its reliefs, as several strips of a survey show it."""
_WALL_VARIANCE_M2 = _SHEET_M**2 / 12.0
_WALL_SIGMA_M = math.sqrt(_WALL_VARIANCE_M2)
"""Standard error of one wall: that of a uniform distribution as wide as its sheet."""
_MIN_BELOW_EAVE_M = 0.5
"""Gutters and soffits hang no lower."""
_MIN_HEIGHT_M = 1.0
"""Lower points are steps, fences and cars."""
_MIN_SHEET_HEIGHT_M = 1.5
"""Least height of a sheet."""
_MIN_SHEET_POINTS = 8
"""Least number of points of a sheet."""
_MIN_SHEET_SHARE = 0.5
"""Least share of the points beneath and before the eave in the sheet."""
_MIN_OCCUPIED_SHARE = 0.25
"""Least share of the strips with points of the sheet."""
_MAX_OUTSIDE_M = 0.1
"""A sheet as far outside the eave still is the wall beneath it: outlines err by as much."""
_OPEN_FROM_M = 0.2
_OPEN_TO_M = 1.5
"""Strip before a line in which open ground is searched for."""
_MAX_OPEN_HEIGHT_M = 1.5
"""Points as low above the terrain are open ground."""
_MIN_OPEN_SHARE = 0.5
"""Least share of the strips with such points."""
_MAX_CORNER_REACH_M = 2.0
"""Lines that meet farther than this from their corner at the eaves are joined by a step there."""
_MAX_CHANGE_PER_SWEPT = 1.5
"""Most area between eaves and walls, as a multiple of what the lines sweep."""
_ROUNDING_MM2 = 1e4
"""Added to it: what rounding to 1 mm changes along 10 m."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FacadePoints:
    """Points that may show the walls beneath a roof."""

    xyz: FloatArray
    """(n, 3) float64, points around and beneath the roof, without its own, local metres."""
    height_m: FloatArray
    """(n,) float64, theirs above the terrain."""
    later: BoolArray
    """(n,) bool, True for the last of several returns of a pulse."""
    roof: FloatArray
    """(m, 3) float64, the roof points, local metres."""
    tree: shapely.STRtree
    """Index of `xyz` in plan."""
    roof_tree: shapely.STRtree
    """Index of `roof` in plan."""

    @classmethod
    def of(
        cls, single: FloatArray, later: FloatArray, roof: FloatArray, ground: FloatArray, ground_z_m: float
    ) -> FacadePoints:
        """Take heights above the terrain, `ground_z_m` where the terrain has no cell, and index the points.

        Parameters
        ----------
        single, later : (n, 3) and (k, 3) float64
            Points around and beneath the roof, of pulses with one return and the last of several, local metres; in
            any order.
        ground : (j, 3) float64
            The terrain at the middles of cells of 1 m, local metres.
        """
        xyz = np.concatenate((single, later))
        cells, wanted = _cells(ground), _cells(xyz)
        order = np.argsort(cells, kind="stable")
        floor = np.full(len(xyz), ground_z_m)
        if len(cells):
            place = order[np.minimum(np.searchsorted(cells, wanted, sorter=order), len(cells) - 1)]
            known = cells[place] == wanted
            floor[known] = ground[place[known], 2]
        return cls(
            xyz=xyz,
            height_m=xyz[:, 2] - floor,
            later=np.arange(len(xyz)) >= len(single),
            roof=roof,
            tree=shapely.STRtree(shapely.points(xyz[:, :2])),
            roof_tree=shapely.STRtree(shapely.points(roof[:, :2])),
        )


def _cells(xyz: FloatArray) -> IntArray:
    """A number for the cell of 1 m of every point, (n,)."""
    cells = np.floor(xyz[:, :2]).astype(np.int64)
    numbers: IntArray = (cells[:, 0] << 32) + cells[:, 1]
    return numbers


@dataclasses.dataclass(frozen=True, kw_only=True)
class Eave:
    """One line of an outline and the wall beneath it."""

    length_m: float
    """From corner to corner."""
    is_open: bool
    """Whether open ground lies before it; assumed for a short line."""
    overhang_m: float | None
    """How far inside the line its wall is; None where there is no sheet of points."""


def eave_of(start: FloatArray, end: FloatArray, points: FacadePoints, reach_m: float) -> Eave:
    """The wall beneath one line of an outline, as far as points show it.

    The line goes from `start` to `end`, (2,) local metres, the roof on its left; see `mixed_pulse_reach_mm` for the
    reach. The overhang is slightly negative where the outline was drawn a little inside the wall.
    """
    length = math.dist(start, end)
    if length < _MIN_LINE_M:
        return Eave(length_m=length, is_open=True, overhang_m=None)
    (x0, y0), (ux, uy) = start.tolist(), ((end - start) / length).tolist()
    out = np.array([uy, -ux])
    strips = max(1, math.floor(length / _STRIP_M))

    def near(
        tree: shapely.STRtree, xyz: FloatArray, inside: float, outside: float
    ) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
        """Indices of points by the line, their ways along it and to its right, and their strips."""
        box = Polygon([start - inside * out, start + outside * out, end + outside * out, end - inside * out])
        index = np.sort(tree.query(box, predicate="intersects"))
        x, y = xyz[index, 0] - x0, xyz[index, 1] - y0
        way = x * ux + y * uy
        return index, way, x * uy - y * ux, np.clip((way / length * strips).astype(np.int64), 0, strips - 1)

    index, _, _, strip = near(points.roof_tree, points.roof, _EAVE_DEPTH_M, _SHEET_M)
    if len(index) == 0:
        return Eave(length_m=length, is_open=False, overhang_m=None)
    eave_z = np.full(strips, np.inf)
    np.minimum.at(eave_z, strip, points.roof[index, 2])
    eave_z[np.isinf(eave_z)] = eave_z.min()
    index, way, off, strip = near(points.tree, points.xyz, _MAX_OVERHANG_M + _SHEET_M, _OPEN_TO_M)
    z, height = points.xyz[index, 2], points.height_m[index]
    off = off + reach_m * points.later[index]
    open_strips = np.unique(strip[(off > _OPEN_FROM_M) & (height < _MAX_OPEN_HEIGHT_M)])
    if len(open_strips) < _MIN_OPEN_SHARE * strips:
        return Eave(length_m=length, is_open=False, overhang_m=None)
    beneath = (off < _OUTSIDE_EAVE_M) & (z < eave_z[strip] - _MIN_BELOW_EAVE_M) & (height > _MIN_HEIGHT_M)
    beneath &= (way > _END_MARGIN_M) & (way < length - _END_MARGIN_M)
    overhang_m = _overhang_of_sheet(off[beneath], strip[beneath], z[beneath], strips)
    return Eave(length_m=length, is_open=True, overhang_m=overhang_m)


def _overhang_of_sheet(off: FloatArray, strip: IntArray, z: FloatArray, strips: int) -> float | None:
    """How far inside a line the sheet with most of the points is; None where it is not a wall.

    `off` is the points' distance to the right of the line, `strip` where along it they are.
    """
    if len(off) < _MIN_SHEET_POINTS:
        return None
    order = np.lexsort((z, strip, off))
    off, strip, z = off[order], strip[order], z[order]
    counts = np.searchsorted(off, off + _SHEET_M, side="right") - np.arange(len(off))
    first = int(np.argmax(counts))
    sheet = slice(first, first + int(counts[first]))
    fewest = max(_MIN_SHEET_POINTS, _MIN_SHEET_SHARE * len(off))
    if counts[first] < fewest or float(np.ptp(z[sheet])) < _MIN_SHEET_HEIGHT_M:
        return None
    if len(np.unique(strip[sheet])) < _MIN_OCCUPIED_SHARE * strips:
        return None
    overhang = -float(np.median(off[sheet]))
    return min(overhang, _MAX_OVERHANG_M) if overhang >= -_MAX_OUTSIDE_M else None


def mean_overhang(eaves: Sequence[Eave]) -> tuple[float, float]:
    """Mean overhang of the lines whose wall is known, by their lengths, never negative, and its standard error, metres.

    Each line has its own error, as great as its sheet is thick, and the lines differ; nan where no wall is known.
    """
    known = [(eave.length_m, eave.overhang_m) for eave in eaves if eave.overhang_m is not None]
    if not known:
        return math.nan, math.nan
    whole = math.fsum(length for length, _ in known)
    mean = math.fsum(length * over for length, over in known) / whole
    variance = math.fsum(length**2 * (_WALL_VARIANCE_M2 + (over - mean) ** 2) for length, over in known) / whole**2
    return max(0.0, mean), math.sqrt(variance)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Walls:
    """The walls beneath an outline at the eaves."""

    outline_mm: MultiPolygon
    """At the walls, integer millimetres; at the eaves where a ring would break."""
    overhang_m: float
    """Mean overhang of the lines whose wall is known; nan where no wall is."""
    overhang_sigma_m: float
    """Its standard error."""
    overhung_mm: MultiPolygon
    """The same with the least overhang that counts: where it is less, or not above its standard error, at the eaves."""
    widest_m: float
    """The widest overhang of a line, seen or taken over."""
    counted_m: float
    """The widest that counts."""


def walls_beneath(
    outline_mm: MultiPolygon, points: FacadePoints, reach_m: float, usual_m: float, least_m: float = 0.0
) -> Walls:
    """Find the walls beneath an outline at the eaves, with straight lines, in integer millimetres; it stays valid.

    `usual_m` is the overhang where no wall of the whole outline is known, `least_m` the least that counts; see
    `mixed_pulse_reach_mm` for the reach.
    """
    polygons = [orient(polygon) for polygon in outline_mm.geoms]
    rings = rings_of(polygons)
    eaves_of = [_eaves(ring, points, reach_m) for _, ring in rings]
    known_m, sigma_m = mean_overhang([eave for eaves in eaves_of for eave in eaves])
    mean_m, mean_sigma_m = (usual_m, 0.0) if math.isnan(known_m) else (known_m, sigma_m)
    ways_m, counted_m = [], []
    for eaves in eaves_of:
        ways = [e.overhang_m if e.overhang_m is not None else mean_m if e.is_open else 0.0 for e in eaves]
        least = [max(least_m, mean_sigma_m if e.overhang_m is None else _WALL_SIGMA_M) for e in eaves]
        ways_m.append(ways)
        counted_m.append([way if way >= enough else 0.0 for way, enough in zip(ways, least, strict=True)])

    moved: list[list[FloatArray]] = [[] for _ in polygons]
    for (k, ring), ways in zip(rings, ways_m, strict=True):
        moved[k].append(moved_line_by_line(ring, ways))
    drawn = MultiPolygon([Polygon(outer, holes) for outer, *holes in moved])
    walls = drawn if drawn.is_valid else outline_mm
    return Walls(
        outline_mm=walls,
        overhang_m=known_m,
        overhang_sigma_m=sigma_m,
        overhung_mm=_overhung(polygons, rings, counted_m),
        widest_m=max(way for ways in ways_m for way in ways),
        counted_m=max(way for ways in counted_m for way in ways),
    )


def rings_of(polygons: Sequence[Polygon]) -> list[tuple[int, FloatArray]]:
    """The vertices of all rings, (n, 2) each, and the numbers of their polygons; the outer ring of each comes first."""
    return [
        (k, shapely.get_coordinates(ring)[:-1])
        for k, polygon in enumerate(polygons)
        for ring in (polygon.exterior, *polygon.interiors)
    ]


def _overhung(
    polygons: Sequence[Polygon], rings: Sequence[tuple[int, FloatArray]], ways_m: Sequence[Sequence[float]]
) -> MultiPolygon:
    """Polygons without what hangs over the lines of their rings, in integer millimetres.

    The lines of a ring are moved, as those of an outline at the walls. Where the ring would break, for example at a
    notch that is narrower than its overhangs, the strips along its lines are taken away.
    """
    walls: list[list[FloatArray]] = [[] for _ in polygons]
    strips: list[list[Polygon]] = [[] for _ in polygons]
    for (k, ring), ways in zip(rings, ways_m, strict=True):
        walls[k].append(moved_line_by_line(ring, ways))
        if any(ways) and walls[k][-1] is ring:
            strips[k] += _strips(ring, ways)
    parts: list[Polygon] = []
    for k, (polygon, (outer, *holes)) in enumerate(zip(polygons, walls, strict=True)):
        whole = Polygon(outer, holes)
        if not whole.is_valid:  # its rings are sound and cross one another
            whole = polygon
            strips[k] = [
                s for (j, ring), ways in zip(rings, ways_m, strict=True) if j == k for s in _strips(ring, ways)
            ]
        hidden = shapely.union_all(strips[k])
        parts += polygons_of(shapely.difference(whole, hidden, grid_size=1.0) if strips[k] else whole)
    return MultiPolygon(parts)


def _strips(ring: FloatArray, ways_m: Sequence[float]) -> list[Polygon]:
    """The strips to the left of the lines of a ring, (n, 2) in millimetres, as wide as their overhangs.

    Where two of them meet at a corner that points inwards, what the moved lines cut off beside both is added.
    """
    ends = np.roll(ring, -1, axis=0)
    along = (ends - ring) / np.maximum(np.hypot(*(ends - ring).T), 1.0)[:, None]
    inwards = 1e3 * np.array(ways_m)[:, None] * np.column_stack((-along[:, 1], along[:, 0]))
    strips = [Polygon([a, b, b + way, a + way]) for a, b, way in zip(ring, ends, inwards, strict=True) if way.any()]
    before, before_along = np.roll(inwards, 1, axis=0), np.roll(along, 1, axis=0)
    turns = before_along[:, 0] * along[:, 1] - before_along[:, 1] * along[:, 0]
    for corner, one, other, turn in zip(ring, before, inwards, turns, strict=True):
        if turn < 0.0 and one.any() and other.any():
            strips.append(Polygon([corner, corner + other, corner + one + other, corner + one]))
    return [strip for strip in strips if strip.is_valid]


def _eaves(ring: FloatArray, points: FacadePoints, reach_m: float) -> list[Eave]:
    """The lines of a ring, (n, 2) in millimetres, from each vertex to the next."""
    starts = ring * 1e-3
    ends = np.roll(starts, -1, axis=0)
    return [eave_of(start, end, points, reach_m) for start, end in zip(starts, ends, strict=True)]


def moved_line_by_line(ring: FloatArray, ways_m: Sequence[float]) -> FloatArray:
    """A ring, (n, 2) in millimetres, with every line moved to its left; as it was where it would break."""
    runs = []
    for k, ((x0, y0), (x1, y1), way_m) in enumerate(zip(ring, np.roll(ring, -1, axis=0), ways_m, strict=True)):
        direction = math.atan2(y1 - y0, x1 - x0)
        runs.append(
            Run(
                first=k,
                last=k + 1,
                x=0.5 * (x0 + x1) - 1e3 * way_m * math.sin(direction),
                y=0.5 * (y0 + y1) + 1e3 * way_m * math.cos(direction),
                direction=direction,
                length=math.hypot(x1 - x0, y1 - y0),
            )
        )
    places = Polygon(corners(ring, runs, 1e3 * _MAX_CORNER_REACH_M, closed=True))
    if places.exterior.is_ccw != Polygon(ring).exterior.is_ccw:
        return ring  # turned inside out: narrower than its overhangs
    sound = shapely.make_valid(places, method="structure", keep_collapsed=False)
    parts = [part for piece in polygons_of(sound) for part in polygons_of(shapely.set_precision(piece, 1.0))]
    if not parts:
        return ring
    largest = Polygon(max(parts, key=lambda part: part.area).exterior)
    swept = math.fsum(run.length * 1e3 * abs(way_m) for run, way_m in zip(runs, ways_m, strict=True))
    if shapely.symmetric_difference(largest, Polygon(ring)).area > _MAX_CHANGE_PER_SWEPT * swept + _ROUNDING_MM2:
        return ring
    drawn: FloatArray = shapely.get_coordinates(largest.exterior)[:-1]
    return drawn
