"""Refinement of rough clusters: what merges, what is dropped, what stays, and what it does not depend on."""

import math
from typing import Any

import numpy as np
import pytest
from candidates_by_hand import TURNS, Matrix, same_partition

from pipeline.errors import BuildingError, SettingsError
from pipeline.geometry import nearest_neighbours
from pipeline.model import FloatArray, LabelArray, Reason
from pipeline.segmentation.plane_refinement import refine_planes
from pipeline.segmentation.plane_regression import describe_planes
from pipeline.segmentation.refinement_settings import PlaneRefinementSettings


def gable(seed: int = 0, count: int = 400, noise: float = 0.03, rise: float = 0.5) -> tuple[FloatArray, LabelArray]:
    """Points of a gable with its ridge at y = 0, and the true side of every point."""
    random = np.random.default_rng(seed)
    points = np.column_stack([random.uniform(0, 12, count), random.uniform(-4, 4, count), np.zeros(count)])
    points[:, 2] = 8 - rise * np.abs(points[:, 1]) + random.normal(0, noise, count)
    return points, (points[:, 1] > 0).astype(np.int32)


def refine(
    points: FloatArray, labels: LabelArray, *, fewest_points: int = 8, **changes: Any
) -> tuple[FloatArray, LabelArray]:
    chosen = {"distance_m": 0.15, "fewest_points": fewest_points, "settings": PlaneRefinementSettings(**changes)}
    return refine_planes(points, nearest_neighbours(points, 9), labels.astype(np.int32), **chosen)


def test_shattered_clusters_of_a_gable_become_two_planes() -> None:
    points, side = gable()
    shattered = 2 * (points[:, 0] / 2).astype(np.int32) + side
    planes, labels = refine(points, shattered)
    assert len(planes) == 2
    assert max((labels == side).mean(), (labels == 1 - side).mean()) > 0.97
    slopes = np.degrees(np.arctan(np.hypot(planes[:, 0], planes[:, 1])))
    np.testing.assert_allclose(slopes, math.degrees(math.atan(0.5)), atol=0.5)


def test_outliers_are_absorbed_and_far_points_are_not() -> None:
    points, side = gable()
    rough = np.where(np.arange(len(points)) % 3 == 0, -1, side)
    points[5, 2] += 2.0
    _, labels = refine(points, rough)
    assert labels[5] == -1
    assert (labels >= 0).sum() >= len(points) - 2


def test_a_cluster_of_another_planes_outliers_is_given_up() -> None:
    points, side = gable(noise=0.05)
    near_ridge = np.abs(points[:, 1]) < 0.5
    rough = np.where(near_ridge, 2, side)
    planes, labels = refine(points, rough)
    assert len(planes) == 2
    assert (labels[near_ridge] >= 0).mean() > 0.95


def test_without_a_cost_a_plane_across_the_edge_may_stay_and_with_it_a_dormer_does() -> None:
    points, side = gable()
    dormer = (np.abs(points[:, 0] - 6) < 1.5) & (points[:, 1] > 1) & (points[:, 1] < 3.5)
    points[dormer, 2] = 7.9
    planes, labels = refine(points, np.where(dormer, 2, side))
    assert len(planes) == 3
    assert len(set(labels[dormer].tolist())) == 1
    assert not set(labels[dormer].tolist()) & set(labels[~dormer & (side == 0)].tolist())


def test_parts_of_one_plane_that_do_not_touch_are_one_plane_within_reach_only() -> None:
    points, _ = gable(rise=0.0)
    kept = np.abs(points[:, 0] - 6) > 2
    points = points[kept]
    parts = (points[:, 0] > 6).astype(np.int32)
    assert len(refine(points, parts)[0]) == 1
    assert len(refine(points, parts, merge_reach_m=1.0)[0]) == 2


def test_steep_planes_and_small_ones_are_dropped_and_no_cluster_gives_none() -> None:
    points, side = gable()
    below = np.random.default_rng(3).uniform(0, 1, 60)
    wall = np.column_stack([np.linspace(0, 12, 60), -4 - below, 6 - 3.5 * below])
    both = np.concatenate([points, wall])
    planes, _ = refine(both, np.concatenate([side, np.full(60, 2, np.int32)]))
    assert len(planes) == 2
    gentle = wall * [1, 1, 0.5] + [0, 0, 3]
    assert len(refine(np.concatenate([points, gentle]), np.concatenate([side, np.full(60, 2, np.int32)]))[0]) == 3
    few = np.where(np.arange(len(points)) < 5, 2, -1)
    for rough, fewest_points in ((few, 500), (np.full(len(points), -1), 8)):
        planes, labels = refine(points, rough, fewest_points=fewest_points)
        assert planes.shape == (0, 3)
        assert (labels == -1).all()


def test_the_order_of_points_and_the_names_of_clusters_do_not_matter() -> None:
    points, side = gable(noise=0.08)
    rough = 2 * (points[:, 0] / 2).astype(np.int32) + side
    planes, labels = refine(points, rough)
    order = np.random.default_rng(1).permutation(len(points))
    renamed = np.random.default_rng(2).permutation(rough.max() + 1)[rough]
    moved_planes, moved_labels = refine(points[order], renamed[order])
    assert same_partition(labels[order], moved_labels)
    np.testing.assert_allclose(sorted(planes.tolist()), sorted(moved_planes.tolist()), atol=1e-9)


@pytest.mark.parametrize("matrix", TURNS)
def test_mirrored_or_turned_by_90_degrees_the_partition_is_the_same(matrix: Matrix) -> None:
    points, side = gable(noise=0.08)
    rough = 2 * (points[:, 0] / 2).astype(np.int32) + side
    _, labels = refine(points, rough)
    turned = points.copy()
    turned[:, :2] = points[:, :2] @ np.array(matrix).T
    order = np.lexsort(turned.T[::-1])
    _, turned_labels = refine(turned[order], rough[order])
    assert same_partition(labels[order], turned_labels)


def test_planes_are_numbered_by_their_first_point() -> None:
    points, side = gable()
    _, labels = refine(points, side)
    seen = [label for label in dict.fromkeys(labels.tolist()) if label >= 0]
    assert seen == sorted(seen)


def test_with_all_planes_every_point_takes_the_nearest() -> None:
    points, side = gable()
    planes, labels = refine(points, side, assignment="all_planes", rounds=1)
    distance = np.abs(points[:, 2:] - points[:, :2] @ planes[:, :2].T - planes[:, 2])
    distance /= np.sqrt(1 + (planes[:, :2] ** 2).sum(axis=1))
    near = distance.min(axis=1) < 0.149
    clear = near & (np.abs(distance[:, 0] - distance[:, 1]) > 0.02)
    assert (labels[clear] == distance[clear].argmin(axis=1)).all()
    assert (labels[distance.min(axis=1) > 0.151] == -1).all()


def test_beyond_its_work_limit_a_building_is_too_complex() -> None:
    points, side = gable()
    with pytest.raises(BuildingError, match="refinement_work_limit is 1") as caught:
        refine(points, 2 * (points[:, 0] / 2).astype(np.int32) + side, refinement_work_limit=1)
    assert caught.value.reason is Reason.TOO_COMPLEX


def test_planes_tell_their_points_and_their_residual() -> None:
    points, side = gable()
    planes, labels = refine(points, side)
    for k, plane in enumerate(describe_planes(points, planes, labels)):
        own = points[labels == k]
        residual = own[:, 2] - own[:, :2] @ planes[k, :2] - planes[k, 2]
        assert plane.n_points == len(own)
        assert plane.rmse_m == pytest.approx(math.sqrt((residual**2).mean()), rel=1e-6)


def test_the_fewest_points_follow_the_density_within_their_bounds() -> None:
    chosen = PlaneRefinementSettings()
    assert [chosen.fewest_points(s) for s in (2.0, 0.5, 0.25, 0.1, 0.0)] == [6, 6, 24, 25, 25]


def test_contradicting_bounds_are_refused() -> None:
    with pytest.raises(SettingsError, match="min_points is 30: use at most max_min_points, 25"):
        PlaneRefinementSettings(min_points=30)
