"""Closed boxes of what stands on a modelled roof."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import shapely

from pipeline.building.drawing import Building
from pipeline.errors import BuildingError
from pipeline.extras.superstructures.finding import FoundBox, RoofModel, found_boxes
from pipeline.model import BoolArray, FaceKind, FloatArray, Plane, RoofFace, Solid, SolidFace
from pipeline.quality.residuals import surface_of
from pipeline.quality.validity import check_solid
from pipeline.roof.footprint import polygons_of
from pipeline.roof.partition import RoofPartition
from pipeline.roof.solid import solid_parts

_GAP_M = 0.005
"""Between roof and box: both are rounded to 1 mm, and val3dity takes boxes for parts, which must not overlap."""
_MIN_OVER_M = 0.15
"""Least height of a box over the highest roof beneath it."""
_KINDS = {FaceKind.ROOF: FaceKind.CLOSURE, FaceKind.GROUND: FaceKind.ROOF, FaceKind.WALL: FaceKind.WALL}
"""Of a box upside down, and as it stands."""


def boxes_of(
    building: Building,
    faces: Sequence[RoofFace],
    planes: Sequence[Plane],
    outline: shapely.Geometry,
    noise_m: float,
) -> tuple[Solid, ...]:
    """Valid boxes above the roof faces of a building, in the order of its points."""
    points = building.candidate.points
    roof = RoofModel(
        surface=surface_of(faces, planes),
        faces=faces,
        planes=planes,
        outline=outline,
        spacing_m=building.roof.spacing_m,
        noise_m=0.0 if math.isnan(noise_m) else noise_m,
    )
    split = _are_among(points, building.candidate.split_returns)
    solids = [box_solid(box, faces, planes) for box in found_boxes(points, split, roof)]
    return tuple(solid for solid in solids if solid is not None and not check_solid(solid))


def _are_among(points: FloatArray, others: FloatArray) -> BoolArray:
    """Which points (n, 3) are among others (m, 3), to 1 mm."""
    known = set(map(tuple, np.rint(others * 1e3).astype(np.int64).tolist()))
    return np.array([tuple(xyz) in known for xyz in np.rint(points * 1e3).astype(np.int64).tolist()], np.bool_)


def box_solid(box: FoundBox, faces: Sequence[RoofFace], planes: Sequence[Plane]) -> Solid | None:
    """A closed box from the roof up, in whole millimetres, within the outline; None where it cannot be drawn.

    Its foot follows the roof, also across ridges: it is extruded upside down, as a roof above a floor. Across a step of
    the roof it is level, on the higher side.
    """
    rectangle = shapely.Polygon(np.rint(box.corners * 1e3))
    polygons: list[shapely.Polygon] = []
    labels: list[int] = []
    for face in faces:
        plan = shapely.transform(shapely.force_2d(face.polygon), lambda xy: np.rint(xy * 1e3))
        if plan.intersects(rectangle):
            pieces = polygons_of(shapely.intersection(plan, rectangle, grid_size=1.0))
            polygons += pieces
            labels += [face.plane] * len(pieces)
    top_z_m = round(box.top_z_m, 3)
    mirrored = [dataclasses.replace(plane, a=-plane.a, b=-plane.b, c=-plane.c - _GAP_M) for plane in planes]
    if not polygons:
        return None
    try:
        solid = _upside_down(polygons, labels, mirrored, top_z_m)
        if any(_is_step(face, solid) for face in solid.faces):
            foot = dataclasses.replace(planes[0], a=0.0, b=0.0, c=_highest_foot(solid))
            inside = polygons_of(shapely.union_all(polygons, grid_size=1.0))
            solid = _upside_down([max(inside, key=lambda part: part.area)], [0], [foot], top_z_m)
    except BuildingError:
        return None
    if top_z_m + _highest_foot(solid) < _MIN_OVER_M:
        return None
    return Solid(
        vertices=solid.vertices * (1.0, 1.0, -1.0) + 0.0,
        faces=tuple(
            SolidFace(rings=tuple(ring[::-1] for ring in face.rings), kind=_KINDS[face.kind]) for face in solid.faces
        ),
    )


def _upside_down(
    polygons: Sequence[shapely.Polygon], labels: Sequence[int], planes: Sequence[Plane], top_z_m: float
) -> Solid:
    """A box over a partition in mm, mirrored at elevation 0; the largest of several parts."""
    partition = RoofPartition(polygons=tuple(polygons), labels=np.array(labels, np.int32))
    parts = solid_parts(partition, planes, -top_z_m)
    return max(parts, key=lambda part: part.footprint.area).solid


def _is_step(face: SolidFace, solid: Solid) -> bool:
    """Whether a face is a wall beneath a box that is upside down: that of a step of the roof."""
    z = solid.vertices[list(face.rings[0]), 2]
    return face.kind is FaceKind.WALL and float(z.min()) > float(solid.vertices[:, 2].min())


def _highest_foot(solid: Solid) -> float:
    """Elevation of the highest place of the foot of a box upside down, where it is the lowest of its roof."""
    corners = [k for face in solid.faces if face.kind is FaceKind.ROOF for ring in face.rings for k in ring]
    return float(solid.vertices[corners, 2].min())
