"""Faces that are parts of one plane are found again, whatever they were cut into."""

import itertools
import math

import numpy as np
import pytest
import shapely
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.model import FaceKind, FloatArray
from pipeline.ruler.evaluation.reading.coplanar import area_vector, coplanar_regions
from pipeline.ruler.evaluation.reading.raw import RawFace, connected, grouped, is_closed, kind_in_name, raw_part

Triangles = list[tuple[int, int, int]]


def regions(xyz: FloatArray, faces: list[list[tuple[int, ...]]], planes: list[int] | None = None) -> list[int]:
    points = xyz.tolist()
    return coplanar_regions(points, faces, [area_vector(points, rings) for rings in faces], planes or [-1] * len(faces))


def lattice(columns: int, rows: int, step_m: float) -> tuple[FloatArray, Triangles]:
    """A plan of squares, each cut into two triangles."""
    x, y = np.meshgrid(np.arange(columns + 1) * step_m, np.arange(rows + 1) * step_m)
    cut: Triangles = []
    for row in range(rows):
        for column in range(columns):
            a = row * (columns + 1) + column
            b, c, d = a + 1, a + columns + 2, a + columns + 1
            cut += [(a, b, c), (a, c, d)] if (row + column) % 2 else [(a, b, d), (b, c, d)]
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]), cut


SLOPE = st.floats(-2.0, 2.0)


@settings(max_examples=examples(60), deadline=None)
@given(a=SLOPE, b=SLOPE, step=st.floats(0.05, 5.0), seed=st.integers(0, 999))
def test_triangles_of_a_plane_are_one_region_after_rounding_to_millimetres(
    a: float, b: float, step: float, seed: int
) -> None:
    xyz, triangles = lattice(4, 3, step)
    random = np.random.default_rng(seed)
    xyz[:, :2] += random.uniform(-0.4, 0.4, (len(xyz), 2)) * step
    xyz[:, 2] = 7.0 + a * xyz[:, 0] + b * xyz[:, 1]
    assert set(regions(np.round(xyz, 3), [[triangle] for triangle in triangles])) == {0}


@settings(max_examples=examples(60), deadline=None)
@given(
    slope=st.floats(0.0, 1.2),
    bend_deg=st.floats(1.0, 60.0),
    azimuth=st.floats(0.0, 2 * math.pi),
    step=st.floats(1.0, 4.0),
)
def test_two_sides_of_a_ridge_are_two_regions(slope: float, bend_deg: float, azimuth: float, step: float) -> None:
    xyz, triangles = lattice(4, 2, step)
    middle = 2 * step
    falling = math.tan(math.atan(slope) - math.radians(bend_deg))
    xyz[:, 2] = np.where(xyz[:, 0] < middle, slope, falling) * (xyz[:, 0] - middle)
    turn = np.array([[math.cos(azimuth), -math.sin(azimuth)], [math.sin(azimuth), math.cos(azimuth)]])
    east = [np.mean([xyz[i, 0] for i in triangle]) > middle for triangle in triangles]
    xyz[:, :2] = xyz[:, :2] @ turn.T
    found = regions(np.round(xyz, 3), [[triangle] for triangle in triangles])
    assert set(found) == {0, 1}
    assert len({(side, label) for side, label in zip(east, found, strict=True)}) == 2


def _misfits(xyz: FloatArray, triangles: Triangles) -> dict[tuple[int, int], float]:
    """How far the vertices of neighbours are from the plane that numpy fits to both."""
    found = {}
    for f, g in itertools.combinations(range(len(triangles)), 2):
        if len(set(triangles[f]) & set(triangles[g])) == 2:
            points = xyz[sorted({*triangles[f], *triangles[g]})]
            design = np.column_stack([points[:, :2], np.ones(len(points))])
            solution = np.linalg.lstsq(design, points[:, 2], rcond=None)[0]
            found[f, g] = float(np.abs(design @ solution - points[:, 2]).max())
    return found


@pytest.mark.parametrize("seed", range(8))
def test_a_roof_of_many_planes_falls_into_the_regions_of_a_slow_search(seed: int) -> None:
    random = np.random.default_rng(seed)
    misfits = {(0, 0): 0.01}
    while any(1e-6 < misfit < 0.03 for misfit in misfits.values()):
        xyz, triangles = lattice(6, 6, 2.0)
        planes = random.uniform(-0.8, 0.8, (4, 2))
        xyz[:, 2] = np.max([a * (xyz[:, 0] - 6) + b * (xyz[:, 1] - 6) for a, b in planes], axis=0)
        misfits = _misfits(xyz, triangles)
    found = regions(xyz, [[triangle] for triangle in triangles])
    grown = [[face for face, label in enumerate(found) if label == one] for one in sorted(set(found))]
    assert sorted(grown) == grouped(len(triangles), [pair for pair, misfit in misfits.items() if misfit <= 1e-6])


def test_faces_of_one_height_that_do_not_touch_stay_apart() -> None:
    xyz, triangles = lattice(3, 1, 1.0)
    assert regions(xyz, [[triangles[0]], [triangles[1]], [triangles[4]], [triangles[5]]]) == [0, 0, 1, 1]


def test_faces_that_a_file_numbers_differently_stay_apart() -> None:
    xyz, triangles = lattice(2, 1, 1.0)
    assert regions(xyz, [[triangle] for triangle in triangles], planes=[3, 3, 4, 4]) == [0, 0, 1, 1]


def test_a_step_of_two_centimetres_between_parallel_faces_stays() -> None:
    xyz = np.array(
        [[0, 0, 3], [5, 0, 3], [5, 5, 3], [0, 5, 3], [10, 0, 3.02], [10, 5, 3.02], [5, 0, 3.02], [5, 5, 3.02]]
    )
    assert regions(xyz.astype(np.float64), [[(0, 1, 2, 3)], [(6, 4, 5, 7)]]) == [0, 1]


def test_vertical_faces_and_faces_without_area_join_nothing() -> None:
    xyz = np.array([[0, 0, 0], [5, 0, 0], [5, 0, 3], [0, 0, 3], [2, 0, 0]], np.float64)
    found = regions(xyz, [[(0, 1, 2)], [(0, 2, 3)], [(0, 4, 1)]])
    assert len(set(found)) == 3


@settings(max_examples=examples(40), deadline=None)
@given(
    corners=st.lists(st.tuples(st.integers(-50, 50), st.integers(-50, 50)), min_size=3, max_size=8, unique=True),
    a=SLOPE,
    b=SLOPE,
)
def test_area_vectors_are_those_of_the_polygon_in_plan(corners: list[tuple[int, int]], a: float, b: float) -> None:
    plan = np.array(corners, np.float64)
    order = np.argsort(np.arctan2(*(plan - plan.mean(axis=0)).T[::-1]), kind="stable")
    plan = plan[order]
    hole = plan.mean(axis=0) + (plan[::-1] - plan.mean(axis=0)) * 0.25
    xy = np.vstack([plan, hole])
    xyz = np.column_stack([xy, a * xy[:, 0] + b * xy[:, 1] + 4.0])
    n = len(plan)
    vector = area_vector(xyz.tolist(), [range(n), range(n, 2 * n)])
    area = shapely.Polygon(plan).area * (1.0 - 0.25**2) * np.sign(shapely.LinearRing(plan).is_ccw - 0.5)
    if shapely.Polygon(plan).is_valid:
        assert np.allclose(vector, np.array([-a, -b, 1.0]) * area, rtol=1e-9, atol=1e-6)


CUBE = [(3, 2, 1, 0), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
CORNERS = np.array([[x, y, z] for z in (0, 2) for x, y in ((0, 0), (2, 0), (2, 2), (0, 2))], np.float64)


def test_a_shell_is_closed_until_a_face_is_missing_or_turned() -> None:
    assert is_closed(CORNERS, [(face,) for face in CUBE])
    assert not is_closed(CORNERS, [(face,) for face in CUBE[1:]])
    assert not is_closed(CORNERS, [(CUBE[0][::-1],), *((face,) for face in CUBE[1:])])
    assert not is_closed(CORNERS, [])
    apart = np.vstack([CORNERS + 0.0002, CORNERS])
    assert is_closed(apart, [(tuple(i + 8 * (k % 2) for i in face),) for k, face in enumerate(CUBE)])


@pytest.mark.parametrize("shift", [(2.0, 0.0), (2.0, 2.0), (5.0, 0.0)])
def test_bodies_that_touch_along_a_wall_or_an_edge_or_not_are_pieces(shift: tuple[float, float]) -> None:
    both = np.vstack([CORNERS, CORNERS + np.array([*shift, 0.0])])
    faces = [RawFace((tuple(i + first for i in face),), None) for first in (0, 8) for face in CUBE]
    pieces = connected(raw_part(both, faces, is_solid=True))
    assert [len(piece.faces) for piece in pieces] == [6, 6]
    assert all(is_closed(piece.xyz, [face.rings for face in piece.faces]) for piece in pieces)


def test_faces_with_vertices_of_their_own_are_pieces_by_place() -> None:
    soup = np.vstack([CORNERS[list(face)] for face in CUBE])
    faces = [RawFace((tuple(range(4 * k, 4 * k + 4)),), None) for k in range(6)]
    (piece,) = connected(raw_part(soup, faces, is_solid=True))
    assert is_closed(piece.xyz, [face.rings for face in piece.faces])
    both = raw_part(
        np.vstack([soup, soup + 9.0]),
        [*faces, *(RawFace((tuple(i + 24 for i in f.rings[0]),), None) for f in faces)],
        is_solid=True,
    )
    assert [len(piece.faces) for piece in connected(both)] == [6, 6]


def test_names_tell_a_kind_only_where_they_are_clear() -> None:
    kinds = {"RoofSurface": FaceKind.ROOF, "my_wall.3": FaceKind.WALL, "GROUND": FaceKind.GROUND}
    assert {name: kind_in_name(name) for name in kinds} == kinds
    assert [kind_in_name(name) for name in ("house", "", "roof_and_wall")] == [None, None, None]
