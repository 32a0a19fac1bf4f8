"""Gross outliers: alone in the 27 cubes around them."""

import numpy as np
import numpy.typing as npt
import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import convolve

from pipeline.errors import SettingsError
from pipeline.model import BoolArray
from pipeline.terrain import outliers as outliers_module
from pipeline.terrain.outliers import dense_enough
from pipeline.terrain.terrain_settings import OutlierSettings

Points = npt.NDArray[np.int64]


def kept_of(points: Points, outliers: OutlierSettings | None = None) -> BoolArray:
    x, y, z = (np.ascontiguousarray(points[:, k]) for k in range(3))
    return dense_enough(x, y, z, outliers or OutlierSettings())


def slow_twin(points: Points, cube_mm: int, min_neighbours: int, min_share: float) -> list[bool]:
    """Each point against each other one, by Python's whole numbers."""
    cubes = [tuple(int(v) // cube_mm for v in p) for p in points]
    kept = []
    for a in cubes:
        column = [b for b in cubes if all(abs(u - v) <= 1 for u, v in zip(a[:2], b[:2], strict=True))]
        others = sum(abs(a[2] - b[2]) <= 1 for b in column) - 1
        fair = len(column) > min_neighbours and others >= max(1, min_share * (len(column) - 1))
        kept.append(others >= min_neighbours or fair)
    return kept


def town(random: np.random.Generator, n: int = 3000, side_mm: int = 40_000) -> Points:
    xy = random.integers(0, side_mm, (n, 2)) + np.array([84_000_000, 447_000_000])
    roof = ((xy // 10_000).sum(axis=1) % 2) * 7000
    return np.column_stack((xy, roof + random.integers(-100, 100, n))).astype(np.int64)


point_lists = st.lists(st.tuples(*[st.integers(-12_000, 12_000)] * 3), min_size=0, max_size=40)


@settings(deadline=None)
@given(
    points=point_lists,
    cube_m=st.sampled_from([1.0, 2.5, 5.0]),
    min_neighbours=st.integers(0, 5),
    min_share=st.sampled_from([0.0, 0.1, 0.5, 1.0]),
)
def test_it_agrees_with_each_point_against_each_other(
    points: list[tuple[int, int, int]], cube_m: float, min_neighbours: int, min_share: float
) -> None:
    cloud = np.array(points, np.int64).reshape(-1, 3)
    kept = kept_of(cloud, OutlierSettings(cube_m=cube_m, min_neighbours=min_neighbours, min_share=min_share))
    assert kept.tolist() == slow_twin(cloud, round(cube_m * 1000), min_neighbours, min_share)


@pytest.mark.parametrize(("n", "low_mm", "cube_m", "few"), [(6000, -60_000, 5.0, 12), (60_000, 0, 2.0, 8)])
def test_it_agrees_with_a_convolution_of_the_counts_also_where_a_table_of_many_cubes_grows(
    n: int, low_mm: int, cube_m: float, few: int
) -> None:
    cloud = np.random.default_rng(3).integers(low_mm, low_mm + 120_000, (n, 3))
    cubes = (cloud - low_mm) // round(cube_m * 1000)
    counts = np.zeros((round(120 / cube_m),) * 3, np.int64)
    np.add.at(counts, tuple(cubes.T), 1)
    assert n == 6000 or (counts > 0).sum() > 40_000
    around = convolve(counts, np.ones((3, 3, 3), np.int64), mode="constant")
    expected = around[tuple(cubes.T)] - 1 >= few
    assert 0.1 < expected.mean() < 0.9
    strict = OutlierSettings(cube_m=cube_m, min_neighbours=few, min_share=1.0)
    np.testing.assert_array_equal(kept_of(cloud, strict), expected)


def test_points_far_below_above_and_away_are_dropped_without_memory_for_the_cubes_between_and_the_town_stays() -> None:
    cloud = town(np.random.default_rng(1))
    strays = cloud[[5, 700, 1400, 2100]].copy()
    strays[:, 2] += [-180_000, 180_000, -180_000, 180_000]
    for outside in (strays, [[10**9, 10**9, 2 * 10**9]]):
        kept = kept_of(np.concatenate((cloud, outside)))
        assert kept[: len(cloud)].all()
        assert not kept[len(cloud) :].any()


def test_up_to_four_close_points_are_dropped_and_five_stay() -> None:
    five = np.column_stack((np.arange(5) * 100, np.zeros((5, 2), np.int64))).astype(np.int64)
    assert kept_of(five).all()
    for count in (1, 2, 4):
        assert not kept_of(five[:count]).any()
    assert kept_of(five[:1], OutlierSettings(min_neighbours=0)).all()


def test_three_points_in_a_sparse_tree_top_stay_where_one_above_it_is_dropped() -> None:
    ground = np.column_stack((np.arange(12) * 900, np.arange(12) * 700 % 5000, np.zeros(12))).astype(np.int64)
    top = np.array([[5000, 4000, 20_000], [6000, 5000, 21_000], [5000, 5000, 22_000]])
    bird = np.array([[5500, 4500, 60_000]])
    kept = kept_of(np.concatenate((ground, top, bird)))
    assert kept.tolist() == [True] * 15 + [False]
    assert not kept_of(np.concatenate((ground, top)), OutlierSettings(min_share=1.0))[12:].any()


@settings(deadline=None, max_examples=examples(25))
@given(points=point_lists, seed=st.integers(0, 1000), shift=st.tuples(*[st.integers(-400, 400)] * 3))
def test_neither_order_nor_a_shift_by_whole_cubes_matters(
    points: list[tuple[int, int, int]], seed: int, shift: tuple[int, int, int]
) -> None:
    cloud = np.array(points, np.int64).reshape(-1, 3)
    kept = kept_of(cloud)
    order = np.random.default_rng(seed).permutation(len(cloud))
    np.testing.assert_array_equal(kept_of(cloud[order]), kept[order])
    np.testing.assert_array_equal(kept_of(cloud + np.array(shift) * 5000), kept)


def test_the_decision_looks_no_further_than_its_support() -> None:
    random = np.random.default_rng(4)
    cloud = random.integers(-80_000, 80_000, (4000, 3))
    cloud[:, 2] //= 4
    outliers = OutlierSettings()
    near = np.abs(cloud[:, :2]).max(axis=1) <= 20_000 + 1000 * outliers.support_m
    inner = np.abs(cloud[:, :2]).max(axis=1) <= 20_000
    expected = kept_of(cloud)
    assert 0 < expected[inner].sum() < inner.sum()
    cut = np.zeros(len(cloud), np.bool_)
    cut[near] = kept_of(cloud[near])
    np.testing.assert_array_equal(cut[inner], expected[inner])


def test_no_points_give_an_empty_mask() -> None:
    kept = kept_of(np.empty((0, 3), np.int64))
    assert kept.shape == (0,)
    assert kept.dtype == np.bool_


def test_cubes_out_of_range_are_refused() -> None:
    with pytest.raises(SettingsError, match=r"cube_m is 0\.5"):
        OutlierSettings(cube_m=0.5)


@pytest.mark.parametrize("cube_m", [1.0, 3.3, 50.0])
@pytest.mark.parametrize("corner_mm", [(0, 0, 0), (84_000_000, 447_000_000, -3_000), (-7_000_000_001, 13, 1)])
def test_borders_of_cubes_are_the_same_in_an_array_and_in_a_table(
    cube_m: float, corner_mm: tuple[int, int, int]
) -> None:
    cube_mm = round(cube_m * 1000)
    random = np.random.default_rng(6)
    # at the borders, and just beside them
    cloud = random.integers(0, 9, (3000, 3)) * cube_mm + random.integers(-1, 2, (3000, 3))
    cloud += np.array(corner_mm) // cube_mm * cube_mm
    x, y, z = (np.ascontiguousarray(cloud[:, k]) for k in range(3))
    cubes = cloud // cube_mm
    low, high = cubes.min(axis=0) - 1, cubes.max(axis=0) + 1
    shape = tuple((high - low + 1).tolist())
    for few in (3, 60, 90):
        array = outliers_module._by_grid(x, y, z, cube_mm, (few, 1.0), tuple(low.tolist()), shape)
        table = outliers_module._by_table(x, y, z, cube_mm, (few, 1.0), tuple(low.tolist()))
        np.testing.assert_array_equal(array, table)
        strict = OutlierSettings(cube_m=cube_m, min_neighbours=few, min_share=1.0)
        np.testing.assert_array_equal(dense_enough(x, y, z, strict), table)
    assert not table.all()
    assert table.any()
