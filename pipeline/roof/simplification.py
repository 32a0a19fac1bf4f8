"""Fewer vertices on the borders of a partition, without breaking its topology."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import shapely

from pipeline.errors import BuildingError
from pipeline.model import FloatArray, Reason
from pipeline.roof.footprint_in_mm import without_repeated
from pipeline.roof.partition import RoofPartition

_STRAIGHT_MM = 2.0
"""A vertex that bends borders by less is idle: rounding to 1 mm moves a point on a line as far."""

XY = tuple[int, int]


def simplify_partition(partition: RoofPartition, tolerance_m: float, *, outline_too: bool = True) -> RoofPartition:
    """Drop border vertices that matter little, the same on both sides of every border.

    A vertex whose triangle with its neighbours covers less than the squared tolerance is dropped, smallest first
    (Visvalingam and Whyatt 1993), unless borders would touch or cross. Vertices are dropped, never moved, so the
    millimetre grid is kept; nodes where three borders meet stay, and polygons keep their order. The tolerance is in
    metres; 0 changes nothing. Raises BuildingError `no_partition` where a polygon vanished or fell apart.
    """
    if tolerance_m <= 0.0:
        return partition
    polygons = shapely.coverage_simplify(
        np.array(partition.polygons, dtype=object), tolerance_m * 1e3, simplify_boundary=outline_too
    )
    if shapely.is_empty(polygons).any() or (shapely.get_type_id(polygons) != shapely.GeometryType.POLYGON).any():
        raise BuildingError(Reason.NO_PARTITION, f"a roof face vanished when simplified by {tolerance_m:g} m")
    return RoofPartition(polygons=tuple(polygons), labels=partition.labels)


def unite_close_vertices(partition: RoofPartition, distance_mm: float) -> RoofPartition:
    """Unite border vertices that lie closer than a distance, the same in every polygon.

    Where a clipped border passes close by a corner of the footprint, two vertices can lie a millimetre apart: distinct
    here, the same for a reader with a tolerance.

    Vertices of a coverage in integer millimetres that are at most this far apart become the leftmost of them; polygons
    that vanish go. The same object comes back where no vertices are close. Raises BuildingError `no_partition` where a
    polygon breaks.
    """
    polygons = np.array(partition.polygons, dtype=object)
    vertices = np.unique(shapely.get_coordinates(polygons), axis=0)
    representative: dict[tuple[float, float], tuple[float, float]] = {}
    points: list[tuple[float, float]] = [(x, y) for x, y in vertices.tolist()]
    for i, first in enumerate(points):
        for j in range(i + 1, len(points)):
            second = points[j]
            if second[0] - first[0] > distance_mm:
                break
            if math.hypot(second[0] - first[0], second[1] - first[1]) <= distance_mm and second not in representative:
                representative[second] = representative.get(first, first)
    if not representative:
        return partition

    def moved(xy: FloatArray) -> FloatArray:
        return np.array([representative.get((x, y), (x, y)) for x, y in xy.tolist()]).reshape(-1, 2)

    united = [without_repeated(polygon, 0.0) for polygon in shapely.transform(polygons, moved).tolist()]
    kept = [k for k, parts in enumerate(united) if parts]
    drawn = [united[k][0] for k in kept]
    if not drawn or not shapely.is_valid(drawn).all():
        raise BuildingError(Reason.NO_PARTITION, f"a roof face breaks when vertices within {distance_mm:g} mm are one")
    return RoofPartition(polygons=tuple(drawn), labels=partition.labels[kept])


def without_idle_vertices(polygons: Sequence[shapely.Polygon]) -> list[shapely.Polygon]:
    """A coverage in integer millimetres without vertices that lie on a straight border between two others.

    Where roof faces are united, the ends of the borders between them are left over. A vertex goes where it joins two
    edges only and all vertices that went between its neighbours are within 2 mm of the line between them.

    Examples
    --------
    >>> square = shapely.Polygon([(0, 0), (500, 1), (1000, 0), (1000, 1000), (0, 1000)])
    >>> without_idle_vertices([square])[0].wkt
    'POLYGON ((0 0, 1000 0, 1000 1000, 0 1000, 0 0))'
    """
    beside: dict[XY, set[XY]] = {}
    for polygon in polygons:
        for line in (polygon.exterior, *polygon.interiors):
            ring = [(round(x), round(y)) for x, y in line.coords]
            for a, b in itertools.pairwise(ring):
                beside.setdefault(a, set()).add(b)
                beside.setdefault(b, set()).add(a)
    gone: dict[frozenset[XY], list[XY]] = {}
    dropped: set[XY] = set()
    for v in sorted(beside):
        if len(beside[v]) != 2:
            continue
        a, b = sorted(beside[v])
        between = [v, *gone.get(frozenset((a, v)), ()), *gone.get(frozenset((v, b)), ())]
        if b in beside[a] or any(_off_mm(a, b, u) > _STRAIGHT_MM for u in between):
            continue
        gone[frozenset((a, b))] = between
        dropped.add(v)
        beside[a] = beside[a] - {v} | {b}
        beside[b] = beside[b] - {v} | {a}
    if not dropped:
        return list(polygons)

    def kept(line: shapely.LinearRing) -> list[XY]:
        return [xy for x, y in line.coords[:-1] if (xy := (round(x), round(y))) not in dropped]

    return [shapely.Polygon(kept(p.exterior), [kept(line) for line in p.interiors]) for p in polygons]


def _off_mm(a: XY, b: XY, v: XY) -> float:
    """Distance of a vertex from the line a b; infinite where it is not between the two."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    along, squared = dx * (v[0] - a[0]) + dy * (v[1] - a[1]), dx * dx + dy * dy
    if not 0 < along < squared:
        return math.inf
    return abs(dx * (v[1] - a[1]) - dy * (v[0] - a[0])) / math.sqrt(squared)
