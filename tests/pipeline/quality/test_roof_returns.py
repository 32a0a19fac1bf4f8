"""Which points are roof returns: facades and what lies below the roof are left out, misfits of the roof never are."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import shapely
from examples import examples
from faces_by_hand import level, plane
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pipeline.geometry import top_visible
from pipeline.model import BoolArray, FloatArray, Plane, RoofFace
from pipeline.quality.residuals import ResidualSummary, summarise, vertical_residuals
from pipeline.quality.roof_returns import MAD_TO_SIGMA, TOLERANCE_M, roof_returns

LENGTH, WIDTH, EAVE, RISE = 12.0, 8.0, 5.0, 0.75
HALVES = (shapely.box(0, 0, LENGTH, WIDTH / 2), shapely.box(0, WIDTH / 2, LENGTH, WIDTH))
GABLE = (plane(0.0, RISE, EAVE), plane(0.0, -RISE, EAVE + RISE * WIDTH))


def roof_z(y: FloatArray) -> FloatArray:
    return EAVE + RISE * np.minimum(y, WIDTH - y)


def rounded(points: FloatArray) -> FloatArray:
    return np.rint(points * 1e3) / 1e3


def gable_points(density: float, noise_m: float, rng: np.random.Generator) -> FloatArray:
    n = round(density * LENGTH * WIDTH)
    x, y = rng.uniform(0, LENGTH, n), rng.uniform(0, WIDTH, n)
    return rounded(np.column_stack((x, y, roof_z(y) + rng.normal(0, noise_m, n))))


def facade_points(n: int, overhang_m: float, rng: np.random.Generator) -> FloatArray:
    """Points on the two long walls, up to the roof."""
    x = rng.uniform(overhang_m, LENGTH - overhang_m, n)
    y = np.where(rng.random(n) < 0.5, overhang_m, WIDTH - overhang_m) + rng.normal(0, 0.02, n)
    return rounded(np.column_stack((x, y, rng.uniform(0.5, 1.0, n) * roof_z(y))))


def residuals_of(points: FloatArray, planes: tuple[Plane, ...] = GABLE) -> FloatArray:
    faces = [RoofFace(plane=k, polygon=shapely.force_3d(half)) for k, half in enumerate(HALVES)]
    return vertical_residuals(points, faces, planes)


def measured(
    points: FloatArray, spacing_m: float = 0.4, planes: tuple[Plane, ...] = GABLE
) -> tuple[ResidualSummary, BoolArray]:
    residuals = residuals_of(points, planes)
    returns = roof_returns(points, residuals, spacing_m)
    return summarise(residuals[returns]), returns


def slow_twin(points: FloatArray, residuals: FloatArray, spacing_m: float) -> BoolArray:
    """Point by point, in whole millimetres."""
    mm = [[round(value * 1000) for value in row] for row in points.tolist()]
    distances = [abs(value) for value in residuals.tolist()]
    radius = round(max(0.5, spacing_m) * 1000)

    def kept(reach: float) -> list[bool]:
        found = []
        for i, (x, y, z) in enumerate(mm):
            near = [j for j, (u, v, _) in enumerate(mm) if (u - x) ** 2 + (v - y) ** 2 <= radius * radius]
            steep = [
                mm[j][2] - z
                for j in near
                if abs(mm[j][2] - z) > round(reach * 1000)
                and 25 * (mm[j][2] - z) ** 2 > 121 * ((mm[j][0] - x) ** 2 + (mm[j][1] - y) ** 2)
            ]
            is_below_roof = any(mm[j][2] > z and distances[j] <= reach for j in near)
            hidden = any(dz > 0 for dz in steep) or (any(dz < 0 for dz in steep) and is_below_roof)
            found.append(distances[i] <= reach or not hidden)
        return found

    near = sorted(round(distance * 1000) for distance in distances if distance <= 1.1)
    median = near[(len(near) - 1) // 2] if near else 0
    reach = round(min(max(200.0, 3.0 * MAD_TO_SIGMA * median), 1100.0)) / 1000.0
    return np.array(kept(reach), bool)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=examples(60), deadline=None)
def test_the_kernel_is_its_slow_twin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    noise_m, spacing_m = float(rng.choice([0.02, 0.15, 0.5])), float(rng.choice([0.3, 1.5]))
    parts = [gable_points(1.0, noise_m, rng), facade_points(int(rng.integers(0, 80)), 0.0, rng)]
    parts.append(rounded(rng.uniform((-1, -1, 0), (LENGTH + 1, WIDTH + 1, 12), (20, 3))))
    points = np.concatenate(parts)
    points = np.concatenate((points, points[:3] + np.array([0.0, 0.0, 0.6])))  # two points at one place in plan
    residuals = residuals_of(points)
    assert np.isnan(residuals).any()
    assert roof_returns(points, residuals, spacing_m).tolist() == slow_twin(points, residuals, spacing_m).tolist()


@pytest.mark.parametrize("overhang_m", [0.0, 0.5])
@pytest.mark.parametrize("per_roof_point", [0.1, 0.5, 1.5])
@pytest.mark.parametrize("density", [2.0, 6.0, 15.0])
def test_facades_do_not_spoil_the_figures_however_many_points_they_have(
    density: float, per_roof_point: float, overhang_m: float
) -> None:
    rng = np.random.default_rng(1)
    roof = gable_points(density, 0.02, rng)
    facades = facade_points(round(per_roof_point * len(roof)), overhang_m, rng)
    points = np.concatenate((roof, facades))
    assert summarise(residuals_of(points)).share_within < 0.95
    found, returns = measured(points, density**-0.5)
    assert found.share_within > 0.97
    assert found.rmse_m < 0.15
    assert returns[: len(roof)].all(), "points of the roof stay"
    off = np.abs(roof_z(facades[:, 1]) - facades[:, 2]) > TOLERANCE_M
    assert returns[len(roof) :][off].sum() <= 3 + 0.1 * off.sum()


def test_points_seen_through_glass_are_below_the_roof() -> None:
    """Floors beneath a roof that lets some pulses through."""
    rng = np.random.default_rng(2)
    points = gable_points(12.0, 0.02, rng)
    through = rng.random(len(points)) < 0.2
    points[through, 2] = 1.0
    found, returns = measured(points)
    assert returns[through].mean() < 0.05
    assert returns[~through].all()
    assert found.share_within > 0.98


@pytest.mark.parametrize("depth_m", [-2.5, 2.5])
def test_a_terrace_in_the_roof_and_a_storey_on_it_are_misfits(depth_m: float) -> None:
    rng = np.random.default_rng(3)
    points = gable_points(12.0, 0.02, rng)
    part = (np.abs(points[:, 0] - 6.0) < 2.0) & (points[:, 1] < 4.0)
    points[part, 2] = points[part, 2].mean() + depth_m
    found, returns = measured(points)
    assert found.share_within == pytest.approx(1.0 - part.mean(), abs=0.06)
    assert returns[part].mean() > 0.6, "only the rim lies below other points"


def test_a_roof_that_the_model_leaves_out_is_a_misfit() -> None:
    rng = np.random.default_rng(4)
    annex = rounded(np.column_stack((rng.uniform(LENGTH, LENGTH + 6, 500), rng.uniform(0, 8, 500), np.full(500, 3.0))))
    points = np.concatenate((gable_points(10.0, 0.02, rng), annex))
    found, returns = measured(points)
    assert returns[-500:].mean() > 0.9
    assert found.share_within == pytest.approx(1.0 - 500 / len(points), abs=0.03)


def test_a_model_that_is_wrong_everywhere_keeps_its_misfit() -> None:
    points = gable_points(10.0, 0.02, np.random.default_rng(5))
    found, returns = measured(points, planes=(level(8.5), level(8.5)))
    assert returns.all()
    assert found.share_within < 0.15
    high, _ = measured(points, planes=tuple(plane(p.a, p.b, p.c + 2.1) for p in GABLE))
    assert high.rmse_m == pytest.approx(2.1, abs=0.01)


def test_a_chimney_does_not_decide_and_is_not_left_out() -> None:
    """Twenty of a thousand points, three metres high."""
    rng = np.random.default_rng(6)
    points = gable_points(10.4, 0.02, rng)
    nearest = np.argsort(np.hypot(points[:, 0] - 3.0, points[:, 1] - 2.0))[:20]
    points[nearest, 2] += 3.0
    residuals = residuals_of(points)
    assert math.sqrt(np.mean(residuals**2)) > 0.4
    found, returns = measured(points)
    assert returns[nearest].all()
    assert found.rmse_m < 0.15
    assert found.share_within == pytest.approx(1.0 - 20 / len(points), abs=0.005)


@pytest.mark.parametrize("n", [1, 2, 9, 10, 11, 40, 99, 1000])
def test_the_rmse_stays_below_half_a_metre_where_nine_in_ten_points_are_near(n: int) -> None:
    rng = np.random.default_rng(n)
    near = rng.uniform(-0.2, 0.2, n - n // 10)
    far = rng.choice([-1.0, 1.0], n // 10) * rng.uniform(0.5, 30.0, n // 10)
    found = summarise(rng.permutation(np.concatenate((near, far))))
    assert found.share_within >= 0.9
    assert found.rmse_m < 0.5


def test_the_rmse_is_that_of_all_points_where_none_is_far() -> None:
    residuals = np.random.default_rng(0).normal(0, 0.3, 5000)
    assert np.abs(residuals).max() > 0.95
    assert summarise(residuals).rmse_m == pytest.approx(math.sqrt(np.mean(residuals**2)), rel=1e-3)


def test_steep_and_noisy_roofs_keep_their_points() -> None:
    rng = np.random.default_rng(7)
    n = 1000
    x, y = rng.uniform(0, LENGTH, n), rng.uniform(0, WIDTH, n)
    steep = (plane(0.0, 1.7, EAVE), plane(0.0, -1.7, EAVE + 1.7 * WIDTH))  # 60 degrees
    z = EAVE + 1.7 * np.minimum(y, WIDTH - y)
    for noise_m in (0.02, 0.15):
        points = rounded(np.column_stack((x, y, z + rng.normal(0, noise_m, n))))
        assert measured(points, planes=steep)[1].mean() >= 0.998


def test_points_far_off_the_roof_that_the_ruler_hides_are_left_out() -> None:
    rng = np.random.default_rng(8)
    points = np.concatenate((gable_points(8.0, 0.02, rng), facade_points(400, 0.3, rng)))
    residuals = residuals_of(points)
    returns, visible = roof_returns(points, residuals, 0.35), top_visible(points)
    hidden = ~visible & (np.abs(residuals) > 1.1)
    assert hidden.sum() > 100
    assert not returns[hidden].any()


Move = Callable[[FloatArray], FloatArray]
MOVES: dict[str, Move] = {
    "moved": lambda p: p + np.array([1000.0, -2000.0, 30.0]),
    "turned": lambda p: p[:, [1, 0, 2]] * np.array([-1.0, 1.0, 1.0]),
    "mirrored": lambda p: p * np.array([-1.0, 1.0, 1.0]),
}


@pytest.mark.parametrize("move", MOVES.values(), ids=MOVES)
def test_neither_place_nor_order_decides(move: Move) -> None:
    rng = np.random.default_rng(9)
    points = np.concatenate((gable_points(6.0, 0.02, rng), facade_points(500, 0.2, rng)))
    residuals = residuals_of(points)
    order: NDArray[np.int64] = rng.permutation(len(points))
    here = roof_returns(points, residuals, 0.4)
    there = roof_returns(rounded(move(points))[order], residuals[order], 0.4)
    assert there.tolist() == here[order].tolist()
    one, two = summarise(residuals[here]), summarise(residuals[order][there])
    assert one == two, "sums are exact"


def test_without_points_and_without_a_roof_nothing_is_below_it() -> None:
    assert len(roof_returns(np.zeros((0, 3)), np.zeros(0), math.nan)) == 0
    points = rounded(np.random.default_rng(0).uniform(0, 9, (50, 3)) * (1.0, 1.0, 0.01))
    assert roof_returns(points, np.full(50, np.nan), math.nan).all()
