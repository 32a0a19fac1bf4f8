"""The upper envelope against a brute-force maximum, and the drawing that it makes."""

import math

import numpy as np
import pytest
import shapely

from pipeline.model import FloatArray
from pipeline.ruler.simulation.envelope import RoofPart, envelope
from pipeline.ruler.simulation.roof_dimensions import FaceRings, RoofFaces

Place = tuple[float, float]


def flat_part(u0: float, u1: float, v0: float, v1: float, height: float, label: str) -> RoofPart:
    outline = ((u0, v0), (u1, v0), (u1, v1), (u0, v1))
    return RoofPart(outline=outline, planes=((0.0, 0.0, height),), labels=(label,))


def random_parts(random: np.random.Generator) -> list[RoofPart]:
    """Two to six convex polygons anywhere in a field of 20 m, each under one to five planes."""
    parts = []
    for number in range(int(random.integers(2, 7))):
        corners = shapely.MultiPoint(random.uniform(-4, 4, (8, 2)) + random.uniform(-6, 6, 2)).convex_hull
        outline = shapely.get_coordinates(shapely.orient_polygons(corners))[:-1]
        planes = np.column_stack([random.uniform(-1, 1, (5, 2)), random.uniform(3, 8, 5)])[: random.integers(1, 6)]
        parts.append(
            RoofPart(
                outline=tuple((float(u), float(v)) for u, v in outline),
                planes=tuple((float(a), float(b), float(c)) for a, b, c in planes),
                labels=tuple(f"{number} {k}" for k in range(len(planes))),
            )
        )
    return parts


def polygon(roof: RoofFaces, rings: FaceRings) -> shapely.Polygon:
    plan = roof.vertices[:, :2]
    return shapely.Polygon(plan[list(rings[0])], [plan[list(hole)] for hole in rings[1:]])


def fitted_plane(corners: FloatArray) -> FloatArray:
    """Least squares through the corners of a face."""
    middle = corners.mean(axis=0)
    design = np.column_stack([corners[:, :2] - middle[:2], np.ones(len(corners))])
    a, b, c = np.linalg.lstsq(design, corners[:, 2], rcond=None)[0]
    return np.array([a, b, c - a * middle[0] - b * middle[1]])


def brute_force(parts: list[RoofPart], u: float, v: float) -> float:
    """The slow twin: the lowest plane of each part whose outline holds the place, the highest of them."""
    best = -math.inf
    for part in parts:
        if shapely.Polygon(part.outline).contains(shapely.Point(u, v)):
            best = max(best, min(a * u + b * v + c for a, b, c in part.planes))
    return best


def vertices_on_foreign_edges(roof: RoofFaces) -> int:
    """How many vertices lie in the middle of an edge of a ring that does not have them."""
    count = 0
    for rings in roof.faces:
        for ring in rings:
            corners = roof.vertices[list(ring), :2]
            for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
                away, length = roof.vertices[:, :2] - start, float(np.hypot(*(end - start)))
                u, v = (end - start) / length
                along, off = away @ [u, v], np.abs(away @ [-v, u])
                count += int(((along > 1e-7) & (along < length - 1e-7) & (off < 1e-7)).sum())
    return count


@pytest.mark.parametrize("seed", range(25))
def test_the_faces_are_the_brute_force_maximum_at_random_places(seed: int) -> None:
    random = np.random.default_rng([seed, 1])
    parts = random_parts(random)
    roof = envelope(parts)
    polygons = [polygon(roof, rings) for rings in roof.faces]
    planes = [fitted_plane(roof.vertices[list(rings[0])]) for rings in roof.faces]
    places = random.uniform(-11, 11, (600, 2))
    borders = shapely.union_all([one.boundary for one in polygons])
    seen = 0
    for u, v in places:
        if shapely.dwithin(borders, shapely.Point(u, v), 1e-3):
            continue
        expected = brute_force(parts, u, v)
        inside = [k for k, one in enumerate(polygons) if one.contains(shapely.Point(u, v))]
        assert len(inside) == (expected > -math.inf)
        if inside:
            assert planes[inside[0]] @ [u, v, 1.0] == pytest.approx(expected, abs=1e-6)
            seen += 1
    assert seen > 20


@pytest.mark.parametrize("seed", range(25))
def test_faces_cover_all_outlines_once_and_meet_vertex_to_vertex(seed: int) -> None:
    parts = random_parts(np.random.default_rng([seed, 2]))
    roof = envelope(parts)
    polygons = [polygon(roof, rings) for rings in roof.faces]
    covered = shapely.union_all([shapely.Polygon(part.outline) for part in parts])
    assert all(one.is_valid and one.exterior.is_ccw for one in polygons)
    assert not any(hole.is_ccw for one in polygons for hole in one.interiors)
    assert sum(one.area for one in polygons) == pytest.approx(covered.area, rel=1e-9)
    assert shapely.symmetric_difference(shapely.union_all(polygons), covered).area < 1e-6
    assert vertices_on_foreign_edges(roof) == 0


@pytest.mark.parametrize("seed", range(10))
def test_vertices_are_exact_not_on_the_grid(seed: int) -> None:
    """All corners of a face lie in its plane and on lines of the input, to far less than the grid's 1e-6 m."""
    parts = random_parts(np.random.default_rng([seed, 3]))
    roof = envelope(parts)
    given = np.array([plane for part in parts for plane in part.planes])
    for rings in roof.faces:
        corners = roof.vertices[[vertex for ring in rings for vertex in ring]]
        heights = given[:, :2] @ corners[:, :2].T + given[:, 2:]
        assert np.abs(heights - corners[:, 2]).max(axis=1).min() < 1e-9


def test_no_two_vertices_share_a_place_where_the_roof_is_continuous() -> None:
    slope = 0.5
    gable = RoofPart(
        outline=((-5.0, -3.0), (5.0, -3.0), (5.0, 3.0), (-5.0, 3.0)),
        planes=((0.0, slope, 3 * slope), (0.0, -slope, 3 * slope)),
        labels=("right", "left"),
    )
    across = RoofPart(
        outline=((-1.0, 0.0), (1.0, 0.0), (1.0, 6.0), (-1.0, 6.0)),
        planes=((slope, 0.0, slope), (-slope, 0.0, slope)),
        labels=("rear", "front"),
    )
    roof = envelope([gable, across])
    assert len(np.unique(roof.vertices[:, :2].round(6), axis=0)) == len(roof.vertices) == 12
    assert len(roof.faces) == 4


def test_a_box_in_the_middle_cuts_a_hole_and_stands_on_its_own_vertices() -> None:
    roof = envelope([flat_part(0, 10, 0, 8, 0.0, "roof"), flat_part(3, 5, 2, 4, 2.0, "box")])
    assert [len(rings) for rings in roof.faces] == [2, 1]
    assert [len(ring) for ring in roof.faces[0]] == [4, 4]
    assert sorted(set(roof.vertices[list(roof.faces[0][1]), 2])) == [0.0]
    assert sorted(set(roof.vertices[list(roof.faces[1][0]), 2])) == [2.0]
    assert polygon(roof, roof.faces[0]).area == pytest.approx(80.0 - 4.0)


def test_of_equal_heights_the_first_part_counts() -> None:
    first, second = flat_part(0, 6, 0, 4, 1.0, "first"), flat_part(4, 10, 0, 4, 1.0, "second")
    for parts in ([first, second], [second, first]):
        roof = envelope(parts)
        assert [polygon(roof, rings).area for rings in roof.faces] == pytest.approx([24.0, 16.0])


def test_pieces_of_one_plane_and_label_are_one_face_where_they_touch_and_one_group_where_not() -> None:
    arms = [flat_part(0, 6, 0, 2, 1.0, "same"), flat_part(4, 6, 0, 7, 1.0, "same")]
    assert len(envelope(arms).faces) == 1
    parted = envelope([flat_part(0, 9, 0, 2, 1.0, "low"), flat_part(4, 5, 0, 2, 3.0, "high")])
    assert parted.groups == (0, 0, 1)
    assert [polygon(parted, rings).area for rings in parted.faces] == pytest.approx([8.0, 8.0, 2.0])


def test_parts_that_only_touch_share_their_border() -> None:
    roof = envelope([flat_part(0, 4, 0, 4, 0.0, "low"), flat_part(4, 9, 1, 3, 2.0, "high")])
    assert sorted(len(rings[0]) for rings in roof.faces) == [4, 6]
    assert len(roof.vertices) == 10


def test_the_same_parts_give_the_same_bits_and_a_hidden_part_changes_nothing() -> None:
    parts = random_parts(np.random.default_rng(8))
    house, cellar = flat_part(0, 10, 0, 8, 3.0, "house"), flat_part(2, 4, 2, 4, 1.0, "cellar")
    for first, second in ((parts, parts), ([house], [house, cellar])):
        assert np.array_equal(envelope(first).vertices, envelope(second).vertices)
        assert envelope(first).faces == envelope(second).faces


def test_no_parts_are_refused() -> None:
    with pytest.raises(ValueError, match="at least one part"):
        envelope([])
