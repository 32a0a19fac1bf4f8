"""A closed solid over a partition of the plan: roof faces on their planes, walls between levels, a floor.

Everything is done on the millimetre grid: plan vertices are integers, heights are rounded before faces are made.
A vertical line through a plan vertex has one solid vertex per level: the heights of the adjacent roof faces, united
within a tolerance, and the floor at the outline. Walls run between levels; levels of other faces on the way are
inserted into their rings. Thus every edge of the solid belongs to exactly two faces.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import shapely
from shapely import MultiPolygon

from pipeline.errors import BuildingError
from pipeline.geometry import corners_of_rings
from pipeline.model import FaceKind, Plane, Reason, RoofFace, Solid, SolidFace
from pipeline.roof.extrusion import CROSSING, DIP, FLOOR, OVERLAP, PINCH, SOUND, WALL, Extruded, Fault, extruded
from pipeline.roof.partition import RoofPartition


@dataclasses.dataclass(frozen=True, kw_only=True)
class SolidPart:
    """One connected part of a building."""

    solid: Solid
    """Closed, oriented; not yet judged."""
    faces: tuple[RoofFace, ...]
    """Its roof faces."""
    footprint: shapely.Polygon
    """Its floor in plan, local metres."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LodParts:
    """A building at one level of detail."""

    lod: str
    """1.2, 1.3, 2.0 or 2.2."""
    parts: list[SolidPart]
    """Its separate parts."""
    planes: list[Plane]
    """The planes that the labels of the parts' faces number."""


def solid_parts(
    partition: RoofPartition, planes: Sequence[Plane], ground_z_m: float, outline_mm: MultiPolygon | None = None
) -> list[SolidPart]:
    """Extrude a partition to one closed solid for every connected part, in the order of each part's first polygon.

    The partition is a valid coverage in integer millimetres; the planes that its labels number lie above the floor over
    their polygons. Coordinates of solids are multiples of 1 mm. The solids stay within an outline that others touch, if
    there is one. Raises BuildingError `no_partition` where borders overlap, pinch, or a plane dips under the floor.
    """
    if outline_mm is not None:
        from pipeline.roof.within_outline import within_outline

        partition = within_outline(partition, outline_mm)
    xy, ring, polygon = corners_of_rings(shapely.orient_polygons(partition.polygons))
    coefficients = np.array([plane.coefficients for plane in planes]).reshape(len(planes), 3)
    solids, fault = extruded(xy, ring, polygon, partition.labels, coefficients, round(ground_z_m * 1e3))
    if fault.kind != SOUND:
        raise BuildingError(Reason.NO_PARTITION, _words(fault))
    return _parts(solids, partition.labels.tolist())


def _words(fault: Fault) -> str:
    """A fault in words."""
    if fault.kind == OVERLAP:
        return f"two roof faces overlap at {(fault.x, fault.y)} mm"
    if fault.kind == PINCH:
        return f"the outline touches itself at {(fault.x, fault.y)} mm"
    if fault.kind == DIP:
        return f"a roof plane dips {fault.x / 1000:.3f} m under the floor"
    if fault.kind == CROSSING:
        return "two roof planes cross between the ends of an edge"
    return "the outline of a part is not one ring with holes"


def _parts(solids: Extruded, labels: Sequence[int]) -> list[SolidPart]:
    """The solids as objects; `labels` are the planes of the polygons."""
    lines = shapely.linearrings(solids.outlines, indices=solids.ring_of_outline)
    # without holes each ring is a polygon, which shapely makes in half the time
    has_holes = len(lines) > np.count_nonzero(solids.source != WALL)
    polygons = iter(shapely.polygons(lines, indices=solids.face_of_outline if has_holes else None).tolist())
    vertices, rings = solids.vertices.tolist(), solids.rings.tolist()
    corners = [tuple(vertices[start:stop]) for start, stop in pairwise(rings)]
    starts = solids.points_of_part.tolist()
    parts: list[SolidPart] = []
    faces: list[SolidFace] = []
    roofs: list[RoofFace] = []
    for source, (start, stop) in zip(solids.source.tolist(), pairwise(solids.rings_of_face.tolist()), strict=True):
        own = tuple(corners[start:stop])
        if source == WALL:
            faces.append(SolidFace(rings=own, kind=FaceKind.WALL))
        elif source != FLOOR:
            faces.append(SolidFace(rings=own, kind=FaceKind.ROOF, plane=labels[source]))
            roofs.append(RoofFace(plane=labels[source], polygon=next(polygons)))
        else:
            faces.append(SolidFace(rings=own, kind=FaceKind.GROUND))
            points = solids.points[starts[len(parts)] : starts[len(parts) + 1]]
            solid = Solid(vertices=points, faces=tuple(faces))
            parts.append(SolidPart(solid=solid, faces=tuple(roofs), footprint=shapely.force_2d(next(polygons))))
            faces, roofs = [], []
    return parts


def renumbered(solid: Solid, number: dict[int, int]) -> Solid:
    """The solid with other plane numbers."""
    faces = tuple(dataclasses.replace(f, plane=number[f.plane]) if f.plane >= 0 else f for f in solid.faces)
    return Solid(vertices=solid.vertices, faces=faces)


def united(footprints: Sequence[shapely.Polygon]) -> shapely.Polygon | shapely.MultiPolygon:
    """One geometry of footprints that do not overlap."""
    if len(footprints) == 1:
        return footprints[0]
    together = shapely.MultiPolygon(list(footprints))
    if together.is_valid:
        return together
    one = shapely.union_all(list(footprints), grid_size=1e-3)
    return one if isinstance(one, shapely.Polygon | shapely.MultiPolygon) else together
