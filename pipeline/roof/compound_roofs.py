"""Names of roofs of several parts: wings that meet in valleys, many sides around a point, saw teeth.

Most roofs are simple, and `roof_type` names them without this module.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations, product

from pipeline.model import RoofType
from pipeline.roof.roof_sides import HALF, LEAST_END, Roof, Side

_LEVEL = 0.15
"""Share of the height of a roof within which tops are at one height."""
_LEAST_VALLEY = 0.4
"""Share of the longest hip, else of the root of the area, from which a valley is that of a wing."""
_LEAST_ARM = 0.1
"""Share of the extent of one part from which the other part reaches beyond it."""
_TEETH, _TOOTH = 3, 0.08
"""Slopes of a sawtooth, and the least share of the roof of each."""


def wings(roof: Roof, pair: Sequence[Side], square: Sequence[Side], total: float) -> RoofType | None:
    """The form of a roof whose wings meet in valleys: an L, a T, a cross, or a combination; None without wings."""
    meetings = [
        (p, q) for one, other in product(pair, square) for p, q in product(sorted(one.planes), sorted(other.planes))
    ]
    longest_hip = max((roof.ridges.get(met, 0.0) for met in meetings), default=0.0)
    least = _LEAST_VALLEY * (longest_hip or math.sqrt(total))
    valleys = [met for met in meetings if roof.bends.get(met, 0.0) >= max(least, roof.ridges.get(met, 0.0))]
    wing = roof.area({q for _, q in valleys})
    if not valleys or wing < roof.settings.minor_share * total:
        return None
    side_of = {p: k for k, side in enumerate([*pair, *square]) for p in side.planes}
    arms: list[int] = []
    for one, other in combinations(valleys, 2):
        for main, across in ((0, 1), (1, 0)):
            is_arm = side_of[one[main]] == side_of[other[main]] and (one[across], other[across]) in roof.ridges
            if is_arm and one in valleys and other in valleys:
                arms.append(side_of[one[main]])
                valleys = [met for met in valleys if met not in (one, other)]
    if len(arms) + len(valleys) != 1 and (valleys or len(arms) != 2 or arms[0] == arms[1]):
        return RoofType.COMBINATION
    north_or_south, east_or_west = _overlaps(roof, pair, square)
    if north_or_south == east_or_west == 2:
        return RoofType.CROSS
    if north_or_south and east_or_west:
        return RoofType.L_SHAPE if north_or_south == east_or_west else RoofType.T_SHAPE
    return RoofType.CROSS if len(arms) == 2 else None


def _overlaps(roof: Roof, pair: Sequence[Side], square: Sequence[Side]) -> tuple[int, int]:
    """At how many ends the wings reach beyond the main part of a roof, and that beyond the wings.

    Both parts are the faces at their ridges; faces at ends do not count.
    """
    parts = []
    for sides in (pair, square):
        planes = [p for side in sides for p in side.planes]
        parts.append([p for p in planes if any((p, q) in roof.ridges for q in planes)])
    if not all(parts):
        return 0, 0
    (mains, wings), plane = parts, roof.planes[pair[0].planes[0]]
    return _reached(roof, (plane.a, plane.b), wings, mains), _reached(roof, (-plane.b, plane.a), mains, wings)


def _reached(roof: Roof, way: tuple[float, float], outer: Sequence[int], inner: Sequence[int]) -> int:
    """At how many ends, along a way, some faces reach well beyond others."""

    def ends(planes: Sequence[int]) -> tuple[float, float]:
        places = [x * way[0] + y * way[1] for p in planes for x, y, _ in roof.corners[p]]
        return min(places), max(places)

    (start, stop), (first, last) = ends(outer), ends(inner)
    least = _LEAST_ARM * (last - first)
    return (first - start > least) + (stop - last > least)


def compound(roof: Roof, sides: Sequence[Side], total: float) -> RoofType | None:
    """The name of saw teeth, or of many sides around a point; None for other roofs."""
    if _is_sawtooth(roof, sides, total):
        return RoofType.SAWTOOTH
    return RoofType.PYRAMID if _is_pyramid(roof, sides, total) else None


def _is_pyramid(roof: Roof, sides: Sequence[Side], total: float) -> bool:
    """Whether more than four sides meet in hips all around, and their tops in a point."""
    around = sorted((side for side in sides if side.area >= LEAST_END * total), key=lambda side: side.aspect_deg)
    if len(around) <= 4 or math.fsum(side.area for side in around) < (1.0 - roof.settings.minor_share) * total:
        return False
    tops, low = [roof.high(side.planes) for side in around], min(roof.low(side.planes) for side in around)
    return max(tops) - min(tops) <= _LEVEL * (max(tops) - low) and all(
        roof.length(roof.ridges, side, other) > 0.0 for side, other in zip(around, around[1:] + around[:1], strict=True)
    )


def _is_sawtooth(roof: Roof, sides: Sequence[Side], total: float) -> bool:
    """Whether there are slopes of one direction and height behind one another, between walls or steeper faces."""
    side = sides[0]
    teeth = [p for p in side.planes if roof.areas[p] >= _TOOTH * total]
    if len(teeth) < _TEETH or roof.area(teeth) < HALF * total:
        return False
    tops, rises = [roof.high([p]) for p in teeth], [roof.high([p]) - roof.low([p]) for p in teeth]
    backs = [p for one in sides[1:] if roof.turned(side, one, 180.0) for p in one.planes]
    is_even = max(tops) - min(tops) <= HALF * min(rises)
    slope_deg = max(roof.planes[p].slope_deg for p in teeth)
    return is_even and all(roof.planes[p].slope_deg > slope_deg + roof.settings.slope_tolerance_deg for p in backs)
