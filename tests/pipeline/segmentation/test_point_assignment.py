"""Assignment of points and dissolution of redundant planes against loops over all points and planes."""

import math

import numpy as np
import pytest

from pipeline.geometry import nearest_neighbours
from pipeline.model import BoolArray, FloatArray, LabelArray
from pipeline.segmentation.plane_refinement import nearest_plane
from pipeline.segmentation.point_votes import (
    dissolve_redundant,
    distance_to_plane,
    touching_pairs,
    vote_among_neighbours,
)


def scene(seed: int) -> tuple[FloatArray, LabelArray, FloatArray, BoolArray, LabelArray]:
    """Points near a few planes with labels at random among the near ones, and which planes are usable."""
    random = np.random.default_rng(seed)
    planes = np.column_stack([random.uniform(-0.5, 0.5, (5, 2)), random.uniform(4, 5, 5)])
    points = random.uniform(0, 4, (120, 3))
    which = random.integers(0, 5, 120)
    points[:, 2] = (planes[which, :2] * points[:, :2]).sum(axis=1) + planes[which, 2] + random.normal(0, 0.08, 120)
    labels = np.where(random.random(120) < 0.3, -1, which).astype(np.int32)
    return points, nearest_neighbours(points, 6), planes, random.random(5) < 0.8, labels


def distance(point: FloatArray, plane: FloatArray) -> float:
    normal = np.array([-plane[0], -plane[1], 1.0])
    return float(abs((point - [0, 0, plane[2]]) @ normal) / math.sqrt(normal @ normal))


@pytest.mark.parametrize("seed", range(5))
def test_one_pass_of_votes_equals_a_loop_over_points_and_planes(seed: int) -> None:
    points, neighbours, planes, usable, labels = scene(seed)
    expected = []
    for i, point in enumerate(points):
        costs = {}
        for j in [i, *neighbours[i].tolist()]:
            k = int(labels[j])
            if k < 0 or not usable[k] or distance(point, planes[k]) > 0.2:
                continue
            votes = sum(int(labels[q]) == k for q in neighbours[i].tolist())
            costs[k] = (distance(point, planes[k]) / 0.2) ** 2 - 0.04 * votes
        expected.append(min(costs, key=lambda k, c=costs: (c[k], k)) if costs and min(costs.values()) < 1 else -1)
    found = vote_among_neighbours(points, neighbours, labels, planes, usable, 0.2, 0.04, 1)
    assert found.tolist() == expected


@pytest.mark.parametrize("seed", range(5))
def test_further_passes_are_one_pass_after_the_other(seed: int) -> None:
    points, neighbours, planes, usable, labels = scene(seed)
    step = labels
    for _ in range(3):
        step = vote_among_neighbours(points, neighbours, step, planes, usable, 0.2, 0.04, 1)
    assert vote_among_neighbours(points, neighbours, labels, planes, usable, 0.2, 0.04, 3).tolist() == step.tolist()


@pytest.mark.parametrize("seed", range(5))
def test_the_nearest_plane_is_that_of_a_loop(seed: int) -> None:
    points, _, planes, usable, _ = scene(seed)
    for i, label in enumerate(nearest_plane(points, planes, usable, 0.2).tolist()):
        distances = {k: distance(points[i], planes[k]) for k in range(5) if usable[k]}
        nearest = min(distances, key=lambda k, d=distances: d[k])
        assert label == (nearest if distances[nearest] <= 0.2 else -1)
        assert distance_to_plane(points, i, planes, nearest) == pytest.approx(distances[nearest], abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_redundant_planes_are_those_a_loop_gives_up(seed: int) -> None:
    points, neighbours, planes, usable, labels = scene(seed)
    labels = np.where(labels >= 0, np.where(usable[labels], labels, -1), -1).astype(np.int32)
    pairs = [divmod(int(code), 5) for code in touching_pairs(neighbours, labels, usable)]
    partners = {k: {a + b - k for a, b in pairs if k in (a, b)} for k in range(5)}
    expected = usable.copy()
    relabelled = labels.copy()
    for k in sorted(range(5), key=lambda k: (int((labels == k).sum()), k)):
        if not expected[k] or not partners[k]:
            continue
        others = [p for p in sorted(partners[k]) if expected[p]]
        own = np.flatnonzero(labels == k)
        worth = sum(
            min([1.0, *((distance(points[i], planes[p]) / 0.2) ** 2 for p in others)])
            - min(1.0, (distance(points[i], planes[k]) / 0.2) ** 2)
            for i in own
        )
        if worth < 8.0:
            expected[k] = False
            for i in own:
                near = {p: distance(points[i], planes[p]) for p in others}
                best = min(near, key=lambda p, n=near: n[p], default=-1)
                relabelled[i] = best if best >= 0 and near[best] < 0.2 else -1
    # A point that went to a plane which is given up later is judged by its first label: compare what stays in use.
    dissolve_redundant(points, neighbours, labels, planes, usable, 0.2, 8.0, 0.0)
    assert usable.tolist() == expected.tolist()
    assert labels.tolist() == relabelled.tolist()


def test_a_cost_of_zero_gives_up_nothing() -> None:
    points, neighbours, planes, usable, labels = scene(0)
    before = usable.copy()
    dissolve_redundant(points, neighbours, labels, planes, usable, 0.2, 0.0, 0.0)
    assert usable.tolist() == before.tolist()


@pytest.mark.parametrize(("width_m", "stays"), [(0.3, False), (1.4, True)])
def test_a_slope_between_two_levels_needs_more_than_a_row_of_points(width_m: float, stays: bool) -> None:
    """Rows of points every 0.35 m: a level roof at 9 m, then a slope that rises by 0.8 m over some width."""
    x, y = (values.ravel() for values in np.meshgrid(np.arange(0.0, 10.0, 0.35), np.arange(-5.0, width_m + 0.01, 0.35)))
    y = y - y.max() + width_m
    points = np.column_stack([x, y, 9.0 + 0.8 / width_m * np.maximum(y, 0.0)])
    planes = np.array([[0.0, 0.0, 9.0], [0.0, 0.8 / width_m, 9.0]])
    labels = (y > -0.1).astype(np.int32)
    usable = np.ones(2, np.bool_)
    dissolve_redundant(points, nearest_neighbours(points, 8), labels, planes, usable, 0.15, 5.0, 0.5)
    assert usable.tolist() == [True, stays]
    top = np.abs(y - width_m) < 0.1
    assert (labels[top] == (1 if stays else -1)).all()


def test_a_row_of_points_stays_where_no_other_plane_is_left() -> None:
    along = np.arange(0.0, 7.0, 0.35)
    row = np.column_stack([along, np.full(20, 0.3), np.full(20, 9.8)])
    points = np.concatenate([[(k, 0.0, 9.0) for k in range(4)], row])
    planes = np.array([[0.0, 0.0, 9.0], [0.0, 0.8 / 0.3, 9.0]])
    labels = np.repeat(np.array([0, 1], np.int32), [4, 20])
    usable = np.ones(2, np.bool_)
    dissolve_redundant(points, nearest_neighbours(points, 8), labels, planes, usable, 0.15, 5.0, 0.5)
    assert usable.tolist() == [False, True]
    assert (labels == 1).all()
