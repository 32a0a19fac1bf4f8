"""Hulls and rectangles in plan: against shapely, and on shapes whose answer is known."""

import math

import numpy as np
import pytest
import shapely
from faces_by_hand import plane

from pipeline.extras.papers.rectangle import (
    PlanLine,
    convex_hull,
    line_of_intersection,
    minimum_rectangle,
    rectangle_on_line,
)
from pipeline.model import FloatArray


def line_at(degrees: float, x: float = 0.0, y: float = 0.0) -> PlanLine:
    turn = math.radians(degrees)
    return PlanLine(origin=(x, y), direction=(math.cos(turn), math.sin(turn)))


def cloud(seed: int, n: int = 60, extent_mm: int = 20_000) -> FloatArray:
    return np.random.default_rng(seed).integers(-extent_mm, extent_mm, (n, 2))


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize(("n", "extent_mm"), [(5, 20_000), (300, 20_000), (200, 4)])
def test_the_hull_is_that_of_shapely(seed: int, n: int, extent_mm: int) -> None:
    xy_mm = cloud(seed, n, extent_mm)
    hull = np.rint(convex_hull(xy_mm) * 1e3)
    expected = shapely.MultiPoint(xy_mm).convex_hull
    assert shapely.Polygon(hull).equals(expected)
    assert len(hull) == len(shapely.get_coordinates(shapely.simplify(expected, 0.0))) - 1
    assert shapely.is_ccw(shapely.LinearRing(hull))
    assert tuple(hull[0]) == min(map(tuple, hull))


def test_the_hull_of_positions_on_one_line_is_its_two_ends() -> None:
    assert convex_hull(np.array([[0, 0], [2000, 1000], [4000, 2000], [2000, 1000]])).tolist() == [[0, 0], [4, 2]]
    assert convex_hull(np.array([[5000, 7000], [5000, 7000]])).tolist() == [[5, 7]]
    assert minimum_rectangle(convex_hull(np.array([[0, 0], [2000, 1000], [4000, 2000]]))) is None


@pytest.mark.parametrize("seed", range(40))
def test_the_minimum_rectangle_has_the_area_of_shapelys(seed: int) -> None:
    xy_mm = cloud(seed, 3 + seed * 4)
    hull = convex_hull(xy_mm)
    found = minimum_rectangle(hull)
    assert found is not None
    expected = shapely.minimum_rotated_rectangle(shapely.Polygon(hull))
    assert found.area_m2 == pytest.approx(expected.area, rel=1e-9)
    ring = shapely.Polygon(found.corners)
    assert ring.area == pytest.approx(found.area_m2)
    assert shapely.is_ccw(shapely.LinearRing(found.corners))
    assert ring.buffer(1e-6).contains(shapely.MultiPoint(xy_mm / 1e3))


@pytest.mark.parametrize("degrees", [0.0, 17.0, 45.0, 90.0, 133.0, 271.5])
def test_the_minimum_rectangle_of_a_turned_rectangle_is_itself(degrees: float) -> None:
    line = line_at(degrees, 3.0, -4.0)
    corners = [line.position(a, w) for a, w in ((0, 0), (12, 0), (12, 7), (0, 7))]
    found = minimum_rectangle(convex_hull(np.rint(np.array(corners) * 1e3).astype(np.int64)))
    assert found is not None
    assert sorted([found.length_m, found.width_m]) == pytest.approx([7, 12], abs=3e-3)
    assert shapely.Polygon(found.corners).symmetric_difference(shapely.Polygon(corners)).area < 0.1


def test_planes_meet_in_the_line_on_which_both_have_one_height() -> None:
    random = np.random.default_rng(1)
    for first, second in random.uniform(-1, 1, (30, 2, 3)):
        p, q = plane(*first), plane(*second)
        line = line_of_intersection(p, q)
        assert line is not None
        for along in (-10.0, 0.0, 25.0):
            x, y = line.position(along, 0.0)
            assert p.a * x + p.b * y + p.c == pytest.approx(q.a * x + q.b * y + q.c, abs=1e-9)
        x, y = line.position(3.0, 2.0)
        assert p.a * x + p.b * y + p.c < q.a * x + q.b * y + q.c, "the first is the lower one to the left"
        assert math.hypot(*line.direction) == pytest.approx(1)
    assert line_of_intersection(plane(0.2, 0.1, 3), plane(0.2, 0.1, 5)) is None


@pytest.mark.parametrize("degrees", [0.0, 30.0, 200.0])
@pytest.mark.parametrize("side", [1, -1])
def test_the_rectangle_on_a_line_is_the_smallest_that_holds_the_hull_on_its_side(degrees: float, side: int) -> None:
    for seed in range(10):
        hull = convex_hull(cloud(seed, 30, 10_000))
        line = line_at(degrees, 1.0, 2.0)
        found = rectangle_on_line(hull, line, side)
        assert found is not None
        half = [line.position(a, w * side) for a, w in ((-99, 0), (99, 0), (99, 99), (-99, 99))]
        part = shapely.Polygon(hull).intersection(shapely.Polygon(half))
        frame = line.frame(shapely.get_coordinates(part))
        across = frame[:, 1] * side
        assert (found.from_m, found.to_m) == pytest.approx((frame[:, 0].min(), frame[:, 0].max()))
        assert found.width_m == pytest.approx(across.max())
        assert (found.left_from_m if side > 0 else found.left_to_m) == 0.0


def test_a_hull_beyond_the_line_has_no_rectangle_on_the_other_side() -> None:
    hull = convex_hull(np.array([[0, 1000], [4000, 1000], [2000, 5000]]))
    assert rectangle_on_line(hull, line_at(0.0), -1) is None
    found = rectangle_on_line(hull, line_at(0.0), 1)
    assert found is not None
    assert (found.from_m, found.to_m, found.left_from_m, found.left_to_m) == pytest.approx((0, 4, 0, 5))


def test_a_line_counts_metres_along_and_to_the_left() -> None:
    line = line_at(90.0, 2.0, 1.0)
    assert line.position(3.0, 1.0) == pytest.approx((1.0, 4.0))
    assert line.frame(np.array([[1.0, 4.0]]))[0] == pytest.approx([3.0, 1.0])
