"""Flight strips of one building that do not fit: found by the planes that both saw, and taken out of the points."""

import math
from collections.abc import Callable
from random import Random

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis.strategies import integers, randoms

from pipeline.strip_alignment import _NEAREST, _find_nearest, aligned_mm, strip_offsets_m

GABLE_SLOPE = 0.7


def gable(seed: int = 3, n: int = 300, noise_m: float = 0.03) -> np.ndarray:
    """Points of a gable roof of 16 m by 12 m with its ridge along x at y = 6."""
    random = np.random.default_rng(seed)
    x, y = random.uniform(0, 16, n), random.uniform(0, 12, n)
    z = 9.0 - GABLE_SLOPE * np.abs(y - 6.0) + random.normal(0, noise_m, n)
    points: np.ndarray = np.column_stack((x, y, z))[np.lexsort((z, y, x))]
    return points


def shifted(points: np.ndarray, other: npt.NDArray[np.bool_], shift: tuple[float, float, float]) -> np.ndarray:
    moved: np.ndarray = points + other[:, None] * np.array(shift)
    return moved


def offsets_of(points: np.ndarray, strip: npt.NDArray[np.uint16], min_offset_m: float) -> np.ndarray:
    """The offsets of points in any order."""
    order = np.lexsort(points.T[::-1])
    offsets = np.empty_like(points)
    offsets[order] = strip_offsets_m(points[order], strip[order], min_offset_m)
    return offsets


def between(offsets: np.ndarray, other: npt.NDArray[np.bool_]) -> np.ndarray:
    """Offset of the other strip from the first."""
    difference: np.ndarray = offsets[other][0] - offsets[~other][0]
    return difference


def rows(points: np.ndarray) -> npt.NDArray[np.bool_]:
    """Strips that overlap: every second row belongs to the other one."""
    odd: npt.NDArray[np.bool_] = np.floor(points[:, 1]) % 2 == 1
    return odd


def half(points: np.ndarray) -> npt.NDArray[np.bool_]:
    """Strips that only touch: their border crosses the ridge."""
    right: npt.NDArray[np.bool_] = points[:, 0] > 9.0
    return right


@pytest.mark.parametrize("strips", [rows, half])
@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.3), (0.0, 0.3, -0.4), (0.5, -0.2, 0.25)])
def test_an_offset_is_found_upwards_and_across_the_ridge(
    strips: Callable[[np.ndarray], npt.NDArray[np.bool_]], shift: tuple[float, float, float]
) -> None:
    points = gable()
    other = strips(points)
    offsets = offsets_of(shifted(points, other, shift), other.astype(np.uint16), 0.1)
    _, north, up = between(offsets, other)
    assert up == pytest.approx(shift[2], abs=0.06)
    assert north == pytest.approx(shift[1], abs=0.1)


def test_the_direction_of_the_ridge_shows_nothing_and_stays() -> None:
    points = gable()
    other = rows(points)
    offsets = offsets_of(shifted(points, other, (0.8, 0.0, 0.3)), other.astype(np.uint16), 0.1)
    assert abs(between(offsets, other)[0]) < 0.15


def test_strips_that_fit_leave_the_points_as_they_are() -> None:
    points = gable()
    for shift in ((0.0, 0.0, 0.0), (0.0, 0.0, 0.05), (0.03, 0.05, -0.03)):
        moved = shifted(points, rows(points), shift)
        assert not offsets_of(moved, rows(points).astype(np.uint16), 0.1).any()
    assert offsets_of(shifted(points, rows(points), (0.0, 0.0, 0.05)), rows(points).astype(np.uint16), 0.03).any()


def test_a_true_step_that_both_strips_saw_stays() -> None:
    points = gable()
    points[:, 2] += 0.4 * (points[:, 0] > 8.0)
    other = np.random.default_rng(1).random(len(points)) < 0.5
    assert not offsets_of(points, other.astype(np.uint16), 0.1).any()


def test_strips_over_different_roofs_show_no_offset() -> None:
    """A house and its garage, 3 m lower and flat, each seen by a strip of its own."""
    points = gable()
    other = points[:, 0] > 9.0
    points[other, 2] = 4.0 + np.random.default_rng(2).normal(0, 0.03, int(other.sum()))
    assert not offsets_of(points, other.astype(np.uint16), 0.1).any()


def test_few_points_of_a_strip_show_no_offset() -> None:
    points = gable()
    other = np.arange(len(points)) < 4
    assert not offsets_of(shifted(points, other, (0.0, 0.0, 0.5)), other.astype(np.uint16), 0.1).any()
    assert len(offsets_of(np.zeros((0, 3)), np.zeros(0, np.uint16), 0.1)) == 0


def test_the_building_stays_where_its_points_are_on_average() -> None:
    points = shifted(gable(), half(gable()), (0.0, 0.3, 0.4))
    strip = half(gable()).astype(np.uint16)
    in_mm = np.rint(points * 1e3).astype(np.int64)
    moved, _, largest_m = aligned_mm(in_mm, strip, np.zeros(len(strip), np.bool_), 0.1)
    assert moved.mean(axis=0) == pytest.approx(in_mm.mean(axis=0), abs=1.0)
    assert largest_m == pytest.approx(0.5, abs=0.08)


def test_three_strips_are_aligned_to_each_other() -> None:
    points = gable(n=450)
    strip = (np.arange(len(points)) % 3).astype(np.uint16)
    true = np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 0.3), (0.0, 0.0, -0.2)])
    offsets = offsets_of(points + true[strip], strip, 0.1)
    wanted = (true - true.mean(axis=0))[strip]
    assert np.abs(offsets - wanted)[:, 1:].max() < 0.06


def test_marks_follow_the_points_and_the_numbers_of_strips_do_not_matter() -> None:
    points = shifted(gable(), rows(gable()), (0.0, 0.3, 0.4))
    other = rows(gable())
    in_mm = np.rint(points * 1e3).astype(np.int64)
    marked = in_mm[:, 2] % 7 == 0
    moved, marks, _ = aligned_mm(in_mm, other.astype(np.uint16), marked, 0.1)
    assert np.array_equal(moved, moved[np.lexsort(moved.T[::-1])])
    assert marks.sum() == marked.sum()
    again, marks_again, _ = aligned_mm(in_mm, np.where(other, 3, 900).astype(np.uint16), marked, 0.1)
    assert np.abs(again - moved).max() <= 1
    assert np.array_equal(marks, marks_again)
    away, _, _ = aligned_mm(in_mm + np.array([85_000_000, 447_500_000, 3_000]), other.astype(np.uint16), marked, 0.1)
    assert np.array_equal(away - np.array([85_000_000, 447_500_000, 3_000]), moved)


def test_one_strip_comes_back_unchanged() -> None:
    in_mm = np.rint(gable() * 1e3).astype(np.int64)
    same, _, largest_m = aligned_mm(in_mm, np.full(len(in_mm), 5, np.uint16), np.ones(len(in_mm), np.bool_), 0.1)
    assert same is in_mm
    assert math.isnan(largest_m)


@settings(deadline=None)
@given(random=randoms(use_true_random=False), n=integers(1, 80), extent=integers(1, 12))
def test_the_nearest_points_are_those_that_a_search_through_all_finds(random: Random, n: int, extent: int) -> None:
    """On a coarse lattice most distances are equal: of equally near points the first counts."""
    points = np.array(sorted((random.randrange(extent), random.randrange(extent), 0.0) for _ in range(n)), np.float64)
    members = np.array(sorted(random.sample(range(n), random.randrange(n + 1))), np.int32)
    squares, nearest = np.empty(_NEAREST), np.zeros(_NEAREST, np.int32)
    for place in range(n):
        first = int(np.searchsorted(members, place))
        _find_nearest(points[members], first, points[place, 0], points[place, 1], squares, nearest)
        away = ((points[:, :2] - points[place, :2]) ** 2).sum(axis=1)
        found = sorted(members.tolist(), key=lambda j: (away[j], j))[:_NEAREST]
        assert members[nearest[: len(found)]].tolist() == found
        assert squares.tolist() == [*away[found].tolist(), *[math.inf] * (_NEAREST - len(found))]
