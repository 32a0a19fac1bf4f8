"""Straight borders: ridges exactly where planes cross, steps along lines, and always a coverage."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import shapely
from examples import examples
from faces_by_hand import plane
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.roof.borders import straighten_borders
from pipeline.roof.partition import RoofPartition, march
from pipeline.roof.roof_settings import RoofSettings
from pipeline.roof.traced_forms import clip_partition
from pipeline.tin.delaunay import triangulate

ExactRoofs = Callable[..., Any]
SETTINGS = RoofSettings()
WIDTH_MM = 10_000


def is_coverage(partition: RoofPartition) -> bool:
    polygons = np.array(partition.polygons, dtype=object)
    return bool(shapely.is_valid(polygons).all() and shapely.coverage_is_valid(polygons))


def two_faces(border: list[tuple[float, float]]) -> RoofPartition:
    """A square cut by a border from its lower to its upper side."""
    left = shapely.Polygon([(0, 0), *border, (0, WIDTH_MM)])
    right = shapely.Polygon([(WIDTH_MM, WIDTH_MM), *border[::-1], (WIDTH_MM, 0)])
    return RoofPartition(polygons=(left, right), labels=np.array([0, 1], np.int32))


def zigzag(amplitude_mm: float, seed: int = 0) -> list[tuple[float, float]]:
    rng = np.random.default_rng(seed)
    y = np.arange(0, WIDTH_MM + 1, 250)
    x = np.rint(5000 + rng.uniform(-amplitude_mm, amplitude_mm, len(y)))
    return [(float(px), float(py)) for px, py in zip(x, y, strict=True)]


def test_a_zigzag_step_becomes_one_line_square_to_the_outline() -> None:
    straight = straighten_borders(two_faces(zigzag(250.0)), [plane(0, 0, 9.0), plane(0, 0, 5.0)], 0.5)
    assert is_coverage(straight)
    for polygon in straight.polygons:
        assert shapely.get_num_coordinates(polygon) == 5
        x = shapely.get_coordinates(polygon)[:, 0]
        border = x[(x > 0) & (x < WIDTH_MM)]
        assert np.ptp(border) == 0.0
        assert border[0] == pytest.approx(5000, abs=60)


def test_a_ridge_lies_exactly_where_the_planes_cross() -> None:
    planes = [plane(0.6, 0.1, 3.0), plane(-0.6, 0.1, 3.0 + 1.2 * 5.08)]
    straight = straighten_borders(two_faces(zigzag(200.0)), planes, 0.5)
    x = shapely.get_coordinates(straight.polygons[0])[:, 0]
    assert set(x[x > 0].tolist()) == {5080.0}


def test_a_step_with_a_corner_keeps_it() -> None:
    rng = np.random.default_rng(2)
    lower = [(4000 + rng.uniform(-150, 150), y) for y in np.arange(0, 5000, 250)]
    across = [(x, 5000 + rng.uniform(-150, 150)) for x in np.arange(4250, 7000, 250)]
    upper = [(7000 + rng.uniform(-150, 150), y) for y in np.arange(5000, WIDTH_MM + 1, 250)]
    border = [(float(round(x)), float(round(y))) for x, y in (*lower, *across, *upper)]
    straight = straighten_borders(two_faces(border), [plane(0, 0, 9.0), plane(0, 0, 5.0)], 0.5)
    assert is_coverage(straight)
    assert shapely.get_num_coordinates(straight.polygons[0]) == 7
    assert straight.polygons[0].area == pytest.approx(55e6, rel=0.01)


def test_three_planes_of_a_hip_meet_in_one_point(exact_roof: ExactRoofs) -> None:
    roof = exact_roof("hip", noise_m=0.03, seed=3, with_footprint=True, density=6.0)
    partition = roof.drawn()
    assert [shapely.get_num_coordinates(p) - 1 for p in partition.polygons].count(3) == 2
    vertices = np.unique(np.concatenate([shapely.get_coordinates(p) for p in partition.polygons]), axis=0)
    inner = [v for v in vertices.tolist() if 0 < v[0] < 14_000 and 0 < v[1] < 8000]
    assert sorted(inner) == [[4000.0, 4000.0], [10_000.0, 4000.0]]


def test_the_outline_stays(exact_roof: ExactRoofs) -> None:
    roof = exact_roof("dormer", noise_m=0.03, with_footprint=True, turn_deg=20.0)
    plan, points, _ = roof.partition()
    clipped = clip_partition(plan.faces, plan.outline_mm, 1.0)
    straight = straighten_borders(clipped, plan.planes, points.spacing_m)
    assert is_coverage(straight)
    before, after = (shapely.union_all(list(p.polygons)) for p in (clipped, straight))
    assert shapely.symmetric_difference(before, after).area < 2.0 * before.length
    n_before, n_after = (sum(shapely.get_num_coordinates(list(p.polygons))) for p in (clipped, straight))
    assert n_after < 0.3 * n_before


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=examples(60), deadline=None)
def test_any_partition_stays_a_coverage_with_the_same_faces(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n, k = int(rng.integers(30, 300)), int(rng.integers(2, 7))
    inner = np.unique(rng.integers(0, 9000, (n, 2)), axis=0)
    frame = np.array([(-3000, -3000), (12_000, -3001), (12_001, 12_000), (-3001, 12_001)])
    xy = np.concatenate((inner, frame))
    labels = np.full(len(xy), -1, np.int32)
    labels[: len(inner)] = rng.integers(0, k, len(inner))
    coefficients = np.column_stack((rng.uniform(-1, 1, (k, 2)), rng.uniform(3, 9, k)))
    partition = march(xy, triangulate(xy), labels, coefficients, 0.3, 0.2)
    if not is_coverage(partition):
        return  # points a few millimetres apart, cut and rounded
    planes = [plane(*row) for row in coefficients.tolist()]
    straight = straighten_borders(partition, planes, float(rng.uniform(0.2, 1.5)))
    assert straight.labels.tolist() == partition.labels.tolist()
    assert is_coverage(straight)
    xy_after = shapely.get_coordinates(list(straight.polygons))
    assert np.array_equal(xy_after, np.rint(xy_after))


def test_a_turned_roof_gives_the_turned_borders(exact_roof: ExactRoofs) -> None:
    areas = [
        sorted(p.area * 1e-6 for p in exact_roof("l", turn_deg=turn, with_footprint=True).drawn().polygons)
        for turn in (0.0, 90.0, 37.0)
    ]
    assert areas[1] == pytest.approx(areas[0], abs=0.3)
    assert areas[2] == pytest.approx(areas[0], abs=0.3)


def test_borders_can_be_left_as_they_are(exact_roof: ExactRoofs) -> None:
    roof = exact_roof("stepped", noise_m=0.03, with_footprint=True)
    ragged, straight = (
        sum(shapely.get_num_coordinates(list(roof.drawn(dataclasses.replace(SETTINGS, straight_borders=on)).polygons)))
        for on in (False, True)
    )
    assert straight <= 14
    assert ragged > 1.5 * straight


def test_an_island_is_drawn_with_straight_sides(exact_roof: ExactRoofs) -> None:
    roof = exact_roof("tower", with_footprint=True, density=12.0)
    outer, tower = roof.drawn().polygons
    assert shapely.get_num_coordinates(tower) <= 8
    assert tower.area * 1e-6 == pytest.approx(16.0, rel=0.15)
    assert shapely.Polygon(outer.interiors[0]).equals(tower)
