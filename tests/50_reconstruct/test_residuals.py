"""Residuals against a plain search, and what a missing roof costs."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import Polygon

from pipeline.model import Plane, RoofFace
from pipeline.quality.residuals import summarise, top_surface, vertical_residuals


def plane(a: float, b: float, c: float) -> Plane:
    return Plane(a=a, b=b, c=c, n_points=1, rmse_m=0.0)


def face(polygon: Polygon, index: int) -> RoofFace:
    return RoofFace(plane=index, polygon=shapely.force_3d(polygon))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_the_top_surface_is_that_of_a_plain_search(seed: int) -> None:
    rng = np.random.default_rng(seed)
    faces, planes = [], []
    for k in range(int(rng.integers(1, 8))):
        shape = shapely.affinity.rotate(shapely.box(0, 0, *rng.uniform(1, 9, 2)), rng.uniform(0, 90))
        shape = shapely.affinity.translate(shape, *rng.uniform(-10, 10, 2))
        if rng.uniform() < 0.5:
            shape = shape.difference(shape.centroid.buffer(0.4))
        faces.append(face(shape, k))
        planes.append(plane(*rng.uniform(-1, 1, 2), rng.uniform(2, 9)))
    points = np.column_stack((rng.uniform(-15, 20, (200, 2)), rng.uniform(0, 10, 200)))
    expected = np.full(len(points), np.nan)
    for f in faces:
        inside = shapely.contains_xy(f.polygon, points[:, 0], points[:, 1])
        p = planes[f.plane]
        z = p.a * points[:, 0] + p.b * points[:, 1] + p.c
        expected = np.where(inside, np.fmax(expected, z), expected)
    assert top_surface(points, faces, planes) == pytest.approx(expected, nan_ok=True, abs=1e-9)


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
