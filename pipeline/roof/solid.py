"""A closed solid over a partition of the plan: roof faces on their planes, walls between levels, a floor.

Everything is done on the millimetre grid: plan vertices are integers, heights are rounded before faces are made.
A vertical line through a plan vertex has one solid vertex per level: the heights of the adjacent roof faces, united
within a tolerance, and the floor at the outline. Walls run between levels; levels of other faces on the way are
inserted into their rings. Thus every edge of the solid belongs to exactly two faces.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from itertools import chain

import numpy as np
import shapely

from pipeline.errors import BuildingError
from pipeline.kernels.union_find import united
from pipeline.model import FaceKind, FloatArray, Plane, Reason, RoofFace, Solid, SolidFace
from pipeline.roof.partition import RoofPartition

SAME_HEIGHT_MM = 2
"""Levels of one plan vertex that are closer than this are one: twice the rounding."""
MIN_SPAN_MM = 5
"""A crossing of two planes nearer than this to the end of its edge is moved to that end; numerical guard."""

Ring = list[int]


@dataclasses.dataclass(frozen=True, kw_only=True)
class SolidPart:
    """One connected part of a building."""

    solid: Solid
    """Closed, oriented; not yet judged."""
    faces: tuple[RoofFace, ...]
    """Its roof faces."""
    footprint: shapely.Polygon
    """Its floor in plan, local metres."""


@dataclasses.dataclass
class _Mesh:
    """Faces in plan as rings of vertex numbers, with the vertices' millimetres."""

    xy: list[tuple[int, int]]
    faces: list[list[Ring]]
    planes: list[int]


def solid_parts(partition: RoofPartition, planes: Sequence[Plane], ground_z_m: float) -> list[SolidPart]:
    """Extrude a partition to one closed solid for every connected part, in the order of each part's first polygon.

    The partition is a valid coverage in integer millimetres; the planes that its labels number lie above the floor over
    their polygons. Coordinates of solids are multiples of 1 mm. Raises BuildingError `no_partition` where borders
    overlap, pinch, or a plane dips under the floor.
    """
    mesh = _mesh(partition)
    edges = _insert_crossings(mesh, planes)
    parts = _connected(mesh, edges)
    if len(parts) == 1:
        return [_extrude(mesh, parts[0], edges, planes, ground_z_m)]
    return [_extrude(mesh, members, _edges(mesh, members), planes, ground_z_m) for members in parts]


def _fault(detail: str) -> BuildingError:
    return BuildingError(Reason.NO_PARTITION, detail)


def _mesh(partition: RoofPartition) -> _Mesh:
    """Number the distinct plan vertices."""
    xy: list[tuple[int, int]] = []
    number: dict[tuple[int, int], int] = {}
    lines, owner = shapely.get_rings(shapely.orient_polygons(np.array(partition.polygons, object)), return_index=True)
    coordinates = np.rint(shapely.get_coordinates(lines)).astype(np.int64).tolist()
    stops = np.cumsum(shapely.get_num_coordinates(lines)).tolist()
    faces: list[list[Ring]] = [[] for _ in partition.polygons]
    for face, start, stop in zip(owner.tolist(), [0, *stops[:-1]], stops, strict=True):
        ring: Ring = []
        for x, y in coordinates[start : stop - 1]:
            vertex = number.setdefault((x, y), len(xy))
            if vertex == len(xy):
                xy.append((x, y))
            if not ring or ring[-1] != vertex:
                ring.append(vertex)
        faces[face].append(ring)
    return _Mesh(xy=xy, faces=faces, planes=[int(label) for label in partition.labels])


def _edges(mesh: _Mesh, members: Sequence[int]) -> dict[tuple[int, int], int]:
    """Face to the left of every directed edge."""
    edges: dict[tuple[int, int], int] = {}
    for face in members:
        for ring in mesh.faces[face]:
            for a, b in zip(ring, ring[1:] + ring[:1], strict=True):
                if (a, b) in edges or a == b:
                    raise _fault(f"two roof faces overlap at {mesh.xy[a]} mm")
                edges[a, b] = face
    return edges


def height_mm(plane: Plane, xy: tuple[int, int]) -> float:
    """Height of a plane over a plan vertex; all in millimetres."""
    return (plane.a * (xy[0] * 1e-3) + plane.b * (xy[1] * 1e-3) + plane.c) * 1e3


def _insert_crossings(mesh: _Mesh, planes: Sequence[Plane]) -> dict[tuple[int, int], int]:
    """Give every shared edge on which the two planes cross a vertex there; the edges afterwards."""
    edges = _edges(mesh, range(len(mesh.faces)))
    inserted: dict[tuple[int, int], int] = {}
    for (a, b), left in edges.items():
        right = edges.get((b, a), -1)
        if a > b or right < 0:
            continue
        p, q = planes[mesh.planes[left]], planes[mesh.planes[right]]
        at_a = height_mm(p, mesh.xy[a]) - height_mm(q, mesh.xy[a])
        at_b = height_mm(p, mesh.xy[b]) - height_mm(q, mesh.xy[b])
        if at_a * at_b >= 0.0 or min(abs(at_a), abs(at_b)) <= SAME_HEIGHT_MM:
            continue
        (xa, ya), (xb, yb) = mesh.xy[a], mesh.xy[b]
        fraction = at_a / (at_a - at_b)
        if min(fraction, 1.0 - fraction) * math.hypot(xb - xa, yb - ya) < MIN_SPAN_MM:
            continue
        inserted[a, b] = inserted[b, a] = len(mesh.xy)
        mesh.xy.append((round(xa + fraction * (xb - xa)), round(ya + fraction * (yb - ya))))
    if not inserted:
        return edges
    for rings in mesh.faces:
        for k, ring in enumerate(rings):
            longer: Ring = []
            for a, b in zip(ring, ring[1:] + ring[:1], strict=True):
                longer.append(a)
                if (a, b) in inserted:
                    longer.append(inserted[a, b])
            rings[k] = longer
    return _edges(mesh, range(len(mesh.faces)))


def _connected(mesh: _Mesh, edges: dict[tuple[int, int], int]) -> list[list[int]]:
    """Faces of every part that is connected by edges."""
    left = np.fromiter(edges.values(), np.int64)
    right = np.fromiter((edges.get((b, a), face) for (a, b), face in edges.items()), np.int64)
    parts: dict[int, list[int]] = {}
    for face, first in enumerate(united(len(mesh.faces), left, right).tolist()):
        parts.setdefault(first, []).append(face)
    return list(parts.values())


class _Levels:
    """Solid vertices on the vertical lines through the plan vertices of one part."""

    def __init__(self, mesh: _Mesh, edges: dict[tuple[int, int], int], planes: Sequence[Plane], floor_mm: int) -> None:
        self.points: list[tuple[int, int, int]] = []
        self.line: dict[int, list[int]] = {}
        """Solid vertices of a plan vertex, from below."""
        self.rank: dict[tuple[int, int], int] = {}
        """(plan vertex, face) to the position in `line`; face -1 is the floor."""
        touching: dict[int, dict[int, float]] = {}
        outline: set[int] = set()
        united: list[tuple[int, int, int]] = []
        for (a, b), face in edges.items():
            plane = planes[mesh.planes[face]]
            # every vertex of a ring is the start of one of its edges
            touching.setdefault(a, {})[face] = height_mm(plane, mesh.xy[a])
            other = edges.get((b, a), -1)
            if other < 0:
                outline.update((a, b))
            elif a < b:
                united.append((a, b, other))
        self._unite_near_crossings(edges, touching, united)
        for v in sorted(touching):
            self._stack(mesh.xy[v], v, touching[v], floor_mm if v in outline else None, floor_mm)

    @staticmethod
    def _unite_near_crossings(
        edges: dict[tuple[int, int], int],
        touching: dict[int, dict[int, float]],
        shared: list[tuple[int, int, int]],
    ) -> None:
        """Where two planes still cross on an edge, they do so next to an end: make that end one height."""
        for a, b, right in shared:
            left = edges[a, b]
            at_a = touching[a][left] - touching[a][right]
            at_b = touching[b][left] - touching[b][right]
            if at_a * at_b < 0.0:
                end = a if abs(at_a) <= abs(at_b) else b
                middle = 0.5 * (touching[end][left] + touching[end][right])
                touching[end][left] = touching[end][right] = middle

    def _stack(self, xy: tuple[int, int], v: int, heights: dict[int, float], floor: int | None, lowest: int) -> None:
        """Make the solid vertices over plan vertex `v`."""
        line: list[int] = []
        if floor is not None:
            self.rank[v, -1] = 0
            line.append(len(self.points))
            self.points.append((*xy, floor))
        level: int | None = None
        for height, face in sorted((height, face) for face, height in heights.items()):
            z = round(height)
            if z < lowest + SAME_HEIGHT_MM:
                raise _fault(f"a roof plane dips {(lowest - z) / 1000:.3f} m under the floor")
            if level is None or z - level >= SAME_HEIGHT_MM:
                level = z
                line.append(len(self.points))
                self.points.append((*xy, z))
            self.rank[v, face] = len(line) - 1
        self.line[v] = line

    def at(self, v: int, face: int) -> int:
        """Solid vertex of a face over a plan vertex."""
        return self.line[v][self.rank[v, face]]


def _wall(levels: _Levels, a: int, b: int, left: int, right: int) -> Ring | None:
    """Ring of the wall over edge a -> b, seen from the lower side; None where both sides are level."""
    left_a, left_b = levels.rank[a, left], levels.rank[b, left]
    right_a, right_b = levels.rank[a, right], levels.rank[b, right]
    if left_a == right_a and left_b == right_b:
        return None
    if left_a < right_a or left_b < right_b:
        if left_a > right_a or left_b > right_b:
            raise _fault("two roof planes cross between the ends of an edge")
        a, b = b, a
        left_a, left_b, right_a, right_b = right_b, right_a, left_b, left_a
    # the higher face lies left of a -> b, so the wall is seen from the right: up at b, down at a
    up = levels.line[b][right_b : left_b + 1]
    down = levels.line[a][right_a : left_a + 1]
    return up + down[::-1]


def trace(following: dict[int, int], xy: Sequence[tuple[int, int]]) -> list[Ring]:
    """Closed rings of a successor table, the outer one (clockwise: a floor is seen from below) first."""
    rings: list[Ring] = []
    left = dict(following)
    while left:
        start = next(iter(left))
        ring = [start]
        v = left.pop(start)
        while v != start:
            ring.append(v)
            v = left.pop(v)
        rings.append(ring)

    def twice_area(ring: Ring) -> int:
        return sum(xy[a][0] * xy[b][1] - xy[b][0] * xy[a][1] for a, b in zip(ring, ring[1:] + ring[:1], strict=True))

    rings.sort(key=twice_area)
    if sum(twice_area(ring) < 0 for ring in rings) != 1:
        raise _fault("the outline of a part is not one ring with holes")
    return rings


def _extrude(
    mesh: _Mesh,
    members: Sequence[int],
    edges: dict[tuple[int, int], int],
    planes: Sequence[Plane],
    ground_z_m: float,
) -> SolidPart:
    """Roof, walls and floor of one part."""
    levels = _Levels(mesh, edges, planes, round(ground_z_m * 1e3))
    faces: list[SolidFace] = []
    for face in members:
        rings = tuple(tuple(levels.at(v, face) for v in ring) for ring in mesh.faces[face])
        faces.append(SolidFace(rings=rings, kind=FaceKind.ROOF, plane=mesh.planes[face]))
    n_roof = len(faces)
    below: dict[int, int] = {}
    for (a, b), face in edges.items():
        other = edges.get((b, a), -1)
        if other < 0:
            if b in below:
                raise _fault(f"the outline touches itself at {mesh.xy[b]} mm")
            below[b] = a
        elif a > b:
            continue
        wall = _wall(levels, a, b, face, other)
        if wall is not None:
            faces.append(SolidFace(rings=(tuple(wall),), kind=FaceKind.WALL))
    floor = trace(below, mesh.xy)
    faces.append(SolidFace(rings=tuple(tuple(levels.at(v, -1) for v in ring) for ring in floor), kind=FaceKind.GROUND))
    vertices = np.array(levels.points, np.float64) / 1e3
    plan = np.array(mesh.xy, np.float64) / 1e3
    polygons = _polygons(vertices, [face.rings for face in faces[:n_roof]])
    roof_faces = tuple(
        RoofFace(plane=face.plane, polygon=polygon) for face, polygon in zip(faces[:n_roof], polygons, strict=True)
    )
    (footprint,) = _polygons(plan, [[ring[::-1] for ring in floor]])
    return SolidPart(solid=Solid(vertices=vertices, faces=tuple(faces)), faces=roof_faces, footprint=footprint)


def _polygons(vertices: FloatArray, faces: Sequence[Sequence[Sequence[int]]]) -> list[shapely.Polygon]:
    """A polygon of every face's rings, the outer one first, all made at once."""
    rings = [ring for face in faces for ring in face]
    numbers = np.repeat(np.arange(len(rings)), [len(ring) for ring in rings])
    lines = shapely.linearrings(vertices[list(chain.from_iterable(rings))], indices=numbers)
    owner = np.repeat(np.arange(len(faces)), [len(face) for face in faces])
    polygons: list[shapely.Polygon] = shapely.polygons(lines, indices=owner).tolist()
    return polygons
