"""Thinning: one point a cell, whatever the order of the points."""

import numpy as np
import numpy.typing as npt
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.model import BoolArray
from pipeline.terrain.thinning import highest_per_cell, lowest_below

Points = npt.NDArray[np.int64]


def thinned(points: Points, preferred: BoolArray, used: BoolArray, cell_m: float = 0.5) -> npt.NDArray[np.int64]:
    x, y, z = (np.ascontiguousarray(points[:, k]) for k in range(3))
    chosen, cell = highest_per_cell(x, y, z, preferred, used, cell_m)
    assert (cell[~used] == -1).all()
    np.testing.assert_array_equal(np.unique(cell[used]), np.arange(len(chosen)))
    np.testing.assert_array_equal(cell[chosen], np.arange(len(chosen)))
    return chosen


def slow_twin(points: Points, preferred: BoolArray, used: BoolArray, cell_mm: int) -> list[tuple[int, int, int]]:
    """The winners' coordinates by (x, y), from a dict of cells."""
    cells: dict[tuple[int, int], list[tuple[bool, int, int, int]]] = {}
    for (x, y, z), wins, usable in zip(points.tolist(), preferred.tolist(), used.tolist(), strict=True):
        if usable:
            cells.setdefault((x // cell_mm, y // cell_mm), []).append((not wins, -z, y, x))
    return sorted((x, y, -minus_z) for _, minus_z, y, x in (min(members) for members in cells.values()))


rows = st.lists(
    st.tuples(st.integers(-3000, 3000), st.integers(-3000, 3000), st.integers(-3, 3), st.booleans(), st.booleans()),
    max_size=60,
)


def as_arrays(members: list[tuple[int, int, int, bool, bool]]) -> tuple[Points, BoolArray, BoolArray]:
    table = np.array(members, np.int64).reshape(-1, 5)
    return np.ascontiguousarray(table[:, :3]), table[:, 3].astype(np.bool_), table[:, 4].astype(np.bool_)


@settings(deadline=None)
@given(members=rows, cell_m=st.sampled_from([0.3, 0.5, 1.7]))
def test_it_agrees_with_a_dict_of_cells(members: list[tuple[int, int, int, bool, bool]], cell_m: float) -> None:
    points, preferred, used = as_arrays(members)
    chosen = thinned(points, preferred, used, cell_m)
    assert used[chosen].all()
    expected = slow_twin(points, preferred, used, round(cell_m * 1000))
    assert [tuple(p) for p in points[chosen].tolist()] == expected


@settings(deadline=None, max_examples=examples(30))
@given(members=rows, seed=st.integers(0, 1000))
def test_the_order_of_the_points_does_not_matter(members: list[tuple[int, int, int, bool, bool]], seed: int) -> None:
    points, preferred, used = as_arrays(members)
    order = np.random.default_rng(seed).permutation(len(points))
    first = points[thinned(points, preferred, used)]
    again = points[order][thinned(points[order], preferred[order], used[order])]
    np.testing.assert_array_equal(again, first)


@settings(deadline=None, max_examples=examples(30))
@given(members=rows)
def test_the_result_is_sorted_and_no_position_repeats(members: list[tuple[int, int, int, bool, bool]]) -> None:
    points, preferred, used = as_arrays(members)
    positions = [tuple(p) for p in points[thinned(points, preferred, used)][:, :2].tolist()]
    assert positions == sorted(set(positions))


def test_the_highest_of_a_cell_is_chosen_unless_another_is_preferred() -> None:
    points = np.array([[100, 100, 500], [200, 200, 900], [300, 300, 100]])
    nothing, everything = np.zeros(3, np.bool_), np.ones(3, np.bool_)
    assert thinned(points, nothing, everything).tolist() == [1]
    assert thinned(points, np.array([False, False, True]), everything).tolist() == [2]
    assert thinned(points, np.array([True, False, True]), everything).tolist() == [0]
    assert thinned(points, nothing, np.array([True, False, True])).tolist() == [0]


def test_equal_heights_are_decided_south_then_west() -> None:
    points = np.array([[100, 200, 7], [50, 100, 7], [40, 100, 7]])
    nothing, everything = np.zeros(3, np.bool_), np.ones(3, np.bool_)
    assert thinned(points, nothing, everything).tolist() == [2]


def test_of_points_at_one_place_the_greater_among_equals_is_chosen_whatever_their_order() -> None:
    points = np.array([[40, 100, 7], [40, 100, 7], [40, 100, 7], [300, 300, 9], [300, 300, 2]])
    nothing, everything = np.zeros(5, np.int8), np.ones(5, np.bool_)
    rank = np.array([0, 1, 0, 0, 1], np.int8)
    for used, expected in ((np.array([True, True, True, False, False]), (7, 1)), (everything, (9, 0))):
        for order in (np.arange(5), np.array([1, 0, 2, 4, 3]), np.array([2, 4, 0, 3, 1])):
            x, y, z = (np.ascontiguousarray(points[order, k]) for k in range(3))
            (chosen,), _ = highest_per_cell(x, y, z, nothing, used[order], 0.5, rank[order])
            assert (z[chosen], rank[order][chosen]) == expected


def test_cells_are_half_open_and_anchored_at_the_origin_of_the_crs() -> None:
    points = np.array([[-1, 0, 1], [0, 0, 2], [499, 499, 3], [500, 0, 4]])
    nothing, everything = np.zeros(4, np.bool_), np.ones(4, np.bool_)
    assert thinned(points, nothing, everything).tolist() == [0, 2, 3]


def test_a_shift_by_whole_cells_chooses_the_same_points() -> None:
    random = np.random.default_rng(2)
    points = random.integers(-20_000, 20_000, (5000, 3))
    preferred, used = random.random(5000) < 0.1, random.random(5000) < 0.8
    chosen = thinned(points, preferred, used)
    shifted = thinned(points + np.array([84_000_500, -447_000_500, 13]), preferred, used)
    np.testing.assert_array_equal(shifted, chosen)


def test_a_cloud_sparser_than_the_cells_passes_unchanged() -> None:
    lattice = np.stack(np.meshgrid(np.arange(20), np.arange(20)), -1).reshape(-1, 2) * 700
    points = np.column_stack((lattice, np.arange(400))).astype(np.int64)
    nothing, everything = np.zeros(400, np.bool_), np.ones(400, np.bool_)
    assert sorted(thinned(points, nothing, everything).tolist()) == list(range(400))


def test_where_nothing_may_be_chosen_nothing_is() -> None:
    points = np.array([[0, 0, 0], [5000, 0, 0]])
    nothing = np.zeros(2, np.bool_)
    assert thinned(points, nothing, nothing).shape == (0,)
    assert thinned(np.empty((0, 3), np.int64), nothing[:0], nothing[:0]).shape == (0,)


@settings(deadline=None, max_examples=examples(30))
@given(members=rows, cell_m=st.sampled_from([0.5, 1.7]), seed=st.integers(0, 1000))
def test_the_lowest_of_each_cell_is_that_of_a_walk_over_all_points(
    members: list[tuple[int, int, int, bool, bool]], cell_m: float, seed: int
) -> None:
    points, stands, used = as_arrays(members)
    points = points[np.random.default_rng(seed).permutation(len(points))]
    stands &= used
    x, y, z = (np.ascontiguousarray(points[:, k]) for k in range(3))
    chosen, of_point = highest_per_cell(x, y, z, np.zeros(len(points), np.bool_), used, cell_m)
    lowest = lowest_below(x, y, z, stands, chosen, of_point, 0.002)
    cell_mm = round(cell_m * 1000)
    for top, found in zip(chosen.tolist(), lowest.tolist(), strict=True):
        cell = x[top] // cell_mm, y[top] // cell_mm
        near = [i for i in range(len(x)) if (x[i] // cell_mm, y[i] // cell_mm) == cell and z[i] >= z[top] - 2]
        among = [(z[i], y[i], x[i]) for i in near if stands[i] or i == top]
        assert (z[found], y[found], x[found]) == min(among)
