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
import itertools
import math
from collections.abc import Iterable, Sequence

import numpy as np
import shapely
from shapely import LineString, MultiPolygon, Polygon

from pipeline.errors import BuildingError
from pipeline.model import FloatArray, IntArray, LabelArray
from pipeline.roof.footprint import polygons_of
from pipeline.roof.lines import Run, corners, fitted_run
from pipeline.roof.outlines.description import Prices
from pipeline.roof.outlines.exterior import described_chain, pairs_of, peaks_of
from pipeline.roof.partition import RoofPartition
from pipeline.roof.simplification import unite_close_vertices

PRICES = Prices(edge=6.0, free=14.0, change=4.0, sharp=60.0, flat=60.0)
"""A wall inside a block is seen less well than an outline: it costs more to bend it."""
_NOISE_SPACINGS, _NOISE_M = 0.8, 0.4
"""Standard deviation of the border between two units about their wall: in point spacings, and at least."""
_BEYOND_SPACINGS, _BEYOND_M = 2.0, 1.0
"""How far beyond the outline borders are followed, and walls reach beyond their borders."""
_FAR_SPACINGS, _FAR_M = 8.0, 6.0
"""How far a wall is continued until it meets something."""
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
_OVERSHOOT_MM = 5.0
"""Walls end this far beyond what they meet: the lines must cross."""
_CLOSE_MM = 10.0
"""Corners of cells this near to each other are one."""
_LEAST_CELL_MM2 = 2e6
_LEAST_WIDTH_MM = 500.0
"""Smaller or narrower cells join the neighbour with the longest common wall."""


@dataclasses.dataclass(frozen=True)
class _Wall:
    """A border between units and the edges that describe it."""

    border: FloatArray
    """(n, 2), millimetres."""
    runs: list[Run]
    """Its edges."""


def divided(
    units: RoofPartition, outline_mm: MultiPolygon, xy_mm: IntArray, unit: LabelArray, spacing_m: float
) -> dict[int, MultiPolygon]:
    """The parts of an outline by unit, integer millimetres; none of a unit for which nothing is left.

    `units` are the surroundings of every unit's points, beyond the outline; `xy_mm` (n, 2), ascending by x, are the
    points, `unit` (n,) their units.
    """
    spacing_mm = 1e3 * spacing_m
    edges = _edges_of(outline_mm)
    beyond = max(_BEYOND_SPACINGS * spacing_mm, 1e3 * _BEYOND_M)
    walls = []
    for border in _through(_borders(units, shapely.buffer(outline_mm, beyond))):
        near = edges[shapely.distance(LineString(border), shapely.linestrings(edges.reshape(-1, 2, 2))) <= _NEARBY_MM]
        runs = described_chain(border, pairs_of(peaks_of(_edge_runs(near))), spacing_mm, _noise_mm(spacing_m), PRICES)
        walls.append(_Wall(border, runs))
    _put_in_line(walls, edges, max(_IN_LINE_MM, spacing_mm))
    lines = [_drawn(wall, beyond) for wall in walls]
    far = max(_FAR_SPACINGS * spacing_mm, 1e3 * _FAR_M)
    chords = [_ended(k, lines, edges, beyond, far) for k in range(len(lines))]
    cells, owners = _cells(outline_mm, chords, xy_mm, unit)
    lost = set(units.labels.tolist()) - set(owners)
    if lost:
        # a unit that no wall separates is drawn around its own points
        directions = pairs_of(peaks_of(_edge_runs(edges), 3))
        around = [
            _drawn_around(polygon.exterior, directions, spacing_m)
            for polygon, label in zip(units.polygons, units.labels.tolist(), strict=True)
            if label in lost
        ]
        cells, owners = _cells(outline_mm, [*chords, *around], xy_mm, unit)
    return _united(cells, owners)


def _drawn_around(ring: shapely.LinearRing, directions: FloatArray, spacing_m: float) -> FloatArray:
    """A closed border (n, 2) with straight edges, in some directions or others; as it is if it has too few edges."""
    border = np.asarray(ring.coords)
    start = int(np.argmax(np.hypot(*(border - border.mean(axis=0)).T)))
    border = np.concatenate((border[start:-1], border[:start]))
    opened = np.concatenate((border, border[:1]))
    runs = described_chain(opened, directions, 1e3 * spacing_m, _noise_mm(spacing_m), PRICES)
    if len(runs) < 3:
        return opened
    places = np.array(corners(border, runs, math.inf, closed=True))
    return np.concatenate((places, places[:1]))


def _noise_mm(spacing_m: float) -> float:
    return 1e3 * max(_NOISE_SPACINGS * spacing_m, _NOISE_M)


def _edges_of(outline_mm: MultiPolygon) -> FloatArray:
    """The edges of an outline, (e, 4): both ends of each, millimetres."""
    rings = [np.asarray(ring.coords) for part in outline_mm.geoms for ring in (part.exterior, *part.interiors)]
    return np.concatenate([np.column_stack((ring[:-1], ring[1:])) for ring in rings])


def _edge_runs(edges: FloatArray) -> list[Run]:
    """Edges (e, 4) as runs."""
    return [fitted_run(edge.reshape(2, 2), 0, 1) for edge in edges]


def _borders(units: RoofPartition, within: Polygon | MultiPolygon) -> list[FloatArray]:
    """The borders between two units, (n, 2) each, as far as they lie within an area."""
    polygons = np.array(units.polygons, dtype=object)
    whole = [shapely.coverage_union_all(polygons[units.labels == number]) for number in np.unique(units.labels)]
    borders: list[FloatArray] = []
    for stretches in _stretches(whole):
        common = shapely.line_merge(shapely.intersection(shapely.multilinestrings(stretches), within))
        borders += [
            np.asarray(line.coords)
            for line in shapely.get_parts(common)
            if isinstance(line, LineString) and line.length > _SHORTEST_MM
        ]
    return borders


def _stretches(shapes: Sequence[Polygon | MultiPolygon]) -> list[list[LineString]]:
    """The lines that each two shapes of a coverage share, pair by pair: as the first one has them on its rings.

    Shapes of a coverage have the same edges where they meet, which makes an overlay needless. A closed line begins at
    its westernmost vertex.
    """
    parts, of_part = shapely.get_parts(np.array(shapes, dtype=object), return_index=True)
    rings, of_ring = shapely.get_rings(parts, return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    inside = ring[:-1] == ring[1:]
    start, end, ring = xy[:-1][inside], xy[1:][inside], ring[:-1][inside]
    own = of_part[of_ring[ring]]
    is_turned = (start[:, 0] > end[:, 0]) | ((start[:, 0] == end[:, 0]) & (start[:, 1] > end[:, 1]))
    edges = np.where(is_turned[:, None], np.column_stack((end, start)), np.column_stack((start, end)))
    order = np.lexsort((own, *edges.T))
    twin = np.flatnonzero((edges[order[:-1]] == edges[order[1:]]).all(axis=1))
    edge, other = order[twin], own[order[twin + 1]]
    order = np.lexsort((edge, other, own[edge]))
    edge, other = edge[order], other[order]
    goes_on = (np.diff(edge) == 1) & (np.diff(ring[edge]) == 0) & (np.diff(other) == 0)
    found: dict[tuple[int, int], list[LineString]] = {}
    for stretch in np.split(np.arange(len(edge)), np.flatnonzero(~goes_on) + 1):
        if len(stretch):
            line = np.concatenate((start[edge[stretch]], end[edge[stretch[-1:]]]))
            if (line[0] == line[-1]).all():
                first = int(np.lexsort(line[:-1, ::-1].T)[0])
                line = np.concatenate((line[first:-1], line[: first + 1]))
            found.setdefault((int(own[edge[stretch[0]]]), int(other[stretch[0]])), []).append(LineString(line))
    return list(found.values())


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
        pairs = [(float(ways[a] @ ways[b]), a, b) for a, b in itertools.combinations(meeting, 2) if a[0] != b[0]]
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


def _way_from(border: FloatArray, at_start: bool) -> FloatArray:
    """The unit vector from an end of a border into it."""
    line = LineString(border if at_start else border[::-1])
    inner = np.asarray(line.interpolate(min(_WAY_MM, line.length)).coords[0])
    way = inner - np.asarray(line.coords[0])
    return np.asarray(way / max(math.hypot(*way.tolist()), 1e-9))


def _put_in_line(walls: Sequence[_Wall], edges: FloatArray, most_mm: float) -> None:
    """Move walls onto the line of a parallel edge, or longer wall, that they nearly continue; the longest first."""
    middle = 0.5 * (edges[:, :2] + edges[:, 2:])
    ways = edges[:, 2:] - edges[:, :2]
    lengths = np.hypot(ways[:, 0], ways[:, 1])
    long = lengths >= _SHORTEST_MM
    known = np.column_stack((middle, ways / np.maximum(lengths, 1e-9)[:, None], lengths))[long]
    for run in sorted((run for wall in walls for run in wall.runs), key=lambda run: (-run.length, run.x, run.y)):
        ux, uy = math.cos(run.direction), math.sin(run.direction)
        dx, dy = known[:, 0] - run.x, known[:, 1] - run.y
        off, along = ux * dy - uy * dx, ux * dx + uy * dy
        gap = np.abs(along) - 0.5 * (known[:, 4] + run.length)
        fits = (np.abs(ux * known[:, 3] - uy * known[:, 2]) <= _PARALLEL) & (np.abs(off) <= most_mm)
        fits &= gap <= _IN_LINE_GAP_MM
        if fits.any():
            nearest = float(off[fits][np.argmin(np.abs(off[fits]))])
            run.x -= nearest * uy
            run.y += nearest * ux
        known = np.concatenate((known, [[run.x, run.y, ux, uy, run.length]]))


def _drawn(wall: _Wall, beyond: float) -> FloatArray:
    """The vertices of a wall, both ends reaching beyond its border."""
    first, last = wall.runs[0], wall.runs[-1]
    ends = []
    for run, (x, y), sense in ((first, wall.border[0].tolist(), -1.0), (last, wall.border[-1].tolist(), 1.0)):
        ux, uy = math.cos(run.direction), math.sin(run.direction)
        way = (x - run.x) * ux + (y - run.y) * uy + sense * beyond
        ends.append((run.x + way * ux, run.y + way * uy))
    between = corners(wall.border, wall.runs, math.inf, closed=False)
    return np.array([ends[0], *between, ends[1]])


def _ended(number: int, lines: Sequence[FloatArray], edges: FloatArray, beyond: float, far: float) -> FloatArray:
    """A wall whose ends lie on what they meet nearest to them, the outline or another wall."""
    others = [np.column_stack((line[:-1], line[1:])) for k, line in enumerate(lines) if k != number]
    obstacles = np.concatenate((edges, *others))
    line = lines[number].copy()
    for end, before in ((0, 1), (-1, -2)):
        way = line[end] - line[before]
        length = float(np.hypot(*way))
        if length == 0.0:
            continue
        way /= length
        border_end = length - beyond
        # the places on the ray from the vertex before at which it meets an obstacle
        ux, uy = obstacles[:, 2] - obstacles[:, 0], obstacles[:, 3] - obstacles[:, 1]
        det = way[0] * uy - way[1] * ux
        dx, dy = obstacles[:, 0] - line[before, 0], obstacles[:, 1] - line[before, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            t, u = (dx * uy - dy * ux) / det, (dx * way[1] - dy * way[0]) / det
        meets = (np.abs(det) > 1e-9) & (u >= 0.0) & (u <= 1.0) & (t > 0.1 * length) & (t <= border_end + far)
        meets &= t >= border_end - 2.0 * beyond
        if meets.any():
            at = t[meets]
            place = float(at[np.argmin(np.abs(at - border_end))])
            line[end] = line[before] + (place + _OVERSHOOT_MM) * way
    return line


def _cells(
    outline_mm: MultiPolygon, chords: Iterable[FloatArray], xy_mm: IntArray, unit: LabelArray
) -> tuple[list[Polygon], list[int]]:
    """The cells between an outline and some walls, and the unit of each."""
    drawn = [shapely.boundary(outline_mm), *(LineString(chord) for chord in chords)]
    net = shapely.union_all(drawn, grid_size=1.0)
    shapely.prepare(outline_mm)
    cells = [
        cell
        for cell in polygons_of(shapely.polygonize(shapely.get_parts(net)))
        if shapely.contains(outline_mm, shapely.point_on_surface(cell))
    ]
    count = int(unit.max(initial=0)) + 1
    owners = [_owner(cell, xy_mm, unit, count) for cell in cells]
    order = sorted(range(len(cells)), key=lambda k: (cells[k].area, cells[k].bounds))
    tree = shapely.STRtree(cells)
    for k in order:
        if owners[k] < 0 or cells[k].area < _LEAST_CELL_MM2 or _is_narrow(cells[k]):
            _join_neighbour(k, cells, owners, tree)
    # cells amid others without points: each round joins those that touch a cell of a unit
    while sum(owners[k] < 0 and _join_neighbour(k, cells, owners, tree) for k in order):
        pass
    return cells, owners


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
    return bool(shapely.is_empty(shapely.buffer(cell, -0.5 * _LEAST_WIDTH_MM)))


def _owner(cell: Polygon, xy_mm: IntArray, unit: LabelArray, count: int) -> int:
    """The unit that has most points in a cell; -1 where none has any."""
    left, bottom, right, top = cell.bounds
    low, high = np.searchsorted(xy_mm[:, 0], [left, right + 1.0])
    xy, of = xy_mm[low:high], unit[low:high]
    inside = (xy[:, 1] >= bottom) & (xy[:, 1] <= top) & (of >= 0)
    inside[inside] = shapely.contains_xy(cell, xy[inside].astype(np.float64))
    return int(np.bincount(of[inside], minlength=count).argmax()) if inside.any() else -1


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
