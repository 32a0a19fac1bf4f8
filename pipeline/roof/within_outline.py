"""Roof faces that lie exactly within an outline that other buildings touch, on the millimetre grid.

New vertices on the outline are rounded to the grid, and vertices of the outline that bend its edges by a millimetre may
be missing: then an edge of the faces leaves the outline by as much. Such vertices move to the nearest place inside, and
edges take the outline's vertices beside them. Faces that reach far beyond the outline are cut.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from itertools import compress, pairwise

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.errors import BuildingError
from pipeline.geometry import corners_of_rings
from pipeline.model import FloatArray, Reason
from pipeline.roof.footprint import polygons_of
from pipeline.roof.partition import RoofPartition

_STEPS_MM = np.array(sorted(((x, y) for x in range(-2, 3) for y in range(-2, 3)), key=lambda xy: (math.hypot(*xy), xy)))
"""Places around one on the grid, the nearest first."""
_NEAR_MM = 2.9
"""A vertex this near to one of the outline takes its place; an edge takes vertices of the outline this near to it."""
_UNITED_MM = 10.0
"""A corner of the outline that the faces lack takes the place of a vertex this near: faces unite such vertices."""
_FAR_MM = 12.0
_MOST_AREA_MM2 = 1e4
"""Vertices farther outside do not move, unless so little lies outside: needles reach far, but hold little."""
_ROUNDS = 4
"""Most looks at it: an edge may need a second vertex once it has a first one."""
_BACK_MM = 1.0
"""What is cut ends this far inside: rounding to the grid moves it by up to 0.71 mm."""

XY = tuple[float, float]


def limit_in_mm(outline: MultiPolygon) -> MultiPolygon:
    """An outline drawn with regard to others, in metres on the millimetre grid, in millimetres with every vertex.

    Raises BuildingError `no_footprint` where others took all of it.
    """
    if outline.is_empty:
        raise BuildingError(Reason.NO_FOOTPRINT, "others that touch it take all of its outline")
    in_mm: MultiPolygon = shapely.transform(outline, lambda xy: np.rint(xy * 1e3))
    return in_mm


def within_outline(partition: RoofPartition, outline_mm: MultiPolygon) -> RoofPartition:
    """A coverage in integer millimetres, within an outline; the same object if it was within.

    Raises BuildingError `no_partition` where nothing lies within the outline, or faces cannot be cut at it.
    """
    shapely.prepare(outline_mm)
    drawn: RoofPartition | None = partition
    for _ in range(_ROUNDS):
        if drawn is None:
            break
        if shapely.covers(outline_mm, drawn.polygons).all():
            return drawn
        drawn = _fitted(drawn, outline_mm)
    return _cut(partition, outline_mm)


def _fitted(partition: RoofPartition, outline_mm: MultiPolygon) -> RoofPartition | None:
    """A coverage with vertices moved into the outline and its own inserted; None where faces break, or reach far."""
    all_xy, ring_of, polygon_of = corners_of_rings(partition.polygons)
    vertices = list(map(tuple, all_xy.tolist()))
    known = set(vertices)
    xy = np.array(sorted(known))
    places = {(x, y) for x, y in shapely.get_coordinates(outline_mm).tolist() if x.is_integer() and y.is_integer()}
    corners = np.array(sorted(places)).reshape(-1, 2)
    tree = shapely.STRtree(shapely.points(corners))
    moved = _places(known, corners, tree)
    outside = xy[~shapely.intersects_xy(outline_mm, xy[:, 0], xy[:, 1])]
    ways = shapely.shortest_line(outline_mm, shapely.points(outside))
    is_far = (shapely.length(ways) > _FAR_MM).any()
    if is_far and shapely.area(shapely.difference(partition.polygons, outline_mm)).sum() > _MOST_AREA_MM2:
        return None
    tried = np.rint(shapely.get_coordinates(ways)[::2])[:, None] + _STEPS_MM
    inside = shapely.intersects_xy(outline_mm, tried[..., 0], tried[..., 1])
    first = tried[np.arange(len(tried)), inside.argmax(axis=1)]
    found = inside.any(axis=1)
    moved = dict(zip(map(tuple, outside[found].tolist()), map(tuple, first[found].tolist()), strict=True)) | moved
    borders = [0, *np.cumsum(np.bincount(ring_of)).tolist()]
    given = [vertices[start:stop] for start, stop in pairwise(borders)]
    rings = [
        ring if moved.keys().isdisjoint(ring) and len(set(ring)) == len(ring) - 1 else _moved(ring, moved)
        for ring in given
    ]
    edges = Counter([(a, b) if a < b else (b, a) for ring in rings for a, b in pairwise(ring) if a != b])
    outer = [edge for edge, times in edges.items() if times == 1]
    if not outer:
        return None
    lines = shapely.linestrings(outer)
    is_out = ~shapely.covers(outline_mm, lines)
    open_edges = list(compress(outer, is_out.tolist()))
    between: dict[tuple[XY, XY], list[XY]] = {edge: [] for edge in open_edges}
    if open_edges:
        at, near = tree.query(lines[is_out], predicate="dwithin", distance=_NEAR_MM)
        beside = lines[is_out][at]
        ways = shapely.line_locate_point(beside, tree.geometries[near])
        is_inner = (ways > 0.0) & (ways < shapely.length(beside))
        order = np.lexsort((ways, at))
        for k in order[is_inner[order]].tolist():
            between[open_edges[at[k]]].append(tuple(corners[near[k]].tolist()))
    longer = [_with_corners(ring, between) for ring in rings]
    owned: list[list[int]] = [[] for _ in partition.polygons]
    for k, owner in enumerate(polygon_of.tolist()):
        owned[owner].append(k)
    left = [number for number, own in enumerate(owned) if len(longer[own[0]]) > 3]
    fitted = tuple(
        partition.polygons[number]
        if all(longer[k] == given[k] for k in owned[number])
        else _polygon(longer[owned[number][0]], [longer[k] for k in owned[number][1:] if len(longer[k]) > 3])
        for number in left
    )
    if not fitted or not (shapely.is_valid(fitted).all() and shapely.coverage_is_valid(fitted)):
        return None
    return dataclasses.replace(partition, polygons=fitted, labels=partition.labels[left])


def _places(known: set[XY], corners: FloatArray, tree: shapely.STRtree) -> dict[XY, XY]:
    """Those of the vertices that take the place of a corner of the outline, and that place."""
    xy = np.array(sorted(known.difference(map(tuple, corners.tolist())))).reshape(-1, 2)
    near, at = tree.query_nearest(shapely.points(xy), max_distance=_UNITED_MM, all_matches=False)
    return {
        tuple(vertex): tuple(corner)
        for vertex, corner in zip(xy[near].tolist(), corners[at].tolist(), strict=True)
        if tuple(corner) not in known or math.dist(vertex, corner) <= _NEAR_MM
    }


def _moved(ring: list[XY], moved: dict[XY, XY]) -> list[XY]:
    """The vertices of a ring where they moved to, closed; none twice in a row, and none to which it returns at once."""
    places: list[XY] = []
    for vertex in ring[:-1]:
        place = moved.get(vertex, vertex)
        if place in places[-2:-1]:
            places.pop()
        elif place not in places[-1:]:
            places.append(place)
    while len(places) > 2 and (places[0] == places[-1] or places[1] == places[-1] or places[0] == places[-2]):
        places = places[1:] if places[1] == places[-1] else places[:-1]
    return [*places, places[0]]


def _with_corners(ring: list[XY], between: dict[tuple[XY, XY], list[XY]]) -> list[XY]:
    """A closed ring with the vertices between the ends of some of its edges."""
    if not between:
        return ring
    longer = ring[:1]
    for a, b in pairwise(ring):
        longer += [*(between.get((a, b)) or between.get((b, a), [])[::-1]), b]
    return longer


def _polygon(shell: list[XY], holes: list[list[XY]]) -> Polygon:
    """A polygon of closed rings; without holes in a third of the time that shapely's class takes."""
    plain: Polygon = Polygon(shell, holes) if holes else shapely.polygons(shell)
    return plain


def _cut(partition: RoofPartition, outline_mm: MultiPolygon) -> RoofPartition:
    """The part of a coverage that lies inside an outline by a few millimetres."""
    inner = shapely.buffer(outline_mm, -_BACK_MM, join_style="mitre")
    net = shapely.union_all(shapely.boundary([*partition.polygons, inner]), grid_size=1.0)
    cells = np.array(polygons_of(shapely.polygonize(shapely.get_parts(net))), dtype=object)
    places = shapely.point_on_surface(cells)
    inside = shapely.contains(inner, places)
    polygons: list[Polygon] = []
    labels: list[int] = []
    for polygon, label in zip(partition.polygons, partition.labels.tolist(), strict=True):
        own = cells[inside & shapely.contains(polygon, places)]
        pieces = polygons_of(shapely.coverage_union_all(own)) if len(own) else []
        polygons += pieces
        labels += [label] * len(pieces)
    if not polygons or not shapely.covers(outline_mm, polygons).all():
        raise BuildingError(Reason.NO_PARTITION, "the roof faces leave the outline that others touch")
    return dataclasses.replace(partition, polygons=tuple(polygons), labels=np.array(labels, np.int32))
