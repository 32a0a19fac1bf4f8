"""Names of roofs with hips, bends or wings.

- A side square to the first two is an *end* where it meets one of them in a hip. Ends that begin well above the eaves
  make a half-hip; ends that meet in a point, a pyramid.
- Where both sides have a steeper lower face the roof is a gambrel, with such ends a mansard.
- Valleys between sides square to each other are those of wings (`compound_roofs`): one for an L, two for a T, four for
  a cross. Short ones are those of dormers. Three slopes of one direction behind one another are a sawtooth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import permutations

from pipeline.model import RoofType
from pipeline.roof.compound_roofs import compound, wings
from pipeline.roof.roof_sides import LEAST_END, Roof, Side, opposite

_END_REACH = 0.7
"""Share of the height of the roof over which an end falls that is not half a hip's."""
_POINT = 0.04
"""Ridges shorter than this share of the hips are a point."""
_LEAST_KINK = 0.15
"""Share of a side's area that the flatter and the steeper face of a gambrel have at least."""
_STEEP_DEG = 45.0
"""Slope of the sides of a mansard under a flat top."""


def name_of(roof: Roof, sides: Sequence[Side], total: float, tops: Sequence[int]) -> RoofType:
    """The type of a main roof of some sides, the largest first, with flat tops, and of a total area."""
    if (name := compound(roof, sides, total)) is not None:
        return name
    first = sides[0]
    second = next((one for one in sides if roof.turned(first, one, 180.0)), None)
    if second is not None and second.area < roof.settings.minor_share * total and not tops:
        second = None
    pair = [first] if second is None else [first, second]
    square = [one for one in sides if roof.turned(first, one, 90.0) and one.area >= LEAST_END * total]
    if (name := wings(roof, pair, square, total)) is not None:
        return name
    ends = [one for one in square if any((p, q) in roof.ridges for p in one.planes for q in _mains(roof, pair))]
    decided = math.fsum(side.area for side in pair + ends) + roof.area(tops)
    if total - decided >= roof.settings.minor_share_together * total:
        return RoofType.COMBINATION
    if second is None:
        return _of_one_side(roof, first, ends, total)
    if (name := _hipped_or_bent(roof, pair, ends, tops)) is not None:
        return name
    name = opposite(roof, first, second)
    return RoofType.GAMBREL if tops and name is not RoofType.GABLE else name


def _mains(roof: Roof, pair: list[Side]) -> list[int]:
    """The planes of two sides that meet in ridges, else the largest of each: no fronts of dormers."""
    opposite = [(p, q) for one, other in permutations(pair, 2) for p in one.planes for q in other.planes]
    return [p for p, q in opposite if (p, q) in roof.ridges] or [side.planes[0] for side in pair]


def _of_one_side(roof: Roof, side: Side, ends: Sequence[Side], total: float) -> RoofType:
    """The type of a roof without an opposite side: a pent roof, or the half of a hip roof on one side of its ridge."""
    if side.area >= (1.0 - roof.settings.minor_share_together) * total:
        return RoofType.PENT
    return RoofType.HIP if len(ends) > 1 else RoofType.COMBINATION


def _hipped_or_bent(roof: Roof, pair: Sequence[Side], ends: Sequence[Side], tops: Sequence[int]) -> RoofType | None:
    """The type of a roof with two opposite sides that bend, or that meet ends in hips; None for others."""
    is_kinked = all(_is_kinked(roof, side) for side in pair)
    if not ends:
        return RoofType.GAMBREL if is_kinked else None
    mains = [p for side in pair for p in side.planes]
    least = roof.high(mains) - _END_REACH * (roof.high(mains) - roof.low(mains))
    whole = [end for end in ends if roof.low(end.planes) <= least]
    if not whole:
        return RoofType.GAMBREL if is_kinked else RoofType.HALF_HIP
    if is_kinked:
        return RoofType.MANSARD
    if tops:
        steep = math.fsum(roof.planes[p].slope_deg * roof.areas[p] for p in mains) >= _STEEP_DEG * roof.area(mains)
        return RoofType.MANSARD if steep else RoofType.HIP
    hips = math.fsum(roof.length(roof.ridges, end, side) for end in whole for side in pair)
    is_point = roof.length(roof.ridges, *pair) < _POINT * hips
    return RoofType.PYRAMID if len(whole) > 1 and is_point else RoofType.HIP


def _is_kinked(roof: Roof, side: Side) -> bool:
    """Whether a side has a steeper face below a flatter one, each with a good share of its area."""
    for p in side.planes:
        for q in side.planes:
            steeper_deg = roof.planes[q].slope_deg - roof.planes[p].slope_deg
            if steeper_deg >= roof.settings.slope_tolerance_deg and (p, q) in roof.ridges:
                least = _LEAST_KINK * side.area
                if roof.areas[p] >= least and roof.areas[q] >= least:
                    return True
    return False
