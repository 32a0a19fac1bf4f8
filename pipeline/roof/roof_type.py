"""Roof type from the delivered planes, their areas and their ridges.

Flat is below 7 degrees, a gable has two opposite sides of similar slope, a hip roof two such pairs
(Hofmann, Maas and Streilein 2003); faces of one direction count as one side.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from pipeline.model import FaceKind, Plane, RoofFace, RoofType, Solid
from pipeline.parameters import Parameters, parameter


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofTypeSettings(Parameters):
    """Thresholds of the roof types; they change no geometry."""

    flat_below_deg: float = parameter(
        7.0, "A roof plane with less slope is flat.", unit="deg", minimum=0.5, maximum=20.0
    )
    aspect_tolerance_deg: float = parameter(
        20.0,
        "Sides are opposite where their aspects are 180 degrees apart within this.",
        unit="deg",
        minimum=1.0,
        maximum=45.0,
    )
    slope_tolerance_deg: float = parameter(
        10.0, "Slopes within this are similar.", unit="deg", minimum=1.0, maximum=45.0
    )
    minor_share: float = parameter(
        0.12, "Directions with a smaller share of the roof's area do not decide the type.", minimum=0.0, maximum=0.4
    )


@dataclasses.dataclass
class _Side:
    """All roof faces of one direction."""

    slope_deg: float
    aspect_deg: float
    area: float
    planes: set[int]


def _turn(a_deg: float, b_deg: float) -> float:
    """Angle between two aspects, 0 to 180."""
    return abs((a_deg - b_deg + 180.0) % 360.0 - 180.0)


def roof_type(
    planes: Sequence[Plane], faces: Sequence[RoofFace], solids: Sequence[Solid], settings: RoofTypeSettings
) -> RoofType:
    """The type of a delivered roof.

    Parameters
    ----------
    planes : sequence of Plane
        The roof planes.
    faces : sequence of RoofFace
        The roof faces.
    solids : sequence of Solid
        Where faces meet.
    settings : RoofTypeSettings
        Thresholds.

    Returns
    -------
    RoofType
        `none` without faces, `combination` for what has no simpler name.
    """
    areas: dict[int, float] = {}
    for face in faces:
        areas[face.plane] = areas.get(face.plane, 0.0) + face.polygon.area
    total = math.fsum(areas.values())
    if total <= 0.0:
        return RoofType.NONE
    flat_area = math.fsum(area for p, area in areas.items() if planes[p].slope_deg < settings.flat_below_deg)
    sides = _sides(planes, areas, settings)
    major = [side for side in sides if side.area >= settings.minor_share * total]
    if flat_area >= settings.minor_share * total:
        return RoofType.COMBINATION if major else RoofType.FLAT
    if not major:
        return RoofType.UNKNOWN
    ridges = _ridges(planes, solids)
    if len(major) == 1:
        return RoofType.PENT
    if len(major) == 2 and _opposite(major[0], major[1], settings) and _meet(major[0], major[1], ridges):
        return RoofType.GABLE
    if len(major) == 4 and _is_hip(major, ridges, settings):
        return RoofType.HIP
    return RoofType.COMBINATION


def _sides(planes: Sequence[Plane], areas: dict[int, float], settings: RoofTypeSettings) -> list[_Side]:
    """Sloping planes gathered by direction, largest first."""
    sides: list[_Side] = []
    for p in sorted(areas, key=lambda p: (-areas[p], p)):
        plane = planes[p]
        if plane.slope_deg < settings.flat_below_deg:
            continue
        for side in sides:
            if (
                _turn(side.aspect_deg, plane.aspect_deg) <= settings.aspect_tolerance_deg
                and abs(side.slope_deg - plane.slope_deg) <= settings.slope_tolerance_deg
            ):
                side.area += areas[p]
                side.planes.add(p)
                break
        else:
            sides.append(_Side(slope_deg=plane.slope_deg, aspect_deg=plane.aspect_deg, area=areas[p], planes={p}))
    return sides


def _ridges(planes: Sequence[Plane], solids: Sequence[Solid]) -> set[tuple[int, int]]:
    """Pairs of planes that meet in a common edge and fall away from it on both sides."""
    ridges: set[tuple[int, int]] = set()
    for solid in solids:
        owner: dict[tuple[int, int], int] = {}
        for face in solid.faces:
            if face.kind is not FaceKind.ROOF:
                continue
            for ring in face.rings:
                for a, b in zip(ring, ring[1:] + ring[:1], strict=True):
                    owner[a, b] = face.plane
        for (a, b), left in owner.items():
            right = owner.get((b, a), left)
            if right == left:
                continue
            # a step of one metre to the left of the edge: the left plane lies below the right one's continuation
            (xa, ya), (xb, yb) = solid.vertices[a, :2].tolist(), solid.vertices[b, :2].tolist()
            p, q = planes[left], planes[right]
            if (p.a - q.a) * (ya - yb) + (p.b - q.b) * (xb - xa) < 0.0:
                ridges.add((left, right))
                ridges.add((right, left))
    return ridges


def _opposite(a: _Side, b: _Side, settings: RoofTypeSettings) -> bool:
    return (
        180.0 - _turn(a.aspect_deg, b.aspect_deg) <= settings.aspect_tolerance_deg
        and abs(a.slope_deg - b.slope_deg) <= settings.slope_tolerance_deg
    )


def _meet(a: _Side, b: _Side, ridges: set[tuple[int, int]]) -> bool:
    return any((p, q) in ridges for p in a.planes for q in b.planes)


def _is_hip(sides: list[_Side], ridges: set[tuple[int, int]], settings: RoofTypeSettings) -> bool:
    """Two opposite pairs, square to one another, each side meeting both of the other pair (slopes may differ)."""
    by_aspect = sorted(sides, key=lambda side: side.aspect_deg)
    tolerance = settings.aspect_tolerance_deg
    for k in range(4):
        following = by_aspect[(k + 1) % 4]
        if abs(_turn(by_aspect[k].aspect_deg, following.aspect_deg) - 90.0) > tolerance:
            return False
        if not _meet(by_aspect[k], following, ridges):
            return False
    return all(
        180.0 - _turn(by_aspect[k].aspect_deg, by_aspect[k + 2].aspect_deg) <= tolerance
        and abs(by_aspect[k].slope_deg - by_aspect[k + 2].slope_deg) <= settings.slope_tolerance_deg
        for k in range(2)
    )
