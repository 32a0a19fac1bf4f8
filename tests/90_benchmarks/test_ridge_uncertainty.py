"""What is said of the ridge's standard deviation, from errors and figures by hand."""

import math

import numpy as np
import pytest
import roofs_by_hand as hand

from benchmarks.entries import hofmann_entries, sweep_entries
from benchmarks.ridge_uncertainty import RidgeError, groups_of, highest_m, share_within, table


def errors(sizes: list[float], sigma_m: float = 0.01, *, is_good: bool = True) -> list[RidgeError]:
    return [RidgeError(error_m=size, sigma_m=sigma_m, is_good=is_good) for size in sizes]


def test_normal_errors_with_the_right_sigma_are_within_one_in_68_of_100_cases() -> None:
    rng = np.random.default_rng(4)
    sigmas = rng.uniform(0.005, 0.1, 20_000)
    drawn = [RidgeError(error_m=float(sigma * rng.normal()), sigma_m=float(sigma)) for sigma in sigmas]
    assert share_within(drawn, 1.0) == pytest.approx(0.6827, abs=0.01)
    assert share_within(drawn, 2.0) == pytest.approx(0.9545, abs=0.01)


def test_what_has_no_figure_is_counted_but_in_no_share() -> None:
    some = [*errors([0.005, -0.02]), RidgeError(error_m=3.0, sigma_m=math.nan)]
    assert share_within(some, 1.0) == 0.5
    assert math.isnan(share_within(some[2:], 1.0))
    row = table([("some", some), ("nothing", some[2:])]).splitlines()[2:]
    cells = [[cell.strip() for cell in line.strip("|").split("|")][:5] for line in row]
    assert cells == [["some", "3", "1", "50.0 %", "100.0 %"]]


def test_the_ridge_of_a_true_building_is_its_highest_corner() -> None:
    assert highest_m(hand.gable("a", slope=0.5)) == pytest.approx(6.0)
    assert highest_m(hand.hip("a", 30.0, slope=0.7)) == pytest.approx(6.8)


def test_buildings_are_gathered_by_suite_density_and_noise() -> None:
    hofmann, sweep = next(hofmann_entries("dev", 1)), list(sweep_entries("dev"))
    hard = errors([0.5], is_good=False)
    groups = dict(groups_of([(hofmann, [*errors([0.1]), *hard]), *((entry, errors([0.0])) for entry in sweep)]))
    assert (len(groups["hofmann310, all"]), len(groups["hofmann310, good ones"])) == (2, 1)
    assert len(groups["sweep, all"]) == len(sweep) == 21
    assert (len(groups["sweep, 8 pulses per m2"]), len(groups["sweep, 0.05 m of noise"])) == (3, 7)
