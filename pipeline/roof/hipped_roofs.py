"""Names of roofs with hips, and of those whose sides bend."""

from __future__ import annotations

import math
from collections.abc import Sequence

from pipeline.model import RoofType
from pipeline.roof.roof_sides import Roof, Side

_END_REACH = 0.7
"""Share of the height of the roof over which an end falls that is not half a hip's."""
_POINT = 0.04
"""Ridges shorter than this share of the hips are a point."""
_LEAST_KINK = 0.15
"""Share of a side's area that the flatter and the steeper face of a gambrel have at least."""
_STEEP_DEG = 45.0
"""Slope of the sides of a mansard under a flat top."""


def hipped_or_bent(roof: Roof, pair: Sequence[Side], ends: Sequence[Side], tops: Sequence[int]) -> RoofType | None:
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
