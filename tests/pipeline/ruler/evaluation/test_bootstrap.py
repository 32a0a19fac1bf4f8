"""Intervals by resampling units."""

import math

import numpy as np
import pytest
from scipy import stats

from pipeline.ruler.evaluation.bootstrap import bootstrap, quality, quantile, ratio, root_mean, share

RANDOM = np.random.default_rng(5)


def test_an_interval_of_a_mean_is_that_of_scipy() -> None:
    values = RANDOM.gamma(2.0, 1.5, 200)
    ours = bootstrap({"sum": values, "n": np.ones(200)}, ratio("sum", "n"), draws=4000)
    theirs = stats.bootstrap((values,), np.mean, n_resamples=4000, method="percentile", rng=7).confidence_interval
    assert ours.value == pytest.approx(values.mean())
    width = theirs.high - theirs.low
    assert ours.low == pytest.approx(theirs.low, abs=0.08 * width)
    assert ours.high == pytest.approx(theirs.high, abs=0.08 * width)


def test_units_that_hold_many_points_widen_the_interval() -> None:
    """Points of one building err together: drawing buildings must not pretend that they are independent."""
    right = (RANDOM.random(40) < 0.7).astype(float)
    by_building = bootstrap({"right": 100 * right, "n": np.full(40, 100.0)}, ratio("right", "n"))
    by_point = bootstrap({"right": np.repeat(right, 100), "n": np.ones(4000)}, ratio("right", "n"))
    assert by_building.value == pytest.approx(by_point.value)
    assert by_building.high - by_building.low > 5 * (by_point.high - by_point.low)


def test_intervals_cover_the_true_share_about_as_often_as_they_say() -> None:
    covered = 0
    for seed in range(200):
        hits = (np.random.default_rng(seed).random(80) < 0.6).astype(float)
        estimate = bootstrap({"hits": hits, "n": np.ones(80)}, ratio("hits", "n"), draws=400)
        covered += estimate.low <= 0.6 <= estimate.high
    assert 180 <= covered <= 198


def test_the_same_columns_give_the_same_interval() -> None:
    columns = {"squares": RANDOM.random(30), "n": RANDOM.integers(1, 9, 30).astype(float)}
    assert bootstrap(columns, root_mean("squares", "n")) == bootstrap(columns, root_mean("squares", "n"))


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_units_have_no_interval(count: int) -> None:
    estimate = bootstrap({"a": np.ones(count), "b": np.full(count, 2.0)}, ratio("a", "b"))
    assert math.isnan(estimate.low)
    assert math.isnan(estimate.high)
    assert math.isnan(estimate.value) if count == 0 else estimate.value == 0.5


def test_nothing_to_divide_by_is_not_a_number() -> None:
    estimate = bootstrap({"a": np.zeros(5), "b": np.zeros(5)}, ratio("a", "b"))
    assert math.isnan(estimate.value)
    assert math.isnan(estimate.low)


def test_quality_follows_from_completeness_and_correctness() -> None:
    columns = {"both": np.array([3.0, 2.0]), "reference": np.array([4.0, 4.0]), "found": np.array([5.0, 2.0])}
    completeness, correctness = 5 / 8, 5 / 7
    expected = 1 / (1 / completeness + 1 / correctness - 1)
    assert bootstrap(columns, quality("both", "reference", "found")).value == pytest.approx(expected)


@pytest.mark.parametrize("share", [0.05, 0.5, 0.95])
def test_a_quantile_of_summed_histograms_is_that_of_the_pooled_values(share: float) -> None:
    edges = np.linspace(0.0, 5.0, 1001)
    samples = [RANDOM.exponential(0.4, size) for size in (10, 300, 55)]
    histograms = np.array([np.histogram(np.minimum(sample, 4.999), edges)[0] for sample in samples], float)
    estimate = bootstrap({"h": histograms}, quantile("h", edges, share))
    assert estimate.value == pytest.approx(np.quantile(np.concatenate(samples), share), abs=0.02)
    assert estimate.low <= estimate.value <= estimate.high


def test_columns_of_different_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\[2, 3\] units"):
        bootstrap({"a": np.ones(2), "b": np.ones(3)}, ratio("a", "b"))


@pytest.mark.parametrize("found", [0.0, 1.0])
def test_a_share_on_which_all_units_agree_has_the_exact_limit(found: float) -> None:
    """39 of 39 does not prove 100 %: with a true share of 91 % it happens in one of forty cases."""
    estimate = bootstrap({"found": np.full(39, found), "all": np.ones(39)}, share("found", "all"))
    exact = stats.binomtest(39 * int(found), 39).proportion_ci(0.95, method="exact")
    assert (estimate.low, estimate.high) == pytest.approx((exact.low, exact.high))
    mean = bootstrap({"sum": np.zeros(39), "n": np.ones(39)}, ratio("sum", "n"))
    assert (mean.value, mean.low, mean.high) == (0.0, 0.0, 0.0)


def test_units_without_anything_to_count_are_no_trials() -> None:
    columns = {"found": np.array([2.0, 3.0, 0.0]), "all": np.array([2.0, 3.0, 0.0])}
    assert bootstrap(columns, share("found", "all")).low == pytest.approx(0.025**0.5)
