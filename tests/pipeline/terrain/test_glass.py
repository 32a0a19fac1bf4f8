"""Ground under glass is distinguished from alleys, courtyards and the ground of a wood."""

import numpy as np
import pytest

from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.terrain.facets import SceneVertices, VertexKind
from pipeline.terrain.glass import glass_of
from pipeline.terrain.thinning import highest_per_cell

LEAST_MM = 2000


def found_share(height_m: FloatArray, xy: FloatArray, inside: BoolArray, planar: int = 1) -> float:
    """Share of the low vertices in a part of the scene that lie under glass; heights (n,) over places."""
    x, y, z = (np.rint(values * 1e3).astype(np.int64) for values in (*xy.T, height_m))
    chosen, _ = highest_per_cell(x, y, z, np.zeros(len(x), np.int8), np.ones(len(x), np.bool_), 0.5)
    kind = np.where(z[chosen] < 500, VertexKind.GROUND, VertexKind.OBJECT).astype(np.int8)
    flags = np.where(kind == VertexKind.OBJECT, planar, -1).astype(np.int8)
    vertices = SceneVertices(
        x_mm=x[chosen], y_mm=y[chosen], z_mm=z[chosen], height_mm=z[chosen], kind=kind, planar=flags
    )
    found = glass_of(vertices, flags, (x, y), z, np.ones(len(x), np.bool_), (500, LEAST_MM))
    assert not found.under[z[chosen] >= LEAST_MM].any()
    assert not found.roof[z[chosen] < LEAST_MM].any()
    assert (found.seen_through <= (z < LEAST_MM)).all()
    low: IntArray = np.flatnonzero(inside[chosen] & (z[chosen] < LEAST_MM))
    return float(found.under[low].mean()) if len(low) else 0.0


def strewn(density: float, seed: int = 0) -> FloatArray:
    """Places on 40 m by 40 m."""
    return np.random.default_rng(seed).uniform(0.0, 40.0, (round(density * 1600), 2))


@pytest.mark.parametrize("density", [3.0, 8.0, 20.0])
@pytest.mark.parametrize("through", [0.35, 0.5, 0.6])
def test_ground_below_glass_is_found_and_that_around_it_is_not(density: float, through: float) -> None:
    xy = strewn(density)
    house = (np.abs(xy - 20.0) < (12.0, 6.0)).all(axis=1)
    stopped = np.random.default_rng(1).random(len(xy)) >= through
    height = np.where(house & stopped, 4.0, 0.0)
    middle = (np.abs(xy - 20.0) < (10.0, 4.0)).all(axis=1)
    away = (np.abs(xy - 20.0) > (14.5, 8.5)).any(axis=1)
    assert found_share(height, xy, middle) > 0.9
    assert found_share(height, xy, away) == 0.0


@pytest.mark.parametrize("plants_m", [0.0, 1.2])
@pytest.mark.parametrize("density", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("through", [0.4, 0.5, 0.65])
def test_glass_is_found_where_few_points_lie_and_over_plants(density: float, through: float, plants_m: float) -> None:
    xy = strewn(density)
    house = (np.abs(xy - 20.0) < (15.0, 7.0)).all(axis=1)
    rng = np.random.default_rng(1)
    stopped = rng.random(len(xy)) >= through
    height = np.where(house, np.where(stopped, 4.0, plants_m * rng.random(len(xy))), 0.0)
    middle = (np.abs(xy - 20.0) < (13.0, 5.0)).all(axis=1)
    away = (np.abs(xy - 20.0) > (15.5, 7.5)).any(axis=1)
    assert found_share(height, xy, middle) > (0.95 if density > 1.0 else 0.8)
    assert found_share(height, xy, away) == 0.0


@pytest.mark.parametrize("width_m", [0.6, 1.0, 1.5, 3.0])
@pytest.mark.parametrize("density", [1.0, 2.0, 8.0, 20.0])
def test_alleys_between_houses_stay(width_m: float, density: float) -> None:
    xy = strewn(density, 3)
    alley = np.minimum(np.abs(xy[:, 0] - 13.3), np.abs(xy[:, 0] - 26.7)) < width_m / 2.0
    assert found_share(np.where(alley, 0.0, 6.0), xy, alley) == 0.0


@pytest.mark.parametrize("density", [1.0, 2.0, 8.0])
@pytest.mark.parametrize("side_m", [1.0, 2.0, 5.0])
def test_courtyards_stay(side_m: float, density: float) -> None:
    xy = strewn(density, 4)
    yard = (np.abs((xy - 5.0) % 10.0 - 5.0) < side_m / 2.0).all(axis=1)
    assert found_share(np.where(yard, 0.0, 6.0), xy, yard) == 0.0


@pytest.mark.parametrize("density", [0.3, 0.45])
def test_nothing_is_glass_where_houses_are_mixed_with_what_surrounds_them(density: float) -> None:
    xy = strewn(density, 7)
    rows = (xy[:, 0] % 9.0 < 6.0) & (xy[:, 1] % 9.0 < 6.0)
    assert found_share(np.where(rows, 6.0, 0.0), xy, np.ones(len(xy), np.bool_)) == 0.0


def test_a_roof_of_tiles_is_not_of_glass_where_plants_stand_beside_it() -> None:
    xy = strewn(2.0, 8)
    inside = (np.abs(xy - 20.0) < (8.0, 5.0)).all(axis=1)
    height = np.where(inside, 5.0, np.random.default_rng(9).uniform(0.0, 1.8, len(xy)))
    assert found_share(height, xy, np.ones(len(xy), np.bool_)) == 0.0


@pytest.mark.parametrize("density", [1.0, 2.0, 6.0])
def test_ground_below_rough_crowns_stays(density: float) -> None:
    xy = strewn(density, 5)
    rng = np.random.default_rng(6)
    height = np.where(rng.random(len(xy)) < 0.5, 0.0, rng.uniform(4.0, 12.0, len(xy)))
    assert found_share(height, xy, np.ones(len(xy), np.bool_), planar=0) == 0.0


def test_the_place_on_the_lattice_does_not_matter() -> None:
    xy = strewn(8.0)
    house = (np.abs(xy - 20.0) < (12.0, 6.0)).all(axis=1)
    height = np.where(house & (np.random.default_rng(1).random(len(xy)) < 0.5), 4.0, 0.0)
    shares = [
        found_share(height, xy + np.array([east, 0.7 * east]), (np.abs(xy - 20.0) < (10.0, 4.0)).all(axis=1))
        for east in (0.0, 0.4, 1.3)
    ]
    assert min(shares) > 0.9
