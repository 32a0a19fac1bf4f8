"""Rejected objects that look rough because two flight strips saw them apart: they may be buildings, and say so."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

import numpy as np

from pipeline.model import Reason
from pipeline.runtime.scratch.folder import POINT, Scratch
from pipeline.runtime.stages.gather import canonical_order
from pipeline.runtime.stages.sites import RejectedSite
from pipeline.terrain.candidates import Verdict
from pipeline.tiling import MM


def with_strips_that_disagree(
    rejected: Iterable[RejectedSite], scratch: Scratch, min_offset_m: float
) -> tuple[RejectedSite, ...]:
    """Rejected objects; rough ones whose strips lie farther than `min_offset_m` above one another have that reason."""
    return tuple(_judged(site, scratch, min_offset_m) for site in rejected)


def _judged(site: RejectedSite, scratch: Scratch, min_offset_m: float) -> RejectedSite:
    if site.verdict.reason is not Reason.VEGETATION or not site.ranges:
        return site
    pieces = []
    for part in site.ranges:
        stored = scratch.array(f"{part.folder}/{part.tile.key}", "points", mapped=True).view(POINT)
        pieces.append(np.array(stored[part.start : part.stop]))
    points = np.concatenate(pieces)
    if (points["source"] == points["source"][0]).all():
        return site
    from pipeline.strip_alignment import disagreement_m

    points = points[canonical_order(points)]
    places = np.column_stack([points[axis].astype(np.int64) - int(points[axis][0]) for axis in "xyz"]) / MM
    apart_m = disagreement_m(places, points["source"], min_offset_m)
    if math.isnan(apart_m):
        return site
    detail = f"strips lie {apart_m:.2f} m apart, at most {min_offset_m:g}; {site.verdict.reason}: {site.verdict.detail}"
    return dataclasses.replace(site, verdict=Verdict(reason=Reason.STRIPS_DISAGREE, detail=detail))
