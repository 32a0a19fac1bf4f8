"""Class 6 is compared point by point, except in a house that a file leaves unclassified."""

from __future__ import annotations

import laspy
import numpy as np
import pytest

from benchmarks.unseen import ClassScore, judged_points, thinned_to


def tile(x: np.ndarray, y: np.ndarray) -> laspy.LasData:
    las = laspy.create(point_format=6, file_version="1.4")
    las.header.scales, las.header.offsets = [0.01] * 3, [x[0], y[0], 0.0]
    las.x, las.y, las.z = x, y, np.zeros(len(x))
    return las


def drawn(seed: int, n: int, side_m: float) -> laspy.LasData:
    return tile(*np.random.default_rng(seed).uniform(0.0, side_m, (2, n)))


def test_shares_of_class_6_are_those_of_the_points() -> None:
    assert ClassScore(right=60, said=80, true=100).shares == pytest.approx((0.5, 0.6, 0.75))


def test_the_house_that_a_file_leaves_unclassified_is_not_judged() -> None:
    las = tile(np.array([870220.0, 870300.0]), np.array([6617100.0, 6617100.0]))
    assert judged_points("hdf", las).tolist() == [False, True]
    assert judged_points("delft_west", las).all()


def test_a_tile_is_thinned_to_a_density() -> None:
    las = thinned_to(0.5)(drawn(2, 20_000, 100.0))
    assert 4_700 < len(las.x) < 5_300
