"""The compiled toolkit against slow scalar twins: sets, sorting, heaps, orientation, normal equations."""

import heapq
import itertools
import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.compiler import kernel
from pipeline.geometry import bounds_of
from pipeline.kernels.exact_sum import exact_sum
from pipeline.kernels.heap import heap_pop, heap_push, heap_with_room
from pipeline.kernels.normal_equations import moments_of, solve_plane_moments
from pipeline.kernels.orientation import (
    comes_before,
    in_cone,
    lies_between,
    same_place,
    same_ray,
    segments_meet,
    turn_of,
)
from pipeline.kernels.sorting import ascending_order, counting_sort, in_order, radix_order, sort_few
from pipeline.kernels.union_find import numbered_sets, root_of, unite, united
from pipeline.model import FloatArray

PAIRS = st.lists(st.tuples(st.integers(0, 11), st.integers(0, 11)), max_size=20)


@given(PAIRS)
@settings(deadline=None)
def test_sets_are_those_of_labels_that_spread_along_all_pairs(pairs: list[tuple[int, int]]) -> None:
    label = list(range(12))
    parent = np.arange(12)
    for a, b in pairs:
        assert unite(parent, a, b) == (label[a] != label[b])
        low, high = sorted((label[a], label[b]))
        label = [low if one == high else one for one in label]
    assert [root_of(parent, node) for node in range(12)] == label
    one, other = np.array(pairs, np.int64).reshape(-1, 2).T
    assert united(12, one, other).tolist() == label
    sets, count = numbered_sets(parent)
    number = {root: k for k, root in enumerate(sorted(set(label)))}
    assert sets.tolist() == [number[one] for one in label]
    assert count == len(number)


@given(st.lists(st.integers(-(2**62), 2**62) | st.integers(0, 3), max_size=60))
@settings(deadline=None)
def test_whole_numbers_are_sorted_and_ties_keep_their_order(values: list[int]) -> None:
    keys = np.array(values, np.int64)
    assert ascending_order(keys).tolist() == sorted(range(len(values)), key=values.__getitem__)
    assert in_order(keys).tolist() == sorted(values)


@given(st.lists(st.integers(0, 2**63 - 1) | st.integers(0, 3) | st.integers(2000, 5000), max_size=60))
@settings(deadline=None)
def test_radix_sort_keeps_the_order_of_ties(values: list[int]) -> None:
    keys = np.array(values, np.int64)
    assert radix_order(keys).tolist() == sorted(range(len(values)), key=values.__getitem__)
    assert keys.tolist() == values


@given(st.lists(st.tuples(st.integers(-(2**62), 2**62), st.integers(-3, 3)), min_size=1, max_size=20))
@settings(deadline=None)
def test_bounds_are_the_lowest_and_the_highest_of_each_column(places: list[tuple[int, int]]) -> None:
    xy = np.array(places, np.int64)
    low, high = bounds_of(xy)
    assert low.tolist() == xy.min(axis=0).tolist()
    assert high.tolist() == xy.max(axis=0).tolist()


@given(st.lists(st.floats() | st.sampled_from([0.0, 1.0, math.inf, math.nan]), max_size=60))
@settings(deadline=None)
def test_floats_are_sorted_as_numpy_sorts_them_with_nan_at_the_end(values: list[float]) -> None:
    keys = np.array(values, np.float64)
    assert ascending_order(keys).tolist() == np.argsort(keys, kind="stable").tolist()
    np.testing.assert_array_equal(in_order(keys), np.sort(keys))


@given(st.lists(st.floats(-1e300, 1e300) | st.sampled_from([1.0, 2.0**53, 2.0**-53, -(2.0**-53), -1e16]), max_size=60))
@settings(deadline=None)
def test_a_sum_is_rounded_once_as_by_fsum(values: list[float]) -> None:
    assert exact_sum(np.array(values, np.float64)) == math.fsum(values)


def test_a_sum_of_many_parts_that_do_not_overlap_is_exact() -> None:
    rng = np.random.default_rng(5)
    values = rng.uniform(0.5, 1.5, 2000) * 2.0 ** np.linspace(-1000.0, 900.0, 2000) * rng.choice([-1.0, 1.0], 2000)
    assert exact_sum(values) == math.fsum(values)


@given(st.lists(st.floats(-10.0, 10.0), max_size=100))
@settings(deadline=None)
def test_a_few_values_are_sorted_where_they_are(values: list[float]) -> None:
    own = np.array([0.0, *values, 0.0])
    _sorted_inside(own)
    assert own.tolist() == [0.0, *sorted(values), 0.0]


@kernel
def _sorted_inside(values: FloatArray) -> None:
    sort_few(values[1:-1])


@given(st.lists(st.integers(-2, 6), max_size=40))
@settings(deadline=None)
def test_members_are_listed_by_their_keys_and_those_without_a_key_left_out(keys: list[int]) -> None:
    starts, members = counting_sort(np.array(keys, np.int32), 7)
    assert len(members) == starts[7] == sum(key >= 0 for key in keys)
    for key in range(7):
        assert members[starts[key] : starts[key + 1]].tolist() == [i for i, own in enumerate(keys) if own == key]


@given(st.lists(st.none() | st.tuples(st.sampled_from([0.0, 0.5, 1.0, -3.0]), st.integers(-5, 5)), max_size=120))
@settings(deadline=None)
def test_a_heap_gives_its_entries_by_key_and_rank_and_grows(steps: list[tuple[float, int] | None]) -> None:
    heap, held = heap_with_room(2), 0
    twin: list[tuple[float, int]] = []
    for number, step in enumerate(steps):
        if step is not None:
            heap, held = heap_push(heap, held, step[0], step[1], number), held + 1
            heapq.heappush(twin, step)
        elif twin:
            assert (heap.keys[0], heap.ranks[0]) == heapq.heappop(twin)
            assert steps[heap.items[0]] == (heap.keys[0], heap.ranks[0])
            heap_pop(heap, held)
            held -= 1
        assert held == len(twin)


GRID = np.array(list(itertools.product(range(3), repeat=2)))


def test_segments_on_a_grid_meet_where_shapely_says_so() -> None:
    lines = [(a, b) for a, b in itertools.product(range(9), repeat=2)]
    shapes = [shapely.Point(GRID[a]) if a == b else shapely.LineString(GRID[[a, b]]) for a, b in lines]
    for (line, shape), (other, shape_of_other) in itertools.product(zip(lines, shapes, strict=True), repeat=2):
        assert segments_meet(GRID, *line, *other) == shape.intersects(shape_of_other), (line, other)


def test_turns_rays_and_places_between_are_those_of_the_angles() -> None:
    for a, b, c in itertools.product(range(9), repeat=3):
        (bx, by), (cx, cy) = GRID[b] - GRID[a], GRID[c] - GRID[a]
        turn = turn_of(GRID, a, b, c)
        assert turn == bx * cy - by * cx == turn_of(GRID, b, c, a)
        assert same_place(GRID, a, b) == (a == b)
        if a not in (b, c):
            apart = math.atan2(by, bx) - math.atan2(cy, cx)
            assert same_ray(GRID, a, b, c) == (abs(apart) < 1e-9)
        if turn == 0:
            between = shapely.LineString(GRID[[a, b]]).distance(shapely.Point(GRID[c])) == 0.0
            assert lies_between(GRID, a, b, c) == between


def test_a_way_starts_inside_a_polygon_where_its_first_steps_lie_in_it() -> None:
    for before, node, after, target in itertools.permutations(range(9), 4):
        if turn_of(GRID, before, node, after) == 0:
            continue
        angles = [math.atan2(*(GRID[k] - GRID[node])[::-1]) for k in (after, target, before)]
        # from the edge that leaves to the left up to the one that came in
        wide, own = ((angle - angles[0]) % (2.0 * math.pi) for angle in (angles[2], angles[1]))
        is_on_edge = min(own, 2.0 * math.pi - own, abs(own - wide)) < 1e-9
        assert in_cone(GRID, before, node, after, target) == (own < wide and not is_on_edge)


def test_points_come_in_the_order_of_their_coordinates() -> None:
    points = np.array(list(itertools.product(range(2), repeat=3)))
    for a, b in itertools.product(range(8), repeat=2):
        assert comes_before(points, a, b) == (a < b)


@pytest.mark.parametrize("seed", range(5))
def test_moments_give_the_plane_that_lstsq_finds(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = np.column_stack((rng.uniform(0.0, 9.0, (50, 2)), rng.normal(0.0, 2.0, 50)))
    index = rng.permutation(50)[:30].astype(np.int32)
    chosen = points[index]
    found = moments_of(points, index)
    off = chosen - chosen.mean(axis=0)
    np.testing.assert_allclose(found[:3], chosen.mean(axis=0))
    products = [(off[:, p] * off[:, q]).sum() for p, q in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2))]
    np.testing.assert_allclose(found[3:], products)
    expected = np.linalg.lstsq(off[:, :2], off[:, 2], rcond=None)[0]
    np.testing.assert_allclose(solve_plane_moments(*found[3:]), expected)


def test_points_on_a_line_in_plan_give_the_plane_that_is_level_across_it() -> None:
    points = np.array([(t, 2.0 * t, 5.0 * t) for t in range(4)], np.float64)
    found = moments_of(points, np.arange(4, dtype=np.int32))
    np.testing.assert_allclose(solve_plane_moments(*found[3:]), (1.0, 2.0))
    assert solve_plane_moments(0.0, 0.0, 0.0, 0.0, 0.0) == (0.0, 0.0)
