"""Closed solids of exact buildings: the roof faces, walls down to the floor, and the floor."""

from __future__ import annotations

import math

import numpy as np
import shapely
from shapely import Polygon

from pipeline.model import BuildingResult, FaceKind, FloatArray, Plane, RoofFace, Solid, SolidFace, Status
from pipeline.roof.partition import RoofPartition
from pipeline.roof.solid import solid_parts
from pipeline.ruler.simulation.roof_dimensions import FaceRings
from pipeline.ruler.simulation.simulated_scene import Building
from pipeline.ruler.simulation.straight_walls import with_straight_walls


def boundary_rings(faces: tuple[FaceRings, ...]) -> list[list[int]]:
    """Rings of the directed edges that only one face has: outlines counter-clockwise, courtyards clockwise."""
    directed = {(ring[k], ring[(k + 1) % len(ring)]) for face in faces for ring in face for k in range(len(ring))}
    follower = {start: end for start, end in sorted(directed) if (end, start) not in directed}
    rings = []
    while follower:
        first = min(follower)
        ring = [first]
        vertex = follower.pop(first)
        while vertex != first:
            ring.append(vertex)
            vertex = follower.pop(vertex)
        rings.append(ring)
    return rings


def _from_a_corner(ring: list[int], vertices: FloatArray) -> tuple[list[int], list[bool]]:
    """The ring, turned so that it starts at a corner of the plan, and which of its vertices are corners."""
    plan = vertices[ring, :2]
    before, after = plan - np.roll(plan, 1, axis=0), np.roll(plan, -1, axis=0) - plan
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    scale = np.hypot(before[:, 0], before[:, 1]) * np.hypot(after[:, 0], after[:, 1])
    corner = np.abs(cross) > 1e-9 * scale
    shift = int(np.argmax(corner))
    return ring[shift:] + ring[:shift], [bool(flag) for flag in np.roll(corner, -shift)]


def building_solid(building: Building, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Solid:
    """The closed, outward oriented solid of a building.

    Each straight run of the outline is one wall, so the end wall of a gable is one face of five vertices. A step edge
    between roof faces is a wall. Vertices are relative to `origin` and rounded to whole millimetres. Raises ValueError
    if the roof falls into parts that share no edge, and BuildingError if a corner alone connects them.
    """
    if has_steps(building):
        return _stepped_solid(building, origin)
    roof = building.vertices - np.array(origin)
    floor_z = building.floor_z_m - origin[2]
    faces = [SolidFace(rings=face, kind=FaceKind.ROOF, plane=k) for k, face in enumerate(building.faces)]
    bottom: list[tuple[float, float, float]] = []
    ground_rings = []
    for unturned in boundary_rings(building.faces):
        ring, is_corner = _from_a_corner(unturned, building.vertices)
        corners = [k for k, flag in enumerate(is_corner) if flag]
        first = len(roof) + len(bottom)
        for n, k in enumerate(corners):
            end = corners[n + 1] if n + 1 < len(corners) else len(ring)
            top = [ring[m % len(ring)] for m in range(k, end + 1)]
            below, below_next = first + n, first + (n + 1) % len(corners)
            faces.append(SolidFace(rings=((below, below_next, *reversed(top)),), kind=FaceKind.WALL))
            bottom.append((float(roof[ring[k], 0]), float(roof[ring[k], 1]), floor_z))
        ground_rings.append(tuple(range(first + len(corners) - 1, first - 1, -1)))
    # The outline is the ring of largest extent; courtyards lie inside it.
    vertices = np.vstack([roof, np.array(bottom)])
    ground_rings.sort(key=lambda ring: -float(np.ptp(vertices[list(ring), 0])))
    faces.append(SolidFace(rings=tuple(ground_rings), kind=FaceKind.GROUND))
    return Solid(vertices=np.round(vertices, 3), faces=tuple(faces))


def has_steps(building: Building) -> bool:
    """Whether the roof has a step edge: two vertices over one place."""
    plan = np.round(building.vertices[:, :2] * 1e6)
    return len(np.unique(plan, axis=0)) < len(plan)


def _stepped_solid(building: Building, origin: tuple[float, float, float]) -> Solid:
    """The solid of a roof with steps, by the extrusion of the roof models: levels of all faces over each vertex."""
    plan = np.rint((building.vertices[:, :2] - np.array(origin[:2])) * 1000.0)
    polygons = tuple(
        shapely.Polygon(plan[list(face[0])], [plan[list(hole)] for hole in face[1:]]) for face in building.faces
    )
    partition = RoofPartition(polygons=polygons, labels=np.arange(len(polygons), dtype=np.int32))
    planes = [moved_plane(plane, origin) for plane in building.planes]
    parts = solid_parts(partition, planes, building.floor_z_m - origin[2])
    if len(parts) != 1:
        raise ValueError(f"{building.building_id}: the roof falls into {len(parts)} parts that share no edge")
    return with_straight_walls(parts[0].solid)


def moved_plane(plane: Plane, origin: tuple[float, float, float]) -> Plane:
    """The same plane seen from another origin."""
    c = plane.c + plane.a * origin[0] + plane.b * origin[1] - origin[2]
    return Plane(a=plane.a, b=plane.b, c=c, n_points=plane.n_points, rmse_m=plane.rmse_m)


def truth_record(
    building: Building, scene_origin: tuple[float, float, float], *, touches_data_edge: bool = False
) -> BuildingResult:
    """The record that a perfect method would deliver for the building; its source_id is the block.

    Its local origin is the middle of the building in whole metres. Figures that need points (density, residuals) are
    nan, and the number of points is 0.
    """
    local = (float(math.floor(building.x)), float(math.floor(building.y)), float(math.floor(building.floor_z_m)))
    solid = building_solid(building, local)
    shift = np.array(local)
    return BuildingResult(
        building_id=building.building_id,
        origin=(scene_origin[0] + local[0], scene_origin[1] + local[1], scene_origin[2] + local[2]),
        source_id=building.block_id,
        status=Status.OK,
        reason=None,
        reason_detail="",
        method="truth",
        roof_type=building.roof_type,
        lod="2.2",
        footprint=_shifted(building.footprint, shift),
        planes=tuple(moved_plane(plane, local) for plane in building.planes),
        faces=tuple(
            RoofFace(plane=k, polygon=_shifted(polygon, shift)) for k, polygon in enumerate(building.roof_polygons())
        ),
        solids=(solid,),
        validity_codes=(),
        ground_z_m=building.floor_z_m - local[2],
        n_points=0,
        density_per_m2=math.nan,
        rmse_m=math.nan,
        p95_m=math.nan,
        coverage=1.0,
        touches_data_edge=touches_data_edge,
    )


def _shifted(polygon: Polygon, shift: FloatArray) -> Polygon:
    """The polygon, 2D or 3D, with the shift subtracted and rounded to whole millimetres."""
    depth = 3 if polygon.has_z else 2
    moved = shapely.transform(polygon, lambda xyz: np.round(xyz - shift[:depth], 3), include_z=polygon.has_z)
    if not isinstance(moved, Polygon):
        raise TypeError(f"a moved polygon became a {moved.geom_type}")
    return moved
