"""Common walls of touching units: straight chords between the walls of a block, in its directions.

The borders between units lie half-way between the points on either side, so they zigzag. Each is described as an
outline is (`description.py`), in the directions of the outline nearby; a wall that is nearly in line with an edge of
the outline, or with a longer wall, is in line with it. Walls then end on what they meet first, the outline or another
wall, and the cells between them go to the units whose points lie in them. Cells of one drawing have no gaps and do not
overlap.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import math
from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt
import shapely
from shapely import LineString, MultiPolygon, Polygon

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.model import FloatArray, IntArray, LabelArray
from pipeline.roof.footprint import polygons_of
from pipeline.roof.lines import Run, corners, fitted_run
from pipeline.roof.outlines.exterior import NONE_MET, described_chain, pairs_of, peaks_of
from pipeline.roof.outlines.wall_ends import (
    PRICES,
    Scale,
    Wall,
    directions_beside,
    end_outside,
    ended,
    met,
    obstacles_of,
    put_through_corner,
    without_stubs,
)
from pipeline.roof.partition import RoofPartition
from pipeline.roof.simplification import unite_close_vertices

_NEARBY_MM = 10_000.0
"""The outline's edges within this of a border give its directions."""
_IN_LINE_MM = 500.0
"""Walls this near to the line of an edge, or a point spacing if that is more, are in line with it."""
_IN_LINE_GAP_MM = 4000.0
"""Such an edge ends at most this far from the wall."""
_PARALLEL = 0.03
"""Sine of the angle between walls that can be in line."""
_SHORTEST_MM = 300.0
"""A border between units is a wall from this length on. An edge must be as long to bring a wall in line."""
_STRAIGHT_ON = -0.8
"""Cosine between two borders, seen from where they meet: from 143 degrees on, one goes on in the other."""
_WAY_MM = 2500.0
"""The direction of a border at its end is that of this much of it."""
_CLOSE_MM = 10.0
"""Corners of cells this near to each other are one."""
_LEAST_CELL_MM2 = 2e6
_LEAST_WIDTH_MM = 500.0
"""Smaller or narrower cells join the neighbour with the longest common wall."""
_LEAST_OWN = 0.5
"""Walls do not separate a unit with a smaller share of its points in its cells."""


def divided(
    units: RoofPartition, outline_mm: MultiPolygon, xy_mm: IntArray, unit: LabelArray, spacing_m: float
) -> dict[int, MultiPolygon]:
    """The parts of an outline by unit, integer millimetres; none of a unit for which nothing is left.

    `units` are the surroundings of every unit's points, beyond the outline; `xy_mm` (n, 2), ascending by x, are the
    points, `unit` (n,) their units.
    """
    edges = _edges_of(outline_mm)
    within = shapely.buffer(outline_mm, Scale.of(spacing_m).beyond_mm)
    chords = _chords(_borders(units, within), outline_mm, edges, spacing_m)
    cells, owners, lost = _cells(outline_mm, chords, xy_mm, unit)
    lost |= set(units.labels.tolist()) - set(owners)
    if lost:
        # a unit that walls do not separate is drawn around its own points
        directions = pairs_of(peaks_of(_edge_runs(edges), 3))
        around = [
            _drawn_around(part.exterior, directions, spacing_m)
            for polygon, label in zip(units.polygons, units.labels.tolist(), strict=True)
            if label in lost
            for part in polygons_of(shapely.intersection(polygon, within))
        ]
        cells, owners, _ = _cells(outline_mm, [*chords, *around], xy_mm, unit)
    return _united(cells, owners)


def _chords(
    borders: Sequence[FloatArray], outline_mm: MultiPolygon, edges: FloatArray, spacing_m: float
) -> list[FloatArray]:
    """The walls along borders between units, (n, 2) each; they end on the outline, edges (e, 4), or on other walls."""
    scale = Scale.of(spacing_m)
    walls = []
    pieces, runs = shapely.linestrings(edges.reshape(-1, 2, 2)), _edge_runs(edges)
    for border in _through(borders):
        near = np.flatnonzero(shapely.dwithin(pieces, LineString(border), _NEARBY_MM)).tolist()
        directions = pairs_of(peaks_of([runs[k] for k in near]))
        walls.append(Wall(border, directions, _described(border, directions, scale)))
    _put_in_line(walls, edges, scale)
    obstacles = obstacles_of(edges, [wall.line(scale) for wall in walls])
    for k, wall in enumerate(walls):
        # what it ends on is known once all are drawn
        ends = directions_beside(wall.border[[0, -1]], obstacles, k)
        walls[k] = dataclasses.replace(wall, runs=_described(wall.border, wall.directions, scale, ends))
        end_outside(walls[k].runs, outline_mm)
    _put_in_line(walls, edges, scale)
    for change in (without_stubs, functools.partial(put_through_corner, edges=edges)):
        lines = [wall.line(scale) for wall in walls]
        obstacles = obstacles_of(edges, lines)
        for k, wall in enumerate(walls):
            change(wall, met(lines[k], k, obstacles, scale), scale)
    lines = [wall.line(scale) for wall in walls]
    obstacles = obstacles_of(edges, lines)
    return [ended(line, k, obstacles, scale) for k, line in enumerate(lines)]


def _described(border: FloatArray, directions: FloatArray, scale: Scale, ends: FloatArray = NONE_MET) -> list[Run]:
    """The edges of a border (n, 2), in some directions or others; it ends on lines with the directions `ends` (2,)."""
    return described_chain(border, directions, scale.spacing_mm, scale.noise_mm, PRICES, ends)


def _drawn_around(ring: shapely.LinearRing, directions: FloatArray, spacing_m: float) -> FloatArray:
    """A closed border (n, 2) with straight edges, in some directions or others; as it is if it has too few edges."""
    border = np.asarray(ring.coords)
    start = int(np.argmax(np.hypot(*(border - border.mean(axis=0)).T)))
    border = np.concatenate((border[start:-1], border[:start]))
    opened = np.concatenate((border, border[:1]))
    runs = _described(opened, directions, Scale.of(spacing_m))
    if len(runs) < 3:
        return opened
    places = np.array(corners(border, runs, math.inf, closed=True))
    return np.concatenate((places, places[:1]))


def _edges_of(outline_mm: MultiPolygon) -> FloatArray:
    """The edges of an outline, (e, 4): both ends of each, millimetres."""
    rings = [np.asarray(ring.coords) for part in outline_mm.geoms for ring in (part.exterior, *part.interiors)]
    return np.concatenate([np.column_stack((ring[:-1], ring[1:])) for ring in rings])


def _edge_runs(edges: FloatArray) -> list[Run]:
    """Edges (e, 4) as runs."""
    return [fitted_run(edge.reshape(2, 2), 0, 1) for edge in edges]


def _borders(units: RoofPartition, within: Polygon | MultiPolygon) -> list[FloatArray]:
    """The borders between two units, (n, 2) each, as far as they lie within an area; each begins in the west."""
    borders: list[list[list[float]]] = []
    for line in shapely.get_parts(shapely.line_merge(shapely.intersection(_common_lines(units), within))).tolist():
        if isinstance(line, LineString) and line.length > _SHORTEST_MM:
            places = shapely.get_coordinates(line).tolist()
            if places[0] == places[-1]:
                west = places.index(min(places))
                places = [*places[west:-1], *places[: west + 1]]
            borders.append(places if places[0] <= places[-1] else places[::-1])
    return [np.array(border) for border in sorted(borders)]


def _common_lines(units: RoofPartition) -> npt.NDArray[np.object_]:
    """The lines that each two units of a partition share, pair by pair, as the first one has them on its rings.

    Faces of a partition have the same edges where they meet, which makes an overlay needless.
    """
    rings, of_ring = shapely.get_rings(units.polygons, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    inside = ring[:-1] == ring[1:]
    start, end, ring = xy[:-1][inside], xy[1:][inside], ring[:-1][inside]
    own = units.labels[of_ring[ring]]
    is_turned = (start[:, 0] > end[:, 0]) | ((start[:, 0] == end[:, 0]) & (start[:, 1] > end[:, 1]))
    edges = np.where(is_turned[:, None], np.column_stack((end, start)), np.column_stack((start, end)))
    order = np.lexsort((own, *edges.T))
    twin = np.flatnonzero((edges[order[:-1]] == edges[order[1:]]).all(axis=1))
    edge, other = order[twin], own[order[twin + 1]]
    order = np.lexsort((edge, other, own[edge]))
    edge, other = edge[order], other[order]
    if len(edge) == 0:
        return np.empty(0, object)
    new_pair = (np.diff(own[edge], prepend=-1) != 0) | (np.diff(other, prepend=-1) != 0)
    new_line = new_pair | (np.diff(edge, prepend=-2) != 1) | (np.diff(ring[edge], prepend=-1) != 0)
    # a line has the starts of all its edges, and the end of the last
    firsts = np.flatnonzero(new_line)
    stops = np.append(firsts[1:], len(edge))
    places = np.insert(start[edge], stops, end[edge[stops - 1]], axis=0)
    lines = shapely.linestrings(places, indices=np.repeat(np.arange(len(firsts)), stops - firsts + 1))
    pairs: npt.NDArray[np.object_] = shapely.multilinestrings(lines, indices=np.cumsum(new_pair[firsts]) - 1)
    return pairs


def _through(borders: Sequence[FloatArray]) -> list[FloatArray]:
    """Borders that go on in one another straight: where several meet, the two that do so best are one."""
    ends: dict[tuple[float, float], list[tuple[int, bool]]] = {}
    for k, border in enumerate(borders):
        if not np.array_equal(border[0], border[-1]):
            for at_start in (True, False):
                x, y = border[0 if at_start else -1].tolist()
                ends.setdefault((x, y), []).append((k, at_start))
    follows: dict[tuple[int, bool], tuple[int, bool]] = {}
    for meeting in ends.values():
        ways = {end: _way_from(borders[end[0]], end[1]) for end in meeting}
        pairs = [(math.cos(ways[a] - ways[b]), a, b) for a, b in itertools.combinations(meeting, 2) if a[0] != b[0]]
        straightest = min(pairs, default=None)
        if straightest is not None and straightest[0] < _STRAIGHT_ON:
            _, a, b = straightest
            follows[a], follows[b] = b, a
    united: list[FloatArray] = []
    used: set[int] = set()
    for k in range(len(borders)):
        if k in used:
            continue
        end, passed = (k, True), {k}
        while end in follows and follows[end][0] not in passed:
            before = follows[end]
            passed.add(before[0])
            end = (before[0], not before[1])
        path: list[FloatArray] = []
        while True:
            number, at_start = end
            used.add(number)
            piece = borders[number] if at_start else borders[number][::-1]
            path.append(piece[1:] if path else piece)
            following = follows.get((number, not at_start))
            if following is None or following[0] in used:
                break
            end = following
        united.append(np.concatenate(path))
    return united


def _way_from(border: FloatArray, at_start: bool) -> float:
    """The direction from an end of a border into it, radians."""
    start = end = tuple(border[0 if at_start else -1].tolist())
    left, share = _WAY_MM, 0.0
    for place in (border[1:] if at_start else border[-2::-1]).tolist():
        before, end, piece = end, place, math.dist(end, place)
        left -= piece
        if left <= 0.0:
            share = left / piece
            break
    else:
        before = end
    x, y = end[0] + share * (end[0] - before[0]), end[1] + share * (end[1] - before[1])
    return math.atan2(y - start[1], x - start[0])


def _put_in_line(walls: Sequence[Wall], edges: FloatArray, scale: Scale) -> None:
    """Move walls onto the line of a parallel edge, or longer wall, that they nearly continue; the longest first.

    A wall moves if its points speak less against it than two edges cost: its own one, and the step between both lines.
    """
    runs = sorted((run for wall in walls for run in wall.runs), key=lambda run: (-run.length, run.x, run.y))
    lines = np.array([(run.x, run.y, math.cos(run.direction), math.sin(run.direction), run.length) for run in runs])
    moved = _in_line(edges, lines.reshape(-1, 5), max(_IN_LINE_MM, scale.spacing_mm), scale.per_mm).tolist()
    for run, (x, y) in zip(runs, moved, strict=True):
        run.x, run.y = x, y


@kernel
def _in_line(edges: FloatArray, lines: FloatArray, most: float, per_mm: float) -> FloatArray:
    """Where the middles of some lines move, (n, 2): onto the nearest of the edges (e, 4) and lines before them.

    Lines (n, 5) are their middle, unit vector and length; `per_mm` as in `Scale`.
    """
    known = np.empty((len(edges) + len(lines), 5))
    count = 0
    for e in range(len(edges)):
        vx, vy = edges[e, 2] - edges[e, 0], edges[e, 3] - edges[e, 1]
        length = math.hypot(vx, vy)
        if length >= _SHORTEST_MM:
            known[count, 0], known[count, 1] = 0.5 * (edges[e, 0] + edges[e, 2]), 0.5 * (edges[e, 1] + edges[e, 3])
            known[count, 2], known[count, 3], known[count, 4] = vx / length, vy / length, length
            count += 1
    for r in range(len(lines)):
        x, y, ux, uy, length = lines[r]
        nearest = np.nan
        for k in range(count):
            dx, dy = known[k, 0] - x, known[k, 1] - y
            off, gap = ux * dy - uy * dx, abs(ux * dx + uy * dy) - 0.5 * (known[k, 4] + length)
            fits = abs(ux * known[k, 3] - uy * known[k, 2]) <= _PARALLEL and abs(off) <= most and gap <= _IN_LINE_GAP_MM
            if fits and per_mm * length * off * off < 2.0 * PRICES.edge and not abs(off) >= abs(nearest):
                nearest = off
        known[count] = lines[r]
        if not np.isnan(nearest):
            known[count, 0], known[count, 1] = x - nearest * uy, y + nearest * ux
        count += 1
    return known[count - len(lines) : count, :2].copy()


def _cells(
    outline_mm: MultiPolygon, chords: Iterable[FloatArray], xy_mm: IntArray, unit: LabelArray
) -> tuple[list[Polygon], list[int], set[int]]:
    """The cells between an outline and some walls, the unit of each, and the units that are not separated."""
    drawn = [shapely.boundary(outline_mm), *(LineString(chord) for chord in chords)]
    net = shapely.union_all(drawn, grid_size=1.0)
    shapely.prepare(outline_mm)
    cells = [
        cell
        for cell in polygons_of(shapely.polygonize(shapely.get_parts(net)))
        if shapely.contains(outline_mm, shapely.point_on_surface(cell))
    ]
    count = int(unit.max(initial=0)) + 1
    counts = np.array([_counts(cell, xy_mm, unit, count) for cell in cells]).reshape(-1, count)
    owners = np.where(counts.any(axis=1), counts.argmax(axis=1), -1).tolist()
    order = sorted(range(len(cells)), key=lambda k: (cells[k].area, cells[k].bounds))
    tree = shapely.STRtree(cells)
    for k in order:
        if owners[k] < 0 or cells[k].area < _LEAST_CELL_MM2 or _is_narrow(cells[k]):
            _join_neighbour(k, cells, owners, tree)
    # cells amid others without points: each round joins those that touch a cell of a unit
    while sum(owners[k] < 0 and _join_neighbour(k, cells, owners, tree) for k in order):
        pass
    own = np.bincount(np.maximum(owners, 0), weights=counts[np.arange(len(owners)), owners], minlength=count)
    return cells, owners, set(np.flatnonzero(own < _LEAST_OWN * counts.sum(axis=0)).tolist())


def _join_neighbour(k: int, cells: Sequence[Polygon], owners: list[int], tree: shapely.STRtree) -> bool:
    """Give a cell to the unit of the neighbour with the longest common wall; whether it has one with a unit."""
    shares = [
        (shapely.intersection(cells[k], cells[j]).length, -j)
        for j in tree.query(cells[k], predicate="touches").tolist()
        if owners[j] >= 0
    ]
    if shares:
        owners[k] = owners[-max(shares)[1]]
    return bool(shares)


def _is_narrow(cell: Polygon) -> bool:
    # a border this far inside takes no more area from it: the rest need not be drawn
    reach = 0.5 * _LEAST_WIDTH_MM
    most_mm2 = reach * (cell.length + 0.5 * math.pi * reach * shapely.get_num_coordinates(cell))
    return bool(cell.area <= most_mm2 and shapely.is_empty(shapely.buffer(cell, -reach)))


def _counts(cell: Polygon, xy_mm: IntArray, unit: LabelArray, count: int) -> IntArray:
    """The number of points of every unit in a cell."""
    left, bottom, right, top = cell.bounds
    low, high = np.searchsorted(xy_mm[:, 0], [left, right + 1.0])
    xy, of = xy_mm[low:high], unit[low:high]
    inside = (xy[:, 1] >= bottom) & (xy[:, 1] <= top) & (of >= 0)
    shapely.prepare(cell)
    inside[inside] = shapely.contains_xy(cell, xy[inside].astype(np.float64))
    return np.bincount(of[inside], minlength=count)


def _united(cells: Sequence[Polygon], owners: Sequence[int]) -> dict[int, MultiPolygon]:
    """The cells of each unit as one shape, without edges that a solid cannot have."""
    drawn = RoofPartition(polygons=tuple(cells), labels=np.array(owners, np.int32))
    with contextlib.suppress(BuildingError):  # where a cell breaks, all corners stay
        drawn = unite_close_vertices(drawn, _CLOSE_MM)
    polygons = np.array(drawn.polygons, dtype=object)
    found = {}
    for number in sorted(set(drawn.labels.tolist()) - {-1}):
        found[number] = MultiPolygon(polygons_of(shapely.coverage_union_all(polygons[drawn.labels == number])))
    return found
