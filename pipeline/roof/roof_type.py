"""Roof type from the delivered planes, their areas, and how they meet.

Flat is below 7 degrees, a gable has two opposite sides "whose inclinations must not be the same", a hip roof two such
pairs (Hofmann, Maas and Streilein 2003). The finer names follow the list of roof types of CityGML and usage:

- The *main roof* decides: the largest part whose sloping faces meet. Flat faces count with it where they lie on top of
  it; others are annexes, and the roof is flat where these have half of the area.
- A *side* is all faces of one direction. Two opposite sides with a ridge are a gable, with a valley a butterfly.
- A side square to them is an *end* where it meets one of them in a hip. Ends that begin well above the eaves make a
  half-hip; ends that meet in a point, a pyramid.
- Where both sides have a steeper lower face the roof is a gambrel, with such ends a mansard.
- Valleys between sides square to each other are those of wings: one for an L, two for a T, four for a cross. Short ones
  are those of dormers.
- Three slopes of one direction behind one another are a sawtooth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations, permutations, product

from pipeline.model import Plane, RoofFace, RoofType, Solid
from pipeline.roof.roof_settings import RoofTypeSettings
from pipeline.roof.roof_sides import HALF, LEAST_END, Roof, Side, corners_of, folds, turn_deg

_FEW = 4
"""Sides of a hip roof."""
_MAIN = 0.6
"""Share of the sloping faces from which a part of them decides alone."""


def roof_type(
    planes: Sequence[Plane], faces: Sequence[RoofFace], solids: Sequence[Solid], settings: RoofTypeSettings
) -> RoofType:
    """The type of a delivered roof; `solids` show where its faces meet.

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
    """Sloping planes by direction, largest first; of two directions nearly as near, that of the larger plane."""
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
    sides = _sides(roof, main)
    if len(sides) > _FEW or len(sides[0].planes) >= _FEW - 1:
        from pipeline.roof.compound_roofs import compound  # most roofs are simple

        if (name := compound(roof, sides, total)) is not None:
            return name
    first = sides[0]
    second = next((one for one in sides if roof.turned(first, one, 180.0)), None)
    if second is not None and second.area < roof.settings.minor_share * total and not tops:
        second = None
    pair = [first] if second is None else [first, second]
    square = [one for one in sides if roof.turned(first, one, 90.0) and one.area >= LEAST_END * total]
    if any((p, q) in roof.bends for side, other in product(pair, square) for p in side.planes for q in other.planes):
        from pipeline.roof.compound_roofs import wings

        if (name := wings(roof, pair, square, total)) is not None:
            return name
    ends = [one for one in square if any((p, q) in roof.ridges for p in one.planes for q in _mains(roof, pair))]
    decided = math.fsum(side.area for side in pair + ends) + roof.area(tops)
    if total - decided >= roof.settings.minor_share_together * total:
        return RoofType.COMBINATION
    if second is None:
        return _of_one_side(roof, first, ends, total)
    if ends or len(first.planes) > 1:
        from pipeline.roof.hipped_roofs import hipped_or_bent

        if (name := hipped_or_bent(roof, pair, ends, tops)) is not None:
            return name
    has_ridge = roof.length(roof.ridges, first, second) > 0.0
    if tops and not has_ridge:
        return RoofType.GAMBREL
    if has_ridge:
        return RoofType.GABLE
    return RoofType.BUTTERFLY if roof.length(roof.bends, first, second) > 0.0 else RoofType.COMBINATION


def _mains(roof: Roof, pair: list[Side]) -> list[int]:
    """The planes of two sides that meet in ridges, else the largest of each: no fronts of dormers."""
    opposite = [(p, q) for one, other in permutations(pair, 2) for p in one.planes for q in other.planes]
    return [p for p, q in opposite if (p, q) in roof.ridges] or [side.planes[0] for side in pair]


def _of_one_side(roof: Roof, side: Side, ends: Sequence[Side], total: float) -> RoofType:
    """The type of a roof without an opposite side: a pent roof, or the half of a hip roof on one side of its ridge."""
    if side.area >= (1.0 - roof.settings.minor_share_together) * total:
        return RoofType.PENT
    return RoofType.HIP if len(ends) > 1 else RoofType.COMBINATION
