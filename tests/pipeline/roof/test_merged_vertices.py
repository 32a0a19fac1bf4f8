"""Vertices of borders that pay too little are merged, and planes move to meet in those that stay."""

import numpy as np
import pytest
import scipy.stats
import shapely
from shapely import MultiPolygon

from pipeline.model import FloatArray, IntArray
from pipeline.roof.arrangement.arranging import arrange
from pipeline.roof.arrangement.joined_planes import joined_planes
from pipeline.roof.arrangement.merged_vertices import merge_vertices, rings_with_merged
from pipeline.roof.arrangement.movable_borders import Borders, edges_of_rings
from pipeline.roof.arrangement.raster_labels import limits_at
from pipeline.roof.partition import RoofPartition
from pipeline.roof.roof_settings import ArrangementSettings

SPACING_M = 0.25
LIMITS = limits_at(SPACING_M, ArrangementSettings())
LOW, HIGH = (0.0, 0.0, 3.0), (0.0, 0.0, 6.0)


class Step:
    """8 m by 6 m, low in the west and high in the east; the step between them has a jog at 3 m."""

    def __init__(self, jog_m: float) -> None:
        self.x_m = np.array([4.0, 4.0 + jog_m])
        x, jogged = 4000, 4000 + round(1000 * jog_m)
        corners = [(0, 0), (8000, 0), (8000, 6000), (0, 6000)]
        self.xy = np.array([*corners, (x, 0), (x, 3000), (jogged, 3000), (jogged, 6000)], np.int64)
        self.rings = np.array([0, 4, 5, 6, 7, 3, 4, 1, 2, 7, 6, 5], np.int64)
        self.starts = np.array([0, 6, 12])
        edges = edges_of_rings(self.xy, self.rings, self.starts, np.arange(2, dtype=np.int32))
        self.borders = Borders(self.xy, edges, np.arange(2, dtype=np.int32), np.arange(8) < 4)
        east, north = (0.125 + np.arange(0.0, size, SPACING_M) for size in (8.0, 6.0))
        x, y = (axis.ravel() for axis in np.meshgrid(east, north))
        self.points = np.column_stack([x, y, np.where(x < self.x_m[(y > 3.0).astype(int)], LOW[2], HIGH[2])])

    def merged(self) -> list[list[tuple[int, int]]]:
        into = merge_vertices(self.borders, self.points, np.array([LOW, HIGH]), LIMITS)
        vertices, starts = rings_with_merged(self.rings, self.starts, into)
        rings = np.split(self.xy[vertices], starts[1:-1])
        return [[(int(x), int(y)) for x, y in ring] for ring in rings]


def test_edges_of_faces_come_once_with_both_faces() -> None:
    edges = Step(0.1).borders.edges
    assert len(edges) == 9
    inner = edges[edges[:, 3] >= 0]
    assert sorted(map(sorted, inner[:, :2].tolist())) == [[4, 5], [5, 6], [6, 7]]
    assert sorted(map(sorted, inner[:, 2:4].tolist())) == [[0, 1]] * 3


def test_a_jog_smaller_than_the_points_show_goes_and_the_outline_stays() -> None:
    low, high = Step(0.1).merged()
    assert len(low) == len(high) == 4
    assert shapely.Polygon(low).union(shapely.Polygon(high)).equals(shapely.box(0, 0, 8000, 6000))
    assert abs(shapely.Polygon(low).area - 4050 * 6000) <= 50 * 6000 + 1


def test_a_step_along_the_outline_stays_parallel_to_it_when_its_jog_goes() -> None:
    step = Step(0.1)
    step.borders = step.borders._replace(directions=np.array([0.0, 0.5 * np.pi]))
    low, high = step.merged()
    assert len(low) == len(high) == 4
    east = max(x for x, _ in low)
    assert east in (4000, 4100)
    assert sorted(low) == [(0, 0), (0, 6000), (east, 0), (east, 6000)]


def test_a_jog_that_many_points_show_stays() -> None:
    assert [len(ring) for ring in Step(1.5).merged()] == [6, 6]


def test_with_a_share_of_zero_every_corner_stays() -> None:
    step = Step(0.1)
    limits = limits_at(SPACING_M, ArrangementSettings(corner_share=0.0))
    into = merge_vertices(step.borders, step.points, np.array([LOW, HIGH]), limits)
    assert into.tolist() == list(range(8))


def test_a_vertex_does_not_sweep_over_another() -> None:
    """A small level in the way keeps the jog, though it holds no point that speaks against the straight step."""
    step = Step(0.1)
    hole = np.array([(4040, 1000), (4040, 1040), (4060, 1020)], np.int64)
    step.xy = np.concatenate([step.xy, hole])
    rings = np.concatenate([step.rings, [8, 9, 10], [8, 10, 9]])
    owner = np.array([0, 1, 1, 2], np.int32)
    edges = edges_of_rings(step.xy, rings, np.array([0, 6, 12, 15, 18]), owner)
    borders = Borders(step.xy, edges, np.array([0, 1, 1], np.int32), np.arange(len(step.xy)) < 4)
    bare = step.points[:1]
    into = merge_vertices(borders, bare, np.array([LOW, HIGH]), LIMITS)
    left = shapely.Polygon(step.xy[rings_with_merged(rings[:6], np.array([0, 6]), into)[0]])
    inside = shapely.intersects_xy(left, *step.xy[into[8:11]].T.astype(float))
    assert not inside.any()


def corners_of(part: RoofPartition) -> int:
    return len(np.unique(np.concatenate([shapely.get_coordinates(face) for face in part.polygons]), axis=0))


def test_a_hip_that_ends_beside_a_corner_of_the_outline_ends_in_it() -> None:
    assert corners_of(arranged_hip()) == 6
    assert corners_of(arranged_hip(corner_share=0.0)) > 6


def arranged_hip(**settings: float) -> RoofPartition:
    """A hip roof whose sides are 3 or 6 cm too high or too low: its hips end beside the corners of the outline."""
    east, north = np.meshgrid(0.1 + np.arange(0.0, 10.0, 0.2), 0.1 + np.arange(0.0, 6.0, 0.2))
    x, y = east.ravel(), north.ravel()
    true = np.array([(0.0, 0.6, 3.0), (0.0, -0.6, 6.6), (0.6, 0.0, 3.0), (-0.6, 0.0, 9.0)])
    heights = x[:, None] * true[:, 0] + y[:, None] * true[:, 1] + true[:, 2]
    labels = np.argmin(heights, axis=1).astype(np.int32)
    z = heights[np.arange(len(x)), labels] + np.array([0.03, -0.03, 0.06, -0.06])[labels]
    outline = MultiPolygon([shapely.box(0, 0, 10_000, 6_000)])
    order = np.lexsort((z, y, x))
    points = np.column_stack([x, y, z])[order]
    return arrange(points, labels[order], true, outline, 0.2, ArrangementSettings(**settings))


def heights(planes: FloatArray, x: float, y: float) -> FloatArray:
    return planes @ np.array([x, y, 1.0])


def corner_of_three(planes: FloatArray, *noise_m: float) -> tuple[FloatArray, IntArray, Borders]:
    """Three sectors of a square around its middle, (n, 3) points near their planes, and the borders between them."""
    xy = np.array([(0, 0), (6000, 0), (6000, 6000), (0, 6000), (3000, 3000)], np.int64)
    rings = np.array([0, 1, 4, 1, 2, 4, 2, 3, 0, 4], np.int64)
    edges = edges_of_rings(xy, rings, np.array([0, 3, 6, 10]), np.arange(3, dtype=np.int32))
    east, north = np.meshgrid(0.1 + np.arange(0.0, 6.0, 0.2), 0.1 + np.arange(0.0, 6.0, 0.2))
    x, y = east.ravel(), north.ravel()
    labels = np.where((y < x) & (y < 6.0 - x), 0, np.where((y < x) & (y >= 6.0 - x), 1, 2)).astype(np.int32)
    points = np.column_stack([x, y, (np.column_stack([x, y, np.ones(len(x))]) * planes[labels]).sum(axis=1)])
    if noise_m:
        points[:, 2] += np.random.default_rng(7).normal(0.0, 1.0, len(x)) * np.array(noise_m)[labels]
    return points, labels, Borders(xy, edges, np.arange(3, dtype=np.int32), np.arange(5) < 4)


def test_three_planes_that_miss_a_corner_by_centimetres_meet_in_it_and_stay_near_their_points() -> None:
    planes = np.array([(0.0, 0.5, 3.0), (-0.5, 0.0, 6.02), (0.4, 0.0, 3.33)])
    points, labels, borders = corner_of_three(planes)
    joined = joined_planes(points, labels, planes, borders, LIMITS)
    assert np.ptp(heights(joined, 3.0, 3.0)) < 1e-9
    residuals = (np.column_stack([points[:, :2], np.ones(len(points))]) * joined[labels]).sum(axis=1) - points[:, 2]
    for label in range(3):
        assert np.sqrt((residuals[labels == label] ** 2).mean()) <= LIMITS.plane_shift_m


@pytest.mark.parametrize("noise_m", [(0.03, 0.03, 0.03), (0.02, 0.03, 0.07)])
def test_it_is_least_squares_under_the_conditions_with_the_weights_of_the_noise(noise_m: tuple[float, ...]) -> None:
    """Against the solution by Lagrange multipliers of the same problem."""
    planes = np.array([(0.0, 0.5, 3.0), (-0.5, 0.0, 6.02), (0.4, 0.0, 3.33)])
    points, labels, borders = corner_of_three(planes, *noise_m)
    joined = joined_planes(points, labels, planes, borders, LIMITS)
    places = [
        (0, 1, 6.0, 0.0),
        (1, 2, 6.0, 6.0),
        (0, 2, 0.0, 0.0),
        (0, 1, 3.0, 3.0),
        (1, 2, 3.0, 3.0),
        (0, 2, 3.0, 3.0),
    ]
    rows = []
    for p, q, x, y in places:
        row = np.zeros((3, 3))
        row[p], row[q] = (x, y, 1.0), (-x, -y, -1.0)
        rows.append(row.ravel())
    held = [row for row in rows if abs(row @ joined.ravel()) < 1e-9]
    assert len(held) >= 3
    normal = np.zeros((9, 9))
    for label in range(3):
        of_plane = np.column_stack([points[labels == label, :2], np.ones((labels == label).sum())])
        noise = np.sqrt(np.mean((of_plane @ planes[label] - points[labels == label, 2]) ** 2))
        normal[3 * label : 3 * label + 3, 3 * label : 3 * label + 3] = of_plane.T @ of_plane / noise
    conditions = np.array(held)
    m = len(held)
    system = np.block([[normal, conditions.T], [conditions, np.zeros((m, m))]])
    right = np.concatenate([normal @ planes.ravel(), np.zeros(m)])
    expected = np.linalg.lstsq(system, right, rcond=None)[0][:9]
    assert joined.ravel() == pytest.approx(expected, abs=1e-4)


def test_planes_of_a_true_step_stay() -> None:
    planes = np.array([(0.0, 0.0, 3.0), (0.0, 0.0, 3.3), (0.0, 0.0, 3.7)])
    points, labels, borders = corner_of_three(planes)
    assert joined_planes(points, labels, planes, borders, LIMITS).tolist() == planes.tolist()


def test_a_gap_that_costs_more_points_to_close_than_four_corners_must_save_stays() -> None:
    """The more points show a gap of 8 cm, and the better, the more they lose; corners save the same everywhere."""
    planes = np.array([(0.0, 0.5, 3.0), (-0.5, 0.0, 6.08), (0.4, 0.0, 3.3)])
    points, labels, borders = corner_of_three(planes, 0.1, 0.1, 0.1)
    joined = joined_planes(points, labels, planes, borders, LIMITS)
    assert np.ptp(heights(joined, 3.0, 3.0)) < 1e-9
    limits = LIMITS._replace(corner_cost=0.25 * LIMITS.corner_cost)
    for more, of_more in ((np.repeat(points, 16, axis=0), np.repeat(labels, 16)), (corner_of_three(planes)[0], labels)):
        joined = joined_planes(more, of_more, planes, borders, limits)
        assert np.ptp(heights(joined, 3.0, 3.0)) > 0.07
        dear = LIMITS._replace(corner_cost=4.0 * LIMITS.corner_cost)
        joined = joined_planes(more, of_more, planes, borders, dear)
        assert np.ptp(heights(joined, 3.0, 3.0)) < 1e-9


def test_the_price_of_a_gap_is_what_its_closing_adds_to_the_residuals() -> None:
    """Four corners of it close a gap at both ends of a border, those of a third not one end; noise is normal."""
    planes = np.array([(0.0, 0.0, 3.0), (0.0, 0.0, 3.06)])
    xy = np.array([(0, 0), (6000, 0), (6000, 6000), (0, 6000), (3000, 0), (3000, 6000)], np.int64)
    rings = np.array([0, 4, 5, 3, 4, 1, 2, 5], np.int64)
    edges = edges_of_rings(xy, rings, np.array([0, 4, 8]), np.arange(2, dtype=np.int32))
    borders = Borders(xy, edges, np.arange(2, dtype=np.int32), np.arange(6) < 4)
    x, y = (axis.ravel() for axis in np.meshgrid(0.1 + np.arange(0.0, 6.0, 0.2), 0.1 + np.arange(0.0, 6.0, 0.2)))
    labels = (x > 3.0).astype(np.int32)
    noise = scipy.stats.norm.ppf((np.arange(len(x)) * 0.6180339887498949 + 0.5) % 1.0) * 0.05
    points = np.column_stack([x, y, planes[labels, 2] + noise])
    closed = joined_planes(points, labels, planes, borders, LIMITS._replace(corner_cost=1e9, plane_shift_m=1.0))
    assert np.ptp(heights(closed, 3.0, 0.0)) < 1e-9 > np.ptp(heights(closed, 3.0, 6.0))
    place = np.column_stack([x, y, np.ones(len(x))])
    before, after = (np.abs((place * p[labels]).sum(axis=1) - points[:, 2]).sum() for p in (planes, closed))
    price = (after - before) / LIMITS.cap_m
    both = [
        joined_planes(points, labels, planes, borders, LIMITS._replace(corner_cost=share * price, plane_shift_m=1.0))
        for share in (0.35 / 4, 1.0 / 4)
    ]
    assert np.ptp(heights(both[0], 3.0, 0.0)) > 0.05 < np.ptp(heights(both[0], 3.0, 6.0))
    assert np.ptp(heights(both[1], 3.0, 0.0)) < 1e-9 > np.ptp(heights(both[1], 3.0, 6.0))
