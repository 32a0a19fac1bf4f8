"""Solids over partitions: closed, oriented, valid, and as large as the truth."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import shapely
from faces_by_hand import assert_closed, level, partition_of, plane
from shapely import Polygon

from pipeline.errors import BuildingError
from pipeline.model import FaceKind, Solid
from pipeline.quality.validity import check_solid
from pipeline.roof.solid import solid_parts

ExactRoofs = Callable[..., Any]
Volume = Callable[[Solid], float]

KINDS = ["flat", "pent", "gable", "hip", "l", "stepped", "courtyard", "dormer", "tower"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("turn_deg", [0.0, 31.0])
@pytest.mark.parametrize("with_footprint", [True, False])
def test_a_roof_gives_one_valid_closed_solid_of_the_true_volume_or_near_it_without_a_footprint(
    exact_roof: ExactRoofs, volume: Volume, kind: str, turn_deg: float, with_footprint: bool
) -> None:
    roof = exact_roof(kind, turn_deg=turn_deg, with_footprint=with_footprint)
    (part,) = roof.parts()
    assert check_solid(part.solid) == ()
    assert_closed(ring for face in part.solid.faces for ring in face.rings)
    # where the walls of a tower stand is known to half a point spacing
    with_walls = 0.02 if kind == "tower" else 0.01
    assert volume(part.solid) == pytest.approx(roof.volume_m3, rel=with_walls if with_footprint else 0.05)
    off_m2 = shapely.symmetric_difference(part.footprint, roof.footprint).area
    if with_footprint:
        assert off_m2 < 0.001 * roof.footprint.length
    else:
        assert off_m2 < 0.08 * shapely.union(part.footprint, roof.footprint).area


def test_the_ridge_of_a_gable_runs_exactly_where_its_planes_cross(exact_roof: ExactRoofs) -> None:
    roof = exact_roof("gable", with_footprint=True)
    (part,) = roof.parts()
    ridge = [v for v in part.solid.vertices.tolist() if v[2] > 5.75]
    assert len(part.faces) == 2
    assert all(abs(y - 4.0) < 0.003 and abs(z - 5.8) < 0.003 for _, y, z in ridge)


def test_vertices_lie_on_the_millimetre_grid_and_on_their_planes(exact_roof: ExactRoofs) -> None:
    roof = exact_roof("hip", turn_deg=17.0)
    (part,) = roof.parts()
    vertices = part.solid.vertices
    assert np.array_equal(np.rint(vertices * 1e3) / 1e3, vertices)
    for face in part.solid.faces:
        if face.kind is FaceKind.ROOF:
            own, p = roof.planes[face.plane], vertices[list(face.rings[0])]
            assert np.abs(own.a * p[:, 0] + own.b * p[:, 1] + own.c - p[:, 2]).max() < 0.0025


def test_a_courtyard_is_a_hole_of_roof_and_floor_with_walls_around_it(exact_roof: ExactRoofs) -> None:
    (part,) = exact_roof("courtyard", with_footprint=True).parts()
    assert len(part.footprint.interiors) == 1
    ground = [face for face in part.solid.faces if face.kind is FaceKind.GROUND]
    assert len(ground) == 1
    assert len(ground[0].rings) == 2


def test_parts_that_do_not_touch_are_solids_of_their_own(volume: Volume) -> None:
    parts = solid_parts(partition_of([shapely.box(0, 0, 4, 4), shapely.box(6, 0, 9, 4)]), [level(3.0), level(5.0)], 1.0)
    assert [volume(part.solid) for part in parts] == pytest.approx([32.0, 48.0])


def test_a_third_level_on_the_way_is_inserted_into_the_wall(volume: Volume) -> None:
    whole = shapely.box(0, 0, 4, 4)
    left, low, high = shapely.box(0, 0, 2, 4), shapely.box(2, 0, 4, 2), shapely.box(2, 2, 4, 4)
    left = shapely.Polygon([(0, 0), (2, 0), (2, 2), (2, 4), (0, 4)])
    assert whole.area == left.area + low.area + high.area
    (part,) = solid_parts(partition_of([left, low, high]), [level(9.0), level(3.0), level(6.0)], 0.0)
    assert check_solid(part.solid) == ()
    assert volume(part.solid) == pytest.approx(8 * 9 + 4 * 3 + 4 * 6)
    middle = [k for k, v in enumerate(part.solid.vertices.tolist()) if v[:2] == [2.0, 2.0]]
    assert sorted(part.solid.vertices[middle, 2].tolist()) == [3.0, 6.0, 9.0]


def test_planes_that_cross_over_a_border_get_a_vertex_at_the_crossing(volume: Volume) -> None:
    left, right = shapely.box(0, 0, 3, 4), shapely.box(3, 0, 6, 4)
    (part,) = solid_parts(partition_of([left, right]), [plane(0.0, 0.5, 4.0), level(5.0)], 0.0)
    assert check_solid(part.solid) == ()
    assert volume(part.solid) == pytest.approx(12 * 5 + 12 * 5)
    assert [3.0, 2.0, 5.0] in part.solid.vertices.tolist()


def test_heights_within_two_millimetres_are_one() -> None:
    left, right = shapely.box(0, 0, 3, 4), shapely.box(3, 0, 6, 4)
    (part,) = solid_parts(partition_of([left, right]), [level(5.0), level(5.001)], 0.0)
    assert check_solid(part.solid) == ()
    assert len(part.solid.vertices) == 12
    assert sum(face.kind is FaceKind.WALL for face in part.solid.faces) == 6


# two courtyards that meet in one corner
TOUCHING_LEFT = Polygon([(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (3, 3), (3, 5), (3, 6), (0, 6)])
ROUND = shapely.Point(0, 0).buffer(2000.0, quad_segs=5000)
"""So many vertices that a write beyond their arrays is not hidden by spare room."""
TOUCHING_RIGHT = Polygon([(3, 0), (6, 0), (6, 6), (3, 6), (3, 5), (5, 5), (5, 3), (3, 3), (3, 1)])


@pytest.mark.parametrize(
    ("polygons", "floor_m", "problem"),
    [
        ([shapely.box(0, 0, 4, 4)], 4.0, r"dips 1\.000 m under the floor"),
        ([shapely.box(0, 0, 4, 4), shapely.box(0, 0, 4, 2)], 0.0, "overlap"),
        ([TOUCHING_LEFT, TOUCHING_RIGHT], 0.0, "touches itself"),
        ([ROUND, ROUND], 0.0, "overlap"),
    ],
)
def test_faces_that_make_no_solid_are_refused(polygons: list[Polygon], floor_m: float, problem: str) -> None:
    with pytest.raises(BuildingError, match=problem):
        solid_parts(partition_of(polygons), [level(3.0), level(4.0)], floor_m)
