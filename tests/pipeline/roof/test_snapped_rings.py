"""Rings on the grid and the areas between them, against the overlays of GEOS."""

import numpy as np
import pytest
import shapely
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.roof.snapped_rings import _most_area_between, differ_by_more, on_grid, snapped_ring

Ring = np.ndarray[tuple[int, int], np.dtype[np.float64]]


def star(rng: np.random.Generator, count: int, least: float, most: float) -> Ring:
    """Vertices around the origin, the interior on their left."""
    angle = np.sort(rng.uniform(0.0, 2.0 * np.pi, count))
    return (rng.uniform(least, most, count) * (np.cos(angle), np.sin(angle))).T.copy()


@given(st.integers(0, 2**32 - 1), st.integers(3, 30), st.sampled_from([4.0, 30.0, 1e4]), st.booleans())
@settings(max_examples=examples(300), deadline=None)
def test_a_ring_that_only_moves_its_vertices_is_the_one_that_geos_draws(
    seed: int, count: int, size: float, halves: bool
) -> None:
    ring = star(np.random.default_rng(seed), count, 0.5 * size, size)
    if halves:
        ring = np.round(2.0 * ring) / 2.0
    if seed % 2:
        ring = ring[::-1].copy()
    polygon = shapely.Polygon(ring)
    snapped = snapped_ring(ring)
    if polygon.is_valid:
        assert shapely.equals_identical(on_grid(polygon), shapely.set_precision(polygon, 1.0))
        if len(snapped):
            assert (np.sort(snapped, axis=0) == np.sort(np.floor(ring + 0.5), axis=0)).all()
    else:
        assert len(snapped) == 0


def test_most_rings_of_the_size_of_a_house_only_move_their_vertices() -> None:
    rng = np.random.default_rng(5)
    assert sum(len(snapped_ring(star(rng, 30, 4e3, 6e3))) > 0 for _ in range(100)) > 80


@pytest.mark.parametrize(
    "ring",
    [
        [(0, 0), (9, 9), (9, 0), (0, 9)],
        [(0, 0), (9, 0), (9, 0.6), (0, 0.6)],
        [(0, 0), (9, 0), (5, 0.2), (5, 9)],
        [(0, 0), (9, 0), (9, 9), (9.3, 9.2), (0, 9)],
        [(0, 0), (9, 0)],
    ],
    ids=["bow tie", "sliver", "spike", "repeated vertex", "no area"],
)
def test_a_ring_that_changes_more_than_its_vertices_is_left_to_geos(ring: list[tuple[float, float]]) -> None:
    assert len(snapped_ring(np.array(ring, np.float64))) == 0


@given(st.integers(0, 2**32 - 1), st.integers(3, 12), st.integers(3, 60), st.booleans())
@settings(max_examples=examples(200), deadline=None)
def test_the_bound_of_the_area_between_rings_is_not_below_the_area(seed: int, n: int, m: int, turned: bool) -> None:
    rng = np.random.default_rng(seed)
    ring, other = star(rng, n, 4e3, 6e3), star(rng, m, 4e3, 6e3)
    if turned:
        other = other[::-1].copy()
    area = shapely.symmetric_difference(shapely.Polygon(ring), shapely.Polygon(other)).area
    assert _most_area_between(ring, other) >= area * (1.0 - 1e-9)
    assert not differ_by_more(ring, other, area * 1.001)
    assert differ_by_more(ring, other, area * 0.999)


def test_the_bound_is_near_the_area_between_a_rectangle_and_its_ragged_outline() -> None:
    rng = np.random.default_rng(3)
    box = shapely.box(0, 0, 12_000, 8_000)
    ring = shapely.get_coordinates(box)[:-1]
    ragged = shapely.get_coordinates(shapely.segmentize(box, 400.0))[:-1] + rng.uniform(-150, 150, (100, 2))
    area = shapely.symmetric_difference(box, shapely.Polygon(ragged)).area
    assert area <= _most_area_between(ring, ragged) < 1.4 * area
    assert not differ_by_more(ring, ring, 1.0)
