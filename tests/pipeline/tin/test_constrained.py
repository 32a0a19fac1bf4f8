"""Constrained Delaunay triangulation: exact, with the given edges, and refined to a tolerance."""

import numpy as np
import pytest
import shapely
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.model import FloatArray, IntArray
from pipeline.tin.constrained import ConstrainedTin, LatticePoints, RefinedTin, refine, triangulate_constrained

SIDE = 9000
NO_POINTS = LatticePoints(z_mm=np.full((1, 1), np.nan), west_mm=500, south_mm=500)


def noded(ends: list[tuple[int, int, int, int]], step: int) -> tuple[IntArray, IntArray]:
    """Points and edges that meet at points only, of a square and of segments; a coarse step makes many coincidences."""
    lines = [shapely.LineString([(a * step, b * step), (c * step, d * step)]) for a, b, c, d in ends]
    square = shapely.LinearRing([(0, 0), (SIDE, 0), (SIDE, SIDE), (0, SIDE)])
    parts = shapely.get_parts(shapely.union_all([square, *lines], grid_size=1.0))
    xy, line = shapely.get_coordinates(parts, return_index=True)
    pairs = np.stack((xy[:-1], xy[1:]), axis=1)[line[:-1] == line[1:]].astype(np.int64)
    points, number = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
    return points, number.reshape(-1, 2)


def facets_of(tin: ConstrainedTin, xy: IntArray) -> RefinedTin:
    """All facets of a triangulation."""
    return refine(tin, np.zeros(len(xy), np.int64), np.ones(len(tin.inside), np.bool_), NO_POINTS, 1.0)


def doubled_area(a: IntArray, b: IntArray, c: IntArray) -> int:
    return int((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def lies_inside_circle(a: IntArray, b: IntArray, c: IntArray, d: IntArray) -> bool:
    """In exact whole numbers."""
    rows = [[int(v) for v in p - d] for p in (a, b, c)]
    (ax, ay), (bx, by), (cx, cy) = rows
    la, lb, lc = (x * x + y * y for x, y in rows)
    return la * (bx * cy - by * cx) + lb * (cx * ay - cy * ax) + lc * (ax * by - ay * bx) > 0


SEGMENTS = st.lists(st.tuples(*[st.integers(0, 9)] * 4).filter(lambda s: s[:2] != s[2:]), min_size=1, max_size=12)


@settings(max_examples=examples(120), deadline=None)
@given(SEGMENTS, st.sampled_from([1000, 997]))
def test_given_edges_are_edges_and_all_others_are_delaunay(ends: list[tuple[int, int, int, int]], step: int) -> None:
    xy, edges = noded(ends, step)
    tin = triangulate_constrained(xy, edges)
    facets = facets_of(tin, xy).facets
    areas = [doubled_area(*xy[facet]) for facet in facets]
    assert min(areas) > 0
    assert sum(areas) == 2 * SIDE**2
    opposite = {(int(f[k]), int(f[(k + 1) % 3])): int(f[(k + 2) % 3]) for f in facets for k in range(3)}
    assert len(opposite) == 3 * len(facets)
    wanted = {(int(a), int(b)) for a, b in edges} | {(int(b), int(a)) for a, b in edges}
    assert all(edge in opposite or edge[::-1] in opposite for edge in wanted)
    for (a, b), c in opposite.items():
        if (a, b) not in wanted:
            assert not lies_inside_circle(xy[a], xy[b], xy[c], xy[opposite[b, a]])


@settings(max_examples=examples(60), deadline=None)
@given(SEGMENTS)
def test_regions_are_the_faces_between_given_edges(ends: list[tuple[int, int, int, int]]) -> None:
    xy, edges = noded(ends, 1000)
    tin = triangulate_constrained(xy, edges)
    faces = shapely.get_parts(shapely.polygonize(list(shapely.linestrings(xy[edges].astype(float)))))
    middles = shapely.points(xy[tin.inside].mean(axis=1))
    assert len(tin.inside) == len(faces)
    assert {int(np.flatnonzero(shapely.contains(faces, point))[0]) for point in middles} == set(range(len(faces)))


def test_a_point_on_an_edge_divides_it() -> None:
    xy = np.array([[0, 0], [8, 0], [8, 8], [0, 8], [4, 4], [2, 6], [3, 6]])
    found = facets_of(triangulate_constrained(xy, np.array([[0, 2]])), xy)
    pairs = {tuple(sorted((int(f[k]), int(f[(k + 1) % 3])))) for f in found.facets for k in range(3)}
    assert {(0, 4), (2, 4)} <= pairs
    assert len(set(found.region.tolist())) == 2


@pytest.mark.parametrize(
    ("xy", "message"),
    [
        ([[0, 0], [4, 0], [4, 4], [0, 0]], r"points at \(0, 0\) mm are equal"),
        ([[0, 0], [4, 0], [8, 0]], "all points lie on one line"),
        ([[0, 0], [1 << 22, 0], [0, 5]], "points extend over 4194.304 m"),
    ],
)
def test_points_that_cannot_be_triangulated_are_named(xy: list[list[int]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        triangulate_constrained(np.array(xy), np.empty((0, 2), np.int64))


def height_at(found: RefinedTin, x: float, y: float) -> float:
    """Elevation of the facet at a place, found one facet after the other."""
    corners: FloatArray = found.vertices_mm[found.facets].astype(float)
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    whole = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    u = ((b[:, 0] - x) * (c[:, 1] - y) - (b[:, 1] - y) * (c[:, 0] - x)) / whole
    v = ((c[:, 0] - x) * (a[:, 1] - y) - (c[:, 1] - y) * (a[:, 0] - x)) / whole
    inside = np.flatnonzero((u >= 0) & (v >= 0) & (u + v <= 1))[0]
    return float(u[inside] * a[inside, 2] + v[inside] * b[inside, 2] + (1 - u[inside] - v[inside]) * c[inside, 2])


@settings(max_examples=examples(60), deadline=None)
@given(SEGMENTS, st.integers(0, 1000), st.sampled_from([20.0, 150.0]))
def test_every_point_of_a_wanted_region_is_within_the_tolerance(
    ends: list[tuple[int, int, int, int]], seed: int, tolerance: float
) -> None:
    random = np.random.default_rng(seed)
    xy, edges = noded(ends, 1000)
    tin = triangulate_constrained(xy, edges)
    wanted = random.random(len(tin.inside)) < 0.7
    z = random.integers(0, 400, (9, 9)).astype(float)
    # points must not lie on given edges
    places = shapely.points(*np.meshgrid(500.0 + 1000.0 * np.arange(9), 500.0 + 1000.0 * np.arange(9)))
    lines = shapely.multilinestrings(shapely.linestrings(xy[edges].astype(float)))
    z[shapely.distance(places, lines) < 1.0] = np.nan
    points = LatticePoints(z_mm=z, west_mm=500, south_mm=500)
    found = refine(tin, random.integers(0, 400, len(xy)), wanted, points, tolerance)
    inside = shapely.union_all([shapely.Polygon(found.vertices_mm[facet, :2]) for facet in found.facets])
    rows, columns = np.nonzero(~np.isnan(z) & shapely.contains(inside, places))
    errors = [
        abs(height_at(found, 500 + 1000 * c, 500 + 1000 * r) - z[r, c]) for r, c in zip(rows, columns, strict=True)
    ]
    assert found.n_points == len(errors)
    assert max(errors, default=0.0) <= tolerance + 1e-6
    assert found.max_error_mm == pytest.approx(max(errors, default=0.0), abs=1e-6)
    assert found.squares_mm2 == pytest.approx(sum(error**2 for error in errors), abs=1e-3)
    directed = [(int(f[k]), int(f[(k + 1) % 3])) for f in found.facets for k in range(3)]
    assert len(set(directed)) == len(directed)
    # the edges of wanted regions stay whole
    kept = {frozenset(pair) for pair in directed}
    pairs = facets_of(tin, xy)
    of_wanted = {
        frozenset((int(f[k]), int(f[(k + 1) % 3])))
        for f, region in zip(pairs.facets, pairs.region, strict=True)
        for k in range(3)
        if wanted[region]
    }
    assert {frozenset(map(int, edge)) for edge in edges} & of_wanted <= kept


def test_a_plane_needs_no_point_and_a_summit_one() -> None:
    xy = np.array([[0, 0], [5000, 0], [5000, 5000], [0, 5000]])
    tin = triangulate_constrained(xy, np.empty((0, 2), np.int64))
    x, y = np.meshgrid(500.0 + 1000.0 * np.arange(5), 500.0 + 1000.0 * np.arange(5))
    plane = 0.1 * x + 0.2 * y
    points = LatticePoints(z_mm=plane, west_mm=500, south_mm=500)
    z = np.array([0, 500, 1500, 1000])
    assert len(refine(tin, z, np.ones(1, np.bool_), points, 1.0).facets) == 2
    plane[2, 3] += 700.0
    summit = refine(tin, z, np.ones(1, np.bool_), points, 699.0)
    assert summit.vertices_mm[4:].tolist() == [[3500, 2500, 1550]]
