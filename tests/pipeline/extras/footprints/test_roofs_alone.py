"""Verdicts on roofs alone: the same in every window; strays and wide halls."""

from typing import Any

import numpy as np
import pytest
import shapely

from pipeline.extras.footprints.roofs_alone import SUPPORT_CELLS, roofs_alone
from pipeline.model import BoolArray
from pipeline.terrain.lattice import NO_DATA, Elevations
from pipeline.terrain.reach import ROOFS_ALONE_CELLS

SIDE = 420


def patchy(seed: int) -> tuple[Elevations, BoolArray, list[shapely.Polygon]]:
    """Houses of several sizes, a part of them among ground, the others alone or in a margin of ground; gaps between."""
    random = np.random.default_rng(seed)
    lowest = np.full((SIDE, SIDE), NO_DATA, np.int32)
    outlines = []
    for east in range(10, SIDE - 90, 45):
        for north in range(10, SIDE - 90, 45):
            wide, high = random.integers(6, 40, 2) if random.random() < 0.9 else (90, 70)
            margin = int(random.choice([0, 0, 1, 2, 9]))
            lowest[max(north - margin, 0) : north + high + margin, max(east - margin, 0) : east + wide + margin] = 0
            lowest[north : north + high, east : east + wide] = random.integers(2500, 9000)
            outlines.append(shapely.box(east, north, east + wide, north + high))
    lowest[random.random(lowest.shape) < 0.1] = NO_DATA
    return lowest, lowest != NO_DATA, outlines


@pytest.mark.parametrize("seed", [1, 2])
def test_the_verdict_does_not_depend_on_the_window(seed: int) -> None:
    lowest, occupied, outlines = patchy(seed)
    whole = roofs_alone(lowest, occupied, (0, 0), outlines)
    assert 0.02 < whole.mean() < 0.6
    for row, column, size in ((0, 0, 300), (37, 91, 290), (120, 130, 300)):
        part = (slice(row, row + size), slice(column, column + size))
        found = roofs_alone(lowest[part], occupied[part], (column, row), outlines[::-1])
        edges = [
            (0 if start == 0 else SUPPORT_CELLS, size if start + size >= SIDE else size - SUPPORT_CELLS)
            for start in (row, column)
        ]
        inner = (slice(*edges[0]), slice(*edges[1]))
        assert found[inner].size
        assert np.array_equal(found[inner], whole[part][inner])


@pytest.mark.parametrize(("seen", "alone"), [(0.0, True), (0.02, True), (0.5, False)])
def test_stray_points_around_a_footprint_do_not_count(seen: float, alone: bool) -> None:
    random = np.random.default_rng(4)
    occupied = np.zeros((120, 120), np.bool_)
    around = (slice(35, 85), slice(30, 90))
    occupied[around] = random.random((50, 60)) < seen * 192 / 3000
    occupied[54:66, 52:68] = True
    lowest = np.where(occupied, 5000, NO_DATA).astype(np.int32)
    found = roofs_alone(lowest, occupied, (1000, -500), [shapely.box(1052.0, -446.0, 1068.0, -434.0)])
    assert found[54:66, 52:68].all() == alone
    assert found.any() == alone


def test_a_hall_wider_than_the_squares_looked_at_is_alone_as_a_whole() -> None:
    occupied = np.zeros((400, 400), np.bool_)
    occupied[60:340, 70:330] = True
    lowest = np.where(occupied, 9000, NO_DATA).astype(np.int32)
    found = roofs_alone(lowest, occupied, (0, 0), [shapely.box(70.0, 60.0, 330.0, 340.0)])
    assert found[occupied].all()


def clipped_house(rise: float, eaves_m: float, margin_m: float, density: float, seed: int) -> tuple[Elevations, Any]:
    """The lowest points of a gabled house of 10 m by 8 m on level ground, clipped with a margin; its outline."""
    random = np.random.default_rng(seed)
    x, y = random.uniform(0.0, 40.0, (2, round(density * 40**2)))
    east, north = 20.0 + random.random(2)
    u, v = np.abs(x - east), np.abs(y - north)
    z = np.where((u < 5.0) & (v < 4.0), eaves_m + rise * (4.0 - v), 0.0) + random.normal(0.0, 0.02, len(x))
    kept = (u < 5.0 + margin_m) & (v < 4.0 + margin_m)
    lowest = np.full((40, 40), np.iinfo(np.int32).max, np.int32)
    np.minimum.at(lowest, (y[kept].astype(int), x[kept].astype(int)), np.round(z[kept] * 1000).astype(np.int32))
    lowest[lowest == np.iinfo(np.int32).max] = NO_DATA
    return lowest, shapely.box(east - 5.0, north - 4.0, east + 5.0, north + 4.0)


@pytest.mark.parametrize("density", [1.0, 2.0, 3.0, 6.0])
@pytest.mark.parametrize("rise", [1.0, 1.73, 2.2, 2.75])
def test_steep_eaves_are_not_ground(rise: float, density: float) -> None:
    alone = 0
    for seed in range(20):
        lowest, outline = clipped_house(rise, 3.0, 0.0, density, seed)
        alone += int(roofs_alone(lowest, lowest != NO_DATA, (0, 0), [outline]).any())
    assert alone >= 19


@pytest.mark.parametrize("density", [2.0, 6.0, 12.0])
@pytest.mark.parametrize("margin_m", [1.0, 2.0])
@pytest.mark.parametrize(("rise", "eaves_m"), [(0.0, 2.2), (0.5, 2.2), (1.0, 3.0), (1.73, 5.0)])
def test_ground_beside_low_and_steep_roofs_stays_ground(
    rise: float, eaves_m: float, margin_m: float, density: float
) -> None:
    alone = 0
    for seed in range(20):
        lowest, outline = clipped_house(rise, eaves_m, margin_m, density, seed)
        alone += int(roofs_alone(lowest, lowest != NO_DATA, (0, 0), [outline]).any())
    assert alone <= 1


def test_without_footprints_nothing_is_a_roof_alone() -> None:
    occupied = np.ones((5, 4), np.bool_)
    lowest = np.zeros((5, 4), np.int32)
    assert not roofs_alone(lowest, occupied, (0, 0), []).any()
    assert not roofs_alone(lowest, occupied, (0, 0), [shapely.box(50.0, 50.0, 60.0, 60.0)]).any()


def test_the_run_gives_the_verdict_all_that_it_looks_at() -> None:
    assert ROOFS_ALONE_CELLS == SUPPORT_CELLS
