"""Slope, orientation and O-distance of facets: what they are of known planes, and what turns and shifts do to them."""

import math

import numpy as np
import pytest

from pipeline.extras.papers.facet_parameters import about_barycentre, cluster_means, facet_parameters
from pipeline.model import FloatArray, LabelArray
from pipeline.tin.delaunay import triangulate


def cloud(seed: int, n: int = 200) -> tuple[FloatArray, LabelArray]:
    """Points over 20 m with their Delaunay facets, whole millimetres."""
    points = np.rint(np.random.default_rng(seed).uniform(0, [20, 15, 6], (n, 3)) * 1000)
    return points / 1000, triangulate(points[:, :2].astype(np.int64)).facets


def plain_parameters(points: FloatArray, facets: LabelArray) -> FloatArray:
    """The same from the planes' equations, one facet after another."""
    rows = []
    for i, j, k in facets:
        a, b, c = np.linalg.solve(np.column_stack([points[[i, j, k], :2], np.ones(3)]), points[[i, j, k], 2])
        rows.append(
            (
                math.degrees(math.atan(math.hypot(a, b))),
                math.degrees(math.atan2(-a, -b)) % 360.0,
                c / math.sqrt(1 + a * a + b * b),
            )
        )
    return np.array(rows)


@pytest.mark.parametrize("seed", range(3))
def test_the_parameters_are_those_of_the_planes_through_three_points(seed: int) -> None:
    points, facets = cloud(seed)
    centred, barycentre = about_barycentre(points)
    np.testing.assert_allclose(centred.mean(axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(barycentre, points.mean(axis=0), atol=1e-9)
    ours, plain = facet_parameters(centred, facets), plain_parameters(centred, facets)
    np.testing.assert_allclose(ours[:, [0, 2]], plain[:, [0, 2]], atol=1e-6)
    assert np.abs((ours[:, 1] - plain[:, 1] + 180) % 360 - 180).max() < 1e-6


@pytest.mark.parametrize(
    ("gradient", "orientation"), [((0, -0.5), 0.0), ((-0.5, 0), 90.0), ((0, 0.5), 180.0), ((0.5, 0), 270.0)]
)
def test_orientation_is_where_water_runs_clockwise_from_north(
    gradient: tuple[float, float], orientation: float
) -> None:
    plan = np.array([[0.0, 0], [4, 1], [1, 3]])
    points = np.column_stack([plan, plan @ gradient + 2])
    slope, turn, distance = facet_parameters(points, np.array([[0, 1, 2]], np.int32))[0]
    assert (slope, turn) == pytest.approx((math.degrees(math.atan(0.5)), orientation), abs=1e-9)
    assert distance == pytest.approx(2 / math.sqrt(1.25))


def test_a_level_facet_has_orientation_0_and_its_height_as_distance() -> None:
    points = np.array([[0.0, 0, -3], [1, 0, -3], [0, 1, -3]])
    assert facet_parameters(points, np.array([[0, 1, 2]], np.int32)).tolist() == [[0.0, 0.0, -3.0]]


def test_turning_the_scene_turns_orientations_alone() -> None:
    points, facets = cloud(5)
    centred, _ = about_barycentre(points)
    turn = math.radians(37.0)
    matrix = np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    turned = np.column_stack([centred[:, :2] @ matrix.T, centred[:, 2]])
    before, after = facet_parameters(centred, facets), facet_parameters(turned, facets)
    np.testing.assert_allclose(before[:, [0, 2]], after[:, [0, 2]], atol=1e-8)
    assert np.abs((after[:, 1] - before[:, 1] - 37.0 + 180) % 360 - 180).max() < 1e-6


def test_the_barycentre_is_the_same_in_every_order_of_points() -> None:
    points, _ = cloud(1)
    shuffled = points[np.random.default_rng(0).permutation(len(points))]
    assert about_barycentre(points)[1].tobytes() == about_barycentre(shuffled)[1].tobytes()


def test_the_mean_orientation_of_a_cluster_across_north_is_near_north() -> None:
    parameters = np.array([[30.0, 350, 1], [32, 20, 2], [10, 100, 5], [11, 101, 7]])
    means = cluster_means(parameters, np.array([0, 0, 1, -1], np.int32), 3)
    np.testing.assert_allclose(means, np.array([[31.0, 5, 1.5], [10, 100, 5], [0, 0, 0]]), atol=1e-9)
