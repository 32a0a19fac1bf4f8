"""Outlines of different candidates that overlap: each piece goes to one of two, and all are disjoint afterwards."""

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
import shapely
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely import MultiPolygon, Polygon
from shapely.affinity import rotate

from pipeline.roof.disjoint_outlines import Claim, _thinned, _without_needles, divided, effort, left_of

CORNER_MM = np.array([84_900_000, 447_500_000])


def claim(name: str, roof: Polygon, z_m: float, outline: Polygon | None = None, spacing_m: float = 0.5) -> Claim:
    """A candidate with points all over its roof, in metres, at one height; its outline is half a spacing wider."""
    x0, y0, x1, y1 = roof.bounds
    x, y = (
        axis.ravel() for axis in np.meshgrid(np.arange(x0, x1 + 1e-9, spacing_m), np.arange(y0, y1 + 1e-9, spacing_m))
    )
    inside = shapely.intersects_xy(roof, x, y)
    places = np.rint(np.column_stack((x, y))[inside] * 1e3).astype(np.int64) + CORNER_MM
    points = np.column_stack((places, np.full(len(places), round(z_m * 1e3))))
    drawn = shapely.buffer(roof, 0.5 * spacing_m, join_style="mitre") if outline is None else outline
    drawn = shapely.transform(drawn, lambda xy: np.rint(xy * 1e3) + CORNER_MM)
    return Claim(name=name, outline_mm=MultiPolygon([drawn]), points_mm=points[np.lexsort(points.T[::-1])])


def resolved(claims: Sequence[Claim], min_area_m2: float = 4.0) -> list[MultiPolygon]:
    """All outlines after all pairs were divided."""
    kept: list[list[MultiPolygon]] = [[] for _ in claims]
    for i, j in itertools.combinations(range(len(claims)), 2):
        for k, shape in zip((i, j), divided(claims[i], claims[j]), strict=True):
            kept[k].append(shape)
    return [left_of(one.outline_mm, kept[k], min_area_m2) for k, one in enumerate(claims)]


def overlap_m2(outlines: Sequence[MultiPolygon]) -> float:
    """The area that two outlines share, over all pairs."""
    return sum(shapely.intersection(*pair).area for pair in itertools.combinations(outlines, 2)) * 1e-6


def uncovered_m2(claims: Sequence[Claim], outlines: Sequence[MultiPolygon]) -> float:
    """The area of the outlines before that none has afterwards."""
    before = shapely.union_all([one.outline_mm for one in claims])
    return shapely.difference(before, shapely.union_all(list(outlines))).area * 1e-6


def corners(outline: MultiPolygon) -> int:
    """Corners of an outline; those within 2 mm of a straight line do not count."""
    return shapely.get_num_coordinates(shapely.simplify(outline, 2.0)) - len(outline.geoms)


def test_the_effort_of_an_area_counts_corners_parts_and_what_is_acute_or_short() -> None:
    square = shapely.box(0, 0, 9000, 9000)
    assert effort(square) == 4 + 4
    assert effort(MultiPolygon([square, shapely.box(20_000, 0, 20_600, 9000)])) == 8 + 8 + 2
    assert effort(Polygon(square.exterior, [shapely.box(1000, 1000, 2000, 2000).exterior])) == 4 + 8
    assert effort(Polygon([(0, 0), (9000, 0), (0, 3000)])) == 4 + 3 + 3
    # a vertex twice, and one that hardly bends an edge
    assert effort(Polygon([(0, 0), (0, 0), (4000, 10), (9000, 0), (9000, 9000), (0, 9000)])) == 4 + 4


def test_two_sheds_that_touch_share_one_straight_wall() -> None:
    sheds = claim("a", shapely.box(0, 0, 6, 4), 3.0), claim("b", shapely.box(6.1, 0, 12, 4), 2.5)
    outlines = resolved(sheds)
    assert overlap_m2(outlines) == 0.0
    assert uncovered_m2(sheds, outlines) == 0.0
    assert [corners(one) for one in outlines] == [4, 4]
    shared = shapely.intersection(*(shapely.boundary(one) for one in outlines))
    assert shared.length == pytest.approx(4_500.0)
    for one, shed in zip(outlines, sheds, strict=True):
        assert shapely.contains_xy(one, shed.points_mm[:, 0], shed.points_mm[:, 1]).mean() > 0.85


def test_turned_sheds_that_touch_have_the_same_corners_along_their_wall() -> None:
    boxes = shapely.box(0, 0, 6, 4), shapely.box(6.1, 0.7, 12, 5), shapely.box(3, 4.1, 9, 9)
    outlines = resolved([claim(str(k), rotate(box, 23.0, origin=(0, 0)), 3.0 + k) for k, box in enumerate(boxes)])
    assert overlap_m2(outlines) == 0.0
    for one, other in itertools.combinations(outlines, 2):
        assert shapely.coverage_is_valid([*one.geoms, *other.geoms])


def test_the_order_of_two_candidates_does_not_matter() -> None:
    first = claim("a", shapely.box(0, 0, 6, 4), 3.0)
    second = claim("b", rotate(shapely.box(5, 1, 12, 5), 23.0), 3.0)
    forth, back = divided(first, second), divided(second, first)
    assert forth == back[::-1]
    assert sum(kept.area for kept in forth) < first.outline_mm.area + second.outline_mm.area


def test_three_candidates_at_one_place_are_disjoint_and_leave_no_gap() -> None:
    three = (
        claim("a", shapely.box(0, 0, 6, 6), 3.0),
        claim("b", shapely.box(6.2, 0, 12, 6), 4.0),
        claim("c", shapely.box(3, 6.2, 9, 12), 5.0),
    )
    outlines = resolved(three)
    assert overlap_m2(outlines) == 0.0
    assert uncovered_m2(three, outlines) < 0.01


def test_a_lean_to_of_six_square_metres_keeps_its_form() -> None:
    house = claim("house", shapely.box(0, 0, 10, 8), 7.0)
    lean_to = claim("lean-to", shapely.box(10.1, 2, 12, 5), 2.5)
    outlines = resolved((house, lean_to))
    assert overlap_m2(outlines) == 0.0
    assert corners(outlines[1]) == 4
    assert outlines[1].area * 1e-6 > 6.0


def test_a_small_one_in_the_outline_of_a_large_one_keeps_its_place() -> None:
    hall = claim("hall", shapely.difference(shapely.box(0, 0, 30, 20), shapely.box(10, 8, 13, 11)), 6.0)
    whole = claim("hall", shapely.box(0, 0, 30, 20), 6.0)
    hall = Claim(name="hall", outline_mm=whole.outline_mm, points_mm=hall.points_mm)
    tower = claim("tower", shapely.box(10.3, 8.3, 12.7, 10.7), 12.0)
    outlines = resolved((hall, tower))
    assert overlap_m2(outlines) == 0.0
    assert shapely.equals(outlines[1], tower.outline_mm)
    assert outlines[0].area == pytest.approx(hall.outline_mm.area - tower.outline_mm.area)


def test_an_overlap_with_points_of_both_is_divided_between_them() -> None:
    # both outlines reach far into the other's points
    left = claim("left", shapely.box(0, 0, 8, 10), 5.0, shapely.box(0, 0, 11, 10))
    right = claim("right", shapely.box(8.4, 0, 16, 10), 5.0, shapely.box(5, 0, 16, 10))
    outlines = resolved((left, right))
    assert overlap_m2(outlines) == 0.0
    for one, own in zip(outlines, (left, right), strict=True):
        assert shapely.intersects_xy(one, own.points_mm[:, 0], own.points_mm[:, 1]).all()


@pytest.mark.parametrize(("lowest_m", "spacing_m", "expected"), [(1.0, 2.0, 4), (-0.2, 0.25, 5)])
def test_a_house_ends_before_another_along_its_own_edges_unless_its_points_lie_beyond(
    lowest_m: float, spacing_m: float, expected: int
) -> None:
    wall = claim("wall", rotate(shapely.box(-20, -6, 20, 0), 30.0, origin=(0, 0)), 6.0)
    house = claim("house", shapely.box(-6, lowest_m, 0, 11), 5.0, shapely.box(-7, -0.5, 1, 12), spacing_m)
    free = ~shapely.intersects_xy(wall.outline_mm, house.points_mm[:, 0], house.points_mm[:, 1])
    house = Claim(name="house", outline_mm=house.outline_mm, points_mm=house.points_mm[free])
    outlines = resolved((wall, house))
    assert overlap_m2(outlines) == 0.0
    assert corners(outlines[1]) == expected
    inside = shapely.intersects_xy(outlines[1], house.points_mm[:, 0], house.points_mm[:, 1])
    assert np.count_nonzero(~inside) <= 1


def test_needles_and_small_parts_are_left_out() -> None:
    wall = claim("wall", shapely.box(0, 0, 20, 6), 9.0)
    # only a strip of 0.15 m and a part of a square metre remain of it beyond the wall
    low = claim("low", shapely.box(5, 6.1, 10, 12), 3.0, Polygon([(5, -0.4), (10, -0.4), (10, 12), (5, 12)]))
    outlines = resolved((wall, low))
    assert overlap_m2(outlines) == 0.0
    assert len(outlines[1].geoms) == 1
    assert corners(outlines[1]) == 4


def test_a_needle_goes_though_a_cut_corner_would_make_up_for_its_area() -> None:
    slope = np.tan(np.radians(15.0))
    wedge = Polygon([(300, -300 * slope), (9000, -9000 * slope), (9000, 9000 * slope), (300, 300 * slope)])
    with_needle = shapely.set_precision(wedge.union(shapely.box(8999, 0, 9250, 100)), 1.0)
    (left,) = _without_needles(with_needle)
    assert left.bounds[2] <= 9001.0
    assert left.area == pytest.approx(wedge.area, abs=4000.0)


@settings(max_examples=examples(60), deadline=None)
@given(
    places=st.lists(
        st.tuples(*[st.floats(0, 12)] * 2, *[st.floats(2.5, 9)] * 2, st.floats(0, 90), st.floats(2, 9)),
        min_size=2,
        max_size=4,
    ),
    seed=st.integers(0, 9),
)
def test_outlines_are_disjoint_within_what_they_covered_in_any_order(
    places: list[tuple[float, ...]], seed: int
) -> None:
    claims = [
        claim(str(k), rotate(shapely.box(x, y, x + wide, y + deep), angle), z)
        for k, (x, y, wide, deep, angle, z) in enumerate(places)
    ]
    outlines = resolved(claims)
    order = np.random.default_rng(seed).permutation(len(claims))
    again = resolved([claims[k] for k in order])
    for k, one in zip(order, again, strict=True):
        assert shapely.equals(one, outlines[k])
    assert all(one.is_valid for one in outlines)
    for one, before in zip(outlines, claims, strict=True):
        assert shapely.difference(one, shapely.buffer(before.outline_mm, 1.5)).is_empty
    assert overlap_m2(outlines) == pytest.approx(0.0, abs=1e-7)


def test_a_short_edge_between_two_inner_corners_goes_and_nothing_is_added() -> None:
    ring = np.array([(0, 0), (0, 4000), (1000, 4000), (2000, 2001), (2001, 2000), (4000, 1000), (4000, 0)], np.float64)
    thinned = _thinned(ring)
    assert len(thinned) == 6
    assert Polygon(ring).buffer(1e-6).covers(Polygon(thinned))
    assert Polygon(ring).area - Polygon(thinned).area < 5.0
