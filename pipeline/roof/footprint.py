"""Outlines of partitions and of points."""

from __future__ import annotations

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.model import FloatArray
from pipeline.roof.partition import RoofPartition
from pipeline.roof.snapped_rings import snapped_ring


def polygons_of(geometry: shapely.Geometry) -> list[Polygon]:
    """The polygons with an area in any geometry."""
    if isinstance(geometry, Polygon):
        return [geometry] if geometry.area > 0.0 else []
    parts = shapely.get_parts(geometry)
    if not isinstance(geometry, MultiPolygon):  # collections may hold others
        parts = shapely.get_parts(parts)
    return [p for p in parts.tolist() if isinstance(p, Polygon) and p.area > 0.0]


def outline(partition: RoofPartition) -> MultiPolygon:
    """The area of a partition in integer millimetres.

    It may have a border that crosses itself since it was rounded: such a partition cannot become a solid, but has an
    outline.
    """
    polygons = np.array(partition.polygons, dtype=object)
    if len(polygons) == 1 and shapely.get_num_interior_rings(polygons[0]) == 0:
        alone = snapped_ring(shapely.get_coordinates(polygons[0])[:-1])
        if len(alone):
            return MultiPolygon([Polygon(alone)])
    if shapely.is_valid(polygons).all():
        return MultiPolygon(polygons_of(shapely.coverage_union_all(polygons)))
    return MultiPolygon(polygons_of(shapely.union_all(shapely.make_valid(polygons), grid_size=1.0)))


def hull_of_points(points: FloatArray) -> Polygon | None:
    """Convex hull of points in plan; None where it has no area."""
    if len(points) < 3:
        return None
    hull = shapely.convex_hull(shapely.multipoints(points[:, :2]))
    return hull if isinstance(hull, Polygon) and hull.area > 0.0 else None
