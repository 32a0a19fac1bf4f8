"""The buildings that are drawn: those on which runs differ, and typical ones."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Sequence
from typing import NamedTuple

from pipeline.ruler.report.comparison_records import FULL_RESIDUAL_M, ComparedBuilding

CASES = 12
"""Buildings that are drawn."""
DIFFERENT = 9
"""Most of them that are chosen for their differences."""
SAME_RESIDUAL_M = 0.05
"""Methods agree if their RMSE differ by at most this."""
KINDS = {
    "status": "status",
    "outcome": "outcome against the truth",
    "roof_type": "roof type",
    "faces": "number of roof planes",
    "residual": "RMSE",
}
"""Kinds of differences in the order in which they choose, with their labels."""
RULE = (
    f"Up to {DIFFERENT} of {CASES} buildings are those on which the methods differ most: in turn by "
    f"{', '.join(KINDS.values())} (share of pairs of methods that differ; planes: largest minus smallest number over "
    f"the largest; RMSE: largest minus smallest, {FULL_RESIDUAL_M:g} m counting in full; type, planes and RMSE among "
    "the methods that delivered a model of their own). The others are typical ones where all agree, RMSE within "
    f"{SAME_RESIDUAL_M:g} m: of each roof type in turn, the most frequent first, the one nearest the median footprint. "
    "Buildings that the data's edge cuts are left out where there are others."
)
"""The choice of buildings, for readers."""


class Choice(NamedTuple):
    """A building that is drawn."""

    building: ComparedBuilding
    why: str


def most_different_first(buildings: Sequence[ComparedBuilding]) -> list[ComparedBuilding]:
    """Buildings by the sum of their differences, equal ones by building_id."""
    return sorted(buildings, key=lambda building: (-building.total, building.building_id))


def chosen_buildings(buildings: Sequence[ComparedBuilding]) -> list[Choice]:
    """The buildings that are drawn, by `RULE`; independent of the order of the buildings."""
    whole = [one for one in buildings if not any(record["touches_data_edge"] for record in one.records)]
    ordered = most_different_first(whole or buildings)
    typical = _typical(ordered)
    agreeing = {choice.building.building_id for choice in typical}
    others = [one for one in ordered if one.building_id not in agreeing]
    different = _different(others, CASES - min(CASES - DIFFERENT, len(typical)))
    return [*different, *typical[: CASES - len(different)]]


def _different(ordered: Sequence[ComparedBuilding], most: int) -> list[Choice]:
    """Buildings with the largest difference of each kind in turn; the larger total difference wins among equal ones."""
    queues = [
        [Choice(one, f"differs in {label}") for one in _by(kind, ordered) if one.difference[kind] > 0.0]
        for kind, label in KINDS.items()
    ]
    chosen: dict[str, Choice] = {}
    while len(chosen) < most and any(queues):
        for queue in queues:
            while queue and queue[0].building.building_id in chosen:
                queue.pop(0)
            if queue and len(chosen) < most:
                one = queue.pop(0)
                chosen[one.building.building_id] = one
    return list(chosen.values())


def _by(kind: str, ordered: Sequence[ComparedBuilding]) -> list[ComparedBuilding]:
    return sorted(ordered, key=lambda building: -building.difference[kind])


def _typical(ordered: Sequence[ComparedBuilding]) -> list[Choice]:
    """Buildings where all models have one type and number of planes: of each type in turn, the median size first."""
    agreed: dict[str, list[ComparedBuilding]] = {}
    for one in ordered:
        same = not any(value for kind, value in one.difference.items() if kind != "residual")
        if same and one.records[0]["is_model"] and one.difference["residual"] * FULL_RESIDUAL_M <= SAME_RESIDUAL_M:
            agreed.setdefault(one.records[0]["roof_type"], []).append(one)
    kinds = sorted(agreed, key=lambda kind: (-len(agreed[kind]), kind))
    for kind in kinds:
        middle = statistics.median(_area(one) for one in agreed[kind])
        agreed[kind].sort(key=lambda one: (abs(_area(one) - middle), one.building_id))
    turns = itertools.zip_longest(*(agreed[kind] for kind in kinds))
    return [Choice(one, "typical: all agree") for turn in turns for one in turn if one is not None]


def _area(building: ComparedBuilding) -> float:
    return float(building.records[0]["footprint_area_m2"] or 0.0)
