"""Roof faces that reach beyond a given footprint, which shows the walls: each continues in its plane to the eaves.

The eaves are the footprint's lines with open ground before them, moved outwards. The strip between footprint and eaves
is divided by the straight continuation of the borders of roof faces: a ridge runs to the verge, a hip to the corner of
the eaves.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import shapely
from shapely import Polygon

from pipeline.errors import BuildingError
from pipeline.extras.lods.facades import FacadePoints, eave_of, moved_line_by_line, rings_of
from pipeline.extras.lods.overhangs import XY, UndrawableError, united_lines
from pipeline.model import FloatArray, NoOverhang, Plane, Reason
from pipeline.roof.footprint import polygons_of
from pipeline.roof.partition import RoofPartition
from pipeline.roof.solid import SolidPart, solid_parts

_SNAP_MM = 60.0
"""A continued border that ends this near to a corner of the eaves ends in it."""
_UNITED_MM = 10.0
"""New vertices this near to others are one with them."""
_REACH = 4.0
"""How far borders are continued, as a multiple of the overhang: a hip reaches 1.5 times as far."""


def wider_parts(
    parts: Sequence[SolidPart],
    planes: Sequence[Plane],
    points: FacadePoints,
    overhang_m: float,
    ground_z_m: float,
) -> list[SolidPart]:
    """The parts of a building with their roofs wider by an overhang, along the lines with open ground before them.

    The footprints of `parts` are the walls. Raises UndrawableError with `no_open_ground` where no line has any, with
    `walls_break` where the eaves of parts would overlap or no plan can be drawn.
    """
    wider = []
    eaves: list[Polygon] = []
    any_open = False
    for part in parts:
        walls = shapely.transform(part.footprint, lambda xy: np.rint(xy * 1e3))
        rings = [ring for _, ring in rings_of([shapely.orient_polygons(walls)])]
        ways = [[-overhang_m * is_open for is_open in _open_lines(ring, points)] for ring in rings]
        any_open = any_open or any(map(any, ways))
        outer, *holes = (moved_line_by_line(ring, way) for ring, way in zip(rings, ways, strict=True))
        try:
            drawn = shapely.union(Polygon(outer, holes), walls, grid_size=1.0)
            if not isinstance(drawn, Polygon) or any(shapely.intersection(drawn, other).area > 0.0 for other in eaves):
                raise UndrawableError(NoOverhang.WALLS_BREAK, "the eaves of two parts overlap")
            eaves.append(drawn)
            wider += solid_parts(_widened(part, walls, drawn, 1e3 * overhang_m), planes, ground_z_m)
        except (BuildingError, shapely.errors.GEOSException) as error:
            raise UndrawableError(NoOverhang.INVALID_SOLID, str(error)) from error
    if not any_open:
        raise UndrawableError(NoOverhang.NO_OPEN_GROUND, "no line of the footprint has open ground before it")
    if len(wider) != len(parts):
        raise UndrawableError(NoOverhang.WALLS_BREAK, "the roof falls into other parts")
    return wider


def _open_lines(ring: FloatArray, points: FacadePoints) -> list[bool]:
    """Which lines of a ring, (n, 2) in millimetres, have open ground before them."""
    ends = np.roll(ring, -1, axis=0)
    return [eave_of(a * 1e-3, b * 1e-3, points, 0.0).is_open for a, b in zip(ring, ends, strict=True)]


def _widened(part: SolidPart, walls: Polygon, eaves: Polygon, overhang_mm: float) -> RoofPartition:
    """The roof faces of a part up to the eaves; raises BuildingError `no_partition` where they cannot be continued."""
    faces: list[Polygon] = [
        shapely.transform(shapely.force_2d(face.polygon), lambda xy: np.rint(xy * 1e3)) for face in part.faces
    ]
    strips = shapely.difference(eaves, walls, grid_size=1.0)
    labels = np.array([face.plane for face in part.faces], np.int32)
    if strips.is_empty:
        return RoofPartition(polygons=tuple(faces), labels=labels)
    dividers = _dividers(faces, walls, eaves, overhang_mm)
    lines = shapely.union_all([shapely.boundary(strips), *dividers], grid_size=1.0)
    shapely.prepare(strips)
    pieces = [
        piece
        for piece in polygons_of(shapely.polygonize([lines]))
        if shapely.contains(strips, shapely.point_on_surface(piece))
    ]
    joined: list[list[Polygon]] = [[face] for face in faces]
    while pieces:
        left = []
        for piece in pieces:
            beside = [_border(piece, group) for group in joined]
            if max(beside) > 0.0:
                joined[int(np.argmax(beside))].append(piece)
            else:
                left.append(piece)
        if len(left) == len(pieces):
            raise BuildingError(Reason.NO_PARTITION, "a piece of the eaves touches no roof face")
        pieces = left
    united = [shapely.union_all(group, grid_size=1.0) for group in joined]
    if not all(isinstance(polygon, Polygon) for polygon in united):
        raise BuildingError(Reason.NO_PARTITION, "a roof face falls apart where it is continued")
    own = [(x, y) for x, y in np.unique(shapely.get_coordinates(faces), axis=0).tolist()]
    return RoofPartition(polygons=_with_shared_vertices(united, own), labels=labels)


def _border(piece: Polygon, group: Sequence[Polygon]) -> float:
    """Length of the border of a piece with a group of polygons, millimetres."""
    near = [polygon for polygon in group if shapely.intersects(polygon, piece)]
    return math.fsum(shapely.intersection(shapely.boundary(piece), polygon, grid_size=1.0).length for polygon in near)


def _dividers(faces: Sequence[Polygon], walls: Polygon, eaves: Polygon, overhang_mm: float) -> list[shapely.LineString]:
    """The borders between roof faces that end at the walls, continued to the eaves."""
    edges: set[tuple[tuple[float, float], tuple[float, float]]] = set()
    for face in faces:
        for ring in shapely.get_rings(shapely.orient_polygons(face)):
            xy = [(x, y) for x, y in shapely.get_coordinates(ring).tolist()]
            edges.update(itertools.pairwise(xy))
    outline = {a for a, b in edges if (b, a) not in edges} | {b for a, b in edges if (b, a) not in edges}
    corners = shapely.MultiPoint(shapely.get_coordinates(eaves))
    dividers = []
    for u, v in sorted(edges):
        if (v, u) not in edges or v not in outline or (u in outline and _runs_along(u, v, walls)):
            continue
        length = math.dist(u, v)
        far = [v[k] + _REACH * overhang_mm * (v[k] - u[k]) / length for k in (0, 1)]
        beyond = shapely.get_parts(shapely.intersection(shapely.LineString([v, far]), eaves))
        pieces = [
            p for p in beyond.tolist() if isinstance(p, shapely.LineString) and p.distance(shapely.Point(v)) < 1.0
        ]
        if not pieces:
            continue
        end = max(shapely.get_coordinates(pieces[0]).tolist(), key=lambda place: math.dist(place, v))
        corner = shapely.get_coordinates(shapely.shortest_line(shapely.Point(end), corners))[1]
        if math.dist(corner, end) <= _SNAP_MM:
            end = corner.tolist()
        if math.dist(end, v) > 1.0:
            dividers.append(shapely.LineString([v, [round(c) for c in end]]))
    return dividers


def _runs_along(u: tuple[float, float], v: tuple[float, float], walls: Polygon) -> bool:
    """Whether a line runs along the walls from end to end."""
    return bool(shapely.covered_by(shapely.LineString([u, v]), shapely.boundary(walls)))


def _with_shared_vertices(polygons: Sequence[Polygon], own: Sequence[XY]) -> tuple[Polygon, ...]:
    """Polygons that share borders, each with the vertices of the others on its own: a valid coverage.

    Vertices that are near to one another become one; those of `own` stay.
    """
    noded = shapely.union_all([shapely.boundary(polygon) for polygon in polygons], grid_size=1.0)
    lines = united_lines(noded, own, _UNITED_MM)
    cells = polygons_of(shapely.polygonize([lines]))
    found: list[Polygon] = []
    for polygon in polygons:
        shapely.prepare(polygon)
        within = [cell for cell in cells if shapely.contains(polygon, shapely.point_on_surface(cell))]
        if len(within) != 1:
            raise BuildingError(Reason.NO_PARTITION, "roof faces overlap where they are continued")
        found.append(within[0])
    return tuple(found)
