"""Faces end at the heights that their points show: up the slope soon, down the slope later."""

import dataclasses
import math

import numpy as np
import pytest
import shapely

from pipeline.model import FloatArray, Plane, Reason
from pipeline.quality.validity import check_solid
from pipeline.roof.partition import RoofPartition
from pipeline.roof.plan import RoofPoints
from pipeline.roof.roof_settings import RoofSettings
from pipeline.roof.solid import solid_parts
from pipeline.roof.unlike_points import contradiction_of
from pipeline.roof.unsupported_faces import level_unsupported_faces

SETTINGS = RoofSettings()
SPACING_M, NOISE_M = 0.5, 0.02


def plane(a: float, b: float, c: float, n_points: int = 100) -> Plane:
    return Plane(a=a, b=b, c=c, n_points=n_points, rmse_m=NOISE_M)


def roof_of(points: FloatArray, label: int = 0) -> RoofPoints:
    """Roof points in their order, all with one label."""
    points = points[np.lexsort((points[:, 1], points[:, 0]))]
    bare = RoofPoints.none(None)
    return dataclasses.replace(
        bare,
        points=points,
        xy_mm=np.rint(points[:, :2] * 1e3).astype(np.int64),
        index=np.arange(len(points)),
        labels=np.full(len(points), label, np.int32),
        split=np.zeros(len(points), np.bool_),
        spacing_m=SPACING_M,
    )


def grid(x0: float, y0: float, x1: float, y1: float, a: float, b: float, c: float) -> FloatArray:
    """Points on a plane, every half metre."""
    x, y = np.meshgrid(np.arange(x0 + 0.25, x1, 0.5), np.arange(y0 + 0.25, y1, 0.5))
    return np.column_stack((x.ravel(), y.ravel(), (a * x + b * y + c).ravel()))


def boxes(*bounds: tuple[float, float, float, float]) -> RoofPartition:
    polygons = tuple(shapely.transform(shapely.box(*one), lambda xy: np.rint(xy * 1e3)) for one in bounds)
    return RoofPartition(polygons=polygons, labels=np.arange(len(bounds), dtype=np.int32))


@pytest.mark.parametrize("seen_m", [2.0, 4.0, 6.0])
@pytest.mark.parametrize("slope", [0.3, 0.8, 1.5])
def test_a_slope_is_level_behind_its_last_points(seen_m: float, slope: float) -> None:
    side = plane(0.0, slope, 5.0)
    roof = roof_of(grid(0, 0, 12, seen_m, 0.0, slope, 5.0))
    drawn, planes = level_unsupported_faces(boxes((0, 0, 12, 10)), roof, [side], 0.0, SETTINGS)
    assert planes[0] is side
    top_m = 5.0 + slope * (seen_m - 0.25) + slope * SPACING_M + 3 * NOISE_M
    assert [one.c for one in planes[1:]] == [pytest.approx(top_m, abs=1e-3)]
    assert [one.n_points for one in planes[1:]] == [0]
    sloped, level = (drawn.polygons[drawn.labels.tolist().index(k)] for k in (0, 1))
    assert (sloped.area + level.area) * 1e-6 == pytest.approx(120.0)
    assert level.bounds[1] * 1e-3 == pytest.approx((top_m - 5.0) / slope, abs=0.002)
    assert [check_solid(part.solid) for part in solid_parts(drawn, planes, 0.0)] == [()]
    assert contradiction_of(drawn, planes, roof, roof, [side]) is None


def test_a_slope_may_go_on_over_two_spacings() -> None:
    side = plane(0.0, 0.8, 5.0)
    partition = boxes((0, 0, 12, 8))
    roof = roof_of(grid(0, 0, 12, 7.5, 0.0, 0.8, 5.0))
    drawn, planes = level_unsupported_faces(partition, roof, [side], 0.0, SETTINGS)
    assert drawn is partition
    assert planes == [side]


def test_a_slope_goes_on_down_to_an_eave_and_is_level_far_below() -> None:
    side = plane(0.0, 0.8, 5.0)
    roof = roof_of(grid(0, 4, 12, 8, 0.0, 0.8, 5.0))
    near = boxes((0, 2, 12, 8))
    assert level_unsupported_faces(near, roof, [side], 0.0, SETTINGS)[0] is near
    drawn, planes = level_unsupported_faces(boxes((0, -2, 12, 8)), roof, [side], 0.0, SETTINGS)
    lowest_m = float(roof.points[:, 2].min()) - SETTINGS.max_overshoot_m
    assert [one.c for one in planes[1:]] == [pytest.approx(lowest_m, abs=1e-3)]
    sloped = drawn.polygons[drawn.labels.tolist().index(0)]
    assert sloped.area * 1e-6 == pytest.approx(12 * (8 - (lowest_m - 5.0) / 0.8), abs=0.1)


def test_a_neighbour_stays_as_it_is() -> None:
    partition = boxes((0, 0, 12, 10), (12, 0, 20, 10))
    points = np.concatenate((grid(0, 0, 12, 4, 0.0, 0.8, 5.0), grid(12, 0, 20, 10, 0.0, 0.0, 6.0)))
    roof = roof_of(points, label=-1)
    labels = np.where(roof.points[:, 0] < 12, 0, 1).astype(np.int32)
    roof = dataclasses.replace(roof, labels=labels)
    drawn, planes = level_unsupported_faces(partition, roof, [plane(0, 0.8, 5.0), plane(0, 0, 6.0)], 0.0, SETTINGS)
    assert drawn.labels.tolist() == [0, 2, 1]
    assert shapely.coverage_is_valid(np.array(drawn.polygons, object))
    assert len(planes) == 3


def test_a_face_without_points_on_its_plane_becomes_level_as_a_whole() -> None:
    roof = roof_of(grid(0, 0, 12, 10, 0.0, 0.0, 6.0))
    drawn, planes = level_unsupported_faces(boxes((0, 0, 12, 10)), roof, [plane(0.0, 4.0, 5.0)], 0.0, SETTINGS)
    assert drawn.labels.tolist() == [1]
    assert planes[1].c == pytest.approx(6.0)


def test_a_face_that_was_left_too_high_contradicts_its_points() -> None:
    side = plane(0.0, 0.8, 5.0)
    roof = roof_of(grid(0, 0, 12, 4, 0.0, 0.8, 5.0))
    found = contradiction_of(boxes((0, 0, 12, 8)), [side], roof, roof, [side])
    assert found is not None
    assert found.reason is Reason.ABOVE_POINTS
    assert found.check.value == pytest.approx(0.8 * 4.25)
    assert found.check.limit == pytest.approx(3 * NOISE_M + 2 * SPACING_M * 0.8)
    assert (f"{found.check.value:.2f} m" in found.words, f"{found.check.limit:.2f} m" in found.words) == (True, True)


@pytest.mark.parametrize(("share", "is_found"), [(0.3, False), (0.7, True)])
def test_a_level_face_through_a_slope_contradicts_its_points(share: float, is_found: bool) -> None:
    """The points that lie on the slope, among others on the level face."""
    slope, level = plane(0.0, 0.8, 5.0), plane(0.0, 0.0, 8.0)
    points = grid(0, 0, 12, 8, 0.0, 0.8, 5.0)
    on_slope = np.random.default_rng(2).random(len(points)) < share
    points[:, 2] = np.where(on_slope, points[:, 2], 8.0)
    roof = roof_of(points)
    label = np.where(np.abs(roof.points[:, 2] - 5.0 - 0.8 * roof.points[:, 1]) < 0.01, 0, 1).astype(np.int32)
    roof = dataclasses.replace(roof, labels=label)
    partition = RoofPartition(polygons=boxes((0, 0, 12, 8)).polygons, labels=np.array([1], np.int32))
    found = contradiction_of(partition, [slope, level], roof, roof, [slope, level])
    assert (found is not None) == is_found
    if found is not None:
        assert (found.reason, found.check.limit) == (Reason.LEVEL_THROUGH_SLOPE, 0.5)
        assert math.isclose(found.check.value, share, abs_tol=0.1)
