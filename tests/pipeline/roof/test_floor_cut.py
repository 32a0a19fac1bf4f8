"""Faces that come down to the floor are cut there: the slope stays, borders stay shared, solids stay valid."""

import numpy as np
import pytest
import shapely

from pipeline.model import Plane
from pipeline.quality.validity import check_solid
from pipeline.roof.partition import RoofPartition
from pipeline.roof.solid import solid_parts
from pipeline.roof.unsupported_faces import cut_at_floor

FLOOR_M = 0.1


def plane(a: float, b: float, c: float) -> Plane:
    return Plane(a=a, b=b, c=c, n_points=10, rmse_m=0.0)


def box_mm(x0: float, y0: float, x1: float, y1: float) -> shapely.Polygon:
    return shapely.transform(shapely.box(x0, y0, x1, y1), lambda xy: np.rint(xy * 1e3))


def partition_of(*polygons: shapely.Polygon) -> RoofPartition:
    return RoofPartition(polygons=polygons, labels=np.arange(len(polygons), dtype=np.int32))


def test_a_slope_keeps_its_plane_down_to_the_floor_and_is_level_below() -> None:
    slope = plane(0.5, 0.0, -0.4)
    cut, planes = cut_at_floor(partition_of(box_mm(0, 0, 4, 3)), [slope], FLOOR_M)
    assert planes[0] is slope
    assert (planes[-1].slope_deg, planes[-1].c) == (0.0, FLOOR_M)
    bounds = {label: polygon.bounds for label, polygon in zip(cut.labels.tolist(), cut.polygons, strict=True)}
    assert bounds == {0: (1000, 0, 4000, 3000), 1: (0, 0, 1000, 3000)}
    (part,) = solid_parts(cut, planes, 0.0)
    assert check_solid(part.solid) == ()


def test_a_neighbour_that_stays_whole_gets_the_ends_of_the_cut() -> None:
    lean_to, house = box_mm(0, 0, 4, 3), box_mm(0, 3, 4, 8)
    cut, planes = cut_at_floor(partition_of(lean_to, house), [plane(0.5, 0.0, -0.4), plane(0.0, 0.0, 5.0)], FLOOR_M)
    whole = cut.polygons[cut.labels.tolist().index(1)]
    assert (1000.0, 3000.0) in whole.exterior.coords
    assert sum(polygon.area for polygon in cut.polygons) == pytest.approx(32e6)
    assert [check_solid(part.solid) for part in solid_parts(cut, planes, 0.0)] == [()]


def test_faces_above_the_floor_come_back_as_they_were() -> None:
    partition = partition_of(box_mm(0, 0, 4, 3))
    cut, planes = cut_at_floor(partition, [plane(0.5, 0.0, 0.07)], FLOOR_M)
    assert cut is partition
    assert len(planes) == 1


def test_a_face_with_arms_is_cut_into_all_its_parts() -> None:
    comb = shapely.transform(
        shapely.Polygon([(0, 0), (6, 0), (6, 3), (5, 3), (5, 1), (1, 1), (1, 3), (0, 3)]), lambda xy: np.rint(xy * 1e3)
    )
    cut, planes = cut_at_floor(partition_of(comb), [plane(0.0, -1.0, 2.1)], FLOOR_M)
    areas = [polygon.area * 1e-6 for polygon in cut.polygons]
    assert sorted(zip(cut.labels.tolist(), areas, strict=True)) == [(0, 8.0), (1, 1.0), (1, 1.0)]
    assert [check_solid(part.solid) for part in solid_parts(cut, planes, 0.0)] == [()]


@pytest.mark.parametrize("seed", range(20))
def test_cut_gables_in_any_direction_are_valid(seed: int) -> None:
    random = np.random.default_rng(seed)
    angle, pitch = random.uniform(0.0, np.pi), random.uniform(0.2, 2.5)
    turn = np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])
    corners = np.array([(0.0, 0.0), (5.0, 0.0), (5.0, 2.0), (5.0, 4.0), (0.0, 4.0), (0.0, 2.0)]) @ turn
    halves = [shapely.Polygon(np.rint(corners[list(ring)] * 1e3)) for ring in ((0, 1, 2, 5), (5, 2, 3, 4))]
    across = np.array([0.0, 1.0]) @ turn
    low = float(random.uniform(-0.5, 0.05))
    planes = [
        plane(*(pitch * across), low),
        plane(*(-pitch * across), low + 4.0 * pitch),
    ]
    cut, extended = cut_at_floor(partition_of(*halves), planes, FLOOR_M)
    assert len(cut.polygons) == 4
    assert [check_solid(part.solid) for part in solid_parts(cut, extended, 0.0)] == [()]
