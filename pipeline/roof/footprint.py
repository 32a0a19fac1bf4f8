"""Footprints: what is given is cleaned, what is missing is drawn around the roof."""

from __future__ import annotations

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.errors import BuildingError
from pipeline.model import FloatArray, IntArray, Reason
from pipeline.roof.partition import RoofPartition

_REPEATED_MM = 10.0
_STRAIGHT_MM = 1.5
"""Vertices this near to the line through their neighbours are not corners."""


def footprint_in_mm(footprint: Polygon | MultiPolygon) -> MultiPolygon:
    """A given footprint on the millimetre grid: valid, without repeated vertices.

    Parameters
    ----------
    footprint : Polygon or MultiPolygon
        Local metres; a third dimension is ignored.

    Returns
    -------
    MultiPolygon
        Integer millimetres.

    Raises
    ------
    BuildingError
        `no_footprint` where nothing with an area is left.
    """
    scaled = shapely.force_2d(footprint)
    scaled = shapely.set_coordinates(scaled, shapely.get_coordinates(scaled) * 1e3)
    if not scaled.is_valid:
        scaled = shapely.make_valid(scaled, method="structure", keep_collapsed=False)
    snapped = shapely.set_precision(scaled, 1.0)
    straight = shapely.simplify(snapped, _STRAIGHT_MM, preserve_topology=True)
    cleaned = polygons_of(straight)
    if cleaned and _has_repeated(cleaned, _REPEATED_MM):
        cleaned = [thinned for polygon in cleaned for thinned in without_repeated(polygon, _REPEATED_MM)]
    thinned_all = MultiPolygon(cleaned)
    if not thinned_all.is_valid:
        thinned_all = MultiPolygon(polygons_of(snapped))
    if thinned_all.is_empty:
        raise BuildingError(Reason.NO_FOOTPRINT, f"the given footprint has an area of {footprint.area:g} m2")
    return thinned_all


def _has_repeated(polygons: list[Polygon], distance_mm: float) -> bool:
    """Whether a vertex is as near to the one before it."""
    xy, ring = shapely.get_coordinates(shapely.get_rings(polygons), return_index=True)
    steps = xy[1:] - xy[:-1]
    squares = steps[:, 0] * steps[:, 0] + steps[:, 1] * steps[:, 1]
    return bool((squares[ring[1:] == ring[:-1]] <= distance_mm * distance_mm).any())


def without_repeated(polygon: Polygon, distance_mm: float) -> list[Polygon]:
    """The polygon without vertices that repeat the one before; holes that vanish go, and so does the whole."""
    paths, number = shapely.get_coordinates(shapely.get_rings(polygon), return_index=True)
    thinned = shapely.remove_repeated_points(shapely.linestrings(paths, indices=number), distance_mm)
    rings = [shapely.get_coordinates(line) for line in thinned]
    if len(rings[0]) < 4:
        return []
    return [Polygon(rings[0], [ring for ring in rings[1:] if len(ring) >= 4])]


def polygons_of(geometry: shapely.Geometry) -> list[Polygon]:
    """The polygons with an area in any geometry."""
    parts = shapely.get_parts(shapely.get_parts(geometry))
    return [p for p in parts.tolist() if isinstance(p, Polygon) and p.area > 0.0]


def clip_partition(partition: RoofPartition, footprint_mm: MultiPolygon, minimum_area_m2: float) -> RoofPartition:
    """The part of a partition inside a footprint.

    Parameters
    ----------
    partition : RoofPartition
        A coverage that reaches beyond the footprint wherever there is roof.
    footprint_mm : MultiPolygon
        Integer millimetres.
    minimum_area_m2 : float
        Smaller pieces join the neighbour with the longest border, or go where they have none.

    Returns
    -------
    RoofPartition
        Every polygon connected.

    Raises
    ------
    BuildingError
        `no_partition` where nothing is left.
    """
    shapely.prepare(footprint_mm)
    polygons = np.array(partition.polygons, dtype=object)
    inside = shapely.contains_properly(footprint_mm, polygons)
    pieces: list[Polygon] = []
    labels: list[int] = []
    for polygon, label, whole in zip(polygons, partition.labels.tolist(), inside, strict=True):
        for piece in [polygon] if whole else polygons_of(shapely.intersection(polygon, footprint_mm, grid_size=1.0)):
            pieces.append(piece)
            labels.append(label)
    pieces, labels = _absorb_small(pieces, labels, minimum_area_m2 * 1e6)
    if not pieces:
        raise BuildingError(Reason.NO_PARTITION, "no roof face lies inside the footprint")
    return RoofPartition(polygons=tuple(pieces), labels=np.array(labels, np.int32))


def _absorb_small(pieces: list[Polygon], labels: list[int], minimum_area_mm2: float) -> tuple[list[Polygon], list[int]]:
    """Unite pieces that are too small with a neighbour, smallest first."""
    alive = [True] * len(pieces)
    small = [k for k in range(len(pieces)) if pieces[k].area < minimum_area_mm2]
    if not small:
        return pieces, labels
    tree = shapely.STRtree(pieces)
    for k in sorted(small, key=lambda k: (pieces[k].area, k)):
        if pieces[k].area >= minimum_area_mm2:
            continue
        longest, into = 0.0, -1
        for j in sorted(tree.query(pieces[k]).tolist()):
            if j == k or not alive[j]:
                continue
            border = shapely.intersection(pieces[k], pieces[j], grid_size=1.0).length
            if border > longest:
                longest, into = border, j
        alive[k] = False
        if into >= 0:
            united = shapely.union(pieces[k], pieces[into], grid_size=1.0)
            if isinstance(united, Polygon):
                pieces[into] = united
    kept = [k for k in range(len(pieces)) if alive[k]]
    return [pieces[k] for k in kept], [labels[k] for k in kept]


def outline(partition: RoofPartition) -> MultiPolygon:
    """The area of a partition in integer millimetres.

    Also of one in which rounding to millimetres let a border cross itself: such a partition makes no solid, but has an
    outline all the same.
    """
    polygons = np.array(partition.polygons, dtype=object)
    if shapely.is_valid(polygons).all():
        return MultiPolygon(polygons_of(shapely.coverage_union_all(polygons)))
    return MultiPolygon(polygons_of(shapely.union_all(shapely.make_valid(polygons), grid_size=1.0)))


def hull_of_points(points: FloatArray) -> Polygon | None:
    """Convex hull of points in plan; None where it has no area."""
    if len(points) < 3:
        return None
    hull = shapely.convex_hull(shapely.multipoints(points[:, :2]))
    return hull if isinstance(hull, Polygon) and hull.area > 0.0 else None


def in_footprint(footprint_mm: MultiPolygon, xy_mm: IntArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Mask of the points inside or on the border."""
    shapely.prepare(footprint_mm)
    inside: np.ndarray[tuple[int], np.dtype[np.bool_]] = shapely.intersects_xy(footprint_mm, xy_mm[:, 0], xy_mm[:, 1])
    return inside
