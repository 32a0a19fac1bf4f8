"""Lines through ragged borders."""

import itertools
import math

import numpy as np
import pytest
import shapely
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.roof.lines import Run, corners, crossing, dominant_direction, fitted_run, merge, projected, split, square


def along(x: float, y: float, direction: float, length: float = 1000.0) -> Run:
    return Run(first=0, last=1, x=x, y=y, direction=direction, length=length)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=examples(30), deadline=None)
def test_a_fitted_line_is_that_of_the_densely_sampled_border(seed: int) -> None:
    rng = np.random.default_rng(seed)
    border = np.cumsum(rng.uniform(-300, 1000, (8, 2)), axis=0)
    run = fitted_run(border, 1, 6)
    dense = []
    for a, b in itertools.pairwise(border[1:7]):
        n = max(1, round(math.dist(a, b)))
        dense.append(a + (np.arange(n) + 0.5)[:, None] / n * (b - a))
    points = np.concatenate(dense)
    centred = points - points.mean(axis=0)
    main = np.linalg.svd(centred, full_matrices=False)[2][0]
    assert [run.x, run.y] == pytest.approx(points.mean(axis=0), abs=2.0)
    assert abs(math.cos(run.direction) * main[1] - math.sin(run.direction) * main[0]) < 0.01
    assert run.length == pytest.approx(math.dist(border[1], border[6]))


def test_a_stretch_without_length_has_a_line_all_the_same() -> None:
    assert fitted_run(np.zeros((3, 2)), 0, 2).length == 0.0


def test_a_zigzag_is_one_run_and_a_corner_two() -> None:
    x = np.arange(0, 10_001, 250.0)
    zigzag = np.column_stack((x, 200.0 * (-1.0) ** np.arange(len(x))))
    runs = merge(zigzag, split(zigzag, 150.0, closed=False), 260.0, closed=False)
    assert len(runs) == 1
    assert math.sin(runs[0].direction) == pytest.approx(0.0, abs=0.01)
    bent = np.vstack((zigzag, [[10_000.0, y] for y in np.arange(500.0, 8001.0, 500.0)]))
    assert len(merge(bent, split(bent, 150.0, closed=False), 260.0, closed=False)) == 2


@given(st.integers(0, 2**32 - 1), st.booleans())
@settings(max_examples=examples(60), deadline=None)
def test_a_border_is_split_where_the_simplified_one_has_its_vertices(seed: int, closed: bool) -> None:
    rng = np.random.default_rng(seed)
    border = rng.permutation(400)[:40].reshape(20, 2).astype(np.float64)
    path = shapely.LineString([*border, border[0]] if closed else border)
    runs = split(border, 80.0, closed=closed)
    kept = shapely.get_coordinates(shapely.simplify(path, 80.0, preserve_topology=False))
    if runs:
        assert border[[run.first for run in runs]].tolist() == kept[:-1].tolist()
        assert [run.last for run in runs[:-1]] == [run.first for run in runs[1:]]
    else:
        assert closed
        assert len(kept) < 4


def test_a_closed_border_keeps_three_runs() -> None:
    angle = np.linspace(0, math.tau, 40, endpoint=False)
    circle = 1000.0 * np.column_stack((np.cos(angle), np.sin(angle)))
    runs = merge(circle, split(circle, 50.0, closed=True), 1e9, closed=True)
    assert len(runs) == 3
    assert sum(run.last - run.first for run in runs) == 40


def test_exact_runs_are_neither_merged_nor_turned() -> None:
    border = np.array([[0.0, 0.0], [500.0, 5.0], [1000.0, 0.0]])
    runs = [fitted_run(border, 0, 1), fitted_run(border, 1, 2)]
    runs[0].exact = True
    direction = runs[0].direction
    assert len(merge(border, runs, 1e6, closed=False)) == 2
    square(runs, 0.0, 0.5, 1.0)
    assert (runs[0].direction, runs[1].direction) == (direction, 0.0)


def test_the_dominant_direction_is_modulo_a_right_angle() -> None:
    runs = [along(0, 0, 0.3), along(0, 0, 0.3 + math.pi / 2), along(0, 0, 0.3 - math.pi)]
    assert dominant_direction(runs) == pytest.approx(0.3)
    assert dominant_direction([along(0, 0, 0.0), along(0, 0, math.pi / 4)]) is None
    assert dominant_direction([]) is None


def test_lines_cross_where_they_should_and_parallel_ones_nowhere() -> None:
    assert crossing(along(0, 5, 0.0), along(3, 0, math.pi / 2)) == pytest.approx((3.0, 5.0))
    assert crossing(along(0, 5, 0.0), along(0, 9, 0.1)) is None
    assert projected((3.0, 4.0), along(0, 0, 0.0)) == (3.0, 0.0)


def test_parallel_neighbours_are_joined_by_a_square_step() -> None:
    border = np.array([[0.0, 0.0], [1000.0, 0.0], [1000.0, 400.0], [2000.0, 400.0]])
    runs = [fitted_run(border, 0, 1), fitted_run(border, 2, 3)]
    runs[1].first = 1
    step = np.array(corners(border, runs, 100.0, closed=False))
    assert step == pytest.approx(np.array([[1000.0, 0.0], [1000.0, 400.0]]))
