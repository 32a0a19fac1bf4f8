"""Residuals against a plain search, and what a missing roof costs."""

import math

import numpy as np
import pytest
import shapely
from examples import examples
from faces_by_hand import plane
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Polygon

from pipeline.model import RoofFace
from pipeline.quality.residuals import TopSurface, plan_index, summarise, surface_of, vertical_residuals


def face(polygon: Polygon, index: int) -> RoofFace:
    return RoofFace(plane=index, polygon=shapely.force_3d(polygon))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=examples(40), deadline=None)
def test_the_top_surface_is_that_of_a_plain_search(seed: int) -> None:
    rng = np.random.default_rng(seed)
    polygons, coefficients = turned_faces(rng, int(rng.integers(1, 8)), spread_m=15.0)
    faces = [face(polygon, k) for k, polygon in enumerate(polygons)]
    planes = [plane(*row) for row in coefficients.tolist()]
    points = np.column_stack((rng.uniform(-5, 25, (200, 2)), rng.uniform(0, 10, 200)))
    expected = np.full(len(points), np.nan)
    for f in faces:
        inside = shapely.contains_xy(f.polygon, points[:, 0], points[:, 1])
        p = planes[f.plane]
        z = p.a * points[:, 0] + p.b * points[:, 1] + p.c
        expected = np.where(inside, np.fmax(expected, z), expected)
    found = surface_of(faces, planes).elevation(points[:, 0], points[:, 1])
    assert found == pytest.approx(expected, nan_ok=True, abs=1e-9)


def test_a_point_on_the_border_of_two_faces_belongs_to_exactly_one() -> None:
    faces = [face(shapely.box(0, 0, 2, 2), 0), face(shapely.box(2, 0, 4, 2), 1)]
    planes = [plane(0, 0, 5.0), plane(0, 0, 7.0)]
    on_border = np.array([[2.0, 1.0, 5.0], [1.0, 1.0, 5.0], [3.0, 1.0, 7.0]])
    assert np.isfinite(vertical_residuals(on_border, faces, planes)).all()


def test_points_above_are_positive_and_outside_are_nan() -> None:
    faces, planes = [face(shapely.box(0, 0, 2, 2), 0)], [plane(0.5, 0.0, 3.0)]
    residuals = vertical_residuals(np.array([[1.0, 1.0, 4.0], [5.0, 1.0, 4.0]]), faces, planes)
    assert residuals[0] == pytest.approx(0.5)
    assert math.isnan(residuals[1])


def test_a_smaller_roof_cannot_buy_a_better_share() -> None:
    points = np.column_stack((np.linspace(0.05, 9.95, 100), np.full(100, 0.5), np.full(100, 3.0)))
    planes = [plane(0, 0, 3.0)]
    whole = summarise(vertical_residuals(points, [face(shapely.box(0, 0, 10, 1), 0)], planes))
    half = summarise(vertical_residuals(points, [face(shapely.box(0, 0, 5, 1), 0)], planes))
    assert (whole.share_within, whole.coverage) == (1.0, 1.0)
    assert (half.share_within, half.coverage) == (0.5, 0.5)
    assert half.rmse_m == 0.0


def test_figures_are_those_of_numpy() -> None:
    residuals = np.random.default_rng(0).normal(0, 0.2, 501)
    summary = summarise(residuals)
    assert summary.rmse_m == pytest.approx(np.sqrt(np.mean(residuals**2)))
    assert summary.median_m == pytest.approx(np.median(np.abs(residuals)))
    assert summary.p95_m == pytest.approx(np.percentile(np.abs(residuals), 95))
    assert summary.share_within == pytest.approx(np.mean(np.abs(residuals) <= 0.2))


def test_nothing_covered_gives_nan_and_zero() -> None:
    summary = summarise(np.full(3, np.nan))
    assert math.isnan(summary.rmse_m)
    assert (summary.coverage, summary.share_within, summary.n_points) == (0.0, 0.0, 3)
    assert len(vertical_residuals(np.zeros((0, 3)), [], [])) == 0


def turned_faces(rng: np.random.Generator, n: int, spread_m: float = 40.0) -> tuple[list[Polygon], np.ndarray]:
    """Turned rectangles with and without holes, whose planes are given about (0, 0)."""
    polygons = []
    for _ in range(n):
        shape = shapely.affinity.rotate(shapely.box(0, 0, *rng.uniform(2, 9, 2)), rng.uniform(0, 90))
        shape = shapely.affinity.translate(shape, *rng.uniform(0, spread_m, 2))
        polygons.append(shape.difference(shape.centroid.buffer(0.5)) if rng.uniform() < 0.4 else shape)
    return polygons, np.column_stack((rng.uniform(-1, 1, (n, 2)), rng.uniform(2, 9, n)))


def test_a_top_surface_built_once_is_asked_for_elevations_and_faces() -> None:
    rng = np.random.default_rng(3)
    polygons, coefficients = turned_faces(rng, 30)
    x, y = rng.uniform(-2, 52, (2, 3000))
    top, number = TopSurface(polygons, coefficients).at(x, y)
    for i in range(0, 3000, 7):  # the slow twin: point by point, face by face
        heights = {
            k: coefficients[k] @ (x[i], y[i], 1.0)
            for k, polygon in enumerate(polygons)
            if polygon.contains(shapely.Point(x[i], y[i]))
        }
        if not heights:
            assert math.isnan(top[i])
            assert number[i] == -1
        else:
            best = max(heights, key=lambda k: heights[k])
            assert number[i] == best
            assert top[i] == pytest.approx(heights[best], abs=1e-9)


def test_nothing_is_lost_at_coordinates_of_millions_of_metres() -> None:
    rng = np.random.default_rng(4)
    polygons, coefficients = turned_faces(rng, 20)
    x, y = np.round(rng.uniform(0, 50, (2, 5000)), 3)
    far = (1_234_567.0, 5_876_543.0)
    moved = [shapely.transform(shapely.set_precision(p, 2.0**-20), lambda xy: xy + far) for p in polygons]
    near = [shapely.set_precision(p, 2.0**-20) for p in polygons]
    origins = np.tile([*far, 0.0], (20, 1))
    here = TopSurface(near, coefficients).elevation(x, y)
    there = TopSurface(moved, coefficients, origins).elevation(x + far[0], y + far[1])
    assert there == pytest.approx(here, nan_ok=True, abs=1e-8)


def test_a_gap_of_less_than_the_tolerance_is_none() -> None:
    """Two faces whose shared border was rounded apart by half a millimetre."""
    polygons = [shapely.box(0, 0, 1.9996, 2), shapely.box(2.0001, 0, 4, 2)]
    planes = np.array([[0, 0, 5.0], [0, 0, 7.0]])
    x, y = np.array([1.9998, 4.0005, 4.002]), np.array([1.0, 1.0, 1.0])
    assert np.isnan(TopSurface(polygons, planes).elevation(x, y)).all()
    within = TopSurface(polygons, planes, tolerance_m=0.001).elevation(x, y)
    assert within[:2].tolist() == [7.0, 7.0]
    assert math.isnan(within[2])


def test_a_plan_index_says_which_polygon_holds_a_place_parts_and_all() -> None:
    two_parts = shapely.MultiPolygon([shapely.box(0, 0, 1, 1), shapely.box(5, 0, 6, 1)])
    index = plan_index([two_parts, shapely.box(1, 0, 3, 1), shapely.box(2, 0, 5, 1)])
    x = np.array([0.5, 5.5, 1.0, 2.5, 4.0, 9.0])
    assert index.face(x, np.full(6, 0.5)).tolist() == [0, 0, 1, 1, 2, -1]
    assert plan_index([]).face(x, x).tolist() == [-1] * 6


def test_a_corner_of_many_faces_belongs_to_exactly_one() -> None:
    fan = [Polygon([(0, 0), (math.cos(a), math.sin(a)), (math.cos(b), math.sin(b))]) for a, b in FAN]
    counted = sum(plan_index([part]).face(np.zeros(1), np.zeros(1))[0] == 0 for part in fan)
    assert counted == 1


FAN = [(k * math.pi / 4, (k + 1) * math.pi / 4) for k in range(8)]
