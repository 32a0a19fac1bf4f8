"""Verdicts on roofs alone: the same in every window; strays and wide halls."""

import numpy as np
import pytest
import shapely

from pipeline.model import BoolArray
from pipeline.terrain.lattice import NO_DATA, Elevations
from pipeline.terrain.roofs_alone import SUPPORT_CELLS, roofs_alone

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


def test_without_footprints_nothing_is_a_roof_alone() -> None:
    occupied = np.ones((5, 4), np.bool_)
    lowest = np.zeros((5, 4), np.int32)
    assert not roofs_alone(lowest, occupied, (0, 0), []).any()
    assert not roofs_alone(lowest, occupied, (0, 0), [shapely.box(50.0, 50.0, 60.0, 60.0)]).any()
