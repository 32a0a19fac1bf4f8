"""From figures to verdicts: which class, which reason, which doubts. Pure functions on columns."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.model import FloatArray
from pipeline.ruler.epochs.change_records import Change, Doubt, Incomparable, Relation
from pipeline.ruler.epochs.epoch_settings import DiffSettings
from pipeline.ruler.epochs.roof_raster import (
    ADDED_M2,
    COMMON_M2,
    FORM_M2,
    FORM_M3,
    REMOVED_M2,
    ROUGH_M2,
    SHIFT_M,
    UNIFORM_M,
)
from pipeline.ruler.epochs.sides import Side

NEAR = 1.5
"""A change within this factor of its limit is near it. It decides a doubt only, never a class."""
OVERLAPS_SHARE = 0.1
"""Least share of a footprint that overlaps a building of the other epoch for a doubt."""

Words = npt.NDArray[np.object_]


def limits(old: Side, new: Side, settings: DiffSettings) -> dict[str, FloatArray]:
    """Least changes of each group: the settings, or more if the models are less accurate."""
    sigma_m = np.hypot(old["sigma_m"], new["sigma_m"])
    spacing_m = np.maximum(old["spacing_m"], new["spacing_m"])
    return {
        "least_height_change_m": np.maximum(settings.min_height_change_m, settings.sigmas * sigma_m),
        "least_width_m": np.maximum(settings.min_width_m, settings.spacings * spacing_m),
    }


def judge(
    old: Side,
    new: Side,
    figures: FloatArray,
    least_height_m: FloatArray,
    seen: Mapping[str, Any],
    settings: DiffSettings,
) -> dict[str, Any]:
    """Judge every group by its figures (g, 16) from `compare_roofs`: the columns of the table on the verdict.

    `seen` is what `comparing` knows of the place of each group: `covered_old`, the share of the footprint where the
    earlier epoch has data, `tile_failed_old`, `rejected_old`, the same of the later one, `overlapped`, the share that
    overlaps buildings of the other epoch outside of the group, and `made_otherwise`, whether the runs differ in more
    than their points.
    """
    only_old, only_new = new["count"] == 0, old["count"] == 0
    both = ~only_old & ~only_new
    shift_m, form_m3 = figures[:, SHIFT_M], figures[:, FORM_M3]
    outline_m2 = figures[:, ADDED_M2] + figures[:, REMOVED_M2]
    part_m2 = np.maximum(outline_m2, figures[:, FORM_M2])
    raised, lowered = both & (shift_m > 0.0), both & (shift_m < 0.0)
    reshaped = (
        both & (part_m2 >= settings.min_area_change_m2) & (form_m3 >= settings.min_volume_change_m3) & (part_m2 > 0.0)
    )
    mostly_form = reshaped & (form_m3 > np.abs(shift_m) * figures[:, COMMON_M2])
    change = np.full(len(both), Change.UNCHANGED.value, object)
    change[reshaped] = Change.RESHAPED.value
    change[raised & ~mostly_form] = Change.RAISED.value
    change[lowered & ~mostly_form] = Change.LOWERED.value
    change[only_old] = Change.GONE.value
    change[only_new] = Change.NEW.value
    reason = _reasons(old, new, seen, settings)
    hidden = np.array([one is not None for one in reason], np.bool_)
    change[hidden] = Change.NOT_COMPARABLE.value
    ratio = _ratio(figures, part_m2, least_height_m, settings)
    ratio[~both | old["has_failed"] | new["has_failed"]] = np.nan
    half_m2 = (outline_m2 + figures[:, FORM_M2]) / 2.0
    unexplained_m2 = np.maximum(old["unexplained_m2"], new["unexplained_m2"])
    near = (ratio >= 1.0 / NEAR) & (ratio < NEAR)
    overlapping = (only_old | only_new) & (seen["overlapped"] > OVERLAPS_SHARE)
    doubts = (
        (Doubt.BLOCK_IN_OLD, old["has_block"]),
        (Doubt.BLOCK_IN_NEW, new["has_block"]),
        (Doubt.DOUBTFUL_IN_OLD, old["has_doubtful"]),
        (Doubt.DOUBTFUL_IN_NEW, new["has_doubtful"]),
        (Doubt.ROUGH_PART, reshaped & ~hidden & (figures[:, ROUGH_M2] > half_m2)),
        (Doubt.UNEXPLAINED_PART, reshaped & ~hidden & (unexplained_m2 >= half_m2)),
        (Doubt.NEAR_LIMIT, near & ~hidden),
        (Doubt.OVERLAPS_ANOTHER, overlapping & ~hidden),
        (Doubt.OTHER_UNITS, both & (old["count"] != new["count"])),
        (Doubt.OTHER_VERSION, reshaped & ~hidden & seen["made_otherwise"]),
    )
    return {
        "change": change,
        "reason": reason,
        "relation": _relations(old, new),
        "is_raised": raised & ~hidden,
        "is_lowered": lowered & ~hidden,
        "is_reshaped": reshaped & ~hidden,
        "change_ratio": ratio,
        "doubts": [[doubt.value for doubt, holds in doubts if holds[group]] for group in range(len(both))],
    }


def _ratio(figures: FloatArray, part_m2: FloatArray, least_height_m: FloatArray, settings: DiffSettings) -> FloatArray:
    """The largest change over its limit."""
    of_part = part_m2 / settings.min_area_change_m2
    if settings.min_volume_change_m3 > 0.0:
        of_part = np.minimum(of_part, figures[:, FORM_M3] / settings.min_volume_change_m3)
    ratio: FloatArray = np.maximum(np.abs(figures[:, UNIFORM_M]) / least_height_m, of_part)
    return ratio


def _reasons(old: Side, new: Side, seen: Mapping[str, Any], settings: DiffSettings) -> Words:
    """Why groups are not comparable: the first reason that applies, else None."""
    only_old, only_new = new["count"] == 0, old["count"] == 0
    least = settings.min_covered_share - 1e-9
    holds = (
        (Incomparable.FAILED_IN_OLD, old["has_failed"]),
        (Incomparable.FAILED_IN_NEW, new["has_failed"]),
        (Incomparable.TILE_FAILED_IN_OLD, seen["tile_failed_old"]),
        (Incomparable.TILE_FAILED_IN_NEW, seen["tile_failed_new"]),
        (Incomparable.OUTSIDE_OLD, only_new & (seen["covered_old"] < least)),
        (Incomparable.OUTSIDE_NEW, only_old & (seen["covered_new"] < least)),
        (Incomparable.EDGE_OF_OLD, old["at_edge"]),
        (Incomparable.EDGE_OF_NEW, new["at_edge"]),
        (Incomparable.REJECTED_IN_OLD, only_new & seen["rejected_old"]),
        (Incomparable.REJECTED_IN_NEW, only_old & seen["rejected_new"]),
    )
    reason = np.full(len(only_old), None, object)
    for word, mask in reversed(holds):
        reason[mask] = word.value
    return reason


def _relations(old: Side, new: Side) -> Words:
    relation = np.full(len(old["count"]), Relation.ONE_TO_ONE.value, object)
    for word, mask in (
        (Relation.SPLIT, (old["count"] == 1) & (new["count"] > 1)),
        (Relation.MERGED, (old["count"] > 1) & (new["count"] == 1)),
        (Relation.MANY_TO_MANY, (old["count"] > 1) & (new["count"] > 1)),
        (Relation.ONLY_OLD, new["count"] == 0),
        (Relation.ONLY_NEW, old["count"] == 0),
    ):
        relation[mask] = word.value
    return relation
