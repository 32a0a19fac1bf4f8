"""Planarity of the surroundings: roofs are planar up to their ridges and eaves, crowns are not."""

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.kernels.normal_equations import smallest_eigenvalue
from pipeline.model import KindArray
from pipeline.terrain.terrain_settings import VegetationSettings
from pipeline.terrain.vegetation import _is_planar, crowns, planarity

Points = npt.NDArray[np.int64]


def verdicts(points: Points, wanted: npt.NDArray[np.bool_] | None = None) -> KindArray:
    x, y, z = (np.ascontiguousarray(points[:, k]) for k in range(3))
    return planarity(x, y, z, np.ones(len(points), np.bool_) if wanted is None else wanted, VegetationSettings())


def in_mm(x: npt.ArrayLike, y: npt.ArrayLike, z: npt.ArrayLike) -> Points:
    metres = np.column_stack((np.asarray(x), np.asarray(y), np.asarray(z)))
    return np.asarray(np.rint(1000 * metres), dtype=np.int64)


def scattered(random: np.random.Generator, side_m: float, per_m2: float) -> npt.NDArray[np.float64]:
    return random.uniform(0, side_m, (round(side_m * side_m * per_m2), 2))


def flat(random: np.random.Generator, per_m2: float) -> Points:
    xy = scattered(random, 10.0, per_m2)
    return in_mm(xy[:, 0], xy[:, 1], np.zeros(len(xy)))


def slow_twin(points: Points, index: int, vegetation: VegetationSettings) -> int:
    """Nine windows at three scales, eigenvalues by numpy."""
    for scale in range(3):
        radius = round(vegetation.radius_m * 1000) * 2**scale
        shift, diagonal = 4 * radius // 5, 566 * radius // 1000
        offset = points - points[index]
        offset = offset[np.abs(offset[:, 2]) <= vegetation.level_m * 1000]
        eigenvalues = []
        for k, (u, v) in enumerate([(0, 0), (1, 0), (0, 1), (-1, 0), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)]):
            step = diagonal if k > 4 else shift
            members = offset[(offset[:, 0] - u * step) ** 2 + (offset[:, 1] - v * step) ** 2 <= radius * radius]
            if len(members) >= vegetation.min_neighbours:
                eigenvalues.append(np.linalg.eigvalsh(np.cov(members.T.astype(np.float64), bias=True))[0])
            elif k == 0:
                break
        else:
            planar, smooth = (limit * 1000 * 1.5**scale for limit in (vegetation.roughness_m, vegetation.smooth_m))
            return 2 if eigenvalues[0] <= smooth * smooth else int(min(eigenvalues) <= planar * planar)
    return -1


def crown(random: np.random.Generator, n: int) -> Points:
    """A volume of returns, 6 m wide and 5 m high, at about 12 points/m2."""
    inside: list[npt.NDArray[np.float64]] = []
    while len(inside) < n:
        p = random.uniform(-1, 1, 3)
        if p @ p <= 1:
            inside.append(p)
    return in_mm(*(np.array(inside) * [3.0, 3.0, 2.5] + [50.0, 50.0, 8.0]).T)


@settings(deadline=None)
@given(
    values=st.lists(st.floats(-100, 100), min_size=9, max_size=9),
    stretch=st.sampled_from([1e-3, 1.0, 1e3]),
    rank=st.integers(1, 3),
)
def test_the_smallest_eigenvalue_is_that_of_numpy(values: list[float], stretch: float, rank: int) -> None:
    factor = np.array(values).reshape(3, 3) * stretch
    factor[:, rank:] = 0.0
    m = factor @ factor.T
    expected = float(np.linalg.eigvalsh(m)[0])
    found = smallest_eigenvalue(m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], m[2, 2])
    assert found >= 0.0
    assert found == pytest.approx(max(0.0, expected), abs=1e-7 * float(np.trace(m)) + 1e-12)


@pytest.mark.parametrize("diagonal", [(3.0, 1.0, 2.0), (5.0, 5.0, 0.0), (7.0, 0.0, 0.0), (2.0, 2.0, 2.0)])
def test_the_smallest_eigenvalue_of_a_diagonal_is_its_smallest_entry(diagonal: tuple[float, float, float]) -> None:
    a, b, c = diagonal
    assert smallest_eigenvalue(a, 0.0, 0.0, b, 0.0, c) == pytest.approx(min(diagonal), abs=1e-7)


@settings(deadline=None)
@given(
    values=st.lists(st.floats(-100, 100), min_size=9, max_size=9),
    stretch=st.sampled_from([1e-3, 1.0, 1e3]),
    rank=st.integers(1, 3),
)
def test_planar_is_what_varies_little_across_some_plane(values: list[float], stretch: float, rank: int) -> None:
    factor = np.array(values).reshape(3, 3) * stretch
    factor[:, rank:] = 0.0
    m = factor @ factor.T
    across, scale = float(np.linalg.eigvalsh(m)[0]), float(np.trace(m)) + 1e-9
    # ten points whose mean is (1, -2, 3)
    moments = m + np.outer([1, -2, 3], [1, -2, 3])
    sums = (10.0, 10.0, -20.0, 30.0, *(10.0 * moments[np.triu_indices(3)]))
    assert _is_planar(sums, across + 1e-6 * scale)
    assert not _is_planar(sums, across - 1e-6 * scale)


@pytest.mark.parametrize("per_m2", [0.3, 1.0, 4.0, 40.0])
def test_the_verdict_is_that_of_a_slow_twin(per_m2: float) -> None:
    random = np.random.default_rng(round(10 * per_m2))
    xy = scattered(random, 16.0, per_m2)
    z = 0.4 * np.abs(xy[:, 0] - 8.0) + np.where(xy[:, 1] > 8, random.normal(0, 0.25, len(xy)), 0.0)
    points = in_mm(xy[:, 0], xy[:, 1], z)
    found = verdicts(points)
    chosen = random.choice(len(points), 60, replace=False)
    expected = [slow_twin(points, int(i), VegetationSettings()) for i in chosen]
    assert found[chosen].tolist() == expected
    assert len(set(expected)) >= 2


@pytest.mark.parametrize("per_m2", [1.0, 4.0])
def test_no_planar_window_is_lost_where_the_points_that_two_windows_share_are_rough(per_m2: float) -> None:
    # about as rough as a planar window may be: some windows pass whose parts do not
    random = np.random.default_rng(15)
    xy = scattered(random, 16.0, per_m2)
    points = in_mm(xy[:, 0], xy[:, 1], random.normal(0, 0.16 if per_m2 > 2 else 0.3, len(xy)))
    found = verdicts(points)
    expected = [slow_twin(points, k, VegetationSettings()) for k in range(len(points))]
    assert found.tolist() == expected
    assert expected.count(0) > 20
    assert expected.count(1) > 20


@pytest.mark.parametrize("slope_deg", [0.0, 20.0, 45.0, 60.0])
@pytest.mark.parametrize("noise_m", [0.0, 0.03])
def test_a_plane_is_planar_whatever_its_slope(slope_deg: float, noise_m: float) -> None:
    random = np.random.default_rng(1)
    xy = scattered(random, 14.0, 4.0)
    z = math.tan(math.radians(slope_deg)) * xy[:, 0] + random.normal(0, noise_m, len(xy))
    assert (verdicts(in_mm(xy[:, 0], xy[:, 1], z)) >= 1).mean() > 0.99


@pytest.mark.parametrize("per_m2", [1.0, 4.0, 16.0])
def test_a_ridge_of_35_degrees_is_planar_on_both_sides_and_on_top(per_m2: float) -> None:
    random = np.random.default_rng(2)
    xy = scattered(random, 12.0, per_m2)
    z = 9.0 - math.tan(math.radians(35.0)) * np.abs(xy[:, 0] - 6.0) + random.normal(0, 0.02, len(xy))
    found = verdicts(in_mm(xy[:, 0], xy[:, 1], z))
    assert (found >= 1).mean() > 0.98
    top = np.abs(xy[:, 0] - 6.0) < 0.5
    assert (found[top] >= 1).mean() > 0.95


def test_a_crown_is_mostly_not_planar() -> None:
    found = verdicts(crown(np.random.default_rng(3), 340))
    judged = found >= 0
    assert judged.mean() > 0.9
    assert (found[judged] >= 1).mean() < 0.2


def test_more_noise_makes_less_of_a_roof_planar() -> None:
    random = np.random.default_rng(4)
    xy = scattered(random, 15.0, 4.0)
    unit = random.normal(0, 1, len(xy))
    shares = [(verdicts(in_mm(xy[:, 0], xy[:, 1], 5.0 + noise * unit)) >= 1).mean() for noise in (0.02, 0.12, 0.2, 0.5)]
    assert shares == sorted(shares, reverse=True)
    assert shares[0] > 0.99
    assert shares[-1] < 0.2


def test_a_roof_is_smooth_and_the_trimmed_top_of_a_hedge_is_planar_alone() -> None:
    random = np.random.default_rng(14)
    xy = scattered(random, 15.0, 4.0)
    unit = random.normal(0, 1, len(xy))
    roof, hedge = (verdicts(in_mm(xy[:, 0], xy[:, 1], 3.0 + noise * unit)) for noise in (0.015, 0.06))
    assert (roof == 2).mean() > 0.99
    assert (hedge == 1).mean() > 0.9


def test_only_wanted_vertices_are_judged_but_all_are_neighbours() -> None:
    random = np.random.default_rng(5)
    points = np.concatenate((flat(random, 4.0), crown(random, 340)))
    wanted = random.random(len(points)) < 0.3
    found = verdicts(points, wanted)
    assert (found[~wanted] == -1).all()
    np.testing.assert_array_equal(found[wanted], verdicts(points)[wanted])


def test_too_few_neighbours_give_no_verdict() -> None:
    five = in_mm([0, 0.2, 0.4, 0, 0.2], [0, 0, 0.1, 0.3, 0.4], np.zeros(5))
    assert (verdicts(five) == -1).all()
    assert (verdicts(np.concatenate((five, five[:1] + np.array([10, 10, 0])))) >= 1).all()
    assert verdicts(np.empty((0, 3), np.int64)).shape == (0,)


def test_neither_order_nor_a_shift_matters() -> None:
    random = np.random.default_rng(6)
    points = np.concatenate((flat(random, 2.0), crown(random, 200)))
    expected = verdicts(points)
    order = random.permutation(len(points))
    np.testing.assert_array_equal(verdicts(points[order]), expected[order])
    np.testing.assert_array_equal(verdicts(points + np.array([84_000_123, -447_000_777, 31])), expected)


def test_the_judgement_looks_no_further_than_its_support() -> None:
    random = np.random.default_rng(7)
    xy = scattered(random, 40.0, 0.4)
    points = in_mm(xy[:, 0], xy[:, 1], random.normal(0, 0.2, len(xy)))
    support_mm = 1000 * VegetationSettings().support_m
    from_centre = np.abs(points[:, :2] - 20_000).max(axis=1)
    near, inner = from_centre <= 5000 + support_mm, from_centre <= 5000
    cut = verdicts(points[near])
    np.testing.assert_array_equal(cut[inner[near]], verdicts(points)[inner])
    assert len(set(cut[inner[near]].tolist())) >= 2


def test_crowns_are_those_of_a_slow_twin() -> None:
    random = np.random.default_rng(11)
    sparse = flat(random, 0.2) + np.array([100_000, 0, 0])
    points = np.concatenate((flat(random, 3.0), crown(random, 250), sparse))
    planar = random.choice(np.array([-1, 0, 0, 1, 1], np.int8), len(points))
    several = random.random(len(points)) < 0.12
    settings = VegetationSettings()
    found = crowns(*points.T.copy(), planar, several, settings)
    expected = []
    for k, point in enumerate(points):
        distance_mm = np.sqrt(((points - point) ** 2).sum(axis=1))
        for radius_mm in (2000, 4000, 8000):
            near = (distance_mm <= radius_mm) & (planar >= 0)
            if near.sum() >= settings.min_neighbours:
                break
        rough, pierced = (planar[near] == 0).sum(), several[near].sum()
        expected.append(planar[k] >= 0 and rough > 0.5 * near.sum() and pierced > 0.1 * near.sum())
    assert found.tolist() == expected
    assert 0 < found.sum() < (planar >= 0).sum()


def test_a_tree_of_several_returns_is_a_crown_and_a_chimney_is_not() -> None:
    random = np.random.default_rng(12)
    roof = flat(random, 4.0)
    chimney = np.hypot(roof[:, 0] - 6000, roof[:, 1] - 6000) < 500
    roof[chimney, 2] += 1200
    tree = crown(random, 340) + np.array([40_000, 0, 0])
    points = np.concatenate((roof, tree))
    several = np.append(np.zeros(len(roof), np.bool_), random.random(len(tree)) < 0.4)
    found = crowns(*points.T.copy(), verdicts(points), several, VegetationSettings())
    assert not found[: len(roof)].any()
    assert found[len(roof) :].mean() > 0.8
    # single returns say nothing of crowns
    assert not crowns(*points.T.copy(), verdicts(points), np.zeros(len(points), np.bool_), VegetationSettings()).any()


def test_points_across_a_wall_do_not_make_a_narrow_roof_rough() -> None:
    random = np.random.default_rng(13)
    xy = scattered(random, 14.0, 4.0)
    roof = np.abs(xy[:, 0] - 7.0) < 1.0
    points = in_mm(xy[:, 0], xy[:, 1], np.where(roof, 3.0, 0.0) + random.normal(0, 0.02, len(xy)))
    assert (verdicts(points)[roof] >= 1).mean() > 0.95


@pytest.mark.parametrize("scale", [0, 1, 2])
@pytest.mark.parametrize("corner_mm", [-987_654_000, 0, 123_456_000])
def test_a_lone_wanted_vertex_sees_all_that_its_windows_reach(scale: int, corner_mm: int) -> None:
    # rough to the west; to the east even, but so far off that only a shifted window reaches it
    radius_mm = 1000 * 2**scale
    turn = np.linspace(0.0, 6.0, 8)
    west = np.column_stack((-0.75 - 0.1 * np.cos(turn), 0.3 * np.sin(turn), np.where(turn % 2 < 1, 0.4, -0.4)))
    east = np.column_stack((1.45 + 0.2 * np.cos(turn), 0.3 * np.sin(turn), np.zeros(8)))
    shape = np.vstack((np.zeros(3), west, east)) * [radius_mm, radius_mm, 1000]
    for shift in np.arange(0.0, 4.0, 0.25) * radius_mm:
        points = np.rint(shape + np.array([corner_mm + shift, shift - corner_mm, 0])).astype(np.int64)
        alone = np.zeros(len(points), np.bool_)
        alone[0] = True
        assert verdicts(points, alone)[0] == slow_twin(points, 0, VegetationSettings()) == 1
