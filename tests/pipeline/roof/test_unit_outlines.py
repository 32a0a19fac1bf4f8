"""Outlines of touching units: without slits and overlaps, the border amid the points of both."""

import numpy as np
import pytest
import shapely
from shapely import LineString, MultiPolygon, Polygon

from pipeline.model import Candidate, FloatArray, LabelArray
from pipeline.roof.roof_settings import RoofSettings
from pipeline.roof.unit_outlines import unit_outlines


def candidate_of(points: FloatArray) -> Candidate:
    return Candidate(building_id="a", origin=(0.0, 0.0, 0.0), points=points, ground=np.zeros((0, 3)), ground_z_m=0.0)


@pytest.fixture
def halves() -> tuple[Candidate, LabelArray]:
    """A flat roof of 20 m by 10 m, its right half 3 m higher, 1.6 points per m2."""
    random = np.random.default_rng(8)
    xy = random.uniform((0, 0), (20, 10), (320, 2)).round(3)
    unit = (xy[:, 0] > 10.0).astype(np.int32)
    return candidate_of(np.column_stack((xy, 6.0 + 3.0 * unit))), unit


def test_the_shared_border_is_one_straight_line(halves: tuple[Candidate, LabelArray]) -> None:
    left, right = unit_outlines(*halves, RoofSettings())
    assert left is not None
    assert right is not None
    shared = shapely.intersection(left, right, grid_size=0.001)
    assert shared.length == pytest.approx(10.0, abs=0.6)
    assert shapely.intersection(left, right).area < 1e-6
    x = shapely.get_coordinates(shared)[:, 0]
    assert np.ptp(x) < 0.3
    assert np.abs(x - 10.0).max() < 0.6


def test_turned_units_share_every_corner() -> None:
    random = np.random.default_rng(12)
    x, y = random.uniform((0, 0), (20, 12), (1200, 2)).T
    unit = np.where(y > 6.0, 2, np.where(x > 9.0, 1, 0)).astype(np.int32)
    turned = np.exp(0.4j) * (x + 1j * y)
    points = np.column_stack((turned.real.round(3), turned.imag.round(3), 6.0 + 2.0 * unit))
    outlines = unit_outlines(candidate_of(points), unit, RoofSettings())
    assert shapely.coverage_is_valid([shapely.transform(one, lambda xy: np.rint(xy * 1e3)) for one in outlines])


def test_together_they_are_the_outline_of_the_whole(halves: tuple[Candidate, LabelArray]) -> None:
    candidate, unit = halves
    both = shapely.union_all(unit_outlines(candidate, unit, RoofSettings()))
    (whole,) = unit_outlines(candidate, np.zeros_like(unit), RoofSettings())
    assert whole is not None
    assert shapely.symmetric_difference(both, whole).area < 0.005 * whole.length


def test_swapped_numbers_swap_the_outlines(halves: tuple[Candidate, LabelArray]) -> None:
    candidate, unit = halves
    drawn = unit_outlines(candidate, unit, RoofSettings())
    swapped = unit_outlines(candidate, 1 - unit, RoofSettings())
    assert [outline.equals(other) for outline, other in zip(drawn, swapped[::-1], strict=True)] == [True, True]  # type: ignore[union-attr]


def test_without_a_plan_no_unit_has_an_outline() -> None:
    three = candidate_of(np.array([[0.0, 0.0, 5.0], [1.0, 0.0, 5.0], [0.0, 1.0, 5.0]]))
    assert unit_outlines(three, np.array([0, 0, 1], np.int32), RoofSettings()) == [None, None]


def test_an_overlap_of_strips_does_not_comb_the_outline() -> None:
    random = np.random.default_rng(9)
    lines = np.column_stack((np.repeat(np.arange(0.5, 30.0, 1.8), 20), np.tile(np.arange(0.5, 20.0, 1.0), 17)))
    overlap = random.uniform((0, 7), (30, 12), (2000, 2))
    xy = np.concatenate((lines + random.uniform(-0.1, 0.1, lines.shape), overlap)).round(3)
    candidate = candidate_of(np.column_stack((xy, np.full(len(xy), 6.0))))
    (outline,) = unit_outlines(candidate, np.zeros(len(xy), np.int32), RoofSettings())
    assert outline is not None
    assert outline.area == pytest.approx(600.0, rel=0.08)
    assert outline.length == pytest.approx(100.0, rel=0.1)


def inner_angles(outline: MultiPolygon) -> FloatArray:
    """The inner angles of an outline of one part, degrees, without those of almost straight corners."""
    (polygon,) = shapely.get_parts(shapely.simplify(outline, 0.05))
    ring = shapely.get_coordinates(polygon.exterior)[:-1]
    into, out = ring - np.roll(ring, 1, axis=0), np.roll(ring, -1, axis=0) - ring
    cosine = -(into * out).sum(axis=1) / np.hypot(*into.T) / np.hypot(*out.T)
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def two_units(roof: Polygon, wall: LineString, per_m2: float, seed: int) -> tuple[Candidate, LabelArray]:
    """Points all over a roof; unit 1 lies right of a wall from below to above."""
    random = np.random.default_rng(seed)
    left, bottom, right, top = roof.bounds
    count = int(per_m2 * (right - left) * (top - bottom))
    xy = random.uniform((left, bottom), (right, top), (count, 2)).round(3)
    xy = xy[shapely.contains_xy(roof, xy)]
    (x0, y0), (x1, y1) = wall.coords
    unit = ((x1 - x0) * (xy[:, 1] - y0) - (y1 - y0) * (xy[:, 0] - x0) < 0.0).astype(np.int32)
    return candidate_of(np.column_stack((xy, 6.0 + 3.0 * unit))), unit


@pytest.mark.parametrize("seed", range(8))
def test_a_wall_amid_few_points_leaves_no_wedge(seed: int) -> None:
    candidate, unit = two_units(shapely.box(0, 0, 22, 11), LineString([(11, 0), (11, 11)]), 0.3, seed)
    for outline in unit_outlines(candidate, unit, RoofSettings()):
        assert outline is not None
        angles = inner_angles(outline)
        assert len(angles) > 3
        assert angles.min() > 45.0


def test_an_oblique_wall_that_many_points_show_stays_so() -> None:
    candidate, unit = two_units(shapely.box(0, 0, 22, 11), LineString([(5, 0), (17, 11)]), 8.0, 3)
    left, right = unit_outlines(candidate, unit, RoofSettings())
    assert left is not None
    assert right is not None
    common = shapely.intersection(left, right, grid_size=0.001)
    (x0, y0), (x1, y1) = common.bounds[:2], common.bounds[2:]
    assert np.degrees(np.arctan2(y1 - y0, x1 - x0)) == pytest.approx(42.5, abs=5.0)


@pytest.mark.parametrize("seed", range(4))
def test_a_wall_ends_at_the_inner_corner_of_an_outline(seed: int) -> None:
    roof = Polygon([(0, 0), (22, 0), (22, 14), (16, 14), (12, 9), (0, 9)])
    candidate, unit = two_units(roof, LineString([(12, 0), (12, 14)]), 3.0, seed)
    both = unit_outlines(candidate, unit, RoofSettings())
    corners = shapely.points(shapely.get_coordinates(shapely.simplify(shapely.union_all(both), 0.05)))
    corner = corners[int(np.argmin(shapely.distance(corners, shapely.Point(12, 9))))]
    assert shapely.distance(corner, shapely.Point(12, 9)) < 1.0
    assert shapely.distance(corner, shapely.intersection(*both, grid_size=0.001)) < 0.02


@pytest.mark.parametrize(("off_m", "wall_x_m"), [(0.2, 10.2), (0.45, 10.0)])
def test_a_wall_moves_in_line_with_an_edge_only_as_far_as_its_points_allow(off_m: float, wall_x_m: float) -> None:
    roof = Polygon([(0, 0), (20, 0), (20, 10), (10 + off_m, 10), (10 + off_m, 16), (0, 16)])
    candidate, unit = two_units(roof, LineString([(10, 0), (10, 10)]), 10.0, 4)
    common = shapely.intersection(*unit_outlines(candidate, unit, RoofSettings()), grid_size=0.001)
    assert np.abs(shapely.get_coordinates(common)[:, 0] - wall_x_m).max() < 0.1
