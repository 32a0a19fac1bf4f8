"""Clusters among leftover points: small faces are found, labelled points and clutter are left alone."""

import numpy as np

from pipeline.extras.papers.leftover_planes import cluster_leftovers
from pipeline.geometry import nearest_neighbours
from pipeline.model import FloatArray, LabelArray


def roof_with_dormer(seed: int = 0) -> tuple[FloatArray, LabelArray]:
    """A flat roof, labelled, with a sloping dormer of 30 points on it that nothing explains yet."""
    random = np.random.default_rng(seed)
    roof = np.column_stack([random.uniform(0, 10, (300, 2)), random.normal(5, 0.02, 300)])
    dormer = np.column_stack([random.uniform(4, 6, (30, 2)), np.zeros(30)])
    dormer[:, 2] = 6 + 0.4 * dormer[:, 0] + random.normal(0, 0.02, 30)
    return np.concatenate([roof, dormer]), np.repeat([0, -1], [300, 30]).astype(np.int32)


def test_leftovers_on_one_plane_become_a_cluster_of_their_own() -> None:
    points, labels = roof_with_dormer()
    grown = cluster_leftovers(points, nearest_neighbours(points, 9), labels, 0.15, 10)
    assert (grown[:300] == 0).all()
    assert (grown[300:] == 1).mean() > 0.95


def test_two_leftover_planes_become_two_clusters() -> None:
    points, labels = roof_with_dormer()
    other = points[300:] * [1, 1, -1] + [3.0, 0, 20]
    both, both_labels = np.concatenate([points, other]), np.append(labels, np.full(30, -1)).astype(np.int32)
    grown = cluster_leftovers(both, nearest_neighbours(both, 9), both_labels, 0.15, 10)
    first, second = np.bincount(grown[300:330] + 1).argmax() - 1, np.bincount(grown[330:] + 1).argmax() - 1
    assert {first, second} == {1, 2}


def test_too_few_leftovers_stay_leftovers_and_without_any_nothing_changes() -> None:
    points, labels = roof_with_dormer()
    for known, fewest in ((labels, 31), (np.arange(330, dtype=np.int32) % 7, 6)):
        assert cluster_leftovers(points, nearest_neighbours(points, 9), known, 0.15, fewest).tolist() == known.tolist()


def test_clutter_makes_no_large_cluster() -> None:
    points = np.random.default_rng(1).uniform(0, 8, (200, 3))
    labels = np.full(200, -1, np.int32)
    grown = cluster_leftovers(points, nearest_neighbours(points, 9), labels, 0.15, 25)
    assert (grown == -1).all()


def test_every_cluster_lies_near_a_plane() -> None:
    points, labels = roof_with_dormer(3)
    grown = cluster_leftovers(points, nearest_neighbours(points, 9), labels, 0.15, 6)
    for k in range(1, grown.max() + 1):
        own = points[grown == k]
        design = np.column_stack([own[:, :2], np.ones(len(own))])
        residual = own[:, 2] - design @ np.linalg.lstsq(design, own[:, 2], rcond=None)[0]
        assert np.abs(residual).max() < 0.3
