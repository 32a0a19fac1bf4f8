"""The sides of a roof: its faces by direction, and how they meet."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from itertools import product

from pipeline.model import FaceKind, Plane, RoofType, Solid, SolidFace
from pipeline.roof.roof_settings import RoofTypeSettings

HALF = 0.5
"""Share of the area from which flat faces, or the teeth of a sawtooth, decide."""
LEAST_END = 0.008
"""Share of the main roof that an end has at least."""

Folds = dict[tuple[int, int], float]
"""Length in plan over which two planes meet, by their numbers in both orders; each edge counts from both sides."""


@dataclasses.dataclass
class Side:
    """All roof faces of one direction."""

    aspect_deg: float
    area: float
    planes: list[int]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Roof:
    """What decides the type of a roof, by the numbers of planes."""

    planes: Sequence[Plane]
    areas: dict[int, float]
    ridges: Folds
    bends: Folds
    corners: dict[int, list[tuple[float, float, float]]]
    """Of the faces."""
    settings: RoofTypeSettings

    def is_flat(self, p: int) -> bool:
        """Whether a plane is flat."""
        return self.planes[p].slope_deg < self.settings.flat_below_deg

    def area(self, planes: Iterable[int]) -> float:
        """Area of the faces of planes."""
        return math.fsum(self.areas[p] for p in planes)

    def length(self, met: Folds, a: Side, b: Side) -> float:
        """Length over which the faces of two sides meet."""
        return math.fsum(met.get(pair, 0.0) for pair in product(sorted(a.planes), sorted(b.planes)))

    def low(self, planes: Iterable[int]) -> float:
        """Height of the lowest corner of the faces of planes."""
        return min(z for p in planes for _, _, z in self.corners[p])

    def high(self, planes: Iterable[int]) -> float:
        """Height of the highest corner of the faces of planes."""
        return max(z for p in planes for _, _, z in self.corners[p])

    def turned(self, a: Side, b: Side, by_deg: float) -> bool:
        """Whether the directions of two sides are so far apart."""
        return abs(turn_deg(a.aspect_deg, b.aspect_deg) - by_deg) <= self.settings.aspect_tolerance_deg


def turn_deg(a_deg: float, b_deg: float) -> float:
    """Angle between two aspects, 0 to 180."""
    return abs((a_deg - b_deg + 180.0) % 360.0 - 180.0)


def corners_of(solids: Sequence[Solid]) -> dict[int, list[tuple[float, float, float]]]:
    """The corners of the roof faces of each plane."""
    corners: dict[int, list[tuple[float, float, float]]] = {}
    for solid in solids:
        vertices = solid.vertices.tolist()
        for face in solid.faces:
            if face.kind is FaceKind.ROOF:
                corners.setdefault(face.plane, []).extend(vertices[vertex] for ring in face.rings for vertex in ring)
    return corners


def folds(planes: Sequence[Plane], solids: Sequence[Solid], sliver_height_m: float) -> tuple[Folds, Folds]:
    """Where planes meet and fall away on both sides (ridges, hips), and where they do not (bends, valleys).

    Planes meet in a common edge, or across a wall that is nowhere higher than a sliver.
    """
    ridges: Folds = {}
    bends: Folds = {}
    for solid in solids:
        vertices: list[tuple[float, float, float]] = solid.vertices.tolist()
        owner = {edge: face.plane for face in solid.faces if face.kind is FaceKind.ROOF for edge in _edges(face)}
        met = [(edge, owner[edge[::-1]]) for edge in owner if edge[::-1] in owner]
        for face in solid.faces:
            if face.kind is FaceKind.WALL:
                roof_edges = [edge[::-1] for edge in _edges(face) if edge[::-1] in owner]
                if len(roof_edges) > 1 and _height_m(vertices, face) <= sliver_height_m:
                    met += [(edge, owner[other]) for edge in roof_edges for other in roof_edges]
        for (a, b), right in met:
            left = owner[a, b]
            if right == left:
                continue
            # a step of one metre to the left of the edge: the left plane lies below the right one's continuation
            (xa, ya, _), (xb, yb, _) = vertices[a], vertices[b]
            p, q = planes[left], planes[right]
            falls = (p.a - q.a) * (ya - yb) + (p.b - q.b) * (xb - xa) < 0.0
            turned = ridges if falls else bends
            for pair in ((left, right), (right, left)):
                turned[pair] = turned.get(pair, 0.0) + math.hypot(xb - xa, yb - ya)
    return ridges, bends


def _edges(face: SolidFace) -> list[tuple[int, int]]:
    """Directed edges of all rings."""
    return [edge for ring in face.rings for edge in zip(ring, ring[1:] + ring[:1], strict=True)]


def _height_m(vertices: Sequence[tuple[float, float, float]], face: SolidFace) -> float:
    """Greatest height of a wall over one place."""
    ends: dict[tuple[float, float], tuple[float, float]] = {}
    for vertex in face.rings[0]:
        x, y, z = vertices[vertex]
        low, high = ends.get((x, y), (z, z))
        ends[x, y] = min(low, z), max(high, z)
    return max(high - low for low, high in ends.values())


def opposite(roof: Roof, first: Side, second: Side) -> RoofType:
    """The type of two opposite sides alone: a gable with a ridge, a butterfly with a valley."""
    if roof.length(roof.ridges, first, second) > 0.0:
        return RoofType.GABLE
    return RoofType.BUTTERFLY if roof.length(roof.bends, first, second) > 0.0 else RoofType.COMBINATION
