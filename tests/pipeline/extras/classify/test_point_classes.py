"""The class of every point: each kernel against a slow twin, and what a scene's points become."""

import dataclasses
from typing import Any

import numpy as np
import pytest

from pipeline.extras.classify.point_classes import (
    DEEP_MM,
    ON_ROOF_MM,
    PIT_REACH_MM,
    UNDER_ROOF_MM,
    PointClass,
    PointEvidence,
    classes_of,
    counts_nearby,
    index_of_each,
    noise_of,
    sums_around,
    tops_nearby,
)
from pipeline.terrain.lattice import NO_DATA
from pipeline.terrain.terrain_settings import VegetationSettings


@pytest.fixture
def cloud() -> tuple[Any, Any, Any, Any, Any]:
    """400 random points of 12 x 12 m, of which some are used and some wanted; also west and south of the origin."""
    rng = np.random.default_rng(5)
    x, y = rng.integers(-6000, 6000, (2, 400))
    return x, y, rng.integers(0, 9000, 400), rng.random(400) < 0.4, rng.random(400) < 0.5


def test_the_highest_points_nearby_are_those_of_a_full_search(cloud: Any) -> None:
    x, y, z, used, wanted = cloud
    found = tops_nearby(x, y, z, used, wanted, 700)
    for i in range(len(x)):
        near = used & ((x - x[i]) ** 2 + (y - y[i]) ** 2 <= 700**2)
        assert found[i] == (z[near].max() if wanted[i] and near.any() else NO_DATA)


def test_the_counts_nearby_are_those_of_a_full_search(cloud: Any) -> None:
    x, y, _, used, _ = cloud
    found = counts_nearby(x, y, used, 900)
    for i in range(len(x)):
        near = used & (abs(x - x[i]) <= 900) & (abs(y - y[i]) <= 900)
        assert found[i] == (near.sum() if used[i] else 0)


def test_the_sums_around_are_those_of_nine_cells_of_the_origin(cloud: Any) -> None:
    x, y, z, used, _ = cloud
    values = np.column_stack((np.ones(len(x), np.int64), z))
    found = sums_around(x, y, used, values, 1000)
    for i in range(len(x)):
        near = used & (abs(x // 1000 - x[i] // 1000) <= 1) & (abs(y // 1000 - y[i] // 1000) <= 1)
        assert found[i].tolist() == (values[near].sum(axis=0).tolist() if used[i] else [0, 0])


def test_points_are_found_by_place_and_return_number() -> None:
    rng = np.random.default_rng(2)
    x, y, z = rng.integers(-4, 4, (3, 300))
    number = rng.integers(1, 3, 300).astype(np.uint8)
    some = slice(0, 100)
    found = index_of_each(x, y, z, number, x[some], y[some], z[some], number[some])
    for i in range(300):
        same = (x[some] == x[i]) & (y[some] == y[i]) & (z[some] == z[i]) & (number[some] == number[i])
        assert found[i] == (np.flatnonzero(same)[0] if same.any() else -1)
    nothing = np.empty(0, np.int64)
    assert (index_of_each(x, y, z, number, nothing, nothing, nothing, number[:0]) == -1).all()


def scene(*parts: tuple[Any, Any, Any, dict[str, Any]]) -> tuple[PointEvidence, np.ndarray[Any, Any]]:
    """Points over flat terrain at 0 m from parts (x, y, z in metres, flags); also the number of each one's part."""
    xyz = [np.column_stack([np.broadcast_to(v, np.shape(x)) for v in (x, y, z)]) for x, y, z, _ in parts]
    mm = np.rint(1000 * np.concatenate(xyz)).astype(np.int64)
    part = np.repeat(np.arange(len(parts)), [len(p) for p in xyz])

    def flag(name: str) -> Any:
        return np.concatenate([np.broadcast_to(p[3].get(name, False), len(q)) for p, q in zip(parts, xyz, strict=True)])

    x, y, z = mm.T.copy()
    evidence = PointEvidence(
        x_mm=x,
        y_mm=y,
        z_mm=z,
        height_mm=z.copy(),
        rise_mm=np.zeros_like(z),
        ground=(z < 500),
        building=flag("building"),
        outlier=flag("outlier"),
        echoes=flag("echoes"),
    )
    return evidence, part


def grid(x0: float, y0: float, x1: float, y1: float, step: float = 0.4) -> tuple[Any, Any]:
    x, y = np.meshgrid(np.arange(x0, x1, step), np.arange(y0, y1, step))
    return x.ravel(), y.ravel()


def classes(*parts: tuple[Any, Any, Any, dict[str, Any]]) -> list[list[int]]:
    """The classes that occur in each part."""
    evidence, part = scene(*parts)
    found = classes_of(evidence, np.ones(len(part), np.bool_), VegetationSettings())
    return [sorted(set(found[part == k].tolist())) for k in range(len(parts))]


ROOF = (*grid(0, 0, 8, 8), 6.0, {"building": True})
GROUND = (*grid(-10, -10, 18, 18, 0.8), 0.0, {})


def test_roof_wall_chimney_and_ground_get_their_classes() -> None:
    wall = np.full(10, -0.3), np.linspace(1, 7, 10), np.linspace(1.0, 5.5, 10), {}
    chimney = np.full(3, 4.1), np.array([4.0, 4.1, 4.2]), 7.2, {}
    assert classes(ROOF, GROUND, wall, chimney) == [[6], [2], [6], [6]]


def test_a_hedge_beside_a_wall_is_vegetation_but_what_hangs_under_the_eaves_is_not() -> None:
    rng = np.random.default_rng(1)
    across, height = rng.uniform(1, 7, 300), rng.uniform(2.2, 4.5, 300)
    hedge = -UNDER_ROOF_MM / 1000 - rng.uniform(0.05, 0.4, 300), across, height, {"echoes": True}
    eaves = -rng.uniform(0.05, 0.4, 300), across, height, {"echoes": True}
    dense = (*grid(0, 0, 8, 8, 0.1), 6.0, {"building": True})
    assert classes(dense, GROUND, hedge, eaves)[2:] == [[PointClass.VEGETATION], [PointClass.BUILDING]]


def test_a_mast_is_building_up_to_a_height_above_the_roof() -> None:
    low, high = 6.0 + ON_ROOF_MM / 1000 - 0.01, 6.0 + ON_ROOF_MM / 1000 + 0.01
    mast = np.full(1, 4.0), np.full(1, 4.0), low, {}
    beyond = np.full(1, 4.0), np.full(1, 4.0), high, {}
    evidence, part = scene(ROOF, GROUND, mast, beyond)
    # one point each: too few to tell smooth from rough, so it is the flat plate around them that decides
    plate = scene(ROOF, GROUND, (*grid(2, 2, 6, 6), low, {}), (*grid(2, 2, 6, 6), high, {}))
    for one, of in ((evidence, part), plate):
        found = classes_of(one, np.ones(len(of), np.bool_), VegetationSettings())
        assert PointClass.BUILDING not in found[of == 3]
    assert set(found[plate[1] == 2].tolist()) == {PointClass.BUILDING}


def test_a_tree_is_vegetation_with_echoes_or_without_and_a_crown_above_the_roof_no_higher_than_a_chimney() -> None:
    rng = np.random.default_rng(3)
    crown = rng.uniform(1, 7, 300), rng.uniform(1, 7, 300), rng.uniform(7.5, 8.4, 300), {"echoes": True}
    tree = rng.uniform(11, 16, 400), rng.uniform(0, 5, 400), rng.uniform(3, 8, 400)
    for part in (crown, (*tree, {"echoes": True}), (*tree, {"echoes": False})):
        assert classes(ROOF, GROUND, part)[2] == [PointClass.VEGETATION]


def test_smooth_things_without_echoes_are_no_vegetation() -> None:
    container = (*grid(11, 0, 17, 3), 2.6, {})
    car = (*grid(11, 6, 15, 8), 1.5, {})
    assert classes(ROOF, GROUND, container, car)[2:] == [[PointClass.OTHER], [PointClass.OTHER]]


def test_few_points_far_below_the_terrain_are_noise_and_a_pit_and_a_lonely_point_on_it_are_ground() -> None:
    lonely = np.full(3, 14.0), np.array([3.0, 3.1, 3.2]), -4.0, {}
    pit = (*grid(10, 8, 14, 12), -4.0, {})
    bird = np.full(1, 4.0), np.full(1, 4.0), 60.0, {"outlier": True}
    on_terrain = np.full(1, 40.0), np.full(1, 40.0), 0.1, {"outlier": True}
    assert classes(ROOF, GROUND, lonely, pit, bird, on_terrain)[2:] == [[7], [2], [7], [2]]


def test_noise_looks_no_farther_than_its_box_and_must_lie_lower_on_a_slope() -> None:
    x, y, deep = np.arange(4) * PIT_REACH_MM, np.zeros(4, np.int64), np.full(4, -DEEP_MM - 1)
    none, level = np.zeros(4, np.bool_), np.zeros(4, np.int64)
    assert noise_of(x, y, deep, level, none).all()
    assert not noise_of(x, y, deep + 1, level, none).any()
    assert not noise_of(x // 4, y, deep, level, none).any()
    lowest = deep + 1 - 500 * PIT_REACH_MM // 1000
    assert not noise_of(9 * x, y, lowest, level + 500, none).any()
    assert noise_of(9 * x, y, lowest - 1, level + 500, none).all()


def test_without_terrain_only_buildings_and_vegetation_are_known() -> None:
    rng = np.random.default_rng(3)
    tree = rng.uniform(11, 16, 400), rng.uniform(0, 5, 400), rng.uniform(3, 8, 400), {"echoes": True}
    evidence, part = scene(ROOF, tree)
    nowhere = np.full(len(part), np.int64(NO_DATA))
    lost = dataclasses.replace(evidence, height_mm=nowhere, ground=np.zeros(len(part), np.bool_))
    found = classes_of(lost, np.ones(len(part), np.bool_), VegetationSettings())
    assert set(found[part == 0].tolist()) == {6}
    assert set(found[part == 1].tolist()) == {5}


def test_the_order_of_the_points_moving_and_what_is_not_wanted_change_nothing() -> None:
    rng = np.random.default_rng(9)
    tree = rng.uniform(6, 12, 500), rng.uniform(0, 5, 500), rng.uniform(1, 9, 500), {"echoes": True}
    shed = (*grid(11, 6, 15, 10), 2.6, {})
    evidence, part = scene(ROOF, GROUND, tree, shed)
    everything = np.ones(len(part), np.bool_)
    found = classes_of(evidence, everything, VegetationSettings())
    order = rng.permutation(len(part))
    mixed = PointEvidence(**{f.name: getattr(evidence, f.name)[order] for f in dataclasses.fields(evidence)})
    assert (classes_of(mixed, everything, VegetationSettings()) == found[order]).all()
    half = rng.random(len(part)) < 0.5
    some = classes_of(evidence, half, VegetationSettings())
    assert (some == np.where(half, found, 0)).all()
    moved = dataclasses.replace(evidence, x_mm=evidence.x_mm + 85_000_000, y_mm=evidence.y_mm - 447_000_000)
    assert (classes_of(moved, everything, VegetationSettings()) == found).all()


def test_no_points_have_no_classes() -> None:
    evidence, _ = scene(ROOF)
    empty = PointEvidence(**{f.name: getattr(evidence, f.name)[:0] for f in dataclasses.fields(evidence)})
    assert len(classes_of(empty, np.empty(0, np.bool_), VegetationSettings())) == 0
