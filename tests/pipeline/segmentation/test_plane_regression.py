"""Best-fit planes from sums against numpy's least squares."""

import math

import numpy as np
import pytest

from pipeline.model import FloatArray
from pipeline.segmentation.plane_regression import best_fit_plane, cluster_sums, cosine_of_slope, mean_square_residual


def strewn(seed: int, count: int = 40, noise: float = 0.1) -> FloatArray:
    random = np.random.default_rng(seed)
    points = random.uniform(0, 50, (count, 3))
    points[:, 2] = 0.4 * points[:, 0] - 0.2 * points[:, 1] + 7 + random.normal(0, noise, count)
    return points


@pytest.mark.parametrize("seed", range(5))
def test_a_plane_equals_numpy_least_squares(seed: int) -> None:
    points = strewn(seed)
    sums = cluster_sums(points, np.zeros(len(points), np.int32), 1)[0]
    a, b, c, fitted = best_fit_plane(sums)
    design = np.column_stack([points[:, :2], np.ones(len(points))])
    expected, square, _, _ = np.linalg.lstsq(design, points[:, 2], rcond=None)
    assert fitted
    np.testing.assert_allclose([a, b, c], expected, atol=1e-9)
    assert mean_square_residual(sums, a, b, c) == pytest.approx(square[0] / len(points), rel=1e-6)


def test_the_residual_about_any_plane_comes_from_the_sums() -> None:
    points = strewn(7)
    sums = cluster_sums(points, np.zeros(len(points), np.int32), 1)[0]
    expected = ((points[:, 2] - 0.1 * points[:, 0] - 0.3 * points[:, 1] - 2) ** 2).mean()
    assert mean_square_residual(sums, 0.1, 0.3, 2.0) == pytest.approx(expected, rel=1e-9)


def test_sums_of_parts_add_up_to_those_of_the_whole() -> None:
    points = strewn(1)
    halves = np.arange(len(points), dtype=np.int32) % 2
    whole = cluster_sums(points, np.zeros(len(points), np.int32), 1)
    np.testing.assert_allclose(cluster_sums(points, halves, 2).sum(axis=0), whole[0], rtol=1e-12)


def test_unlabelled_points_do_not_count() -> None:
    points = strewn(2)
    labels = np.where(np.arange(len(points)) < 10, 0, -1).astype(np.int32)
    np.testing.assert_array_equal(cluster_sums(points, labels, 1), cluster_sums(points[:10], np.zeros(10, np.int32), 1))


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        np.array([[1.0, 2, 3], [4, 5, 6]]),
        np.array([[0.0, 0, 1], [1, 1, 2], [2, 2, 3], [5, 5, 9]]),
        np.array([[3.0, 3, 1], [3, 3, 2], [3, 3, 3]]),
    ],
    ids=["none", "two", "on a line", "in one place"],
)
def test_points_without_a_plane_come_back_horizontal_at_their_mean(points: FloatArray) -> None:
    sums = cluster_sums(points, np.zeros(len(points), np.int32), 1)[0]
    a, b, c, fitted = best_fit_plane(sums)
    assert (a, b, fitted) == (0.0, 0.0, False)
    assert c == pytest.approx(points[:, 2].mean() if len(points) else 0.0)


def test_the_cosine_of_a_slope_is_that_of_its_angle() -> None:
    assert cosine_of_slope(math.tan(math.radians(35)), 0.0) == pytest.approx(math.cos(math.radians(35)))
