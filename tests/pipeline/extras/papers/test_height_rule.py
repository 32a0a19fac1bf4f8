"""The printed Z_avg rule on facets that can be counted by hand."""

import numpy as np
import pytest

from pipeline.extras.papers.height_rule import facet_z_difference, facet_z_highest, facets_above_z_avg, z_avg
from pipeline.model import FloatArray, LabelArray


def box_with_walls() -> tuple[FloatArray, LabelArray]:
    """A flat roof at 10 m, four wall facets, and ground at 0 m, as (z, facets)."""
    z = np.array([10.0, 10.0, 10.0, 10.0, 0.0, 0.0, 0.0, 0.0])
    roof, walls, ground = [[0, 1, 2], [0, 2, 3]], [[0, 4, 1], [1, 4, 5], [2, 6, 3], [3, 6, 7]], [[4, 5, 6], [4, 6, 7]]
    return z, np.array(roof + walls + ground, np.int32)


def test_the_difference_is_highest_minus_lowest_vertex() -> None:
    z, facets = np.array([1.0, 5.0, -2.0, 3.0]), np.array([[0, 1, 2], [3, 0, 1]], np.int32)
    assert facet_z_difference(z, facets).tolist() == [7.0, 4.0]
    assert facet_z_highest(z, facets).tolist() == [5.0, 5.0]


def test_z_avg_is_the_mean_top_of_the_walls() -> None:
    assert z_avg(np.array([4.0, 8.0, 100.0]), np.array([True, True, False])) == 6.0


def test_z_avg_does_not_depend_on_the_order_of_facets() -> None:
    random = np.random.default_rng(0)
    tops = random.uniform(0, 100, 1000)
    walls = random.random(1000) < 0.5
    order = random.permutation(1000)
    assert z_avg(tops, walls) == z_avg(tops[order], walls[order])


def test_without_a_wall_z_avg_is_minus_infinity() -> None:
    assert z_avg(np.array([4.0]), np.array([False])) == float("-inf")


def test_a_roof_above_the_mean_wall_top_passes_and_ground_and_walls_do_not() -> None:
    z, facets = box_with_walls()
    z[:4] += [0.0, 0.1, 0.2, 0.1]
    # The walls' mean top is 10.125 m, the centres of both roof facets lie at 10.1 m: the rule drops the roof.
    assert z_avg(facet_z_highest(z, facets), facet_z_difference(z, facets) >= 2.0) == pytest.approx(10.125)
    assert facets_above_z_avg(z, facets).tolist() == [False] * 8
    z[2] += 1.0
    assert facets_above_z_avg(z, facets).tolist()[:2] == [True, True]
    assert not facets_above_z_avg(z, facets)[2:].any()


def test_a_noisy_flat_roof_loses_about_half_as_measured() -> None:
    random = np.random.default_rng(1)
    side = 30
    z = np.full((side, side), 0.0)
    z[5:25, 5:25] = 10.0
    z = (z + random.normal(0, 0.1, z.shape)).ravel()
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    facets = np.concatenate(
        [
            np.column_stack([corner, corner + 1, corner + side]),
            np.column_stack([corner + 1, corner + side + 1, corner + side]),
        ]
    ).astype(np.int32)
    roof = (z[facets] > 5).all(axis=1)
    kept = facets_above_z_avg(z, facets)
    assert 0.1 < kept[roof].mean() < 0.9
    assert not kept[~roof].any()


def test_the_wall_height_is_inclusive() -> None:
    z, facets = np.array([0.0, 2.0, 1.0, 3.0]), np.array([[0, 1, 2], [1, 2, 3]], np.int32)
    # Both facets differ by exactly 2 m: both are walls, none is left for the roof.
    assert facets_above_z_avg(z, facets).tolist() == [False, False]
    assert facets_above_z_avg(z, facets, wall_height_m=2.001).tolist() == [True, True]
