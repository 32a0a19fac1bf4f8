"""The exact tests behind the codes, against slow rational twins, shapely and numpy."""

import dataclasses
from collections import Counter
from fractions import Fraction

import numpy as np
import numpy.typing as npt
import pytest
import shapely
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.model import IntArray, Solid
from pipeline.quality.planarity import fitted_plane, in_fitted_plane, min_cosine_of_normals
from pipeline.quality.rings import polygon_code, ring_is_simple
from pipeline.quality.self_intersection import side_of_plane, triangles_intersect
from pipeline.quality.shell import is_sound_shell, six_volumes
from pipeline.quality.validity import check_solid

Point = tuple[Fraction, Fraction, Fraction]


def _cross(u: npt.NDArray[np.object_], v: npt.NDArray[np.object_]) -> npt.NDArray[np.object_]:
    return np.array([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]], dtype=object)


def _clip(polygon: list[Point], normal: npt.NDArray[np.object_], at: npt.NDArray[np.object_]) -> list[Point]:
    """The part of a convex polygon, or of what is left of one, where normal . (p - at) >= 0, boundary included."""
    if not polygon:
        return []
    heights = [sum(n * (c - a) for n, c, a in zip(normal, p, at, strict=True)) for p in polygon]
    kept: list[Point] = []
    for i, (p, height) in enumerate(zip(polygon, heights, strict=True)):
        q, next_height = polygon[(i + 1) % len(polygon)], heights[(i + 1) % len(polygon)]
        if height >= 0:
            kept.append(p)
        if height * next_height < 0:
            share = Fraction(height) / (height - next_height)
            kept.append(tuple(a + share * (b - a) for a, b in zip(p, q, strict=True)))  # type: ignore[arg-type]
    return kept


def _rational_twin(vertices: IntArray, first: IntArray, second: IntArray) -> bool:
    """Clip the first triangle by the second in rational numbers and see what is left beside shared vertices."""
    exact = np.array([[Fraction(int(c)) for c in vertex] for vertex in vertices], dtype=object)
    polygon: list[Point] = [tuple(exact[i]) for i in first]
    a, b, c = (exact[i] for i in second)
    normal = _cross(b - a, c - a)
    polygon = _clip(_clip(polygon, normal, a), -normal, a)
    for p, q in ((a, b), (b, c), (c, a)):
        polygon = _clip(polygon, _cross(normal, q - p), p)
    shared = {tuple(exact[i]) for i in set(map(int, first)) & set(map(int, second))}
    return len(shared) == 3 or not set(polygon) <= shared


def _degenerate(vertices: IntArray, triangle: IntArray) -> bool:
    a, b, c = vertices[triangle]
    return not np.cross(b - a, c - a).any()


@given(
    coordinates=st.lists(st.tuples(*[st.integers(-3, 3)] * 3), min_size=6, max_size=6),
    shared=st.integers(0, 3),
    large=st.booleans(),
)
@settings(max_examples=examples(400), deadline=None)
def test_triangle_pairs_intersect_as_in_rational_numbers(
    coordinates: list[tuple[int, int, int]], shared: int, large: bool
) -> None:
    vertices = np.array(coordinates, dtype=np.int64)
    if large:
        vertices = vertices * 700_001 + np.roll(vertices, 1, axis=0)
    first, second = np.arange(3), np.array([*range(shared), *range(3 + shared, 6)])
    if _degenerate(vertices, first) or _degenerate(vertices, second):
        return
    places = {tuple(map(int, vertices[i])) for i in {*first.tolist(), *second.tolist()}}
    if len(places) != 6 - shared:
        return
    expected = _rational_twin(vertices, first, second)
    assert triangles_intersect(vertices, first, second) == expected
    assert triangles_intersect(vertices, np.roll(second, 1), first[::-1].copy()) == expected


@given(
    base=st.lists(st.tuples(*[st.integers(-4_000_000, 4_000_000)] * 3), min_size=3, max_size=3),
    weights=st.tuples(st.integers(-3, 3), st.integers(-3, 3)),
    off=st.integers(-1, 1),
)
@settings(max_examples=examples(200), deadline=None)
def test_the_side_of_a_plane_is_exact_over_kilometres(
    base: list[tuple[int, int, int]], weights: tuple[int, int], off: int
) -> None:
    a, b, c = (np.array(p, dtype=object) for p in base)
    d = a + weights[0] * (b - a) + weights[1] * (c - a) + np.array([0, 0, off], dtype=object)
    exact = int(_cross(b - a, c - a) @ (d - a))
    vertices = np.array([a, b, c, d], dtype=np.int64)
    assert side_of_plane(vertices, 0, 1, 2, 3) == (exact > 0) - (exact < 0)


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5)), min_size=3, max_size=8, unique=True))
@settings(max_examples=examples(400), deadline=None)
def test_a_ring_is_simple_where_shapely_says_so(places: list[tuple[int, int]]) -> None:
    flat = np.array(places, dtype=np.int64)
    polygon = shapely.Polygon(places)
    assert ring_is_simple(flat, 0, len(flat)) == (polygon.exterior.is_simple and polygon.area > 0)


def _lattice_ring(chance: np.random.Generator, size: int) -> list[tuple[int, int]]:
    """A random simple ring on a lattice, clockwise."""
    while True:
        places = chance.integers(0, size, (int(chance.integers(3, 6)), 2)).tolist()
        polygon = shapely.Polygon(places)
        if polygon.is_valid and polygon.area > 0 and len({tuple(p) for p in places}) == len(places):
            oriented = shapely.geometry.polygon.orient(polygon, -1.0)
            return [(int(x), int(y)) for x, y in oriented.exterior.coords[:-1]]


def test_polygons_with_holes_are_sound_where_shapely_says_so() -> None:
    chance = np.random.default_rng(8)
    outer = [(x, 0) for x in range(6)] + [(6, y) for y in range(6)]
    outer += [(6 - x, 6 - y) for x, y in outer]
    reasons = {0: "Valid", 205: "disconnected"}
    seen: Counter[int] = Counter()
    for _ in range(500):
        moves = [(0, 0), (int(chance.integers(0, 5)), int(chance.integers(0, 7)))]
        sizes = [int(chance.integers(4, 8)), 3]
        holes = [
            [(x + right, y + up) for x, y in _lattice_ring(chance, size)]
            for size, (right, up) in zip(sizes, moves, strict=True)
        ]
        rings = [outer, *holes]
        if set(holes[0]) == set(holes[1]):
            continue
        corners = [place for ring in rings for place in ring]
        off_vertices = any(
            shapely.LinearRing(ring).distance(shapely.Point(place)) == 0 and place not in ring
            for ring in rings
            for place in corners
        )
        numbers = {place: i for i, place in enumerate(dict.fromkeys(corners))}
        ids = np.array([numbers[place] for place in corners], dtype=np.int64)
        offsets = np.cumsum([0, *map(len, rings)])
        code = polygon_code(np.array(corners, dtype=np.int64), ids, offsets)
        polygon = shapely.Polygon(outer, holes)
        if off_vertices:
            assert code != 0
        else:
            assert (code == 0) == polygon.is_valid
            if code in reasons:
                assert reasons[code] in shapely.is_valid_reason(polygon)
            seen[code] += 1
    assert min(seen[code] for code in (0, 201, 205, 206)) > 5


@given(
    st.lists(st.tuples(*[st.integers(-20_000, 20_000)] * 3), min_size=4, max_size=12),
    st.integers(1, 20_000),
)
@settings(max_examples=examples(150), deadline=None)
def test_the_distance_to_the_plane_is_that_of_numpys_eigenvectors(
    places: list[tuple[int, int, int]], flatness: int
) -> None:
    corners = np.array(places, dtype=np.int64) // [1, 1, flatness]
    centred = corners - corners.mean(axis=0)
    values, axes = np.linalg.eigh(centred.T @ centred)
    if values[1] - values[0] < 1e-6 * max(values[2], 1.0):
        return
    expected = np.abs(centred @ axes[:, 0]).max()
    distance_mm, slenderness, found = fitted_plane(corners)
    assert distance_mm == pytest.approx(expected, rel=1e-6, abs=1e-5)
    assert slenderness == pytest.approx(np.sqrt(max(values[1], 0.0) / values[2]), rel=1e-6, abs=1e-6)
    assert found.T @ found == pytest.approx(np.eye(3), abs=1e-9)


def test_in_the_fitted_plane_lengths_stay_and_millimetres_are_thousands() -> None:
    corners = np.array([[0, 0, 0], [30, 0, 40], [30, 120, 40], [0, 120, 0]], dtype=np.int64)
    _, slenderness, axes = fitted_plane(corners)
    flat = in_fitted_plane(corners, axes)
    assert slenderness == pytest.approx(50 / 120)
    assert flat[:, 2].tolist() == [0, 0, 0, 0]
    sides = np.hypot(*np.diff(flat[[0, 1, 2, 3, 0], :2], axis=0).T)
    assert sides == pytest.approx([50_000, 120_000, 50_000, 120_000], abs=2)


def test_normals_of_a_fold_differ_by_its_angle() -> None:
    corners = np.array([[0, 0, 0], [1000, 0, 0], [1000, 1000, 0], [0, 1000, 1000]], dtype=np.int64)
    triangles = np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int64)
    normals = [np.cross(corners[t[1]] - corners[t[0]], corners[t[2]] - corners[t[0]]) for t in triangles]
    expected = normals[0] @ normals[1] / np.linalg.norm(normals[0]) / np.linalg.norm(normals[1])
    assert min_cosine_of_normals(corners, triangles, -1.0) == pytest.approx(expected)


def test_volumes_add_up_and_turn_their_sign() -> None:
    corners = np.array([[0, 0, 0], [3, 0, 0], [0, 5, 0], [0, 0, 7]], dtype=np.int64)
    triangles = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], dtype=np.int64)
    assert six_volumes(corners, triangles) == 3 * 5 * 7
    assert six_volumes(corners + 100, triangles[:, ::-1].copy()) == -3 * 5 * 7
    found = np.zeros(406, dtype=np.bool_)
    assert is_sound_shell(triangles, 4, found)
    assert not found.any()


def test_a_block_of_five_thousand_faces_is_judged(block: Solid) -> None:
    assert len(block.faces) > 5000
    assert check_solid(block) == ()
    low = int(np.argmin(block.vertices.sum(axis=1)))
    vertices = block.vertices.copy()
    vertices[low] += [0.0, 0.0, 30.0]
    assert check_solid(dataclasses.replace(block, vertices=vertices)) != ()
