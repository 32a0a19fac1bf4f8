"""Solids over partitions: closed, oriented, valid, and as large as the truth."""

from __future__ import annotations

import collections
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import shapely
from shapely import Polygon

from pipeline.errors import BuildingError
from pipeline.model import FaceKind, Plane, Solid
from pipeline.quality.validity import check_solid
from pipeline.roof.partition import RoofPartition
from pipeline.roof.solid import solid_parts

ExactRoofs = Callable[..., Any]
Volume = Callable[[Solid], float]

KINDS = ["flat", "pent", "gable", "hip", "l", "stepped", "courtyard", "dormer", "tower"]


def level(z: float) -> Plane:
    return Plane(a=0.0, b=0.0, c=z, n_points=1, rmse_m=0.0)


def partition(*polygons: Polygon, labels: Any = None) -> RoofPartition:
    scaled = tuple(shapely.transform(p, lambda xy: np.rint(xy * 1e3)) for p in polygons)
    return RoofPartition(
        polygons=scaled, labels=np.array(labels if labels is not None else range(len(polygons)), np.int32)
    )


def oriented_edges(solid: Solid) -> collections.Counter[tuple[int, int]]:
    return collections.Counter(
        edge for face in solid.faces for ring in face.rings for edge in zip(ring, ring[1:] + ring[:1], strict=True)
    )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("turn_deg", [0.0, 31.0])
def test_with_a_footprint_a_roof_gives_one_valid_solid_of_the_true_volume(
    exact_roof: ExactRoofs, volume: Volume, kind: str, turn_deg: float
) -> None:
    roof = exact_roof(kind, turn_deg=turn_deg, with_footprint=True)
    parts = roof.parts()
    assert len(parts) == 1
    assert check_solid(parts[0].solid) == ()
    # where the walls of a tower stand is known to half a point spacing
    assert volume(parts[0].solid) == pytest.approx(roof.volume_m3, rel=0.02 if kind == "tower" else 0.01)
    assert shapely.symmetric_difference(parts[0].footprint, roof.footprint).area < 0.001 * roof.footprint.length


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("turn_deg", [0.0, 31.0])
def test_without_a_footprint_the_volume_is_near_the_truth(
    exact_roof: ExactRoofs, volume: Volume, kind: str, turn_deg: float
) -> None:
    roof = exact_roof(kind, turn_deg=turn_deg)
    parts = roof.parts()
    assert len(parts) == 1
    assert check_solid(parts[0].solid) == ()
    assert volume(parts[0].solid) == pytest.approx(roof.volume_m3, rel=0.05)
    overlap = shapely.intersection(parts[0].footprint, roof.footprint).area
    assert overlap / shapely.union(parts[0].footprint, roof.footprint).area > 0.92


@pytest.mark.parametrize("kind", ["gable", "dormer", "courtyard"])
def test_every_edge_of_a_solid_belongs_to_two_faces_that_run_it_both_ways(exact_roof: ExactRoofs, kind: str) -> None:
    for part in exact_roof(kind).parts():
        edges = oriented_edges(part.solid)
        assert set(edges.values()) == {1}
        assert all((b, a) in edges for a, b in edges)


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
            plane, p = roof.planes[face.plane], vertices[list(face.rings[0])]
            assert np.abs(plane.a * p[:, 0] + plane.b * p[:, 1] + plane.c - p[:, 2]).max() < 0.0025


def test_a_courtyard_is_a_hole_of_roof_and_floor_with_walls_around_it(exact_roof: ExactRoofs) -> None:
    (part,) = exact_roof("courtyard", with_footprint=True).parts()
    assert len(part.footprint.interiors) == 1
    ground = [face for face in part.solid.faces if face.kind is FaceKind.GROUND]
    assert len(ground) == 1
    assert len(ground[0].rings) == 2


def test_parts_that_do_not_touch_are_solids_of_their_own(volume: Volume) -> None:
    parts = solid_parts(partition(shapely.box(0, 0, 4, 4), shapely.box(6, 0, 9, 4)), [level(3.0), level(5.0)], 1.0)
    assert [volume(part.solid) for part in parts] == pytest.approx([32.0, 48.0])


def test_a_third_level_on_the_way_is_inserted_into_the_wall(volume: Volume) -> None:
    whole = shapely.box(0, 0, 4, 4)
    left, low, high = shapely.box(0, 0, 2, 4), shapely.box(2, 0, 4, 2), shapely.box(2, 2, 4, 4)
    left = shapely.Polygon([(0, 0), (2, 0), (2, 2), (2, 4), (0, 4)])
    assert whole.area == left.area + low.area + high.area
    (part,) = solid_parts(partition(left, low, high), [level(9.0), level(3.0), level(6.0)], 0.0)
    assert check_solid(part.solid) == ()
    assert volume(part.solid) == pytest.approx(8 * 9 + 4 * 3 + 4 * 6)
    middle = [k for k, v in enumerate(part.solid.vertices.tolist()) if v[:2] == [2.0, 2.0]]
    assert sorted(part.solid.vertices[middle, 2].tolist()) == [3.0, 6.0, 9.0]


def test_planes_that_cross_over_a_border_get_a_vertex_at_the_crossing(volume: Volume) -> None:
    left, right = shapely.box(0, 0, 3, 4), shapely.box(3, 0, 6, 4)
    slope = Plane(a=0.0, b=0.5, c=4.0, n_points=1, rmse_m=0.0)
    (part,) = solid_parts(partition(left, right), [slope, level(5.0)], 0.0)
    assert check_solid(part.solid) == ()
    assert volume(part.solid) == pytest.approx(12 * 5 + 12 * 5)
    assert [3.0, 2.0, 5.0] in part.solid.vertices.tolist()


def test_heights_within_two_millimetres_are_one() -> None:
    left, right = shapely.box(0, 0, 3, 4), shapely.box(3, 0, 6, 4)
    (part,) = solid_parts(partition(left, right), [level(5.0), level(5.001)], 0.0)
    assert check_solid(part.solid) == ()
    assert len(part.solid.vertices) == 12
    assert sum(face.kind is FaceKind.WALL for face in part.solid.faces) == 6


def test_a_plane_under_the_floor_is_refused() -> None:
    with pytest.raises(BuildingError, match=r"dips 1\.000 m under the floor"):
        solid_parts(partition(shapely.box(0, 0, 4, 4)), [level(3.0)], 4.0)


def test_overlapping_polygons_are_refused() -> None:
    with pytest.raises(BuildingError, match="overlap"):
        solid_parts(partition(shapely.box(0, 0, 4, 4), shapely.box(0, 0, 4, 2)), [level(3.0), level(4.0)], 0.0)


def test_an_outline_that_touches_itself_is_refused() -> None:
    # two courtyards that meet in one corner
    left = shapely.Polygon([(0, 0), (3, 0), (3, 1), (1, 1), (1, 3), (3, 3), (3, 5), (3, 6), (0, 6)])
    right = shapely.Polygon([(3, 0), (6, 0), (6, 6), (3, 6), (3, 5), (5, 5), (5, 3), (3, 3), (3, 1)])
    with pytest.raises(BuildingError, match="touches itself"):
        solid_parts(partition(left, right), [level(3.0), level(4.0)], 0.0)
