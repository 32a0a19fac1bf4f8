"""Ridges, hips and valleys: where they are found, and that they become straight."""

import numpy as np
import pytest

from pipeline.extras.papers.ridge_snapping import find_ridges, label_by_ridges
from pipeline.geometry import nearest_neighbours
from pipeline.model import FloatArray, LabelArray

NEAR = {"distance_m": 0.35, "reach_m": 0.8}


def two_planes(
    kind: str, seed: int = 0, swapped: float = 0.35
) -> tuple[FloatArray, FloatArray, LabelArray, LabelArray]:
    """Points on both sides of y = 0, planes, true labels, and labels with the points at the border mixed up."""
    random = np.random.default_rng(seed)
    points = np.column_stack([random.uniform(0, 12, 500), random.uniform(-4, 4, 500), np.zeros(500)])
    rise = {"ridge": 0.5, "valley": -0.5}[kind]
    planes = np.array([[0.0, rise, 8.0], [0.0, -rise, 8.0]])
    true = (points[:, 1] > 0).astype(np.int32)
    points[:, 2] = 8 - rise * np.abs(points[:, 1]) + random.normal(0, 0.03, 500)
    mixed = np.where((np.abs(points[:, 1]) < 0.25) & (random.random(500) < swapped), 1 - true, true)
    return points, planes, true, mixed.astype(np.int32)


@pytest.mark.parametrize("kind", ["ridge", "valley"])
def test_the_border_of_two_planes_becomes_exactly_their_line(kind: str) -> None:
    points, planes, true, mixed = two_planes(kind)
    assert (mixed != true).sum() > 5
    ridges = find_ridges(points, planes, mixed, nearest_neighbours(points, 9), **NEAR)
    snapped = label_by_ridges(points, planes, mixed, ridges, **NEAR)
    assert snapped.tolist() == true.tolist()


@pytest.mark.parametrize("kind", ["ridge", "valley"])
def test_a_ridge_runs_along_the_border(kind: str) -> None:
    points, planes, true, _ = two_planes(kind)
    (ridge,) = find_ridges(points, planes, true, nearest_neighbours(points, 9), **NEAR)
    assert (ridge.plane_low, ridge.plane_high, ridge.is_valley) == (0, 1, kind == "valley")
    ends = sorted([ridge.start, ridge.end])
    np.testing.assert_allclose(ends, [[0, 0], [12, 0]], atol=0.4)


def test_snapping_labels_twice_changes_nothing_more() -> None:
    points, planes, _, mixed = two_planes("ridge")
    ridges = find_ridges(points, planes, mixed, nearest_neighbours(points, 9), **NEAR)
    once = label_by_ridges(points, planes, mixed, ridges, **NEAR)
    assert label_by_ridges(points, planes, once, ridges, **NEAR).tolist() == once.tolist()


def test_points_beyond_the_reach_or_off_the_planes_keep_their_label() -> None:
    points, planes, true, _ = two_planes("ridge")
    far, lifted = int(np.argmax(points[:, 1] > 2)), int(np.argmax(np.abs(points[:, 1]) < 0.1))
    points[lifted, 2] += 1.0
    wrong = true.copy()
    wrong[far], wrong[lifted] = 1 - true[far], 1 - true[lifted]
    ridges = find_ridges(points, planes, true, nearest_neighbours(points, 9), **NEAR)
    snapped = label_by_ridges(points, planes, wrong, ridges, **NEAR)
    assert snapped[far] == wrong[far]
    assert snapped[lifted] == wrong[lifted]


def test_unlabelled_points_stay_unlabelled() -> None:
    points, planes, true, _ = two_planes("ridge")
    labels = np.where(np.arange(500) % 10 == 0, -1, true).astype(np.int32)
    ridges = find_ridges(points, planes, labels, nearest_neighbours(points, 9), **NEAR)
    assert (label_by_ridges(points, planes, labels, ridges, **NEAR)[::10] == -1).all()


def test_a_step_has_no_ridge() -> None:
    points, _, true, _ = two_planes("ridge")
    points[:, 2] = np.where(true == 1, 8.0, 6.0)
    parallel = np.array([[0.0, 0, 6], [0.0, 0, 8]])
    assert find_ridges(points, parallel, true, nearest_neighbours(points[:, :2], 9), **NEAR) == ()
    crossing_elsewhere = np.array([[0.0, 0.2, 6], [0.0, -0.2, 9]])
    assert find_ridges(points, crossing_elsewhere, true, nearest_neighbours(points[:, :2], 9), **NEAR) == ()


def test_a_hip_meets_in_five_lines() -> None:
    random = np.random.default_rng(5)
    points = np.column_stack([random.uniform(-7, 7, 900), random.uniform(-4, 4, 900), np.zeros(900)])
    planes = np.array([[0.0, -0.6, 8.4], [0.0, 0.6, 8.4], [-0.6, 0.0, 10.2], [0.6, 0.0, 10.2]])
    heights = points[:, :2] @ planes[:, :2].T + planes[:, 2]
    labels, points[:, 2] = heights.argmin(axis=1).astype(np.int32), heights.min(axis=1)
    ridges = find_ridges(points, planes, labels, nearest_neighbours(points, 9), **NEAR)
    assert [(r.plane_low, r.plane_high) for r in ridges] == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3)]
    assert not any(r.is_valley for r in ridges)
    assert label_by_ridges(points, planes, labels, ridges, **NEAR).tolist() == labels.tolist()


def test_no_planes_have_no_ridges() -> None:
    points = np.zeros((0, 3))
    assert find_ridges(points, np.zeros((0, 3)), np.zeros(0, np.int32), np.zeros((0, 9), np.int32), **NEAR) == ()
