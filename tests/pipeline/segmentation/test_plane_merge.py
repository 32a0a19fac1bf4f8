"""Merging in a queue against merging by brute force, and the lists of pairs against all pairs."""

import math

import numpy as np
import pytest

from pipeline.geometry import nearest_neighbours
from pipeline.model import FloatArray, IntArray, LabelArray
from pipeline.segmentation.plane_merge import merge_planes, parallel_pairs_in_reach
from pipeline.segmentation.plane_regression import best_fit_plane, cluster_sums
from pipeline.segmentation.point_votes import touching_pairs

ALWAYS = 10**9


def fit(sums: FloatArray) -> FloatArray:
    return np.array([best_fit_plane(row)[:3] for row in sums])


def brute_force(
    points: FloatArray, labels: LabelArray, allowed: list[tuple[int, int]], limit_m: float, angle_deg: float, small: int
) -> dict[int, list[int]]:
    """Merge the best of all allowed pairs until none is left, from the points and not from sums."""
    groups = {k: [k] for k in range(labels.max() + 1)}
    allowed = {tuple(sorted(pair)) for pair in allowed}

    def plane_of(index: IntArray) -> FloatArray:
        design = np.column_stack([points[index, :2], np.ones(len(index))])
        return np.linalg.lstsq(design, points[index, 2], rcond=None)[0]

    def members(k: int) -> IntArray:
        return np.flatnonzero(np.isin(labels, groups[k]))

    def mean_square(index: IntArray, plane: FloatArray) -> float:
        return float(((points[index, 2] - points[index, :2] @ plane[:2] - plane[2]) ** 2).mean())

    while True:
        best = None
        for i, j in sorted(allowed):
            in_i, in_j = members(i), members(j)
            own_i, own_j, both = plane_of(in_i), plane_of(in_j), plane_of(np.union1d(in_i, in_j))
            normals = [np.append(-p[:2], 1) / math.sqrt(1 + p[0] ** 2 + p[1] ** 2) for p in (own_i, own_j)]
            widest = angle_deg if min(len(in_i), len(in_j)) >= small else 2 * angle_deg
            if normals[0] @ normals[1] < math.cos(math.radians(widest)):
                continue
            extra = max(
                0.0,
                mean_square(in_i, both) - mean_square(in_i, own_i),
                mean_square(in_j, both) - mean_square(in_j, own_j),
            )
            residual = math.sqrt(extra / (1 + both[0] ** 2 + both[1] ** 2))
            if residual < limit_m and (best is None or (residual, i, j) < best):
                best = residual, i, j
        if best is None:
            return {k: sorted(group) for k, group in groups.items()}
        _, i, j = best
        groups[i] += groups.pop(j)
        allowed = {tuple(sorted((i if a == j else a, i if b == j else b))) for a, b in allowed if {a, b} != {i, j}}


def strips(seed: int, pieces: int = 8, noise: float = 0.03) -> tuple[FloatArray, LabelArray]:
    """A gable cut into pieces along the ridge: points and labels; even labels on one side."""
    random = np.random.default_rng(seed)
    points = np.column_stack([random.uniform(0, 16, 600), random.uniform(-4, 4, 600), np.zeros(600)])
    points[:, 2] = 9 - 0.5 * np.abs(points[:, 1]) + random.normal(0, noise, 600)
    labels = 2 * (points[:, 0] / 16 * pieces).astype(np.int32) + (points[:, 1] > 0)
    return points, labels.astype(np.int32)


@pytest.mark.parametrize("seed", range(4))
def test_merging_in_a_queue_equals_merging_by_brute_force(seed: int) -> None:
    points, labels = strips(seed, noise=0.08)
    sums = cluster_sums(points, labels, 16)
    pairs = touching_pairs(nearest_neighbours(points, 9), labels, np.ones(16, np.bool_))
    expected = brute_force(points, labels, [(int(p) // 16, int(p) % 16) for p in pairs], 0.1, 12.0, 15)
    root, _ = merge_planes(sums, fit(sums), pairs, 0.1, 12.0, 15, ALWAYS)
    found = {int(r): np.flatnonzero(root == r).tolist() for r in np.unique(root)}
    assert found == expected


def test_the_pieces_of_a_gable_become_its_two_sides() -> None:
    points, labels = strips(1)
    sums = cluster_sums(points, labels, 16)
    planes = fit(sums)
    pairs = touching_pairs(nearest_neighbours(points, 9), labels, np.ones(16, np.bool_))
    root, work = merge_planes(sums, planes, pairs, 0.1, 12.0, 15, ALWAYS)
    assert root.tolist() == [0, 1] * 8
    assert work >= 14
    np.testing.assert_allclose(planes[:2], [[0, 0.5, 9], [0, -0.5, 9]], atol=0.02)
    assert sums[:2, 0].sum() == 600


def test_clusters_without_a_common_pair_stay_apart_and_limited_work_ends_and_says_so() -> None:
    points, labels = strips(1)
    sums = cluster_sums(points, labels, 16)
    pairs = touching_pairs(nearest_neighbours(points, 9), labels, np.ones(16, np.bool_))
    root, work = merge_planes(sums.copy(), fit(sums), np.empty(0, np.int64), 0.1, 12.0, 15, ALWAYS)
    assert (root.tolist(), work) == (list(range(16)), 0)
    assert merge_planes(sums, fit(sums), pairs, 0.1, 12.0, 15, 5)[1] > 5


def test_a_step_of_parallel_planes_does_not_merge() -> None:
    points, labels = strips(1, pieces=2, noise=0.0)
    points[:, 2] = np.where(labels >= 2, 5.0, 5.5)
    sums = cluster_sums(points, labels, 4)
    pairs = touching_pairs(nearest_neighbours(points, 9), labels, np.ones(4, np.bool_))
    root, _ = merge_planes(sums, fit(sums), pairs, 0.1, 12.0, 15, ALWAYS)
    assert root.tolist() == [0, 0, 2, 2]


@pytest.mark.parametrize("seed", range(4))
def test_touching_pairs_are_those_among_neighbours(seed: int) -> None:
    random = np.random.default_rng(seed)
    points = random.uniform(0, 10, (150, 3))
    labels = random.integers(-1, 12, 150).astype(np.int32)
    usable = random.random(12) < 0.8
    neighbours = nearest_neighbours(points, 5)
    expected = set()
    for i in range(150):
        around = {int(labels[j]) for j in [i, *neighbours[i].tolist()] if labels[j] >= 0 and usable[labels[j]]}
        expected |= {a * 12 + b for a in around for b in around if a < b}
    assert touching_pairs(neighbours, labels, usable).tolist() == sorted(expected)


@pytest.mark.parametrize("reach_m", [0.5, 3.0, 100.0])
def test_pairs_in_reach_are_those_of_near_boxes_and_parallel_planes(reach_m: float) -> None:
    random = np.random.default_rng(4)
    centre = random.uniform(0, 60, (30, 2))
    labels = np.repeat(np.arange(30), 20).astype(np.int32)
    points = np.column_stack([centre[labels] + random.uniform(-2, 2, (600, 2)), np.zeros(600)])
    planes = np.column_stack([random.choice([0.0, 0.3], (30, 2)), np.zeros(30)])
    usable = random.random(30) < 0.9
    expected = []
    for i in range(30):
        for j in range(i + 1, 30):
            low = [points[labels == k, :2].min(axis=0) for k in (i, j)]
            high = [points[labels == k, :2].max(axis=0) for k in (i, j)]
            near = (low[1] <= high[0] + reach_m).all() and (low[0] <= high[1] + reach_m).all()
            if near and usable[i] and usable[j] and (planes[i] == planes[j]).all():
                expected.append(i * 30 + j)
    found, work = parallel_pairs_in_reach(points, labels, planes, usable, reach_m, math.cos(math.radians(5)), ALWAYS)
    assert found.tolist() == expected
    assert work >= len(expected)


def test_looking_for_pairs_in_reach_stops_at_its_limit() -> None:
    labels = np.repeat(np.arange(30), 3).astype(np.int32)
    points = np.zeros((90, 3))
    _, work = parallel_pairs_in_reach(points, labels, np.zeros((30, 3)), np.ones(30, np.bool_), 1.0, 0.9, 50)
    assert work == 51
