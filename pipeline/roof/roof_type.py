"""Roof type from the delivered planes, their areas, and how they meet.

Flat is below 7 degrees, a gable has two opposite sides "whose inclinations must not be the same", a hip roof two such
pairs (Hofmann, Maas and Streilein 2003). The finer names follow the list of roof types of CityGML and usage:

- The *main roof* decides: the largest part whose sloping faces meet. Flat faces count with it where they lie on top of
  it; others are annexes, and the roof is flat where these have half of the area.
- A *side* is all faces of one direction. Two opposite sides with a ridge are a gable, with a valley a butterfly.
  `many_sided_roofs` names the others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations

from pipeline.model import Plane, RoofFace, RoofType, Solid
from pipeline.roof.roof_settings import RoofTypeSettings
from pipeline.roof.roof_sides import HALF, Roof, Side, corners_of, folds, opposite, turn_deg

_FEW = 2
"""Faces of a gable."""
_MAIN = 0.6
"""Share of the sloping faces from which a part of them decides alone."""


def roof_type(
    planes: Sequence[Plane], faces: Sequence[RoofFace], solids: Sequence[Solid], settings: RoofTypeSettings
) -> RoofType:
    """The type of a delivered roof; `solids`, which hold all faces, show where they meet.

    It is `none` without faces and `combination` for a roof without a simpler name.
    """
    areas: dict[int, float] = {}
    around: dict[int, float] = {}
    for face in faces:
        areas[face.plane] = areas.get(face.plane, 0.0) + face.polygon.area
        around[face.plane] = around.get(face.plane, 0.0) + face.polygon.length
    if math.fsum(areas.values()) <= 0.0:
        return RoofType.NONE
    ridges, bends = folds(planes, solids, settings.sliver_height_m)
    roof = Roof(planes=planes, areas=areas, ridges=ridges, bends=bends, corners=corners_of(solids), settings=settings)
    slopes = [p for p in areas if not roof.is_flat(p)]
    # each edge counts from both sides, so that a face with ridges all around has twice its length
    tops = [p for p in areas if roof.is_flat(p) and math.fsum(ridges.get((p, q), 0.0) for q in slopes) >= around[p]]
    if roof.area(areas) - roof.area(slopes) - roof.area(tops) >= HALF * roof.area(areas) or not slopes:
        return RoofType.FLAT
    main = _main_roof(roof, slopes)
    return _named(roof, main, [p for p in tops if any((p, q) in ridges for q in main)])


def _main_roof(roof: Roof, slopes: list[int]) -> list[int]:
    """The largest part of the sloping faces that meet; all of them where none is much larger than the rest."""
    part_of = {p: {p} for p in slopes}
    for p, q in combinations(slopes, 2):
        if ((p, q) in roof.ridges or (p, q) in roof.bends) and part_of[p] is not part_of[q]:
            part_of[p] |= part_of[q]
            for other in part_of[q]:
                part_of[other] = part_of[p]
    largest = max(part_of.values(), key=lambda part: (roof.area(sorted(part)), -min(part)))
    return sorted(largest) if roof.area(largest) >= _MAIN * roof.area(slopes) else slopes


def _sides(roof: Roof, slopes: Sequence[int]) -> list[Side]:
    """Sloping planes by direction, the largest side first; a plane joins the first side that it fits."""
    sides: list[Side] = []
    for p in sorted(slopes, key=lambda p: (-roof.areas[p], p)):
        aspect_deg = roof.planes[p].aspect_deg
        for side in sides:
            if turn_deg(side.aspect_deg, aspect_deg) <= roof.settings.aspect_tolerance_deg:
                side.area += roof.areas[p]
                side.planes.append(p)
                break
        else:
            sides.append(Side(aspect_deg=aspect_deg, area=roof.areas[p], planes=[p]))
    return sorted(sides, key=lambda side: -side.area)


def _named(roof: Roof, main: Sequence[int], tops: Sequence[int]) -> RoofType:
    """The type of the main roof, with its flat tops."""
    total = roof.area(main) + roof.area(tops)
    first, *others = sides = _sides(roof, main)
    if len(main) > _FEW or tops:
        from pipeline.roof.many_sided_roofs import name_of  # most roofs have one or two faces

        return name_of(roof, sides, total, tops)
    if others and roof.turned(first, others[0], 180.0) and others[0].area >= roof.settings.minor_share * total:
        return opposite(roof, first, others[0])
    return RoofType.PENT if first.area >= (1.0 - roof.settings.minor_share_together) * total else RoofType.COMBINATION
