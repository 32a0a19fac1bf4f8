"""Straight borders between roof faces: ridges where planes cross, steps along fitted lines.

The borders of a partition are arcs between nodes, where three or more borders meet. An arc takes its shortest
description (`outlines/description.py`). An edge along which the two planes cross takes their line of intersection; any
other edge its own line, or one in a common direction of the building. Nodes move to where their lines meet; nodes on
the outline move along it. If a face breaks, its arcs are restored, so the result is always a coverage.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Sequence

import numpy as np
import shapely

from pipeline.model import Plane
from pipeline.roof.lines import Point, Run, corners, crossing, fitted_run
from pipeline.roof.outlines.description import Prices
from pipeline.roof.outlines.exterior import described_chain, pairs_of, peaks_of
from pipeline.roof.partition import RoofPartition
from pipeline.roof.snapped_rings import differ_by_more

_ROUNDS = 4
"""Most rounds in which arcs of broken faces are put back; then nothing is straightened."""
_TOLERANCE_SPACINGS = 0.65
"""How far borders and nodes may move, in point spacings."""
_NOISE_SPACINGS = 0.3
"""Standard deviation of a border about its line: it lies between points of either side."""
_PRICES = Prices(edge=4.0, free=4.0, change=0.0, sharp=60.0, flat=20.0)
"""Slopes meet in any direction: a direction of its own costs less than in an outline."""
_MIN_SLOPE = 0.05
"""Planes whose slopes differ by less cross nowhere exactly: their noise moves the line."""


@dataclasses.dataclass
class _Arc:
    """A border between two nodes, or a closed one that starts at any vertex."""

    path: list[Point]
    """Its vertices, both ends included; equal ends where it is closed."""
    left: int
    right: int
    """The faces beside it; -1 is outside."""
    runs: list[Run] = dataclasses.field(default_factory=list)
    straight: bool = False
    """Whether the runs replace the path."""

    @property
    def closed(self) -> bool:
        """Whether the border has no node."""
        return self.path[0] == self.path[-1]


def straighten_borders(partition: RoofPartition, planes: Sequence[Plane], spacing_m: float) -> RoofPartition:
    """Draw the borders between roof faces as straight lines, leaving the outline, in a coverage in integer millimetres.

    The tolerances are multiples of the point spacing. The same object comes back where nothing could be straightened.
    """
    tolerance = _TOLERANCE_SPACINGS * spacing_m * 1e3
    arcs, rings = _arcs(partition)
    outline_runs = [
        fitted_run(np.array([a, b]), 0, 1)
        for arc in arcs
        if min(arc.left, arc.right) < 0
        for a, b in itertools.pairwise(arc.path)
    ]
    common = peaks_of(outline_runs, 1)
    for arc in arcs:
        if min(arc.left, arc.right) >= 0:
            left, right = planes[partition.labels[arc.left]], planes[partition.labels[arc.right]]
            _fit(arc, left, right, common, spacing_m)
            arc.straight = bool(arc.runs)
    before = np.array(partition.polygons, dtype=object)
    for _ in range(_ROUNDS):
        if not any(arc.straight for arc in arcs):
            return partition
        moved = _moved_nodes(arcs, tolerance)
        drawn = _drawn(arcs, rings, moved, tolerance)
        broken = _broken_faces(drawn, before, tolerance)
        if not broken:
            return RoofPartition(polygons=tuple(drawn), labels=partition.labels)
        for arc in arcs:
            if arc.left in broken or arc.right in broken:
                arc.straight = False
    return partition


def _arcs(partition: RoofPartition) -> tuple[list[_Arc], list[list[list[tuple[int, bool]]]]]:
    """The arcs of a coverage, and every polygon's rings as (arc, forwards)."""
    face_rings = [
        [list(map(tuple, shapely.get_coordinates(line)[:-1].tolist())) for line in (p.exterior, *p.interiors)]
        for p in shapely.orient_polygons(np.array(partition.polygons, dtype=object)).tolist()
    ]
    owner: dict[tuple[Point, Point], int] = {}
    degree: dict[Point, int] = {}
    for face, rings in enumerate(face_rings):
        for ring in rings:
            for a, b in zip(ring, ring[1:] + ring[:1], strict=True):
                if (a, b) not in owner and (b, a) not in owner:
                    degree[a] = degree.get(a, 0) + 1
                    degree[b] = degree.get(b, 0) + 1
                owner[a, b] = face
    arcs: list[_Arc] = []
    arc_of: dict[tuple[Point, Point], tuple[int, bool]] = {}
    rings_of_arcs: list[list[list[tuple[int, bool]]]] = []
    for face, rings in enumerate(face_rings):
        as_arcs = []
        for ring in rings:
            nodes = [k for k, v in enumerate(ring) if degree[v] != 2]
            # a closed border starts at the same vertex in both its faces
            start = nodes[0] if nodes else ring.index(min(ring))
            turned = [*ring[start:], *ring[:start], ring[start]]
            stops = [*(k - start for k in nodes), len(ring)] if nodes else [0, len(ring)]
            sequence = []
            for i, j in itertools.pairwise(stops):
                path = turned[i : j + 1]
                known = arc_of.get((path[0], path[1]))
                if known is None:
                    known = (len(arcs), True)
                    arcs.append(_Arc(path=path, left=face, right=owner.get((path[1], path[0]), -1)))
                    arc_of[path[-1], path[-2]] = (known[0], False)
                sequence.append(known)
            as_arcs.append(sequence)
        rings_of_arcs.append(as_arcs)
    return arcs, rings_of_arcs


def _fit(arc: _Arc, left: Plane, right: Plane, common: Sequence[float], spacing_m: float) -> None:
    """Describe an arc by edges: along the crossing of its planes, in a common direction, or in others."""
    border = np.array(arc.path)
    da, db, dc = left.a - right.a, left.b - right.b, (left.c - right.c) * 1e3
    slope = math.hypot(da, db)
    crosses = slope > _MIN_SLOPE
    directions = np.append(pairs_of(common), [math.atan2(da, -db)] if crosses else [])
    noise_mm = _NOISE_SPACINGS * spacing_m * 1e3
    for run in described_chain(border, directions, 1e3 * spacing_m, noise_mm, _PRICES):
        run.exact = False
        piece = border[run.first : run.last + 1]
        if crosses and float(np.median(np.abs(piece[:, 0] * da + piece[:, 1] * db + dc))) <= slope * 2.0 * noise_mm:
            run.exact = True
            shift = (run.x * da + run.y * db + dc) / (slope * slope)
            run.x -= shift * da
            run.y -= shift * db
            along = math.atan2(da, -db)
            run.direction = along if math.cos(along - run.direction) >= 0.0 else along + math.pi
        if arc.runs and run.exact and arc.runs[-1].exact:
            # one line of intersection, whatever the number of runs along it
            arc.runs[-1].last = run.last
            arc.runs[-1].length += run.length
        else:
            arc.runs.append(run)
    if arc.closed and len(arc.runs) < 3:
        arc.runs.clear()


def _moved_nodes(arcs: Sequence[_Arc], tolerance: float) -> dict[Point, Point]:
    """New places of the nodes at which straight arcs end."""
    lines: dict[Point, list[Run]] = {}
    fixed: dict[Point, list[tuple[Point, Point]]] = {}
    for arc in arcs:
        if arc.closed:
            continue
        if arc.straight:
            lines.setdefault(arc.path[0], []).append(arc.runs[0])
            lines.setdefault(arc.path[-1], []).append(arc.runs[-1])
        else:
            fixed.setdefault(arc.path[0], []).append((arc.path[0], arc.path[1]))
            fixed.setdefault(arc.path[-1], []).append((arc.path[-1], arc.path[-2]))
    moved: dict[Point, Point] = {}
    for node, candidates in lines.items():
        candidates.sort(key=lambda run: (not run.exact, -run.length, run.x, run.y))
        held = fixed.get(node, [])
        place: Point | None = None
        if not held:
            pairs = itertools.combinations(candidates, 2)
            place = next((p for p in (crossing(a, b) for a, b in pairs) if p is not None), None)
        elif len(held) == 2 and _is_straight(held[0][1], node, held[1][1]):
            # on a straight piece of the outline: slide along it
            place = next((p for p in (_slide(held, run) for run in candidates) if p is not None), None)
        if place is not None and math.dist(place, node) <= 2.0 * tolerance:
            moved[node] = (float(round(place[0])), float(round(place[1])))
    _keep_order(arcs, moved, tolerance)
    return moved


def _keep_order(arcs: Sequence[_Arc], moved: dict[Point, Point], tolerance: float) -> None:
    """Put nodes back that would pass, or come too near to, the other end of a short arc."""
    ends = [(arc.path[0], arc.path[-1]) for arc in arcs if math.dist(arc.path[0], arc.path[-1]) <= 5.0 * tolerance]
    put_back = True
    while put_back:
        put_back = False
        for start, end in ends:
            if start not in moved and end not in moved:
                continue
            (x0, y0), (x1, y1) = moved.get(start, start), moved.get(end, end)
            along = (x1 - x0) * (end[0] - start[0]) + (y1 - y0) * (end[1] - start[1])
            if along <= 0.0 or math.hypot(x1 - x0, y1 - y0) < max(0.4 * tolerance, 50.0):
                moved.pop(start, None)
                moved.pop(end, None)
                put_back = True


def _is_straight(a: Point, b: Point, c: Point) -> bool:
    """Whether b lies within two millimetres of the line from a to c, between them."""
    ux, uy = c[0] - a[0], c[1] - a[1]
    length = math.hypot(ux, uy)
    if length == 0.0:
        return False
    return abs(ux * (b[1] - a[1]) - uy * (b[0] - a[0])) <= 2.0 * length


def _slide(held: Sequence[tuple[Point, Point]], run: Run) -> Point | None:
    """Where a line meets the straight outline through a node, between the node's neighbours on it."""
    (ax, ay), (bx, by) = held[0][1], held[1][1]
    length = math.hypot(bx - ax, by - ay)
    outline = Run(first=0, last=1, x=ax, y=ay, direction=math.atan2(by - ay, bx - ax), length=length)
    place = crossing(outline, run)
    if place is None:
        return None
    along = ((place[0] - ax) * (bx - ax) + (place[1] - ay) * (by - ay)) / length
    return place if 50.0 < along < length - 50.0 else None


def _new_path(arc: _Arc, moved: dict[Point, Point], tolerance: float) -> list[Point]:
    """The vertices of an arc between its nodes' new places."""
    start, end = moved.get(arc.path[0], arc.path[0]), moved.get(arc.path[-1], arc.path[-1])
    if not arc.straight:
        return [start, *arc.path[1:-1], end]
    border = np.array(arc.path[:-1] if arc.closed else arc.path)
    places = corners(border, arc.runs, 2.0 * tolerance, closed=arc.closed)
    if arc.closed:
        rounded = [(float(round(x)), float(round(y))) for x, y in places]
        return [*rounded, rounded[0]]
    # a corner next to a node or to another corner would make a spike
    near = max(0.4 * tolerance, 50.0)
    path = [start]
    for x, y in places:
        if math.dist((x, y), path[-1]) > near and math.dist((x, y), end) > near:
            path.append((float(round(x)), float(round(y))))
    return [*path, end]


def _drawn(
    arcs: Sequence[_Arc],
    rings: Sequence[Sequence[Sequence[tuple[int, bool]]]],
    moved: dict[Point, Point],
    tolerance: float,
) -> list[shapely.Polygon]:
    """The faces from their arcs; an empty polygon where a ring collapsed."""
    paths = [_new_path(arc, moved, tolerance) for arc in arcs]
    polygons = []
    for face in rings:
        lines = []
        for ring in face:
            vertices: list[Point] = []
            for number, forwards in ring:
                path = paths[number] if forwards else paths[number][::-1]
                vertices.extend(path[:-1])
            lines.append(vertices)
        collapsed = any(len(vertices) < 3 for vertices in lines)
        polygons.append(shapely.Polygon() if collapsed else shapely.Polygon(lines[0], lines[1:]))
    return polygons


def _broken_faces(drawn: Sequence[shapely.Polygon], before: Iterable[shapely.Polygon], tolerance: float) -> set[int]:
    """Faces that are not sound, overlap others, or moved by more than the tolerance allows."""
    after = np.array(drawn, dtype=object)
    broken = ~shapely.is_valid(after) | shapely.is_empty(after)
    if not broken.any():
        broken |= ~shapely.is_empty(shapely.coverage_invalid_edges(after))
    moved = {k for k, old in enumerate(before) if not broken[k] and _moved_far(drawn[k], old, tolerance * old.length)}
    return moved | set(np.flatnonzero(broken).tolist())


def _moved_far(drawn: shapely.Polygon, before: shapely.Polygon, area: float) -> bool:
    """Whether more than an area is in only one of two faces."""
    if drawn.interiors or before.interiors:
        return bool(shapely.symmetric_difference(drawn, before).area > area)
    return differ_by_more(shapely.get_coordinates(drawn)[:-1], shapely.get_coordinates(before)[:-1], area)
