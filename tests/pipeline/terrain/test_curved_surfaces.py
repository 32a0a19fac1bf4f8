"""Domes, cones and barrels are one unit, at any size, rise, density and turn; houses of planes are not curves."""

import math

import numpy as np
import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.model import FloatArray, IntArray
from pipeline.terrain.curved_surfaces import _distances_from_quadric
from pipeline.terrain.terrain_settings import UnitSettings
from pipeline.terrain.unit_division import units_of

SETTINGS = UnitSettings()
SHAPES = ("barrel", "cap", "cone", "ellipsoid", "hemisphere")


def curve(shape: str, radius_m: float, steepness: float, u: FloatArray, v: FloatArray) -> FloatArray:
    """Elevations of a curved roof about the origin; nan outside. `steepness` is the rise over the radius."""
    rise_m = radius_m * (1.0 if shape == "hemisphere" else steepness)
    away = np.abs(v) if shape == "barrel" else np.hypot(u, v)
    if shape == "ellipsoid":
        away = np.hypot(u, v / 0.7)
    sphere_m = (radius_m**2 + rise_m**2) / (2.0 * rise_m)
    z = np.sqrt(np.maximum(sphere_m**2 - away**2, 0.0)) - (sphere_m - rise_m)
    if shape == "cone":
        z = rise_m * (1.0 - away / radius_m)
    if shape == "ellipsoid":
        z = rise_m * np.sqrt(np.maximum(1.0 - (away / radius_m) ** 2, 0.0))
    inside = (away < 0.97 * radius_m) & ((shape != "barrel") | (np.abs(u) < 1.5 * radius_m))
    return np.where(inside, 4.0 + z, np.nan)


def seen(shape: str, radius_m: float, steepness: float, density: float, turn: float, seed: int) -> tuple[IntArray, ...]:
    """Points of a roof, absolute millimetres."""
    rng = np.random.default_rng(seed)
    half = 1.9 * radius_m
    x, y = rng.uniform(-half, half, (2, round(density * 4.0 * half**2)))
    u, v = x * math.cos(turn) + y * math.sin(turn), y * math.cos(turn) - x * math.sin(turn)
    z = curve(shape, radius_m, steepness, u, v) + rng.normal(0.0, 0.02, len(x))
    places = np.column_stack((x + 400_000.0, y + 5_000_000.0, z + 100.0))[np.isfinite(z)]
    return tuple(np.rint(places * 1e3).astype(np.int64).T)


@settings(max_examples=examples(40), deadline=None)
@given(
    shape=st.sampled_from(SHAPES),
    radius_m=st.floats(3.5, 16.0),
    steepness=st.floats(0.2, 1.0),
    density=st.sampled_from([2.0, 5.0, 12.0]),
    turn=st.floats(0.0, math.pi),
    seed=st.integers(0, 99),
)
def test_a_curved_roof_is_one_unit(
    shape: str, radius_m: float, steepness: float, density: float, turn: float, seed: int
) -> None:
    assert units_of(*seen(shape, radius_m, steepness, density, turn, seed), SETTINGS).max() == 0


def test_the_order_of_the_points_does_not_matter() -> None:
    x, y, z = seen("hemisphere", 9.0, 1.0, 6.0, 0.3, 5)
    order = np.random.default_rng(1).permutation(len(x))
    assert units_of(x[order], y[order], z[order], SETTINGS).max() == units_of(x, y, z, SETTINGS).max() == 0


def test_a_dome_beside_a_house_stays_apart_from_it() -> None:
    """A house under a gable touches the dome; a step of some metres lies between their roofs."""
    x, y, z = seen("cap", 9.0, 0.6, 6.0, 0.0, 3)
    rng = np.random.default_rng(4)
    u, v = rng.uniform(8.8, 22.0, 900), rng.uniform(-6.0, 6.0, 900)
    roof = 12.0 + 0.8 * (6.0 - np.abs(v)) + rng.normal(0.0, 0.02, 900)
    house = np.rint(np.column_stack((u + 400_000.0, v + 5_000_000.0, roof + 100.0)) * 1e3).astype(np.int64)
    together = (np.concatenate(pair) for pair in zip((x, y, z), house.T, strict=True))
    units = units_of(*together, SETTINGS)
    of_dome, of_house = units[: len(x)], units[len(x) :]
    assert np.bincount(of_dome).max() > 0.95 * len(of_dome)
    assert np.bincount(of_house).max() > 0.95 * len(of_house)
    assert np.bincount(of_dome).argmax() != np.bincount(of_house).argmax()


@pytest.mark.parametrize("steps_m", [(0.0, 0.6, 1.3, 0.5), (0.0, 1.0, 0.2, 0.9)])
def test_houses_of_several_pitches_in_a_row_are_no_curve(steps_m: tuple[float, ...]) -> None:
    rng = np.random.default_rng(2)
    x, y = rng.uniform(0.0, 32.0, 2400), rng.uniform(0.0, 10.0, 2400)
    house = (x // 8.0).astype(int)
    pitch = np.array([0.5, 0.9, 0.6, 1.1])[house]
    z = 5.0 + np.array(steps_m)[house] + pitch * (5.0 - np.abs(y - 5.0)) + rng.normal(0.0, 0.02, 2400)
    xyz = np.rint(np.column_stack((x + 400_000.0, y + 5_000_000.0, z)) * 1e3).astype(np.int64)
    assert units_of(*xyz.T, SETTINGS).max() == 3


@pytest.mark.parametrize("shape", SHAPES)
def test_distances_from_a_quadric_are_those_from_the_surface(shape: str) -> None:
    x, y, z = (one.astype(np.float64) for one in seen(shape, 8.0, 0.7, 4.0, 0.4, 8))
    xyz = np.column_stack((x, y, z))
    away = _distances_from_quadric(xyz, np.ones(len(x), np.bool_), 120.0)
    assert np.median(away) < 30.0  # the noise is 20 mm, more or less upright
    raised = _distances_from_quadric(xyz + [0.0, 0.0, 500.0] * (np.arange(len(x)) % 9 == 0)[:, None],
                                     np.arange(len(x)) % 9 != 0, 120.0)  # fmt: skip
    assert np.median(raised[np.arange(len(x)) % 9 == 0]) > 250.0


def test_too_few_places_show_no_quadric() -> None:
    assert np.isinf(_distances_from_quadric(np.random.default_rng(0).random((19, 3)), np.ones(19, np.bool_), 0.1)).all()
