"""Lines through ragged borders."""

import itertools
import math

import numpy as np
import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.roof.lines import Run, corners, crossing, fitted_run, projected


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
