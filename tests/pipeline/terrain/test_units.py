"""Roofs made by hand: where units are split and where not, at any density, turn and order of the points."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.model import BoolArray, FloatArray, IntArray, LabelArray
from pipeline.terrain.terrain_settings import UnitSettings
from pipeline.terrain.unit_division import units_of

SETTINGS = UnitSettings()
STEEP = math.tan(math.radians(40.0))
SHALLOW = math.tan(math.radians(25.0))

Roof = Callable[[FloatArray, FloatArray], tuple[FloatArray, IntArray]]
"""Elevations, and the house of each place; -1 where there is none."""


def _inside(x: FloatArray, y: FloatArray, x0: float, y0: float, x1: float, y1: float) -> BoolArray:
    inside: BoolArray = (x >= x0) & (x < x1) & (y >= y0) & (y < y1)
    return inside


def _gable(across: FloatArray, width: float, eave: float | FloatArray, slope: float = STEEP) -> FloatArray:
    """Elevation of a gable roof, `across` counted from one eave."""
    return eave + slope * (width / 2 - np.abs(across - width / 2))


def _row(eaves: tuple[float, ...]) -> Roof:
    def roof(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
        house = np.where(_inside(x, y, 0, 0, 8 * len(eaves), 10), x // 8, -1).astype(np.int64)
        return _gable(y, 10, np.array(eaves)[house]), house

    return roof


def _mansard(across: FloatArray, width: float, eave: float | FloatArray) -> FloatArray:
    """Elevation of a mansard roof: 62 deg over a sixth of the width, 24 deg above."""
    inside = width / 2 - np.abs(across - width / 2)
    return (
        eave
        + math.tan(math.radians(62.0)) * np.minimum(inside, width / 6)
        + 0.445 * np.maximum(inside - width / 6, 0.0)
    )


def _mansard_row(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    """Mansard roofs that differ by 0.15 m."""
    house = np.where(_inside(x, y, 0, 0, 24, 12), x // 8, -1).astype(np.int64)
    return _mansard(y, 12, np.array([6.0, 6.15, 6.0])[house]), house


def _gable_beside_mansard(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    """Two houses side by side, whose slopes cross half a metre above the eave of one."""
    house = np.where(_inside(x, y, 0, 0, 18, 12), x // 9, -1).astype(np.int64)
    return np.where(house == 0, _mansard(y, 12, 6.0), _gable(y, 12, 6.5, 0.966)), house


def _corner_of_a_block(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    """A high corner house and its two neighbours, which touch each other over a metre behind it."""
    corner, front, side = _inside(x, y, 0, 0, 10, 10), _inside(x, y, 10, 0, 20, 10), _inside(x, y, 0, 10, 11, 21)
    z = np.where(corner, _gable(y, 10, 9.0), np.where(front, _gable(y, 10, 6.0), _gable(x, 11, 6.05)))
    return z, np.where(corner, 0, np.where(front, 1, np.where(side, 2, -1)))


def _flat_between_gables(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    z, house = _row((6.0, 6.0, 6.0))(x, y)
    return np.where(house == 1, 8.0, z), house


def _parallel_gables(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    house = np.where(_inside(x, y, 0, 0, 18, 12), x // 6, -1).astype(np.int64)
    return _gable(x % 6, 6, 7.0), house


def _steep_hip(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    from_edge = np.minimum(np.minimum(x, 18 - x), np.minimum(y, 11 - y))
    return 6.0 + math.tan(math.radians(62.0)) * from_edge, np.where(_inside(x, y, 0, 0, 18, 11), 0, -1)


def _l_house(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    main, wing = _inside(x, y, 0, 0, 16, 8), _inside(x, y, 0, 0, 7, 18)
    z = np.maximum(np.where(main, _gable(y, 8, 5.0), -9.0), np.where(wing, _gable(x, 7, 5.0), -9.0))
    return z, np.where(main | wing, 0, -1)


def _hip_corner(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    """Two wings of one width and height around a corner, with a hip outside and a valley inside."""
    inside = _inside(x, y, 0, 0, 30, 9) | _inside(x, y, 0, 0, 9, 26)
    outer, inner = np.minimum(x, y), np.maximum(x, y)
    wall = np.minimum(outer, np.maximum(9 - outer, 9 - inner))
    return 8.0 + STEEP * wall, np.where(inside, 0, -1)


def _saw_tooth(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    """Five pent roofs one behind the other, a wall of glass 1.9 m high at the top of each."""
    return 6.0 + SHALLOW * (x % 4), np.where(_inside(x, y, 0, 0, 20, 18), 0, -1)


def _steep_backs(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    """Four teeth with backs of 65 degrees, which meet the next slope in a valley."""
    tooth, rise, back = x % 6, math.tan(math.radians(22.0)), math.tan(math.radians(65.0))
    return 6.0 + np.minimum(rise * tooth, back * (6 - tooth)), np.where(_inside(x, y, 0, 0, 24, 14), 0, -1)


def _steep_beside_gentle(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    """A house of 60 degrees and one of 20 degrees side by side with a gutter between them."""
    house = np.where(_inside(x, y, 0, 0, 16, 14), x >= 7, -1).astype(np.int64)
    return np.where(house == 0, _gable(x, 7, 6.0, 1.73), _gable(x - 7, 9, 6.0, 0.36)), house


def _offset_pents(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    """One house under two pent roofs with a wall of 1 m between their tops."""
    z = np.where(y < 6, 5.0 + SHALLOW * y, 4.0 + SHALLOW * (12 - y))
    return z, np.where(_inside(x, y, 0, 0, 14, 12), 0, -1)


def _tower_on_hall(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    z = np.where(_inside(x, y, 4, 4, 12, 10), 7.5, 6.0)
    return z, np.where(_inside(x, y, 0, 0, 30, 20), 0, -1)


def _dormer(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    z = _gable(y, 10, 5.0)
    return np.where(_inside(x, y, 3, 1, 9, 4), np.maximum(z, 7.9), z), np.where(_inside(x, y, 0, 0, 12, 10), 0, -1)


def _small_annex(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    house, annex = _inside(x, y, 0, 0, 10, 9), _inside(x, y, 10, 2, 13.5, 7)
    return np.where(annex, 4.2, _gable(y, 9, 5.5)), np.where(house | annex, 0, -1)


def _court(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    """Four wings under hipped roofs around a court of 7 m by 7 m."""
    inside = _inside(x, y, 0, 0, 27, 27) & ~_inside(x, y, 10, 10, 17, 17)
    from_edge = np.minimum(np.minimum(x, 27 - x), np.minimum(y, 27 - y))
    return 9.0 + STEEP * np.minimum(from_edge, 10 - from_edge), np.where(inside, 0, -1)


def _u_house(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    """Two wings with parallel ridges, 4 m apart, and a third across their end."""
    west, east, north = _inside(x, y, 0, 0, 8, 20), _inside(x, y, 12, 0, 20, 20), _inside(x, y, 0, 14, 20, 22)
    wings = ((west, _gable(x, 8, 6.0)), (east, _gable(x - 12, 8, 6.0)), (north, _gable(y - 14, 8, 6.0)))
    z: FloatArray = np.maximum.reduce([np.where(inside, elevation, -9.0) for inside, elevation in wings])
    return z, np.where(west | east | north, 0, -1)


def _nave_and_aisles(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    aisles = 6.0 + 0.4 * np.minimum(y, 18 - y)
    z = np.where((y >= 5) & (y < 13), _gable(y - 5, 8, 9.0), aisles)
    return z, np.where(_inside(x, y, 0, 0, 30, 18), 0, -1)


def _lower_wing(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    """A house with a wing of a third of its area, lower and narrower under a ridge of the same direction."""
    house, wing = _inside(x, y, 0, 0, 15, 9), _inside(x, y, 15, 1, 21, 8)
    return np.where(wing, _gable(y - 1, 7, 3.6, SHALLOW), _gable(y, 9, 5.0)), np.where(house | wing, 0, -1)


def _barrel(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    return 6.0 + np.sqrt(np.maximum(81 - (y - 9) ** 2, 0.0)), np.where(_inside(x, y, 0, 0, 30, 18), 0, -1)


def _panels_on_one_slope(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    """Solar panels 0.15 m above the southern half of one slope."""
    z, house = _row((6.0, 6.0, 6.0))(x, y)
    return np.where(_inside(x, y, 12, 1, 24, 5), z + 0.15, z), house


def _strips_shifted_in_plan(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    """One strip of the survey lies 0.2 m beside the other: one slope steps up, the other one down."""
    _, house = _row((6.0, 6.0, 6.0))(x, y)
    return _gable(np.where(x < 13, y, y + 0.2), 10, 6.0), house


def _sloping_ridge(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    z, house = _row((6.0, 6.0, 6.0))(x, y)
    return z + 0.02 * x, house


def _sagging_ridge(x: FloatArray, y: FloatArray) -> tuple[FloatArray, IntArray]:
    """Two bays that sag by 0.12 m between three walls."""
    z, house = _row((6.0, 6.0, 6.0))(x, y)
    return z - 0.12 * np.abs(np.sin(math.pi * x / 12)), house


SEPARATED = {
    "a row with steps": _row((6.0, 7.0, 5.5, 6.2)),
    "a row with small steps of the ridge": _row((6.0, 6.15, 6.0, 6.18)),
    "a row with steps of the ridge as large as what a patch takes": _row((6.0, 6.2, 5.97, 6.19)),
    "a mansard row": _mansard_row,
    "a steep house beside a gentle one": _steep_beside_gentle,
    "the corner of a block": _corner_of_a_block,
    "a flat house between gables": _flat_between_gables,
    "parallel gables": _parallel_gables,
}
TOGETHER = {
    "a row under one ridge": _row((6.0, 6.0, 6.0)),
    "a row under a sloping ridge": _sloping_ridge,
    "a row under a sagging ridge": _sagging_ridge,
    "panels on one slope": _panels_on_one_slope,
    "strips shifted in plan": _strips_shifted_in_plan,
    "an L-shaped house": _l_house,
    "a steep hip": _steep_hip,
    "a hip at a corner": _hip_corner,
    "a saw-tooth hall": _saw_tooth,
    "a saw-tooth hall with sloping backs": _steep_backs,
    "offset pent roofs": _offset_pents,
    "a tower on a hall": _tower_on_hall,
    "a dormer": _dormer,
    "a small annex": _small_annex,
    "a closed court": _court,
    "a house around three sides of a court": _u_house,
    "a nave with aisles": _nave_and_aisles,
    "a house with a lower wing": _lower_wing,
    "a barrel": _barrel,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cloud:
    """Points of a roof."""

    xyz: IntArray
    """(n, 3) mm."""
    house: IntArray
    """(n,) the house of each."""

    def units(self, own: UnitSettings = SETTINGS, strips: IntArray | None = None) -> LabelArray:
        x, y, z = np.ascontiguousarray(self.xyz.T)
        return units_of(x, y, z, own, strips)


def cloud_of(
    roof: Roof,
    *,
    per_m2: float = 6.0,
    turn_deg: float = 23.0,
    mirrored: bool = False,
    seed: int = 1,
    east_m: float = 42.0,
) -> Cloud:
    """Points of a roof, with noise of 2 cm, somewhere in a country."""
    random = np.random.default_rng(seed)
    side = 1 / math.sqrt(per_m2)
    grid = (np.arange(-1.0, most_m, side) for most_m in (east_m, 42.0))
    x, y = (v.ravel() + random.uniform(-0.45, 0.45, v.size) * side for v in np.meshgrid(*grid))
    z, house = roof(x, y)
    z += random.normal(0, 0.02, len(z))
    there = house >= 0
    x, y, z, house = x[there], y[there], z[there], house[there]
    if mirrored:
        x = -x
    c, s = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    metres = np.column_stack((85_123.4 + c * x - s * y, 447_567.8 + s * x + c * y, z))
    return Cloud(xyz=np.rint(metres * 1000).astype(np.int64), house=house)


def agreement(found: LabelArray, house: IntArray) -> float:
    """Share of the points in the unit that holds most of their house, where each unit is claimed by one house."""
    table = np.zeros((found.max() + 1, house.max() + 1), np.int64)
    np.add.at(table, (found, house), 1)
    unit_of = table.argmax(axis=0)
    claimed = table[unit_of].argmax(axis=1) == np.arange(table.shape[1])
    return float(table[unit_of, np.arange(table.shape[1])][claimed].sum()) / len(house)


@pytest.mark.parametrize("per_m2", [1.5, 6.0, 25.0])
@pytest.mark.parametrize("name", SEPARATED)
def test_houses_with_a_step_or_a_gutter_between_them_are_separated(name: str, per_m2: float) -> None:
    cloud = cloud_of(SEPARATED[name], per_m2=per_m2)
    found = cloud.units()
    assert found.max() == cloud.house.max()
    assert agreement(found, cloud.house) > (0.98 if per_m2 < 2 else 0.99)


@pytest.mark.parametrize("per_m2", [4.0, 25.0])
def test_slopes_that_cross_at_a_party_wall_do_not_meet(per_m2: float) -> None:
    cloud = cloud_of(_gable_beside_mansard, per_m2=per_m2)
    found = cloud.units()
    assert found.max() == 1
    assert agreement(found, cloud.house) > 0.99


@pytest.mark.parametrize("per_m2", [1.5, 6.0, 25.0])
@pytest.mark.parametrize("name", TOGETHER)
def test_what_is_one_house_or_shows_no_border_stays_one_unit(name: str, per_m2: float) -> None:
    assert cloud_of(TOGETHER[name], per_m2=per_m2).units().max() == 0


@settings(max_examples=examples(20), deadline=None)
@given(
    name=st.sampled_from(sorted(SEPARATED | TOGETHER)),
    turn_deg=st.floats(0.0, 360.0),
    mirrored=st.booleans(),
    seed=st.integers(0, 99),
)
def test_turned_and_mirrored_roofs_have_the_same_units(name: str, turn_deg: float, mirrored: bool, seed: int) -> None:
    cloud = cloud_of((SEPARATED | TOGETHER)[name], turn_deg=turn_deg, mirrored=mirrored, seed=seed)
    found = cloud.units()
    expected = cloud.house.max() if name in SEPARATED else 0
    assert found.max() == expected
    assert agreement(found, cloud.house if expected else np.zeros_like(cloud.house)) > 0.95


@settings(max_examples=examples(8), deadline=None)
@given(
    seed=st.integers(0, 99),
    columns=st.integers(-40, 40),
    rows=st.integers(-40, 40),
    lift_mm=st.integers(-9999, 9999),
)
def test_neither_the_order_nor_a_move_by_whole_cells_changes_anything(
    seed: int, columns: int, rows: int, lift_mm: int
) -> None:
    cloud = cloud_of(_row((6.0, 7.0, 5.5)))
    order = np.random.default_rng(seed).permutation(len(cloud.xyz))
    moved = Cloud(xyz=cloud.xyz[order] + np.array([500 * columns, 500 * rows, lift_mm]), house=cloud.house[order])
    assert np.array_equal(moved.units(), cloud.units()[order])


@pytest.mark.parametrize("step_m", [0.07, 0.12])
def test_the_order_of_points_at_one_place_in_two_strips_changes_nothing(step_m: float) -> None:
    cloud = cloud_of(_row((6.0, 6.0 + step_m, 6.0)), per_m2=2.0, turn_deg=0.0)
    twice = Cloud(xyz=np.concatenate((cloud.xyz, cloud.xyz)), house=np.concatenate((cloud.house, cloud.house)))
    strips = np.repeat(np.array([4, 9]), len(cloud.xyz))
    expected = twice.units(strips=strips)
    for seed in range(5):
        order = np.random.default_rng(seed).permutation(len(strips))
        shuffled = Cloud(xyz=twice.xyz[order], house=twice.house[order])
        assert np.array_equal(shuffled.units(strips=strips[order]), expected[order])


@pytest.mark.parametrize("houses", [16, 24])
def test_the_slopes_of_a_long_row_are_patches_too(houses: int) -> None:
    cloud = cloud_of(_row((6.0, 6.08) * (houses // 2)), east_m=8.0 * houses + 1.0)
    found = cloud.units()
    assert found.max() + 1 == houses
    assert agreement(found, cloud.house) > 0.98


def test_units_are_numbered_by_their_smallest_points() -> None:
    cloud = cloud_of(_row((6.0, 7.0, 5.5)), turn_deg=200.0)
    found = cloud.units()
    first = [min(map(tuple, cloud.xyz[found == k].tolist())) for k in range(found.max() + 1)]
    assert len(first) == 3
    assert first == sorted(first)


@pytest.mark.parametrize(
    ("roof", "own", "last"),
    [
        (_parallel_gables, {"split": "steps"}, 0),  # gutters part only where ridges count
        (_row((6.0, 7.0)), {"split": "steps"}, 1),
        (_row((6.0, 7.0)), {"split": "nothing"}, 0),
        (_row((6.0, 6.6)), {"min_step_m": 0.5}, 1),
        (_row((6.0, 6.6)), {"min_step_m": 0.8, "min_ridge_step_m": 0.8}, 0),
        (_row((6.0, 6.6)), {"min_step_m": 0.8}, 1),  # both slopes step
        (_row((6.0, 6.08)), {}, 1),
        (_row((6.0, 6.08)), {"min_ridge_step_m": 0.12}, 0),
        (_row((6.0, 7.0)), {"min_area_m2": 60.0}, 1),
        (_row((6.0, 7.0)), {"min_area_m2": 90.0}, 0),  # too small a unit joins its neighbour
        (_lower_wing, {"annex_share": 0.0}, 1),
    ],
)
def test_the_settings_say_what_parts_units(roof: Roof, own: dict[str, Any], last: int) -> None:
    assert cloud_of(roof).units(UnitSettings(**own)).max() == last


def test_strips_that_differ_in_elevation_part_nothing() -> None:
    cloud = cloud_of(_row((6.0, 6.0, 6.0)), turn_deg=0.0)
    strips = (cloud.xyz[:, 0] > 1000 * (85_123.4 + 13.0)).astype(np.int64)
    cloud.xyz[:, 2] += 100 * strips
    assert cloud.units().max() == 1  # as one strip, the seam is a step of both slopes
    assert cloud.units(strips=strips).max() == 0


def test_a_step_shows_in_two_strips_that_differ_in_elevation() -> None:
    cloud = cloud_of(_row((6.0, 6.1)), turn_deg=0.0)
    strips = np.arange(len(cloud.xyz)) % 2
    cloud.xyz[:, 2] += 100 * strips
    found = cloud.units(strips=strips)
    assert found.max() == 1
    assert agreement(found, cloud.house) > 0.97


def test_a_gap_in_the_data_parts_nothing() -> None:
    cloud = cloud_of(_row((6.0, 6.0, 7.0)), turn_deg=0.0)
    x_m = cloud.xyz[:, 0] / 1000 - 85_123.4
    there = np.abs(x_m - 6.0) > 2.5
    found = Cloud(xyz=cloud.xyz[there], house=cloud.house[there]).units()
    assert found.max() == 1
    assert agreement(found, cloud.house[there] // 2) > 0.97


def test_a_gap_in_sparse_data_parts_nothing_though_it_is_hardly_wider_than_the_points_lie_apart() -> None:
    # points 2.2 m apart, a gap of 6 m: its facets have circumradii of 3.2 m, three typical ones are 4.7 m
    x, y = (v.ravel() for v in np.meshgrid(2200 * np.arange(14, dtype=np.int64), 2200 * np.arange(9, dtype=np.int64)))
    x[x > 14_000] += 3800
    assert units_of(x, y, np.full(len(x), 8000), SETTINGS).max() == 0


@pytest.mark.parametrize("count", [0, 1, 2, 13, 40])
def test_too_few_points_and_points_on_a_line_are_one_unit(count: int) -> None:
    along = 1000 * np.arange(count, dtype=np.int64)
    assert np.array_equal(units_of(along, along, along, SETTINGS), np.zeros(count, np.int32))
