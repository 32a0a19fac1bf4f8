"""Corners where a plane leaves the points: found, cut off, and given to a plane that does not."""

import numpy as np
import pytest
import shapely
from candidates_by_hand import Plane
from shapely import MultiPolygon

from pipeline.model import FloatArray
from pipeline.roof.arrangement.arranging import arrange
from pipeline.roof.arrangement.far_corners import (
    add_costs_of_far_planes,
    cut_off_far_corners,
    heights_around,
    heights_raster,
    with_level_planes,
)
from pipeline.roof.arrangement.plan_cells import cell_areas_m2, cells_of_points
from pipeline.roof.arrangement.raster_labels import limits_at
from pipeline.roof.arrangement.subdivision import FACE, insert_chord, insert_vertex, subdivision_of
from pipeline.roof.roof_settings import ArrangementSettings

RISING = (0.5, 0.0, 3.0)
"""A plane that explains the west of a hall, up to x = 8 m."""
FALLING = (-0.5, 0.0, 11.0)
"""Meets it there."""
LOW = (0.0, 0.0, 3.0)
"""Meets it at the west end only."""
SPACING_M = 0.4
FAR_M = 0.5
LIMITS = limits_at(SPACING_M, ArrangementSettings())


def grid(west: float, east: float, plane: tuple[float, float, float], depth: float = 6.0) -> FloatArray:
    x, y = np.meshgrid(np.arange(west + 0.2, east, SPACING_M), np.arange(0.2, depth, SPACING_M))
    return np.column_stack([x.ravel(), y.ravel(), plane[0] * x.ravel() + plane[1] * y.ravel() + plane[2]])


class Hall:
    """12 m by 6 m, one cell; its west rises, its east is something else, and all of it has the rising plane."""

    def __init__(self, east: Plane, planes: list[Plane]) -> None:
        self.points = np.concatenate([grid(0.0, 8.0, RISING), grid(8.0, 12.0, east)])
        ring = np.array([[0, 0], [12_000, 0], [12_000, 6_000], [0, 6_000]], np.int64)
        self.plan = subdivision_of(ring, np.array([0, 4]), np.zeros(1, np.int64), 40)
        self.planes = np.array(planes)
        self.labels = np.zeros(1, np.int32)
        self.look_around()

    def look_around(self) -> None:
        self.around = heights_around(self.plan, heights_raster(self.points, SPACING_M))

    def cut(self) -> int:
        cells = cells_of_points(self.plan, self.points)
        return cut_off_far_corners(self.plan, self.points, cells, self.planes, self.labels, self.around, LIMITS, 0)

    def far_costs(self) -> list[int]:
        """What far planes cost in the first cell, where misfits are the same."""
        costs, misfits = np.zeros((1, 2), np.int64), np.zeros((1, 2), np.int64)
        add_costs_of_far_planes(self.plan, self.planes, self.around, FAR_M, costs, misfits)
        assert costs.tolist() == misfits.tolist()
        return costs[0].tolist()

    def areas(self) -> list[float]:
        return sorted(cell_areas_m2(self.plan).tolist())


def test_heights_are_those_of_the_points_around_a_place() -> None:
    hall = Hall(LOW, [RISING, LOW])
    lowest, highest, within, raster = hall.around
    side = raster.side
    assert side == 0.75
    assert (within[:4] == side).all()
    assert lowest[1] == highest[1] == 3.0
    assert 3.1 <= lowest[0] < highest[0] <= 3.0 + 0.5 * 3 * side
    assert (lowest[4:] > highest[4:]).all()


def test_far_from_all_points_there_are_no_heights() -> None:
    hall = Hall(LOW, [RISING, LOW])
    raster = heights_raster(hall.points[hall.points[:, 0] < 8.0], SPACING_M)
    lowest, highest, _, _ = heights_around(hall.plan, raster)
    assert (lowest[:4] > highest[:4]).tolist() == [False, True, True, False]


@pytest.mark.parametrize("planes", [[RISING, FALLING], [RISING, (-0.8, 0.0, 14.5), FALLING]])
def test_a_cell_is_cut_where_its_plane_meets_the_best_of_those_that_fit_beyond(planes: list[Plane]) -> None:
    hall = Hall(FALLING, planes)
    assert hall.cut() == 1
    assert hall.areas() == pytest.approx([24.0, 48.0], abs=0.01)


def test_a_cell_is_cut_where_it_gets_near_the_points_if_planes_do_not_meet_in_it_from_above_or_below() -> None:
    above, below = Hall(LOW, [RISING, LOW]), Hall((0.0, 0.0, 9.0), [(-0.5, 0.0, 9.0), (0.0, 0.0, 9.0)])
    west = below.points[:, 0] < 8.0
    below.points[west, 2] = 9.0 - 0.5 * below.points[west, 0]
    below.look_around()
    for hall in (above, below):
        assert hall.cut() == 1
        # points in the next cell of the raster and its slope allow the plane to go on
        smaller, larger = hall.areas()
        assert 6.0 * 1.5 < smaller < 6.0 * 4.0
        assert smaller + larger == pytest.approx(72.0, abs=0.01)


@pytest.mark.parametrize("swapped", [False, True])
def test_both_cells_beside_an_edge_are_cut(*, swapped: bool) -> None:
    hall = Hall(FALLING, [RISING, FALLING])
    for x in (0, 12_000):
        xy, graph, counts = hall.plan
        for h in range(int(counts[1])):
            if xy[graph[h, 0], 0] == x == xy[graph[h ^ 1, 0], 0] and graph[h, FACE] == 0:
                assert insert_vertex(hall.plan, h, x, 3_000)
                break
    ends = (5, 4) if swapped else (4, 5)
    assert insert_chord(hall.plan, *ends, 0, 0) == 1
    # one half of the hall rises throughout
    rising = hall.points[:, 1] > 3.0
    hall.points[rising, 2] = 3.0 + 0.5 * hall.points[rising, 0]
    hall.labels = np.zeros(2, np.int32)
    hall.planes = np.array([RISING, FALLING])
    hall.look_around()
    assert hall.cut() == 1
    assert hall.areas() == pytest.approx([12.0, 24.0, 36.0], abs=0.01)


def test_where_points_are_missing_at_a_steep_eave_the_slope_goes_on() -> None:
    north, south = (0.0, -1.7, 16.8), (0.0, 1.7, 3.2)
    points = np.concatenate([grid(0.0, 12.0, south, 4.0), grid(0.0, 12.0, north, 8.0)[10 * 30 :]])
    seen = ~((points[:, 0] > 9.0) & (points[:, 1] < 1.2))
    planes = np.array([south, north])
    outline = MultiPolygon([shapely.box(0.0, 0.0, 12_000.0, 8_000.0)])
    labels = (points[seen, 1] > 4.0).astype(np.int32)
    drawn = arrange(points[seen], labels, planes, outline, SPACING_M, ArrangementSettings())
    assert sorted(drawn.labels.tolist()) == [0, 1]


def test_without_points_the_outline_is_one_face() -> None:
    outline = MultiPolygon([shapely.box(0.0, 0.0, 12_000.0, 8_000.0)])
    for planes in ([LOW], [LOW, RISING]):
        drawn = arrange(
            np.empty((0, 3)), np.empty(0, np.int32), np.array(planes), outline, SPACING_M, ArrangementSettings()
        )
        assert len(drawn.polygons) == 1


def test_a_cell_near_its_points_is_left_alone() -> None:
    hall = Hall(tuple(RISING), [RISING, LOW])
    assert hall.cut() == 0
    assert hall.plan.counts.tolist() == [4, 8, 1]


def test_a_cell_that_is_far_at_all_corners_is_found_and_left_whole() -> None:
    hall = Hall(LOW, [(0.0, 0.0, 20.0), LOW])
    assert hall.cut() == 1
    assert hall.plan.counts[2] == 1


@pytest.mark.parametrize(
    ("plane", "far"),
    [((0.0, 0.0, 4.0), True), ((0.0, 0.0, 3.4), False), ((0.0, 0.3, 3.0), True), ((0.0, 0.1, 2.8), False)],
)
def test_a_plane_costs_where_it_goes_on_by_more_than_its_slope(plane: tuple[float, float, float], *, far: bool) -> None:
    hall = Hall(LOW, [plane, LOW])
    hall.points[:, 2] = 3.0
    hall.look_around()
    own, other = hall.far_costs()
    assert (own > 0, other) == (far, 0)


@pytest.mark.parametrize(("height_m", "cost"), [(3.4, 0), (4.5, 20_000), (13.0, 40_000), (1.5, 20_000)])
def test_a_plane_costs_by_the_metre_up_to_a_limit(height_m: float, cost: int) -> None:
    hall = Hall(LOW, [(0.0, 0.0, height_m), LOW])
    hall.points[:, 2] = 3.0
    hall.look_around()
    assert hall.far_costs() == [cost, 0]


@pytest.mark.parametrize(("slope", "is_far"), [(1.0, False), (1.8, False), (3.0, True)])
def test_steep_planes_go_on_no_farther_than_one_of_45_degrees(slope: float, *, is_far: bool) -> None:
    hall = Hall(LOW, [(0.0, slope, 3.0)])
    hall.points[:, 2] = 3.0 + slope * hall.points[:, 1]
    # the eave is a metre from the first points, so those of the next cells decide
    around = heights_around(hall.plan, heights_raster(hall.points[hall.points[:, 1] > 0.9], SPACING_M))
    extended = with_level_planes(hall.plan, hall.planes, hall.labels, around, FAR_M)
    assert (len(extended) > 1) == is_far


def test_the_nearest_plane_costs_nothing_where_all_are_far() -> None:
    farther, nearest = Hall(LOW, [(0.0, 0.0, 14.0), (0.0, 0.0, 11.0)]).far_costs()
    assert farther > 0
    assert nearest == 0


@pytest.mark.slow
def test_where_no_plane_fits_a_corner_there_is_a_level_one() -> None:
    hall = Hall(LOW, [RISING, (0.0, 0.0, 9.0)])
    extended = with_level_planes(hall.plan, hall.planes, hall.labels, hall.around, FAR_M)
    assert extended[:2].tolist() == hall.planes.tolist()
    assert extended[2:].tolist() == [[0.0, 0.0, 3.0]]
    fitting = np.array([RISING, LOW])
    assert len(with_level_planes(hall.plan, fitting, hall.labels, hall.around, FAR_M)) == 2


def cut_corner() -> tuple[FloatArray, FloatArray, MultiPolygon]:
    """A gable; in one corner of its outline a few points lie much lower, too few for a face on their own account."""
    north, south = (0.0, -0.9, 11.7), (0.0, 0.9, 6.3)
    points = np.concatenate([grid(0.0, 10.0, south, 3.0), grid(0.0, 10.0, north)[7 * 25 :]])
    low = (points[:, 0] > 8.6) & (points[:, 1] < 1.6)
    points[low, 2] = 3.0
    return points, np.array([south, north]), MultiPolygon([shapely.box(0.0, 0.0, 10_000.0, 6_000.0)])


def beyond_m(points: FloatArray, planes: FloatArray, outline: MultiPolygon) -> float:
    """How far a corner of a face is above all points within 1 m of it, at most."""
    labels = np.argmin(np.abs(points[:, :2] @ planes[:, :2].T + planes[:, 2] - points[:, 2:]), axis=1).astype(np.int32)
    drawn = arrange(points, labels, planes, outline, SPACING_M, ArrangementSettings())
    assert drawn.planes is not None
    assert sum(polygon.area for polygon in drawn.polygons) == pytest.approx(outline.area)
    most = 0.0
    for polygon, label in zip(drawn.polygons, drawn.labels.tolist(), strict=True):
        a, b, c = drawn.planes[label].coefficients
        for x, y in shapely.get_coordinates(polygon) * 1e-3:
            near = np.hypot(points[:, 0] - x, points[:, 1] - y) < 1.0
            if near.any():
                most = max(most, a * x + b * y + c - points[near, 2].max())
    return most


def test_no_corner_of_an_arrangement_is_far_above_its_points() -> None:
    assert beyond_m(*cut_corner()) < FAR_M


def test_planes_keep_their_places_before_those_that_were_added() -> None:
    points, planes, outline = cut_corner()
    labels = np.zeros(len(points), np.int32)
    drawn = arrange(points, labels, planes, outline, SPACING_M, ArrangementSettings())
    assert drawn.planes is not None
    assert len(drawn.planes) == len(planes) + 1
    assert drawn.planes[-1].coefficients == (0.0, 0.0, 3.0)
