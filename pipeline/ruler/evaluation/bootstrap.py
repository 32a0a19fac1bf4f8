"""Percentile bootstrap (Efron 1979) of figures that are functions of sums over independent units.

A unit is a building, or a block of raster cells. Points within a unit are correlated, so units are drawn, never points.
Every figure is a function of sums over the units (a share is a ratio of two, a quantile follows from summed
histograms): a resample is a vector of weights, and thousands of them are one matrix product.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator, Mapping

import numpy as np
import numpy.typing as npt

from pipeline.model import FloatArray

DRAWS = 1000
"""Resamples."""
CONFIDENCE = 0.95
"""Share of the resamples inside the interval."""
_SEED = 20_030_117
_ROWS_A_BLOCK = 64
_MIN_UNITS = 2
_MAX_KEPT_UNITS = 50_000
"""50 MB of resamples."""

Sums = Mapping[str, FloatArray]
Statistic = Callable[[Sums], FloatArray]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Share:
    """A figure from 0 to 1. If all units agree on 0 or 1, resampling has no spread and an exact limit is given."""

    figure: Statistic
    denominator: str
    """Column whose units that are not zero count as trials."""

    def __call__(self, sums: Sums) -> FloatArray:
        """The figure of sums."""
        return self.figure(sums)

    def limits(self, value: float, columns: Mapping[str, FloatArray]) -> tuple[float, float]:
        """The exact interval of n trials that all failed or all succeeded (Clopper and Pearson 1934)."""
        trials = int(np.count_nonzero(columns[self.denominator]))
        missed = ((1.0 - CONFIDENCE) / 2.0) ** (1.0 / trials)
        return (missed, 1.0) if value == 1.0 else (0.0, 1.0 - missed)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Estimate:
    """A figure and its interval."""

    value: float
    """The figure of the original units."""
    low: float
    """Lower end; nan with fewer than two units."""
    high: float


def bootstrap(columns: Mapping[str, FloatArray], statistic: Statistic, *, draws: int = DRAWS) -> Estimate:
    """A figure with its percentile interval; the same for the same columns: resamples are drawn from a fixed seed.

    The columns, (units,) or (units, k) float64, are summed over the units. From sums, each (draws,) or (draws, k), the
    statistic computes the figure, (draws,); nan where it is undefined.

    >>> import numpy as np
    >>> found = {"found": np.array([1.0, 1.0, 0.0, 1.0]), "all": np.ones(4)}
    >>> estimate = bootstrap(found, share("found", "all"))
    >>> estimate.value, estimate.low < 0.75 < estimate.high
    (0.75, True)
    """
    arrays = {name: np.asarray(column, np.float64) for name, column in columns.items()}
    units = {len(column) for column in arrays.values()}
    if len(units) != 1:
        raise ValueError(f"columns of a bootstrap have {sorted(units)} units: give one number")
    count = units.pop()
    whole = {name: column.sum(axis=0, keepdims=True) for name, column in arrays.items()}
    value = float(_figures(statistic, whole)[0])
    if count < _MIN_UNITS:
        return Estimate(value=value, low=math.nan, high=math.nan)
    figures = []
    for counts in (_kept_resamples if count <= _MAX_KEPT_UNITS else _drawn_resamples)(count, draws):
        weights = counts.astype(np.float64)
        figures.append(_figures(statistic, {name: weights @ column for name, column in arrays.items()}))
    drawn = np.concatenate(figures)
    drawn = drawn[np.isfinite(drawn)]
    if len(drawn) == 0:
        return Estimate(value=value, low=math.nan, high=math.nan)
    tail = (1.0 - CONFIDENCE) / 2.0
    low, high = np.quantile(drawn, [tail, 1.0 - tail])
    if isinstance(statistic, Share) and value in {0.0, 1.0} and low == high:
        low, high = statistic.limits(value, arrays)
    return Estimate(value=value, low=float(low), high=float(high))


@functools.lru_cache(maxsize=4)
def _kept_resamples(units: int, draws: int) -> tuple[npt.NDArray[np.uint8], ...]:
    """All resamples, cached: most figures of an evaluation have the same units, and drawing costs most."""
    return tuple(_drawn_resamples(units, draws))


def _drawn_resamples(units: int, draws: int) -> Iterator[npt.NDArray[np.uint8]]:
    """How often each unit is drawn, (rows, units), some rows at a time; deterministic."""
    random = np.random.default_rng(_SEED)
    chances = np.full(units, 1.0 / units)
    for first in range(0, draws, _ROWS_A_BLOCK):
        yield random.multinomial(units, chances, size=min(_ROWS_A_BLOCK, draws - first)).astype(np.uint8)


def _figures(statistic: Statistic, sums: Sums) -> FloatArray:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(statistic(sums), np.float64)


def share(numerator: str, denominator: str) -> Share:
    """Sum of one column over the sum of another that contains it."""
    return Share(figure=ratio(numerator, denominator), denominator=denominator)


def ratio(numerator: str, denominator: str) -> Statistic:
    """Sum of one column over the sum of another: means."""

    def statistic(sums: Sums) -> FloatArray:
        return np.where(sums[denominator] > 0.0, sums[numerator] / sums[denominator], np.nan)

    return statistic


def root_mean(squares: str, count: str) -> Statistic:
    """Root of the mean of squares."""
    mean = ratio(squares, count)
    return lambda sums: np.sqrt(mean(sums))


def quality(both: str, reference: str, found: str) -> Share:
    """TP / (TP + FP + FN): the quality of completeness and correctness that share their true positives."""

    def statistic(sums: Sums) -> FloatArray:
        union = sums[reference] + sums[found] - sums[both]
        return np.where(union > 0.0, sums[both] / union, np.nan)

    return Share(figure=statistic, denominator=reference)


def quantile(histogram: str, edges: FloatArray, share: float) -> Statistic:
    """A quantile from summed histograms (units, bins) over edges (bins + 1,), linear within the bin."""

    def statistic(sums: Sums) -> FloatArray:
        cumulated = np.cumsum(sums[histogram], axis=1)
        total = cumulated[:, -1]
        wanted = share * total
        place = np.minimum((cumulated < wanted[:, None]).sum(axis=1), cumulated.shape[1] - 1)
        rows = np.arange(len(place))
        below = np.where(place > 0, cumulated[rows, place - 1], 0.0)
        inside = np.maximum(cumulated[rows, place] - below, 1e-300)
        position = np.clip((wanted - below) / inside, 0.0, 1.0)
        return np.where(total > 0.0, edges[place] + position * (edges[place + 1] - edges[place]), np.nan)

    return statistic
