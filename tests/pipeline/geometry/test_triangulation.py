"""Faces are cut into triangles of their own vertices, exactly, and the same from whatever corner a ring starts."""

import itertools
import random

import numpy as np
import pytest
import shapely
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.model import FloatArray, IntArray
from pipeline.triangulation.one_face import triangulate_face

Ring = tuple[int, ...]


def _polygon_to_face(polygon: shapely.Polygon) -> tuple[FloatArray, list[Ring]]:
    """Vertices at z = 0 in metres and rings, outer counter-clockwise, holes clockwise."""
    oriented = shapely.geometry.polygon.orient(polygon, 1.0)
    vertices: list[tuple[float, float, float]] = []
    rings: list[Ring] = []
    numbers: dict[tuple[float, float, float], int] = {}
    for ring in (oriented.exterior, *oriented.interiors):
        places = [(x, y, 0.0) for x, y in ring.coords[:-1]]
        for place in places:
            if place not in numbers:
                numbers[place] = len(vertices)
                vertices.append(place)
        rings.append(tuple(numbers[place] for place in places))
    return np.array(vertices), rings


def _areas(vertices: FloatArray, triangles: IntArray) -> FloatArray:
    """Signed plan areas, in half square millimetres, exact."""
    corners = np.rint(vertices[triangles][:, :, :2] * 1000).astype(np.int64)
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]


def _assert_exact_partition(polygon: shapely.Polygon) -> None:
    vertices, rings = _polygon_to_face(polygon)
    triangles = triangulate_face(vertices, rings)
    corners = sum(map(len, rings))
    touches = corners - len(vertices)
    assert len(triangles) == corners + 2 * (len(rings) - 1 - touches) - 2
    areas = _areas(vertices, triangles)
    assert (areas > 0).all()
    assert areas.sum() == round(polygon.area * 2e6)
    directed = {(int(t[k]), int(t[(k + 1) % 3])) for t in triangles for k in range(3)}
    assert len(directed) == 3 * len(triangles)
    borders = {(a, b) for ring in rings for a, b in zip(ring, (*ring[1:], ring[0]), strict=True)}
    assert {edge for edge in directed if edge[::-1] not in directed} == borders


def _random_polygon(seed: int) -> shapely.Polygon:
    """A random polygon on a coarse lattice, with holes that may touch it at corners, and points on its edges."""
    rng = np.random.default_rng(seed)
    cells = rng.random((7, 7)) < 0.7
    boxes = [shapely.box(i, j, i + 1, j + 1) for i, j in np.argwhere(cells)]
    slanted = [shapely.Polygon(rng.integers(0, 8, (3, 2))).buffer(0) for _ in range(rng.integers(0, 3))]
    union = shapely.union_all(boxes + slanted, grid_size=0.001)
    parts = [part for part in shapely.get_parts(union) if part.geom_type == "Polygon" and part.area > 0.5]
    largest = max(parts, key=lambda part: part.area)
    return largest if rng.random() < 0.5 else shapely.segmentize(largest, 1.0)


def _touches_off_a_corner(polygon: shapely.Polygon) -> bool:
    """Whether a corner of one ring lies within an edge of another: such faces are refused elsewhere."""
    rings = [polygon.exterior, *polygon.interiors]
    return any(
        shapely.Point(place).distance(other) < 0.002 and place not in set(other.coords)
        for ring, other in itertools.permutations(rings, 2)
        for place in ring.coords
    )


@pytest.mark.parametrize("seed", range(90))
def test_random_polygons_are_cut_without_gap_overlap_or_sliver(seed: int) -> None:
    polygon = _random_polygon(seed)
    polygon = shapely.set_precision(polygon, 0.001)
    if polygon.geom_type != "Polygon" or _touches_off_a_corner(polygon):
        pytest.skip("no face of a solid")
    _assert_exact_partition(polygon)


def test_a_sieve_is_cut_through_all_its_holes() -> None:
    holes = [shapely.box(x, y, x + 1, y + 1) for x in range(1, 20, 2) for y in range(1, 20, 2)]
    _assert_exact_partition(shapely.Polygon(shapely.box(0, 0, 21, 21).exterior, [hole.exterior for hole in holes]))


def test_a_hole_may_touch_the_outer_ring_and_another_hole_at_a_corner() -> None:
    outer = [(0, 0), (10, 0), (10, 10), (0, 10)]
    first, second = [(0, 0), (2, 3), (3, 2)], [(3, 2), (5, 6), (6, 5)]
    polygon = shapely.Polygon(outer, [first, second])
    assert polygon.is_valid
    _assert_exact_partition(polygon)


def test_triangles_are_delaunay_as_qhull_has_them() -> None:
    from scipy.spatial import Delaunay

    rng = np.random.default_rng(4)
    angles = np.sort(rng.random(30)) * 2 * np.pi
    circle = np.column_stack([40 * np.cos(angles), 25 * np.sin(angles), np.zeros(30)]).round(3)
    ours = {frozenset(map(int, t)) for t in triangulate_face(circle, [tuple(range(30))])}
    assert ours == {frozenset(map(int, t)) for t in Delaunay(circle[:, :2]).simplices}


@given(seed=st.integers(0, 10_000), start=st.integers(0, 100), permutation=st.randoms(use_true_random=False))
@settings(max_examples=examples(40), deadline=None)
def test_the_triangles_do_not_depend_on_numbering_or_on_where_a_ring_starts(
    seed: int, start: int, permutation: random.Random
) -> None:
    polygon = shapely.set_precision(_random_polygon(seed), 0.001)
    if polygon.geom_type != "Polygon" or _touches_off_a_corner(polygon):
        return
    vertices, rings = _polygon_to_face(polygon)
    plain = {frozenset(map(int, t)) for t in triangulate_face(vertices, rings)}
    order = list(range(len(vertices)))
    permutation.shuffle(order)
    relabelled = np.empty_like(vertices)
    relabelled[order] = vertices
    turned = [tuple(order[i] for i in ring[start % len(ring) :] + ring[: start % len(ring)]) for ring in rings]
    turned[1:] = turned[:0:-1]
    again = {frozenset(order.index(int(i)) for i in t) for t in triangulate_face(relabelled, turned)}
    assert again == plain


def test_the_orientation_is_that_of_the_outer_ring_in_every_direction() -> None:
    square = np.array([[0, 0, 0], [4, 0, 0], [4, 3, 0], [0, 3, 0]], dtype=float)
    for axes in itertools.permutations(range(3)):
        for ring in ((0, 1, 2, 3), (3, 2, 1, 0)):
            vertices = square[:, axes]
            triangles = triangulate_face(vertices, [ring])
            normals = np.cross(
                vertices[triangles[:, 1]] - vertices[triangles[:, 0]],
                vertices[triangles[:, 2]] - vertices[triangles[:, 0]],
            )
            outer = np.cross(vertices[ring[1]] - vertices[ring[0]], vertices[ring[2]] - vertices[ring[0]])
            assert (normals @ outer > 0).all()


def test_vertices_on_a_straight_edge_get_no_flat_triangle_even_when_rounded() -> None:
    eave = np.linspace([0.0, 0.0, 3.0], [7.0, 2.0, 3.0], 12).round(3)
    ridge = np.array([[6.0, 6.0, 6.0], [-1.0, 4.0, 6.0]])
    vertices = np.vstack([eave, ridge])
    triangles = triangulate_face(vertices, [tuple(range(14))])
    sides = vertices[triangles]
    heights = np.linalg.norm(np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]), axis=1)
    longest = np.linalg.norm(sides - np.roll(sides, 1, axis=1), axis=2).max(axis=1)
    assert (heights / longest > 0.3).all()


@pytest.mark.parametrize(
    ("rings", "words"),
    [
        ([], "none is given"),
        ([(0, 1)], "a ring of 2 vertices"),
        ([(0, 1, 1)], "encloses no area"),
        ([(0, 1, 2, 3), (4, 5)], "a ring of 2 vertices"),
        ([(0, 2, 1, 3)], "encloses no area"),
        ([(0, 1, 4, 2)], "cross or touch"),
        ([(0, 1, 2, 3), (4, 5, 6, 7)], "same way round"),
        ([(0, 1, 2, 3), (8, 10, 9)], "lies outside"),
    ],
)
def test_unusable_rings_are_refused_with_the_reason(rings: list[Ring], words: str) -> None:
    square = [[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]]
    inner = [[1, 1, 0], [3, 1, 0], [3, 3, 0], [1, 3, 0]]
    outside = [[6, 6, 0], [7, 6, 0], [6, 7, 0]]
    with pytest.raises(ValueError, match=words):
        triangulate_face(np.array(square + inner + outside, dtype=float), rings)
