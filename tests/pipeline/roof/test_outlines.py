"""Outlines around points: few edges, the true place, and never a broken outline."""

import itertools
import math
from collections.abc import Sequence

import numpy as np
import pytest
import shapely
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import MultiPolygon, Polygon

from pipeline.model import Candidate, FloatArray
from pipeline.prepared_cloud import prepare_cloud
from pipeline.roof.edge_position import EdgePoints
from pipeline.roof.lines import fitted_run
from pipeline.roof.outlines.description import FREE, Prices, least_description
from pipeline.roof.outlines.exterior import PRICES, peaks_of, straighten
from pipeline.roof.plan import drawn_outline, roof_points
from pipeline.roof.roof_settings import RoofSettings

SETTINGS = RoofSettings()


def ragged(polygon: Polygon, spacing_m: float, rng: np.random.Generator) -> MultiPolygon:
    """The polygon's outline as a zigzag of a point spacing, in integer millimetres."""
    ring = shapely.get_coordinates(shapely.segmentize(polygon, 0.6 * spacing_m).exterior)[:-1]
    shaken = np.rint((ring + rng.uniform(-0.35, 0.35, ring.shape) * spacing_m) * 1e3)
    return shapely.MultiPolygon([shapely.Polygon(shaken)])


def overlap(drawn: MultiPolygon, truth: Polygon) -> float:
    """Share of the common area in that of either, of an outline in millimetres and one in metres."""
    metres = shapely.transform(drawn, lambda xy: xy * 1e-3)
    return float(shapely.intersection(metres, truth).area / shapely.union(metres, truth).area)


@pytest.mark.parametrize("turn_deg", [0.0, 12.0, 45.0, 77.0])
def test_a_ragged_rectangle_becomes_a_rectangle(turn_deg: float) -> None:
    truth = shapely.affinity.rotate(shapely.box(0, 0, 12, 8), turn_deg)
    drawn = straighten(ragged(truth, 0.5, np.random.default_rng(3)), 0.5, SETTINGS)
    (polygon,) = drawn.geoms
    assert len(polygon.exterior.coords) - 1 == 4
    assert overlap(drawn, truth) > 0.97
    corners = np.array(polygon.exterior.coords)
    sides = np.diff(corners, axis=0)
    angles = [math.atan2(y, x) for x, y in sides.tolist()]
    for a, b in itertools.pairwise(angles):
        assert abs(math.remainder(b - a, math.tau)) == pytest.approx(math.pi / 2, abs=1e-3)


def test_evenly_spread_points_show_an_oblique_wall_that_points_at_random_do_not() -> None:
    truth = Polygon([(0, 0), (12.5, 0), (10, 8), (0, 8)])
    raw = MultiPolygon([Polygon(np.rint(shapely.get_coordinates(shapely.segmentize(truth, 0.7)) * 1e3))])
    lattice = 1.5 * np.stack(np.meshgrid(np.arange(8), np.arange(6)), axis=-1).reshape(-1, 2) + 0.4
    at_random = np.random.default_rng(4).uniform((0, 0), (11.5, 8), lattice.shape)
    corners = {}
    for name, xy in (("even", lattice), ("at random", at_random)):
        inside = np.rint(xy[shapely.contains_xy(truth, xy)] * 1e3).astype(np.int64)
        points = EdgePoints.of(inside, np.zeros(len(inside), np.bool_), 1.5)
        (drawn,) = straighten(raw, 1.5, SETTINGS, points).geoms
        sides = np.diff(shapely.get_coordinates(drawn.exterior), axis=0)
        turns = np.degrees(np.arctan2(sides[:, 1], sides[:, 0])) % 90
        corners[name] = float(np.abs((turns - turns[0] + 45) % 90 - 45).max())
    assert corners["even"] > 10 > 1 > corners["at random"]


def test_the_outline_of_twenty_points_leaves_hardly_one_outside() -> None:
    outside, share = 0, []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        x, y = rng.uniform((0, 0), (6, 5), (20, 2)).T
        turn = np.exp(1j * rng.uniform(0.0, 3.0))
        xy = np.rint(1e3 * turn * (x + 1j * y))
        points = np.column_stack((xy.real, xy.imag, np.full(20, 6e3))) / 1e3
        candidate = Candidate(building_id="a", origin=(0, 0, 0), points=points, ground=np.zeros((0, 3)), ground_z_m=0.0)
        drawn = drawn_outline(roof_points(prepare_cloud(candidate, 10**6), SETTINGS), SETTINGS)
        outside += np.count_nonzero(shapely.distance(drawn, shapely.points(xy.real, xy.imag)) > 100.0)
        corners = turn * np.array([0, 6, 6 + 5j, 5j])
        share.append(overlap(drawn, Polygon(np.column_stack((corners.real, corners.imag)))))
    assert outside < 3
    assert np.mean(share) > 0.78


def test_a_ragged_l_keeps_its_inner_corner() -> None:
    truth = shapely.union_all([shapely.box(0, 0, 16, 6), shapely.box(0, 0, 6, 14)])
    drawn = straighten(ragged(truth, 0.4, np.random.default_rng(1)), 0.4, SETTINGS)
    (polygon,) = drawn.geoms
    assert len(polygon.exterior.coords) - 1 == 6
    assert polygon.area * 1e-6 == pytest.approx(truth.area, rel=0.03)


@pytest.mark.parametrize(
    ("truth", "least"),
    [
        (Polygon([(0, 0), (14, 0), (14, 8), (5, 8), (0, 4)]), 0.95),
        (shapely.Point(0, 0).buffer(8.0), 0.95),
        (Polygon([(0, 0), (40, 0), (40, 14), (0, 9)]), 0.98),
    ],
    ids=["a slanting side", "a circle", "a long wall that is surely not square"],
)
def test_what_is_not_square_stays_so(truth: Polygon, least: float) -> None:
    drawn = straighten(ragged(truth, 0.4, np.random.default_rng(2)), 0.4, SETTINGS)
    assert overlap(drawn, truth) > least


@given(st.integers(0, 2**32 - 1), st.floats(0.2, 2.0))
@settings(max_examples=examples(80), deadline=None)
def test_any_outline_stays_valid_and_near(seed: int, spacing_m: float) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 40))
    angle = np.sort(rng.uniform(0, math.tau, n))
    radius = rng.uniform(2.0, 15.0, n) * 1e3
    raw = shapely.Polygon(np.rint(np.column_stack((radius * np.cos(angle), radius * np.sin(angle)))))
    if not raw.is_valid or raw.area < 1e6:
        return
    drawn = straighten(shapely.MultiPolygon([raw]), spacing_m, SETTINGS)
    assert drawn.is_valid
    noise = max(SETTINGS.outline_noise_spacings * spacing_m, SETTINGS.min_outline_noise_m) * 1e3
    assert shapely.symmetric_difference(drawn, raw).area <= 1.21 * noise * raw.length + raw.length
    assert np.array_equal(shapely.get_coordinates(drawn), np.rint(shapely.get_coordinates(drawn)))


def test_every_wing_takes_its_own_direction() -> None:
    wing = shapely.affinity.rotate(shapely.box(0, -7, 22, 0), 32.0, origin=(0, 0))
    truth = shapely.union_all([shapely.box(-20, -7, 1, 0), wing, shapely.Point(0, -3.5).buffer(3.5)])
    drawn = straighten(ragged(shapely.simplify(truth, 0.2), 0.4, np.random.default_rng(7)), 0.4, SETTINGS)
    (polygon,) = drawn.geoms
    sides = np.diff(np.array(polygon.exterior.coords), axis=0)
    long = sides[np.hypot(*sides.T) > 5000.0]
    off = sorted({round(math.degrees(math.atan2(y, x)) % 90.0, 3) for x, y in long.tolist()})
    # two exact directions, not one for each wall
    assert len(long) >= 5
    clusters = [group for group in (0.0, 32.0) if any(abs(math.remainder(a - group, 90.0)) < 1.5 for a in off)]
    assert clusters == [0.0, 32.0]
    assert all(min(abs(math.remainder(a - group, 90.0)) for group in clusters) < 1.5 for a in off)
    for group in clusters:
        own = [a for a in off if abs(math.remainder(a - group, 90.0)) < 1.5]
        assert max(own) - min(own) < 0.05 or max(own) - min(own) > 89.9


def test_common_directions_are_those_of_most_length() -> None:
    turned = shapely.affinity.rotate(shapely.box(0, 0, 12, 8), 20.0)
    ring = shapely.get_coordinates(turned.exterior)[:-1]
    (found,) = peaks_of([fitted_run(ring, k, k + 1) for k in range(len(ring))])
    assert math.remainder(found - math.radians(20.0), math.pi / 2) == pytest.approx(0.0, abs=1e-9)
    assert peaks_of([]) == []


def described(
    border: FloatArray,
    degrees: Sequence[float],
    prices: Prices = PRICES,
    met: tuple[float, float] = (math.nan, math.nan),
) -> tuple[list[int], list[int]]:
    """Where the edges of an open border end, and their directions; it ends on lines that run at `met` degrees."""
    directions = np.radians(np.array(degrees, np.float64))
    ends, of_edge, _, _ = least_description(
        border, np.arange(len(border)), directions, 0.5 / (500.0 * 200.0**2), prices, np.radians(met)
    )
    return ends.tolist(), of_edge.tolist()


def test_a_zigzag_is_one_edge_and_a_corner_two() -> None:
    x = np.arange(0, 10_001, 250.0)
    zigzag = np.column_stack((x, 150.0 * (-1.0) ** np.arange(len(x))))
    assert described(zigzag, [0.0, 90.0]) == ([0, 40], [0])
    bent = np.vstack((zigzag, [[10_000.0, y] for y in np.arange(500.0, 8001.0, 500.0)]))
    assert described(bent, [0.0, 90.0]) == ([0, 40, 56], [0, 1])


@pytest.mark.parametrize(("rise", "expected"), [(0.01, 0), (0.25, FREE)])
def test_an_edge_takes_a_direction_of_its_own_where_its_length_shows_it(rise: float, expected: int) -> None:
    x = np.arange(0, 20_001, 500.0)
    assert described(np.column_stack((x, rise * x)), [0.0, 90.0]) == ([0, 40], [expected])


def test_a_border_ends_square_on_what_it_meets_unless_it_is_surely_oblique() -> None:
    x = np.arange(0, 3001, 500.0)
    # amid two directions, the one that is square to the line at its end
    between = np.column_stack((x, math.tan(math.radians(8.0)) * x))
    assert described(between, [0.0, 16.0], met=(math.nan, 106.0))[1] == [1]
    assert described(between, [0.0, 16.0], met=(90.0, math.nan))[1] == [0]
    oblique = np.column_stack((8.0 * x, 8.0 * math.tan(math.radians(35.0)) * x))
    assert described(oblique, [0.0, 35.0, 90.0], met=(0.0, 0.0))[1] == [1]


def test_a_small_bump_is_not_described() -> None:
    x = np.arange(0, 20_001, 250.0)
    y = np.where((x > 9000.0) & (x < 10_000.0), 300.0, 0.0)
    assert described(np.column_stack((x, y)), [0.0, 90.0])[1] == [0]
    y = np.where((x > 9000.0) & (x < 13_000.0), 1500.0, 0.0)
    assert described(np.column_stack((x, y)), [0.0, 90.0])[1] == [0, 1, 0, 1, 0]


@pytest.mark.parametrize("seed", range(6))
def test_a_house_of_few_points_is_a_rectangle_in_its_direction(seed: int) -> None:
    rng = np.random.default_rng(seed)
    truth = shapely.affinity.rotate(shapely.box(0, 0, 14, 9), 33.0)
    points = rng.uniform(-16.0, 16.0, (4000, 2))
    points = points[shapely.contains_xy(truth, points)][:40]
    candidate = Candidate(
        building_id="a", origin=(0.0, 0.0, 0.0), points=np.column_stack((points.round(3), np.full(40, 6.0))),
        ground=np.zeros((0, 3)), ground_z_m=0.0,
    )  # fmt: skip
    drawn = drawn_outline(roof_points(prepare_cloud(candidate, SETTINGS.max_points), SETTINGS), SETTINGS)
    (polygon,) = drawn.geoms
    assert len(polygon.exterior.coords) - 1 == 4
    side = np.diff(np.array(polygon.exterior.coords), axis=0)[0]
    assert abs(math.remainder(math.atan2(side[1], side[0]) - math.radians(33.0), math.pi / 2)) < math.radians(12.0)
    assert overlap(drawn, truth) > 0.75


def test_a_courtyard_stays_a_hole_and_is_as_square_as_the_outside() -> None:
    truth = shapely.affinity.rotate(shapely.box(0, 0, 24, 20).difference(shapely.box(7, 6, 17, 13)), 25.0)
    rng = np.random.default_rng(11)
    outer, inner = (ragged(Polygon(ring), 0.4, rng).geoms[0] for ring in (truth.exterior, *truth.interiors))
    drawn = straighten(MultiPolygon([Polygon(outer.exterior, [inner.exterior])]), 0.4, SETTINGS)
    (polygon,) = drawn.geoms
    assert [len(ring.coords) - 1 for ring in (polygon.exterior, *polygon.interiors)] == [4, 4]
    assert overlap(drawn, truth) > 0.96


@given(st.integers(0, 2**32 - 1), st.floats(0.2, 1.5), st.floats(0.0, 0.6))
@settings(max_examples=examples(60), deadline=None)
def test_any_outline_stays_valid_with_any_points(seed: int, spacing_m: float, split_share: float) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 30))
    angle = np.sort(rng.uniform(0, math.tau, n))
    radius = rng.uniform(1.0, 15.0, n) * 1e3
    raw = Polygon(np.rint(np.column_stack((radius * np.cos(angle), radius * np.sin(angle)))))
    if not raw.is_valid or raw.area < 1e6:
        return
    hole = shapely.Point(0, 0).buffer(300.0)
    body = raw.difference(hole) if raw.contains(hole) else raw
    if not isinstance(body, Polygon):
        return
    xy = np.rint(rng.uniform(-16e3, 16e3, (400, 2))).astype(np.int64)
    points = EdgePoints.of(xy, rng.uniform(size=len(xy)) < split_share, spacing_m)
    drawn = straighten(shapely.set_precision(MultiPolygon([body]), 1.0), spacing_m, SETTINGS, points)
    assert drawn.is_valid
    assert not drawn.is_empty
    assert np.array_equal(shapely.get_coordinates(drawn), np.rint(shapely.get_coordinates(drawn)))
