"""Delaunay triangulation: exact, canonical, complete."""

import itertools
import math

import numpy as np
import numpy.typing as npt
import pytest
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.model import IntArray, Tin
from pipeline.tin.delaunay import strip_order, triangulate, unique_xy
from pipeline.tin.predicates import lies_in_circumcircle, orientation

Point = tuple[int, int]


def exact_orientation(a: Point, b: Point, c: Point) -> int:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def exact_in_circle(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Slow twin: Python's whole numbers; ties by the definition, the smallest point's lift is raised most."""
    rows = []
    for p in (a, b, c):
        u, v = p[0] - d[0], p[1] - d[1]
        rows.append((u, v, u * u + v * v))
    (ax, ay, al), (bx, by, bl), (cx, cy, cl) = rows
    det = al * (bx * cy - by * cx) + bl * (cx * ay - cy * ax) + cl * (ax * by - ay * bx)
    if det != 0:
        return det > 0
    cofactors = {
        a: exact_orientation(d, b, c),
        b: exact_orientation(d, c, a),
        c: exact_orientation(d, a, b),
        d: -exact_orientation(a, b, c),
    }
    for point in sorted(cofactors):
        if cofactors[point] != 0:
            return cofactors[point] > 0
    raise AssertionError("four points of one line have no circle")


def triangles(tin: Tin, xy: IntArray) -> set[tuple[Point, ...]]:
    """Facets as sorted coordinate triples, independent of any numbering."""
    return {tuple(sorted((int(u), int(v)) for u, v in xy[facet])) for facet in tin.facets}


def brute_force(xy: IntArray) -> set[tuple[Point, ...]]:
    """All triples whose perturbed circumcircle holds no other point."""
    points = [(int(u), int(v)) for u, v in xy]
    found = set()
    for a, b, c in itertools.combinations(points, 3):
        turn = exact_orientation(a, b, c)
        if turn == 0:
            continue
        b, c = (b, c) if turn > 0 else (c, b)  # noqa: PLW2901
        if not any(exact_in_circle(a, b, c, d) for d in points if d not in (a, b, c)):
            found.add(tuple(sorted((a, b, c))))
    return found


def assert_sound(tin: Tin, xy: IntArray) -> None:
    """Every edge is locally Delaunay by exact arithmetic, neighbours agree, all points used, the hull is filled."""
    points = [(int(u), int(v)) for u, v in xy]
    assert set(np.unique(tin.facets)) == set(range(len(xy)))
    twice_area = 0
    for t, facet in enumerate(tin.facets):
        a, b, c = (points[v] for v in facet)
        turn = exact_orientation(a, b, c)
        assert turn > 0
        twice_area += turn
        for k in range(3):
            m = int(tin.neighbours[t, k])
            if m < 0:
                continue
            u, v = facet[(k + 1) % 3], facet[(k + 2) % 3]
            other = list(tin.facets[m])
            assert u in other
            assert v in other
            j = next(i for i in range(3) if other[i] not in (u, v))
            assert tin.neighbours[m, j] == t
            assert not exact_in_circle(a, b, c, points[other[j]])
    # Euler: with all points as vertices and b edges on the hull there are 2 n - 2 - b facets
    hull_edges = int((tin.neighbours < 0).sum())
    assert len(tin) == 2 * len(xy) - 2 - hull_edges
    # the edges without a neighbour form the convex hull: its area is that of the facets
    from shapely import MultiPoint

    assert twice_area == pytest.approx(2 * MultiPoint(xy).convex_hull.area, rel=1e-12)


def random_unique(seed: int, n: int, size: int) -> IntArray:
    rng = np.random.default_rng(seed)
    xy = np.unique(rng.integers(0, size, (n, 2)), axis=0)
    return xy[rng.permutation(len(xy))]


small_sets = st.lists(st.tuples(st.integers(0, 7), st.integers(0, 7)), min_size=1, max_size=14, unique=True)


wide = st.integers(-900_000, 900_000)


@settings(max_examples=examples(400), deadline=None)
@given(small_sets | st.lists(st.tuples(wide, wide), min_size=3, max_size=9, unique=True))
def test_it_equals_the_brute_force_definition_on_small_lattices_full_of_ties_and_on_wide_sets(
    points: list[Point],
) -> None:
    xy = np.array(points, np.int64)
    assert triangles(triangulate(xy), xy) == brute_force(xy)


coordinate = st.integers(0, 1 << 21) | st.integers(0, 30) | st.integers((1 << 21) - 30, 1 << 21)
vertex = st.tuples(coordinate, coordinate)


@settings(max_examples=examples(500), deadline=None)
@given(st.lists(vertex, min_size=4, max_size=4, unique=True))
def test_the_predicates_equal_exact_arithmetic(points: list[Point]) -> None:
    a, b, c, d = points
    turn = exact_orientation(a, b, c)
    assert orientation(*map(float, (*a, *b, *c))) == turn
    if turn < 0:
        b, c = c, b
    if turn != 0:
        assert lies_in_circumcircle(*map(float, (*a, *b, *c, *d))) == exact_in_circle(a, b, c, d)


def test_the_in_circle_predicate_feels_one_millimetre_at_two_kilometres() -> None:
    # (0,0), (w,0), (w,w) and around the fourth corner of the square
    w = 2_000_000
    for du, dv in itertools.product((-1, 0, 1), repeat=2):
        d = (0 + du, w + dv)
        expected = exact_in_circle((0, 0), (w, 0), (w, w), d)
        assert lies_in_circumcircle(0.0, 0.0, float(w), 0.0, float(w), float(w), float(d[0]), float(d[1])) == expected


@pytest.mark.parametrize(("n", "size"), [(50, 40), (400, 100_000), (2_000, 2_000_000), (1_500, 60)])
def test_every_edge_is_exactly_delaunay(n: int, size: int) -> None:
    xy = random_unique(n, n, size)
    assert_sound(triangulate(xy), xy)


def test_the_extreme_window_is_exact() -> None:
    rng = np.random.default_rng(3)
    corners = np.array([[0, 0], [2_000_000, 0], [2_000_000, 2_000_000], [0, 2_000_000]])
    ring = np.unique(
        np.round(1e6 + 1e6 * np.stack([np.cos(a := rng.uniform(0, 2 * np.pi, 300)), np.sin(a)], 1)), axis=0
    )
    xy = np.concatenate((corners, ring.astype(np.int64)))
    assert_sound(triangulate(xy), xy)


def test_it_agrees_with_qhull_on_random_points() -> None:
    from scipy.spatial import Delaunay

    xy = random_unique(11, 5_000, 1_000_000)
    ours = triangles(triangulate(xy), xy)
    theirs = {tuple(sorted((int(u), int(v)) for u, v in xy[s])) for s in Delaunay(xy.astype(float)).simplices}
    assert len(ours ^ theirs) == 0


@pytest.mark.parametrize("angle", [(1, 0), (3, 4), (-5, 12)])
def test_a_lattice_where_every_cell_is_cocircular_is_sound(angle: Point) -> None:
    u, v = np.meshgrid(np.arange(23) * 10, np.arange(17) * 10)
    xy = np.stack([u * angle[0] - v * angle[1], u * angle[1] + v * angle[0]], -1).reshape(-1, 2)
    xy = np.random.default_rng(0).permutation(xy)
    tin = triangulate(xy)
    assert len(tin) == 2 * 22 * 16
    assert_sound(tin, xy)


def test_clusters_and_lines_are_sound() -> None:
    rng = np.random.default_rng(5)
    clusters = rng.integers(0, 1_900_000, (6, 2))[rng.integers(0, 6, 700)] + rng.normal(0, 12, (700, 2)).astype(int)
    lines = np.stack([rng.integers(0, 1_000_000, 700), rng.integers(0, 4, 700) * 250_000], 1)
    for xy in (np.unique(clusters, axis=0), np.unique(lines, axis=0)):
        assert_sound(triangulate(xy), xy)


@settings(max_examples=examples(60), deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([12, 60, 5_000]))
def test_the_order_of_points_changes_nothing(seed: int, size: int) -> None:
    xy = random_unique(seed, 120, size)
    turned = np.random.default_rng(seed + 1).permutation(len(xy))
    assert triangles(triangulate(xy), xy) == triangles(triangulate(xy[turned]), xy[turned])


@pytest.mark.parametrize(("wide_mm", "deep_mm"), [(100_000, 100_000), (240_000, 25_000), (24_000, 250_000)])
def test_strips_pass_every_point_once_and_lead_to_near_ones(wide_mm: int, deep_mm: int) -> None:
    xy = np.random.default_rng(3).integers([500, -700], [500 + wide_mm, deep_mm - 700], (4_000, 2))
    order = strip_order(xy)
    assert sorted(order.tolist()) == list(range(len(xy)))
    steps = np.hypot(*np.diff(xy[order], axis=0).T) / math.sqrt(wide_mm * deep_mm / len(xy))
    assert steps.mean() < 1.5
    # at the ends of strips, too
    assert steps.max() < 6.0


@pytest.mark.parametrize("xy", [[[5, 5]], [[5, 5], [5, 9], [5, 7]], [[9, 5], [5, 5], [7, 5]]])
def test_strips_of_points_in_a_row_follow_it(xy: list[list[int]]) -> None:
    places = np.array(xy)[strip_order(np.array(xy))]
    np.testing.assert_array_equal(places, sorted(xy))


def test_renumbering_the_points_only_renumbers_the_facets() -> None:
    xy = random_unique(2, 1_000, 90)
    new_number = np.random.default_rng(1).permutation(len(xy))
    moved = np.empty_like(xy)
    moved[new_number] = xy
    renumbered = new_number[triangulate(xy).facets]
    smallest = renumbered.argmin(axis=1)
    rotated = np.take_along_axis(renumbered, (smallest[:, None] + np.arange(3)) % 3, axis=1)
    in_order = rotated[np.lexsort(rotated.T[::-1])]
    np.testing.assert_array_equal(triangulate(moved).facets, in_order)


def test_a_shift_of_the_origin_changes_nothing() -> None:
    xy = random_unique(4, 500, 80)
    moved = xy + np.array([84_123_456, 447_000_001])
    np.testing.assert_array_equal(triangulate(xy).facets, triangulate(moved).facets)


def circles_inside(tin: Tin, xy: npt.NDArray[np.float64], low: float, high: float) -> set[tuple[Point, ...]]:
    """Facets whose circumcircle lies in the open square window."""
    kept = set()
    for facet in tin.facets:
        (ax, ay), (bx, by), (cx, cy) = xy[facet].astype(float)
        d = 2 * ((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))
        b2, c2 = (bx - ax) ** 2 + (by - ay) ** 2, (cx - ax) ** 2 + (cy - ay) ** 2
        u, v = ((cy - ay) * b2 - (by - ay) * c2) / d, ((bx - ax) * c2 - (cx - ax) * b2) / d
        r = np.hypot(u, v) + 1e-6
        if low < ax + u - r and ax + u + r < high and low < ay + v - r and ay + v + r < high:
            kept.add(tuple(sorted((int(p), int(q)) for p, q in xy[facet])))
    return kept


@pytest.mark.parametrize("step", [1, 37])
def test_a_sub_window_has_the_same_facets_where_it_knows_all_points(step: int) -> None:
    xy = random_unique(9, 4_000, 80) * step
    low, high = 20 * step, 61 * step
    inside = xy[((xy >= low) & (xy <= high)).all(axis=1)]
    whole = circles_inside(triangulate(xy), xy, low, high)
    part = circles_inside(triangulate(inside), inside, low, high)
    assert len(whole) > 500
    assert whole == part


@pytest.mark.parametrize("n", [0, 1, 2, 3, 50])
def test_collinear_points_have_no_facets(n: int) -> None:
    xy = np.stack([np.arange(n) * 3, np.arange(n) * 7], 1).astype(np.int64)
    tin = triangulate(xy)
    assert tin.facets.shape == (0, 3)
    assert tin.neighbours.shape == (0, 3)


def test_a_line_and_one_point_beside_it_is_a_fan() -> None:
    line = np.stack([np.arange(40) * 10, np.zeros(40)], 1)
    xy = np.concatenate((line, [[95.0, 1.0]])).astype(np.int64)
    tin = triangulate(xy)
    assert len(tin) == 39
    assert_sound(tin, xy)


def test_three_points_give_one_facet_that_turns_left() -> None:
    tin = triangulate(np.array([[0, 0], [0, 10], [10, 0]]))
    np.testing.assert_array_equal(tin.facets, [[0, 2, 1]])
    np.testing.assert_array_equal(tin.neighbours, [[-1, -1, -1]])


def test_too_wide_a_window_is_refused_with_its_extent() -> None:
    with pytest.raises(ValueError, match=r"2000\.001 m"):
        triangulate(np.array([[0, 0], [2_000_001, 5], [7, 9]]))


@pytest.mark.parametrize("points", [[[0, 0], [9, 9], [0, 9], [9, 9]], [[0, 0], [1, 1], [0, 0]], [[4, 4], [4, 4]]])
def test_duplicates_are_refused_with_their_position(points: list[list[int]]) -> None:
    with pytest.raises(ValueError, match="given twice"):
        triangulate(np.array(points))


@settings(max_examples=examples(50), deadline=None)
@given(st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3), st.integers(-5, 5)), max_size=30))
def test_unique_xy_keeps_the_highest_of_every_position(points: list[tuple[int, int, int]]) -> None:
    xyz = np.array(points, np.int64).reshape(-1, 3)
    kept, kept_of_point = unique_xy(xyz[:, :2], xyz[:, 2])
    highest = {(u, v): max(h for a, b, h in points if (a, b) == (u, v)) for u, v, _ in points}
    assert {(int(u), int(v)): int(h) for u, v, h in xyz[kept]} == highest
    assert len(kept) == len(highest)
    np.testing.assert_array_equal(xyz[kept[kept_of_point], :2], xyz[:, :2])
