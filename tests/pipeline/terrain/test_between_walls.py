"""Decks and roofs between two parallel drops."""

import math

import numpy as np
import numpy.typing as npt
import pytest

from pipeline.terrain.between_walls import between_walls
from pipeline.terrain.lattice import NO_DATA
from pipeline.terrain.morphological import morphological_ground
from pipeline.terrain.reach import between_walls_support_m
from pipeline.terrain.terrain_settings import GroundSettings

Grid = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.float64]


def coordinates(rows: int, columns: int) -> tuple[Floats, Floats]:
    c, r = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5)
    return c, r


def millimetres(z_m: Floats, noise_mm: float = 20.0) -> Grid:
    return np.rint(1000 * z_m + np.random.default_rng(1).normal(0.0, noise_mm, z_m.shape)).astype(np.int32)


def decks_of(lowest: Grid, widest: int = 102) -> Mask:
    found: Mask = between_walls(lowest, widest, 1000.0, 120.0)
    return found


def valley_with_bridge(turn_deg: float) -> tuple[Floats, Mask]:
    """A valley 8 m deep with slopes of 28 degrees, and a deck 12 m wide that meets the road on its level."""
    c, r = coordinates(180, 180)
    cos, sin = math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))
    u, v = cos * (c - 90) + sin * (r - 90), -sin * (c - 90) + cos * (r - 90)
    valley = -8.0 * np.clip((40.0 - np.abs(u)) / 15.0, 0.0, 1.0)
    deck = (np.abs(v) < 6) & (valley < -0.05)
    return np.where(deck, 0.0, valley), deck


@pytest.mark.parametrize("turn_deg", [0.0, 11.0, 30.0, 45.0, 77.0])
def test_a_deck_that_meets_the_road_on_its_level_is_found_to_near_its_ends(turn_deg: float) -> None:
    z, deck = valley_with_bridge(turn_deg)
    found = decks_of(millimetres(z))
    assert found[deck].mean() > 0.8
    assert not found[~deck].any()


def test_the_ground_of_a_valley_loses_its_bridge_to_near_the_ends() -> None:
    z, deck = valley_with_bridge(30.0)
    lowest = millimetres(z)
    with_walls = morphological_ground(lowest, (0, 0), GroundSettings())[0]
    without = morphological_ground(lowest, (0, 0), GroundSettings(wall_drop_m=20.0))[0]
    assert with_walls[deck].mean() < 0.2
    assert without[deck].mean() > 0.25
    assert with_walls[~deck].mean() > 0.99


def test_a_roof_that_meets_a_slope_uphill_is_found_where_it_stands_out_by_more_than_the_drop() -> None:
    c, r = coordinates(120, 120)
    slope = 0.4 * (c - 60)
    house = (np.abs(c - 53) < 7) & (np.abs(r - 60) < 6)
    found = decks_of(millimetres(np.where(house, 0.0, slope)))
    # the roof is 1.2 m over the ground 3 m from where it meets the slope
    assert found[house & (c < 55)].all()
    assert not found[~house].any()


def test_slopes_dams_and_single_walls_have_no_two_drops() -> None:
    c, _ = coordinates(120, 120)
    dam = 5.0 - np.clip((np.abs(c - 60) - 5.0) / 1.5, 0.0, 5.0)
    for z in (0.9 * c, dam, np.where(c > 60, 4.0, 0.0), 3.0 * np.floor(c / 12.0)):
        assert not decks_of(millimetres(z)).any()


def test_the_corner_of_a_terrace_has_drops_on_two_sides_that_are_not_parallel() -> None:
    c, r = coordinates(160, 160)
    terrace = (c - r > 0) & (c + r > 160)
    z = np.where(terrace, 4.0, 0.0)
    assert decks_of(millimetres(z)).mean() < 0.002


def test_a_wide_deck_must_be_higher_than_a_narrow_one() -> None:
    c, _ = coordinates(200, 200)
    for width, height, expected in ((20, 2.5, True), (80, 2.5, False), (80, 9.0, True), (130, 20.0, False)):
        strip = np.abs(c - 100) < width / 2
        found = decks_of(millimetres(np.where(strip, height, 0.0)))
        assert found[strip].mean() > 0.95 if expected else not found.any()
        assert not found[~strip].any()


def test_a_street_between_houses_is_no_deck_however_high_they_are() -> None:
    c, r = coordinates(150, 150)
    z = np.where(c % 47 < 40, 8.0 + 0.3 * np.abs(r % 20.0 - 10.0), 0.02 * c)
    assert not decks_of(millimetres(z))[c % 47 > 40].any()


def test_cars_and_trees_on_a_deck_do_not_hide_its_edges_and_gaps_between_points_make_none() -> None:
    random = np.random.default_rng(2)
    z, deck = valley_with_bridge(0.0)
    on_it = deck & (random.random(z.shape) < 0.1)
    lowest = millimetres(np.where(on_it, z + 1.8, z))
    lowest[random.random(z.shape) < 0.4] = NO_DATA
    found = decks_of(lowest)
    known = lowest != NO_DATA
    assert found[deck & known & ~on_it].mean() > 0.7
    assert found[~deck].mean() < 0.001
    assert not found[~known].any()


def test_no_cell_looks_farther_than_the_support() -> None:
    random = np.random.default_rng(3)
    z = 4.0 * (random.random((20, 25)) < 0.4)
    lowest = millimetres(np.kron(z, np.ones((6, 6))))
    lowest[random.random(lowest.shape) < 0.2] = NO_DATA
    widest = 15
    margin = math.ceil(between_walls_support_m(widest))
    whole = decks_of(lowest, widest)
    part = decks_of(np.ascontiguousarray(lowest[20:100, 30:130]), widest)
    inner = (slice(margin, 80 - margin), slice(margin, 100 - margin))
    np.testing.assert_array_equal(part[inner], whole[20:100, 30:130][inner])
    assert 0.02 < whole.mean() < 0.9


def test_turning_the_scene_by_right_angles_turns_the_decks() -> None:
    lowest = millimetres(valley_with_bridge(20.0)[0])
    for turns in (1, 2, 3):
        np.testing.assert_array_equal(
            np.rot90(decks_of(lowest), turns), decks_of(np.ascontiguousarray(np.rot90(lowest, turns)))
        )
