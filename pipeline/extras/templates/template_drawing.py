"""Roof faces of templates in plan: the outline noded with the cuts, ridges and hips, on the millimetre grid."""

from __future__ import annotations

import math

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.compiler import kernel
from pipeline.errors import BuildingError
from pipeline.extras.templates.shapes import MAX_PLANES, height
from pipeline.model import FloatArray, LabelArray, Reason
from pipeline.roof.footprint import polygons_of
from pipeline.roof.partition import RoofPartition
from pipeline.roof.simplification import unite_close_vertices

_MARGIN_M = 1.0
"""By how much parts exceed the outline before it cuts them; any length does."""
_UNITE_MM = 10.0
"""Vertices closer than this are united, as in the first form of a traced plan."""
_MAX_PAIRED = 500
"""More vertices are not compared pair by pair, which takes memory."""


def lower_piece(region: FloatArray, planes: FloatArray, number: int) -> FloatArray:
    """Where a plane is the lowest of several within a rectangle: its corners (m, 2), counter-clockwise.

    The rectangle (least and largest u, least and largest v) is clipped by half planes. `planes` (k, 3) are (a, b, c) of
    z = a u + b v + c. There are no corners where another plane is lower everywhere.
    """
    u0, u1, v0, v1 = region.tolist()
    corners = [(u0, v0), (u1, v0), (u1, v1), (u0, v1)]
    for other in range(len(planes)):
        if other == number:
            continue
        a, b, c = (planes[other] - planes[number]).tolist()
        kept: list[tuple[float, float]] = []
        for k, (u, v) in enumerate(corners):
            next_u, next_v = corners[(k + 1) % len(corners)]
            here, there = a * u + b * v + c, a * next_u + b * next_v + c
            if here >= 0.0:
                kept.append((u, v))
            if (here > 0.0 > there) or (here < 0.0 < there):
                share = here / (here - there)
                kept.append((u + share * (next_u - u), v + share * (next_v - v)))
        corners = kept
        if not corners:
            break
    return np.array(corners).reshape(-1, 2)


def draw_parts(
    outline_mm: MultiPolygon,
    regions: FloatArray,
    counts: LabelArray,
    planes: FloatArray,
    direction: float,
    origin_m: FloatArray,
    min_face_m2: float,
) -> RoofPartition:
    """The outline cut into the roof faces of its parts: a coverage; label `MAX_PLANES` p + k is plane k of part p.

    Regions, counts and planes are those of `parts.fit_parts`, in a frame with its axis u in a direction in radians. A
    face below `min_face_m2` joins the neighbour with which it has the longest border. Raises BuildingError
    `no_partition` where faces break on the grid.
    """
    cos, sin = math.cos(direction), math.sin(direction)
    x0, y0 = origin_m.tolist()
    x, y = (shapely.get_coordinates(outline_mm) * 1e-3 - origin_m).T
    u, v = x * cos + y * sin, y * cos - x * sin
    least = np.array([u.min(), u.min(), v.min(), v.min()]) - _MARGIN_M
    most = np.array([u.max(), u.max(), v.max(), v.max()]) + _MARGIN_M
    rings: list[FloatArray] = []
    labels: list[int] = []
    for p in range(len(regions)):
        region = np.clip(regions[p], least, most)
        for k in range(int(counts[p])):
            corners = lower_piece(region, planes[p, : counts[p]], k)
            if len(corners) < 3:
                continue
            u, v = corners[:, 0], corners[:, 1]
            rings.append(np.rint(np.column_stack((u * cos - v * sin + x0, u * sin + v * cos + y0)) * 1e3))
            labels.append(MAX_PLANES * p + k)
    if len(rings) == 1:
        polygons = polygons_of(outline_mm)
        return RoofPartition(polygons=tuple(polygons), labels=np.full(len(polygons), labels[0], np.int32))
    pieces = shapely.polygons(
        shapely.linearrings(np.concatenate(rings), indices=np.repeat(np.arange(len(rings)), [len(r) for r in rings]))
    )
    noded = shapely.union_all(shapely.boundary([outline_mm, *pieces]), grid_size=1.0)
    cells = shapely.get_parts(shapely.polygonize(shapely.get_parts(noded)))
    x, y = shapely.get_coordinates(shapely.point_on_surface(cells)).T
    shapely.prepare(outline_mm)
    within = shapely.contains_xy(outline_mm, x, y)
    cells, x, y = cells[within], x[within] * 1e-3 - x0, y[within] * 1e-3 - y0
    if not len(cells):
        raise BuildingError(Reason.NO_PARTITION, "no face of the templates lies within the outline")
    own = np.array(
        [
            _label_at(a, b, regions, counts, planes)
            for a, b in zip((x * cos + y * sin).tolist(), (y * cos - x * sin).tolist(), strict=True)
        ],
        np.int32,
    )
    partition = _united(cells, own, min_face_m2)
    vertices = np.unique(shapely.get_coordinates(partition.polygons), axis=0)
    if len(vertices) > _MAX_PAIRED or _min_distance_mm(vertices) <= _UNITE_MM:
        partition = unite_close_vertices(partition, _UNITE_MM)
    if not shapely.is_valid(partition.polygons).all() or not shapely.coverage_is_valid(partition.polygons):
        raise BuildingError(Reason.NO_PARTITION, "the faces of the templates do not make a coverage")
    return partition


def _min_distance_mm(vertices: FloatArray) -> float:
    """The least distance of two of the places (n, 2), by the larger of x and y; infinite for fewer than two."""
    apart = np.abs(vertices[:, None] - vertices[None]).max(axis=2) + np.diag(np.full(len(vertices), np.inf))
    return float(apart.min())


@kernel
def _label_at(u: float, v: float, regions: FloatArray, counts: LabelArray, planes: FloatArray) -> int:
    """Number of the part and plane over a place, `MAX_PLANES` p + k."""
    for p in range(len(regions)):
        if regions[p, 0] <= u < regions[p, 1] and regions[p, 2] <= v < regions[p, 3]:
            return MAX_PLANES * p + height(planes[p], counts[p], u, v)[1]
    return 0


def _united(cells: np.ndarray[tuple[int], np.dtype[np.object_]], labels: LabelArray, min_m2: float) -> RoofPartition:
    """Cells of one label that touch are one face; small faces take the label along their longest border."""
    labels = labels.copy()
    if len(np.unique(labels)) == len(labels) and shapely.area(cells).min() >= min_m2 * 1e6:
        return RoofPartition(polygons=tuple(cells.tolist()), labels=labels)
    while True:
        faces: list[Polygon] = []
        own: list[int] = []
        for label in np.unique(labels).tolist():
            for polygon in polygons_of(shapely.coverage_union_all(cells[labels == label])):
                faces.append(polygon)
                own.append(label)
        areas = shapely.area(faces)
        for k in np.argsort(areas, kind="stable").tolist():
            if areas[k] >= min_m2 * 1e6:
                return RoofPartition(polygons=tuple(faces), labels=np.array(own, np.int32))
            shared = shapely.length(shapely.intersection(shapely.boundary(faces[k]), shapely.boundary(faces)))
            shared[np.array(own) == own[k]] = 0.0
            beside = int(np.argmax(shared))
            if shared[beside] > 0.0:
                break
        else:
            return RoofPartition(polygons=tuple(faces), labels=np.array(own, np.int32))
        within = shapely.covers(faces[k], cells)
        labels[within] = own[beside]
