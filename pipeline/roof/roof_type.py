"""Roof type from the delivered planes, their areas and their ridges.

Flat is below 7 degrees, a gable has two opposite sides "whose inclinations must not be the same", a hip roof two such
pairs (Hofmann, Maas and Streilein 2003). Faces of one direction and similar slope count as one side. So do those that
meet in a bend with the steeper one above: the flatter foot of a bent hip. Where a flatter face lies above a steeper one
(gambrel, mansard) the roof is a combination.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from pipeline.model import FaceKind, Plane, RoofFace, RoofType, Solid, SolidFace
from pipeline.roof.roof_settings import RoofTypeSettings


@dataclasses.dataclass
class _Side:
    """All roof faces of one direction."""

    slope_deg: float
    aspect_deg: float
    area: float
    planes: set[int]


Folds = dict[tuple[int, int], float]
"""Length in plan over which two planes meet, by their numbers in both orders; each edge counts from both sides."""


def _turn(a_deg: float, b_deg: float) -> float:
    """Angle between two aspects, 0 to 180."""
    return abs((a_deg - b_deg + 180.0) % 360.0 - 180.0)


def roof_type(
    planes: Sequence[Plane], faces: Sequence[RoofFace], solids: Sequence[Solid], settings: RoofTypeSettings
) -> RoofType:
    """The type of a delivered roof; `solids` show where its faces meet.

    It is `none` without faces and `combination` for a roof without a simpler name.
    """
    areas: dict[int, float] = {}
    for face in faces:
        areas[face.plane] = areas.get(face.plane, 0.0) + face.polygon.area
    total = math.fsum(areas.values())
    if total <= 0.0:
        return RoofType.NONE
    flat_area = math.fsum(area for p, area in areas.items() if planes[p].slope_deg < settings.flat_below_deg)
    ridges, bends = folds(planes, solids, settings.sliver_height_m)
    sides = _sides(planes, areas, bends, settings)
    major = [side for side in sides if side.area >= settings.minor_share * total]
    is_flat = flat_area >= settings.minor_share * total
    decided = math.fsum(side.area for side in major) + (flat_area if is_flat else 0.0)
    if total - decided >= settings.minor_share_together * total:
        return RoofType.COMBINATION
    if is_flat:
        return RoofType.COMBINATION if major else RoofType.FLAT
    if not major:
        return RoofType.UNKNOWN
    if len(major) == 1:
        return RoofType.PENT
    if len(major) == 2 and _opposite(major[0], major[1], settings) and _length(major[0], major[1], ridges) > 0.0:
        return RoofType.GABLE
    if len(major) == 4 and _is_hip(major, ridges, bends, settings):
        return RoofType.HIP
    return RoofType.COMBINATION


def _sides(planes: Sequence[Plane], areas: dict[int, float], bends: Folds, settings: RoofTypeSettings) -> list[_Side]:
    """Sloping planes gathered by direction, largest first."""
    sides: list[_Side] = []
    for p in sorted(areas, key=lambda p: (-areas[p], p)):
        plane = planes[p]
        if plane.slope_deg < settings.flat_below_deg:
            continue
        for side in sides:
            if _turn(side.aspect_deg, plane.aspect_deg) <= settings.aspect_tolerance_deg and (
                abs(side.slope_deg - plane.slope_deg) <= settings.slope_tolerance_deg
                or any((p, other) in bends for other in side.planes)
            ):
                side.area += areas[p]
                side.planes.add(p)
                break
        else:
            sides.append(_Side(slope_deg=plane.slope_deg, aspect_deg=plane.aspect_deg, area=areas[p], planes={p}))
    return sides


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


def _opposite(a: _Side, b: _Side, settings: RoofTypeSettings) -> bool:
    return 180.0 - _turn(a.aspect_deg, b.aspect_deg) <= settings.aspect_tolerance_deg


def _length(a: _Side, b: _Side, met: Folds) -> float:
    """Length over which the faces of two sides meet."""
    return math.fsum(met.get((p, q), 0.0) for p in sorted(a.planes) for q in sorted(b.planes))


def _is_hip(sides: list[_Side], ridges: Folds, bends: Folds, settings: RoofTypeSettings) -> bool:
    """Whether two opposite pairs, square to one another, have a hip at each corner; slopes may differ.

    Valleys as long as the hips are those of a courtyard; short ones are those of dormers.
    """
    by_aspect = sorted(sides, key=lambda side: side.aspect_deg)
    corners = [(by_aspect[k], by_aspect[(k + 1) % 4]) for k in range(4)]
    for side, following in corners:
        if abs(_turn(side.aspect_deg, following.aspect_deg) - 90.0) > settings.aspect_tolerance_deg:
            return False
    hips = [_length(side, following, ridges) for side, following in corners]
    valleys = math.fsum(_length(side, following, bends) for side, following in corners)
    return (
        min(hips) > 0.0
        and valleys <= 0.5 * math.fsum(hips)
        and all(_opposite(by_aspect[k], by_aspect[k + 2], settings) for k in range(2))
    )
