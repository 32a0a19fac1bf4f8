"""Regions grown from the mean of clusters: they follow the plane, not the cluster's members."""

import numpy as np
import pytest

from pipeline.errors import BuildingError, SettingsError
from pipeline.extras.papers.region_growing import grow_regions
from pipeline.geometry import nearest_neighbours
from pipeline.model import FloatArray, LabelArray, Reason
from pipeline.segmentation.refinement_settings import RegionGrowingSettings


def gable(seed: int = 0, noise: float = 0.03) -> tuple[FloatArray, LabelArray]:
    """Points of a gable with 31 degrees, and their true side."""
    random = np.random.default_rng(seed)
    points = random.uniform(0, [14, 10, 0], (280, 3))
    points[:, 2] = 8 - 0.6 * np.abs(points[:, 1] - 5) + random.normal(0, noise, 280)
    return points, (points[:, 1] > 5).astype(np.int32)


SIDES = np.array([[0.0, 0.6], [0.0, -0.6]])


def grown(
    points: FloatArray, clusters: LabelArray, gradients: FloatArray, fewest: int = 6, **limit: int
) -> tuple[FloatArray, LabelArray]:
    chosen = {"distance_m": 0.15, "fewest_points": fewest, "settings": RegionGrowingSettings()}
    return grow_regions(points, nearest_neighbours(points, 9), clusters, gradients, **chosen, **limit)


@pytest.mark.parametrize("seed", range(4))
def test_a_few_members_are_enough_for_whole_faces(seed: int) -> None:
    points, side = gable(seed)
    member = np.random.default_rng(seed).random(280) < 0.3
    planes, labels = grown(points, np.where(member, side, -1).astype(np.int32), SIDES)
    assert len(planes) == 2
    assert (labels >= 0).mean() > 0.95
    away = np.abs(points[:, 1] - 5) > 0.6
    renamed = labels if np.median(labels[side == 0]) == 0 else 1 - labels
    assert (renamed[away] == side[away]).mean() > 0.97
    np.testing.assert_allclose(np.sort(planes[:, 1]), [-0.6, 0.6], atol=0.03)


def test_members_by_chance_do_not_bend_the_plane() -> None:
    points, side = gable(1)
    clusters = side.copy()
    wrong = np.random.default_rng(0).choice(280, 40, replace=False)
    clusters[wrong] = 1 - clusters[wrong]
    planes, _ = grown(points, clusters, SIDES)
    np.testing.assert_allclose(np.sort(planes[:2, 1]), [-0.6, 0.6], atol=0.03)


def test_parallel_faces_of_one_cluster_become_two_regions() -> None:
    random = np.random.default_rng(2)
    points = random.uniform(0, [16, 8, 0], (300, 3))
    upper = points[:, 0] > 8
    points[:, 2] = 5 + 0.5 * points[:, 1] + 1.5 * upper + random.normal(0, 0.03, 300)
    planes, labels = grown(points, np.zeros(300, np.int32), np.array([[0.0, 0.5]]))
    assert len(planes) == 2
    assert len(set(labels[upper & (labels >= 0)].tolist())) == 1
    assert set(labels[upper].tolist()) & set(labels[~upper].tolist()) <= {-1}


def test_points_far_from_every_plane_small_regions_and_what_has_no_members_have_no_label() -> None:
    points, side = gable(3)
    points[:4, 2] += 3.0
    _, labels = grown(points, side, SIDES)
    assert labels[:4].tolist() == [-1] * 4
    # regions too small, and no members
    for members, fewest in ((side, 400), (np.full(280, -1, np.int32), 6)):
        planes, labels = grown(points, members, SIDES, fewest)
        assert planes.shape == (0, 3)
        assert (labels == -1).all()


def test_the_order_of_points_does_not_matter() -> None:
    points, side = gable(5)
    order = np.random.default_rng(1).permutation(280)
    _, here = grown(points, side, SIDES)
    _, there = grown(points[order], side[order], SIDES)
    assert here[order].tolist() == there.tolist()


def test_points_on_a_line_are_grown_over_from_every_seed_until_the_work_is_too_much() -> None:
    line = np.column_stack([np.arange(400) * 0.1, np.zeros(400), np.full(400, 5.0)])
    members, level = np.zeros(400, np.int32), np.zeros((1, 2))
    planes, _ = grown(line, members, level)
    assert len(planes) == 0
    with pytest.raises(BuildingError, match="of 400 points, the limit is 100000") as caught:
        grown(line, members, level, work_limit=100_000)
    assert caught.value.reason is Reason.TOO_COMPLEX


def test_bounds_that_are_no_range_are_refused() -> None:
    with pytest.raises(SettingsError, match=r"use at most max_growing_m, 0\.3"):
        RegionGrowingSettings(min_growing_m=0.5)
