"""Subsets of the reference buildings, and figures over them with buildings as the units of the bootstrap."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.ruler.evaluation.bootstrap import CONFIDENCE, DRAWS, Statistic, Sums, bootstrap
from pipeline.ruler.evaluation.building_matching import summed
from pipeline.ruler.evaluation.measure import Measure
from pipeline.ruler.evaluation.reference import Reference

Columns = dict[str, npt.NDArray[Any]]
"""Columns of one length by name: one row per building, model, face or block."""
_SEED = 20_090_402
_VALUES_A_BLOCK = 1_000_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class Subset:
    """The reference buildings of a figure."""

    name: str
    buildings: BoolArray
    """(buildings,) bool, True for those in it; never those that touch the data edge."""
    elsewhere: bool
    """True if objects on no reference building count too: only in `all`."""

    def holds(self, building: IntArray) -> BoolArray:
        """Whether things on these reference buildings (index, -1 for none) count; any shape."""
        held = np.full(np.shape(building), self.elsewhere)
        on_one = building >= 0
        held[on_one] = self.buildings[building[on_one]]
        return held

    @property
    def size(self) -> int:
        """Number of its reference buildings."""
        return int(self.buildings.sum())


MODELS_ALONE = Subset(name="all", buildings=np.zeros(0, np.bool_), elsewhere=True)
"""The subset of figures without a reference."""


def subsets(reference: Reference) -> tuple[Subset, ...]:
    """All reference buildings first, then the good and the hard ones if conditions are known.

    Buildings that touch the data edge are in none; those without conditions only in `all`.
    """
    whole = np.array([not building.touches_data_edge for building in reference.buildings], np.bool_)
    everything = Subset(name="all", buildings=whole, elsewhere=True)
    if not reference.conditions:
        return (everything,)
    known = [reference.conditions.get(building.building_id) for building in reference.buildings]
    good = np.array([one is not None and one.good for one in known], np.bool_)
    hard = np.array([one is not None and not one.good for one in known], np.bool_)
    return (
        everything,
        Subset(name="good", buildings=whole & good, elsewhere=False),
        Subset(name="hard", buildings=whole & hard, elsewhere=False),
    )


def summed_over_units(
    subset: Subset, building: IntArray, model: IntArray, columns: Mapping[str, FloatArray]
) -> dict[str, FloatArray]:
    """Columns (n,) of things summed to the units of a bootstrap, (units,).

    Units are the buildings of the subset, including empty ones, then the models on no building. `building` (n,) is the
    reference building of each thing, -1 for none; `model` (n,) its model, any number >= 0 if it is on a building.
    """
    place = np.cumsum(subset.buildings) - 1
    held = subset.holds(building)
    inside = held & (building >= 0)
    unit = np.full(len(building), -1)
    unit[inside] = place[building[inside]]
    outside = held & (building < 0)
    own, index = np.unique(model[outside], return_inverse=True)
    unit[outside] = subset.size + index
    return {name: summed(unit[held], column[held], subset.size + len(own)) for name, column in columns.items()}


def measured(
    name: str, columns: Mapping[str, FloatArray], statistic: Statistic, *, n: float, subset: Subset
) -> Measure:
    """A figure of units with its interval; only the columns that the statistic reads are resampled."""
    looked_at = _LookedAt({name: np.asarray(column)[:1] for name, column in columns.items()})
    with np.errstate(all="ignore"):
        statistic(looked_at)
    estimate = bootstrap({name: columns[name] for name in sorted(looked_at.names)}, statistic)
    return Measure(
        name=name, value=estimate.value, low=estimate.low, high=estimate.high, n=round(n), subset=subset.name
    )


def measured_all(
    columns: Mapping[str, FloatArray], subset: Subset, figures: Iterable[tuple[str, Statistic, float]]
) -> list[Measure]:
    """Figures of the same units: name, statistic and denominator of each."""
    return [measured(name, columns, statistic, n=n, subset=subset) for name, statistic, n in figures]


def measured_median(name: str, values: FloatArray, subset: Subset) -> Measure:
    """The median over buildings with its percentile interval: one finite value (n,) per unit, so the units are redrawn.

    Without values the result is nan, with one there is no interval.
    """
    count = len(values)
    if count == 0:
        return Measure(name=name, value=math.nan, n=0, subset=subset.name)
    value = float(np.median(values))
    if count == 1:
        return Measure(name=name, value=value, n=1, subset=subset.name)
    random = np.random.default_rng(_SEED)
    rows = max(1, _VALUES_A_BLOCK // count)
    drawn = np.concatenate(
        [
            np.median(values[random.integers(0, count, (min(rows, DRAWS - first), count))], axis=1)
            for first in range(0, DRAWS, rows)
        ]
    )
    tail = (1.0 - CONFIDENCE) / 2.0
    low, high = np.quantile(drawn, [tail, 1.0 - tail])
    return Measure(name=name, value=value, low=float(low), high=float(high), n=count, subset=subset.name)


class _LookedAt(dict[str, FloatArray]):
    """Sums that remember which of them were read."""

    def __init__(self, sums: Sums) -> None:
        super().__init__(sums)
        self.names: set[str] = set()

    def __getitem__(self, name: str) -> FloatArray:
        self.names.add(name)
        return super().__getitem__(name)


def total(column: str) -> Statistic:
    """The sum of a column: counts."""
    return lambda sums: sums[column]
