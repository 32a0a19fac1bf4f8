"""Vertices move to where the planes beside them meet, as far as outline, steps, other borders and points allow."""

from typing import Any

import numpy as np
import pytest

from pipeline.model import FloatArray, IntArray
from pipeline.roof.arrangement.arranging import clean_borders
from pipeline.roof.arrangement.movable_borders import Borders, edges_of_rings
from pipeline.roof.arrangement.moved_vertices import move_vertices
from pipeline.roof.arrangement.raster_labels import Limits, limits_at
from pipeline.roof.roof_settings import ArrangementSettings

SPACING_M = 0.25
LIMITS = limits_at(SPACING_M, ArrangementSettings())
NO_POINTS_NEAR = np.array([(-50.0, -50.0, 0.0)])
Place = tuple[float, float]


def moved(
    xy: list[Place],
    rings: list[list[int]],
    planes: FloatArray,
    points: FloatArray = NO_POINTS_NEAR,
    *,
    n_fixed: int = 4,
    limits: Limits = LIMITS,
) -> list[Place]:
    """Where vertices (metres) of faces, one ring and one plane each, go; the first ones are those of the outline."""
    starts = np.cumsum([0, *(len(ring) for ring in rings)])
    places: IntArray = np.rint(np.array([*xy, (0.0, 0.0)]) * 1e3).astype(np.int64)
    numbers = np.arange(len(rings), dtype=np.int32)
    edges = edges_of_rings(places, np.concatenate(rings), starts, numbers)
    before = places.copy()
    is_fixed = np.arange(len(places)) < n_fixed
    any_moved = moving(Borders(places, edges, numbers, is_fixed), points, planes, limits)
    assert any_moved == (places[:-1] != before[:-1]).any()
    return [(x / 1e3, y / 1e3) for x, y in places[:-1].tolist()]


def moving(borders: Borders, points: FloatArray, planes: FloatArray, limits: Limits) -> bool:
    return move_vertices(borders, points, planes, limits)


SQUARE = [(0.0, 0.0), (6.0, 0.0), (6.0, 6.0), (0.0, 6.0)]
SECTORS = [[0, 1, 4], [1, 2, 4], [2, 3, 0, 4]]


def planes_through(place: Place, slopes: list[Place], rises: tuple[float, ...] = (0.0, 0.0, 0.0)) -> FloatArray:
    """Planes with these gradients, so much higher than 3 m over a place."""
    a, b = np.array(slopes).T
    return np.column_stack([a, b, 3.0 + np.array(rises)[: len(a)] - a * place[0] - b * place[1]])


HIP = [(0.0, 0.5), (-0.5, 0.0), (0.4, 0.0)]


@pytest.mark.parametrize("apex", [(3.2, 2.9), (2.8, 2.8), (3.0, 3.3)])
def test_the_end_of_a_ridge_goes_where_its_three_planes_cross(apex: Place) -> None:
    places = moved([*SQUARE, (3.0, 3.0)], SECTORS, planes_through(apex, HIP))
    assert places[4] == pytest.approx(apex, abs=0.001)
    assert places[:4] == SQUARE


def test_a_vertex_stays_where_its_planes_cross_exactly_at_another_vertex() -> None:
    places = moved([*SQUARE, (0.15, 0.1)], SECTORS, planes_through((0.0, 0.0), HIP))
    assert places[4] == (0.15, 0.1)


def test_planes_that_do_not_cross_in_one_place_take_the_one_of_least_gaps() -> None:
    planes = planes_through((3.1, 2.95), HIP, (0.0, 0.03, -0.03))
    slopes = np.array([planes[p] - planes[q] for p, q in ((0, 1), (1, 2), (0, 2))])
    expected = np.linalg.lstsq(slopes[:, :2], -slopes[:, 2], rcond=None)[0]
    places = moved([*SQUARE, (3.0, 3.0)], SECTORS, planes)
    assert places[4] == pytest.approx(expected.tolist(), abs=0.0011)


def test_a_vertex_between_two_planes_goes_the_shortest_way_to_their_crossing() -> None:
    """The crossing runs at 45 degrees through the middle; the border bends away from it."""
    crossing = planes_through((3.0, 3.0), [(0.2, -0.2), (-0.2, 0.2)])
    places = moved([*SQUARE, (2.9, 3.3)], [[0, 1, 2, 4], [2, 3, 0, 4]], crossing)
    assert places[4] == pytest.approx((3.1, 3.1), abs=0.001)


def two_slopes(slope: float, at_m: float = 3.3, ridge_m: float = 3.0, lean: float = 0.0, **more: Any) -> Place:
    """Where the ends of a border at `at_m` go; the planes cross at `ridge_m`, leaning over by so much per metre."""
    places = [*SQUARE, (at_m, 0.0), (at_m, 6.0)]
    planes = planes_through((ridge_m, 0.0), [(slope / 2, -lean * slope / 2), (-slope / 2, lean * slope / 2)])
    south, north = moved(places, [[0, 4, 5, 3], [4, 1, 2, 5]], planes, **more)[4:]
    assert (south[1], north[1]) == (0.0, 6.0)
    return south[0], north[0]


def test_on_the_outline_it_slides_to_the_crossing() -> None:
    assert two_slopes(0.5) == pytest.approx((3.0, 3.0))
    assert two_slopes(0.5, lean=0.1) == pytest.approx((3.0, 3.6))


def test_planes_that_hardly_part_do_not_move_a_vertex() -> None:
    assert two_slopes(0.06, at_m=3.2) == pytest.approx((3.0, 3.0))
    assert two_slopes(0.04, at_m=3.2) == (3.2, 3.2)


def test_it_goes_no_farther_than_the_settings_allow() -> None:
    assert LIMITS.corner_reach_m == 0.7
    assert two_slopes(0.1, at_m=3.69) == pytest.approx((3.0, 3.0))
    assert two_slopes(0.1, at_m=3.71) == (3.71, 3.71)


def test_a_wide_gap_is_a_step_and_stays() -> None:
    """0.3 m beside the crossing the planes are 0.198 m apart, or 0.204 m."""
    assert two_slopes(0.66) == pytest.approx((3.0, 3.0))
    assert two_slopes(0.68) == (3.3, 3.3)


def lattice(spacing_m: float, slope: float, at_m: float) -> FloatArray:
    """Points on the two slopes that cross at 3 m, as if their border were at `at_m`."""
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.arange(spacing_m / 2, 6.0, spacing_m)]))
    return np.column_stack([x, y, 3.0 + np.where(x < at_m, 0.5, -0.5) * slope * (x - 3.0)])


def test_points_that_speak_against_it_hold_a_vertex() -> None:
    slope, at_m = 0.38, 3.5
    assert two_slopes(slope, at_m, points=lattice(0.25, slope, at_m=3.0)) == pytest.approx((3.0, 3.0))
    assert two_slopes(slope, at_m, points=lattice(1.0, slope, at_m)) == pytest.approx((3.0, 3.0))
    assert two_slopes(slope, at_m, points=lattice(0.15, slope, at_m)) == (3.5, 3.5)


def ridge_against_a_step(high_m: float, step_x: tuple[float, float, float]) -> list[Place]:
    """A ridge at 3 m, drawn at 3.2 m, that ends at a step; the step passes three places."""
    south, middle, north = step_x
    xy = [*SQUARE, (south, 0.0), (middle, 3.2), (north, 6.0), (0.0, 3.2)]
    ridge = planes_through((0.0, 3.0), [(0.0, 0.4), (0.0, -0.3)])
    planes = np.vstack([ridge, (0.0, 0.0, high_m)])
    return moved(xy, [[0, 4, 5, 7], [7, 5, 6, 3], [4, 1, 2, 6, 5]], planes)


def test_on_a_straight_step_it_slides_along() -> None:
    places = ridge_against_a_step(6.0, (4.0, 4.0, 4.0))
    assert places[5] == pytest.approx((4.0, 3.0))
    assert places[7] == pytest.approx((0.0, 3.0))
    slanted = ridge_against_a_step(6.0, (4.0, 4.32, 4.6))
    assert slanted[5] == pytest.approx((4.3, 3.0), abs=0.001)


def test_a_corner_of_a_step_stays() -> None:
    assert ridge_against_a_step(6.0, (4.0, 4.0, 4.2))[5] == (4.0, 3.2)


def test_the_end_of_a_step_stays() -> None:
    """Heights of 0, 0.15 and 0.3 m: only the first and the last are a step apart, so one border ends there."""
    planes = planes_through((3.0, 3.0), HIP, (0.0, 0.15, 0.3))
    assert moved([*SQUARE, (3.0, 3.0)], SECTORS, planes)[4] == (3.0, 3.0)


QUARTERS = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]


def test_where_three_steps_meet_it_stays() -> None:
    """Two of the four planes beside it meet 0.2 m away; between all others there are steps."""
    planes = planes_through((3.2, 3.0), [(0.3, 0.0), (-0.3, 0.0), (0.0, 0.0), (0.0, 0.0)], (0.0, 0.0, 1.0, 2.0))
    assert moved([*SQUARE, (3.0, 3.0)], QUARTERS, planes)[4] == (3.0, 3.0)


def test_it_does_not_go_where_walls_of_four_planes_would_cross() -> None:
    """A hip roof with a ridge of 0.3 m: half-way both ends are below it and both sides above, in turn."""
    planes = planes_through((3.15, 3.0), [(0.0, 0.6), (-0.6, 0.0), (0.0, -0.6), (0.6, 0.0)], (0.0, 0.09, 0.0, 0.09))
    assert moved([*SQUARE, (3.0, 3.0)], QUARTERS, planes)[4] == (3.0, 3.0)
    planes = planes_through((3.15, 3.0), [(0.0, 0.6), (-0.6, 0.0), (0.0, -0.6), (0.6, 0.0)], (0.0, 0.0, 0.0, 0.0))
    assert moved([*SQUARE, (3.0, 3.0)], QUARTERS, planes)[4] == pytest.approx((3.15, 3.0), abs=0.001)


def test_vertices_of_the_outline_stay() -> None:
    planes = planes_through((3.2, 2.9), HIP)
    assert moved([*SQUARE, (3.0, 3.0)], SECTORS, planes, n_fixed=5)[4] == (3.0, 3.0)


def test_with_a_share_of_zero_it_stays() -> None:
    limits = limits_at(SPACING_M, ArrangementSettings(corner_share=0.0))
    assert two_slopes(0.38, points=lattice(0.25, 0.38, at_m=3.0), limits=limits) == (3.3, 3.3)


def test_a_border_does_not_sweep_over_another_vertex() -> None:
    """A box between the border and the crossing holds both ends of it; they go there without the box."""
    planes = np.vstack([planes_through((3.0, 0.0), [(0.25, 0.0), (-0.25, 0.0)]), (0.0, 0.0, 9.0)])
    for x, expected in ((3.1, 3.3), (4.1, 3.0)):
        xy = [*SQUARE, (3.3, 0.0), (3.3, 6.0), (x, 2.9), (x + 0.1, 2.9), (x + 0.1, 3.1), (x, 3.1)]
        around = 0 if x < 3.3 else 1
        faces = [[0, 4, 5, 3], [4, 1, 2, 5]]
        starts = np.cumsum([0, 4, 4, 4, 4])
        rings = np.concatenate([*faces, [6, 9, 8, 7], [6, 7, 8, 9]])
        places = np.rint(np.array([*xy, (0.0, 0.0)]) * 1e3).astype(np.int64)
        edges = edges_of_rings(places, rings, starts, np.array([0, 1, around, 2], np.int32))
        borders = Borders(places, edges, np.arange(3, dtype=np.int32), np.arange(len(places)) < 4)
        moving(borders, NO_POINTS_NEAR, planes, LIMITS)
        assert places[4:6].tolist() == [[round(expected * 1e3), 0], [round(expected * 1e3), 6000]]


def test_no_points_hold_everything() -> None:
    assert two_slopes(0.5, points=np.empty((0, 3))) == (3.3, 3.3)


def test_planes_that_meet_where_a_vertex_has_moved_to_do_not_leave_their_points() -> None:
    """Three slopes rise by a half from the sides of a triangle; their apex is drawn 0.2 m beside its place."""
    triangle = np.array([(0.0, 0.0), (8.0, 0.0), (3.0, 7.0)])
    along = np.roll(triangle, -1, axis=0) - triangle
    inward = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
    planes = np.column_stack([0.5 * inward, 3.0 - 0.5 * (inward * triangle).sum(axis=1)])
    apex = np.linalg.solve(planes[:2, :2] - planes[2, :2], planes[2, 2] - planes[:2, 2])
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0.1, 8.0, 0.2), np.arange(0.1, 7.0, 0.2)))
    heights = np.column_stack([x, y, np.ones(len(x))]) @ planes.T
    roof = heights.min(axis=1) > 3.0
    points = np.column_stack([x, y, heights.min(axis=1)])[roof]
    labels = np.argmin(heights, axis=1).astype(np.int32)[roof]

    xy = np.rint(np.array([*triangle, apex + np.array([0.16, 0.12]), (0.0, 0.0)]) * 1e3).astype(np.int64)
    rings, starts = np.array([0, 1, 3, 1, 2, 3, 2, 0, 3]), np.arange(0, 10, 3)
    faces = np.arange(3, dtype=np.int32)
    borders = Borders(xy, edges_of_rings(xy, rings, starts, faces), faces, np.arange(5) < 3)
    vertices, starts, joined = clean_borders(borders, (rings, starts), points, labels, planes, LIMITS)
    assert vertices.tolist() == rings.tolist()
    assert xy[3] / 1e3 == pytest.approx(apex, abs=0.001)
    assert np.abs(joined - planes).max() < 0.002
