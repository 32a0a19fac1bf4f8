"""Roof faces that lie exactly within an outline that other buildings touch, on the millimetre grid.

New vertices on the outline are rounded to the grid, and vertices of the outline that bend its edges by a millimetre may
be missing: then an edge of the faces leaves the outline by as much. Such vertices move to the nearest place inside, and
edges take the outline's vertices beside them. Faces that reach far beyond the outline are cut.
"""

from __future__ import annotations

import dataclasses
import math
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.errors import BuildingError
from pipeline.model import Reason
from pipeline.roof.footprint import polygons_of
from pipeline.roof.partition import RoofPartition

_STEPS_MM = np.array(sorted(((x, y) for x in range(-2, 3) for y in range(-2, 3)), key=lambda xy: (math.hypot(*xy), xy)))
"""Places around one on the grid, the nearest first."""
_NEAR_MM = 2.9
"""A vertex this near to one of the outline takes its place; an edge takes vertices of the outline this near to it."""
_FAR_MM = 12.0
"""Vertices farther outside do not move: rounding, and uniting vertices within 10 mm, moves none as far."""
_ROUNDS = 3
"""Most turns of moving and inserting: an edge may need a second vertex once it has a first one."""
_BACK_MM = 3.0
"""What is cut ends this far inside, so that rounding keeps it inside."""

XY = tuple[float, float]


def within_outline(partition: RoofPartition, outline_mm: MultiPolygon) -> RoofPartition:
    """A coverage in integer millimetres, within an outline; the same object if it was within.

    Raises BuildingError `no_partition` where nothing lies within the outline.
    """
    shapely.prepare(outline_mm)
    polygons = list(partition.polygons)
    if shapely.covers(outline_mm, polygons).all():
        return partition
    for _ in range(_ROUNDS):
        fitted = _fitted(polygons, outline_mm)
        if fitted is None or not (shapely.is_valid(fitted).all() and shapely.coverage_is_valid(fitted)):
            break
        polygons = fitted
        if shapely.covers(outline_mm, polygons).all():
            return dataclasses.replace(partition, polygons=tuple(polygons))
    return _cut(partition, outline_mm)


def _fitted(polygons: Sequence[Polygon], outline_mm: MultiPolygon) -> list[Polygon] | None:
    """The polygons with vertices moved into the outline and its own inserted; None where some are far outside."""
    xy = np.unique(shapely.get_coordinates(polygons), axis=0)
    corners = np.unique(shapely.get_coordinates(outline_mm), axis=0)
    corners = corners[(corners == np.rint(corners)).all(axis=1)]
    tree = shapely.STRtree(shapely.points(corners))
    moved: dict[XY, XY] = {}
    near, at = tree.query_nearest(shapely.points(xy), max_distance=_NEAR_MM, all_matches=False)
    for k, corner in zip(near.tolist(), at.tolist(), strict=True):
        moved[tuple(xy[k])] = tuple(corners[corner])
    is_outside = ~shapely.intersects_xy(outline_mm, xy[:, 0], xy[:, 1])
    for place in map(tuple, xy[is_outside].tolist()):
        if place in moved:
            continue
        point = shapely.Point(place)
        if shapely.distance(outline_mm, point) > _FAR_MM:
            return None
        on_line = shapely.get_coordinates(shapely.shortest_line(outline_mm, point))[0]
        tried = np.rint(on_line) + _STEPS_MM
        tried = tried[shapely.intersects_xy(outline_mm, tried[:, 0], tried[:, 1])]
        if not len(tried):
            return None
        moved[place] = tuple(tried[0].tolist())
    rings = [[_moved(ring, moved) for ring in shapely.get_rings(polygon).tolist()] for polygon in polygons]
    edges = Counter(frozenset(edge) for own in rings for ring in own for edge in pairwise(ring))
    outer = [tuple(edge) for edge, times in edges.items() if times == 1]
    lines = shapely.linestrings([sorted(edge) for edge in outer])
    leaving = ~shapely.covers(outline_mm, lines)
    between: dict[frozenset[XY], list[XY]] = {}
    for line in lines[leaving].tolist():
        a, b = (tuple(end) for end in line.coords)
        found = [tuple(corners[k].tolist()) for k in tree.query(line, predicate="dwithin", distance=_NEAR_MM).tolist()]
        along = {corner: line.project(shapely.Point(corner)) for corner in found if corner not in (a, b)}
        along = {corner: way for corner, way in along.items() if 0.0 < way < line.length}
        between[frozenset((a, b))] = [a, *sorted(along, key=lambda corner: along[corner]), b]
    drawn = []
    for own in rings:
        longer = [_with_corners(ring, between) for ring in own]
        kept = [ring for ring in longer if len(ring) > 3]
        if longer[0] in kept:
            drawn.append(Polygon(kept[0], kept[1:]))
    return drawn


def _moved(ring: shapely.LinearRing, moved: dict[XY, XY]) -> list[XY]:
    """The vertices of a ring where they moved to, closed, none twice in a row."""
    places = [moved.get((x, y), (x, y)) for x, y in ring.coords]
    return [place for k, place in enumerate(places) if k == 0 or place != places[k - 1]]


def _with_corners(ring: list[XY], between: dict[frozenset[XY], list[XY]]) -> list[XY]:
    """A closed ring with the vertices that some of its edges, by their ends, take."""
    longer = ring[:1]
    for a, b in pairwise(ring):
        path = between.get(frozenset((a, b)), [a, b])
        longer += path[1:] if path[0] == a else path[-2::-1]
    return longer


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
