"""Labels for places without points."""

import numpy as np
import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.roof.labelling import continue_crossings, empty_samples, fill_labels
from pipeline.roof.nearest_points import nearest_points
from pipeline.tin.delaunay import triangulate


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=examples(40), deadline=None)
def test_the_nearest_point_is_that_of_a_plain_search(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.integers(-20, 20, (int(rng.integers(1, 60)), 2)) * 250
    queries = rng.integers(-9000, 9000, (30, 2))
    index, distance = nearest_points(points, queries)
    squared = ((queries[:, None] - points) ** 2).sum(axis=2)
    assert index.tolist() == squared.argmin(axis=1).tolist()
    assert distance * 1e3 == pytest.approx(np.sqrt(squared.min(axis=1)))


def test_unlabelled_points_take_the_nearest_label() -> None:
    xy = np.array([[0, 0], [1000, 0], [400, 0], [700, 0]])
    assert fill_labels(xy, np.array([3, 5, -1, -1], np.int32)).tolist() == [3, 5, 3, 5]
    assert fill_labels(xy, np.full(4, -1, np.int32)).tolist() == [-1] * 4


def test_samples_keep_their_distance_and_leave_no_gap_wider_than_it() -> None:
    rng = np.random.default_rng(0)
    points = rng.integers(0, 5000, (40, 2))
    samples = empty_samples(points, np.array([-2000, -2000]), np.array([7000, 7000]), 300, 0.5)
    rows = [np.arange(-2000 + 150 * (r % 2), 7000 + 150 * (r % 2) + 1, 300) for r in range(31)]
    lattice = np.array([(x, -2000 + 300 * r) for r, row in enumerate(rows) for x in row])
    distance = np.sqrt(((lattice[:, None] - points) ** 2).sum(axis=2).min(axis=1)) * 1e-3
    assert samples.tolist() == lattice[distance > 0.5].tolist()
    shifted = empty_samples(points + 7000, np.array([5000, 5000]), np.array([14_000, 14_000]), 300, 0.5)
    assert np.array_equal(shifted, samples + 7000)


def test_a_ridge_goes_on_straight_beyond_its_points() -> None:
    rng = np.random.default_rng(7)
    points = rng.integers(0, 8000, (300, 2))
    points = np.unique(points, axis=0)
    planes = np.array([[0.0, 0.7, 3.0], [0.0, -0.7, 3.0 + 5.6]])
    samples = empty_samples(points, np.array([-3000, -3000]), np.array([11_000, 11_000]), 400, 0.6)
    nearest, _ = nearest_points(points, samples)
    labels = (points[:, 1] > 4000).astype(np.int32)
    xy = np.concatenate((points, samples))
    before = np.concatenate((labels, labels[nearest])).astype(np.int32)
    tin = triangulate(xy)
    known = np.arange(len(xy)) < len(points)
    after = continue_crossings(xy[:, 0].copy(), xy[:, 1].copy(), tin.facets, before, known, planes)
    truth = (xy[:, 1] > 4000).astype(np.int32)
    assert (before != truth).any()
    assert np.array_equal(after[: len(points)], labels)
    assert np.array_equal(after, truth)
