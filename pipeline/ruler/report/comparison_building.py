"""Runs over the same candidates, their records of a building, and the differences between them."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

from pipeline.model import Status
from pipeline.ruler.evaluation.evaluate import Evaluation

FULL_RESIDUAL_M = 0.2
"""A difference of RMSE that counts in full."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ComparedRun:
    """A run that is compared."""

    label: str
    """Its label in tables and pages."""
    method: str
    """Name of the method."""
    preset: str
    """Name of its settings."""
    run_dir: str
    """A finished local run directory."""
    seconds: Mapping[str, float] | None = None
    """Seconds per building, by building_id; missing ones are unknown."""
    evaluation: Evaluation | None = None
    """Evaluation of this run; all have one reference."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Record:
    """The record of a building in one run."""

    status: Status
    """ok, doubtful, fallback or failed."""
    reason: str | None
    """None where ok."""
    reason_detail: str
    """The measured figure and the threshold."""
    lod: str | None
    """None without a model."""
    roof_type: str
    """Roof type in the record."""
    n_planes: int
    """Delivered roof planes."""
    rmse_m: float
    """nan without a model, as the next two."""
    p95_m: float
    """95th percentile of the distances."""
    coverage: float
    """Share of points that have a roof."""
    valid: bool
    """Whether all its solids are valid; False without a model."""
    footprint_area_m2: float
    """nan if unknown."""
    seconds: float
    """nan if unknown."""
    touches_data_edge: bool
    """Whether the data end at the candidate."""
    geometry: bytes | None
    """Footprint as WKB in the units of the CRS."""
    truth: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """The row of its true building in the evaluation's table; empty without."""

    @property
    def is_model(self) -> bool:
        """Whether the model of the method was delivered."""
        return self.status.has_roof

    @property
    def outcome(self) -> str | None:
        """correct, passable or false; None if it was not judged."""
        return self.truth.get("outcome")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Difference:
    """Differences of the runs in one building; every part from 0 (all agree) to 1."""

    status: float
    """Share of pairs of runs with different statuses."""
    outcome: float
    """Share of pairs with different outcomes; 0 if none was judged."""
    roof_type: float
    """Share of pairs with different roof types, among the runs with a model of their own, as below."""
    faces: float
    """Largest minus smallest number of planes, over the largest."""
    residual: float
    """Largest minus smallest RMSE; 0.2 m count in full."""

    @property
    def total(self) -> float:
        """Sum of all parts."""
        return self.status + self.outcome + self.roof_type + self.faces + self.residual


@dataclasses.dataclass(frozen=True, kw_only=True)
class ComparedBuilding:
    """A building in all runs."""

    building_id: str
    """The same in all."""
    records: tuple[Record, ...]
    """One per run, in their order."""
    true_id: str | None
    """Id of the reference building under it; None without one."""
    difference: Difference
    """Differences of the runs."""


def difference_of(records: Sequence[Record]) -> Difference:
    """Differences between the records of one building."""
    modelled = [record for record in records if record.is_model]
    planes = [record.n_planes for record in modelled]
    rmse = [record.rmse_m for record in modelled if math.isfinite(record.rmse_m)]
    return Difference(
        status=_pairs_apart([record.status for record in records]),
        outcome=_pairs_apart([record.outcome for record in records if record.outcome is not None]),
        roof_type=_pairs_apart([record.roof_type for record in modelled]),
        faces=(max(planes) - min(planes)) / max(*planes, 1) if planes else 0.0,
        residual=min(1.0, (max(rmse) - min(rmse)) / FULL_RESIDUAL_M) if rmse else 0.0,
    )


def _pairs_apart(values: Sequence[Hashable]) -> float:
    """Share of pairs that are not equal; 0 without a pair."""
    pairs = list(itertools.combinations(values, 2))
    return sum(a != b for a, b in pairs) / len(pairs) if pairs else 0.0
