"""LoD2.0: the main roof alone. Dormers and other small faces on a roof face become a part of that face.

Nothing is cut again: the face beneath takes over the plan of what stands on it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import shapely

from pipeline.model import Plane, RoofFace

Pair = tuple[int, int]

_MAX_SHARE = 0.25
"""What stands on a face is smaller than this share of it."""
_BELOW_M, _ABOVE_M = 0.15, 5.0
"""How far its faces may lie below the plane and above it; a tower rises farther."""
_MIN_AROUND = 0.5
"""Share of its border that it has with the face; wings have more with the outline and with other faces."""


def main_planes(faces: Sequence[RoofFace], planes: Sequence[Plane], border_mm: Mapping[Pair, float]) -> list[int]:
    """The plane of each face of one part in the main roof: its own, or that of the face on which it stands.

    `border_mm` are the lengths of the common borders of faces by their numbers, the lower first.
    """
    area = [face.polygon.area for face in faces]
    main: dict[int, int] = {}
    for host in sorted(range(len(faces)), key=lambda k: (-area[k], k)):
        if host in main:
            continue
        number = faces[host].plane
        small = [
            k
            for k in range(len(faces))
            if k not in main
            and area[k] <= _MAX_SHARE * area[host]
            and faces[k].plane != number
            and _stands_on(faces[k], planes[number])
        ]
        for group in _connected(small, border_mm):
            inside = math.fsum(length for (a, b), length in border_mm.items() if a in group and b in group)
            around = math.fsum(1e3 * faces[k].polygon.length for k in sorted(group)) - 2.0 * inside
            shared = math.fsum(
                length
                for (a, b), length in border_mm.items()
                if (a in group) != (b in group) and faces[b if a in group else a].plane == number
            )
            if math.fsum(area[k] for k in group) <= _MAX_SHARE * area[host] and shared >= _MIN_AROUND * around:
                main.update(dict.fromkeys(group, number))
    return [main.get(k, face.plane) for k, face in enumerate(faces)]


def _stands_on(face: RoofFace, plane: Plane) -> bool:
    """Whether no corner of a face lies deep beneath a plane, or far above it."""
    x, y, z = shapely.get_coordinates(face.polygon, include_z=True).T
    above = z - (plane.a * x + plane.b * y + plane.c)
    return bool(above.min() >= -_BELOW_M and above.max() <= _ABOVE_M)


def _connected(members: Sequence[int], border_mm: Mapping[Pair, float]) -> list[set[int]]:
    """Groups of faces with common borders, in the order of their lowest numbers."""
    group_of = {k: {k} for k in members}
    for a, b in border_mm:
        if a in group_of and b in group_of and group_of[a] is not group_of[b]:
            group_of[a] |= group_of[b]
            for k in group_of[b]:
                group_of[k] = group_of[a]
    return [group for k, group in group_of.items() if k == min(group)]
