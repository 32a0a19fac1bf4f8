"""Parametric buildings: exact, closed, valid."""

import dataclasses
import math

import numpy as np
import pytest
import shapely
from simulated import TWO_LEVELS, placed

from pipeline.model import FaceKind, RoofType, Solid
from pipeline.quality.validity import check_solid
from pipeline.ruler.simulation.additions import random_dormers, random_superstructures
from pipeline.ruler.simulation.random_dimensions import random_dimensions
from pipeline.ruler.simulation.roofs import Addition, AdditionKind, RoofDimensions, RoofShape
from pipeline.ruler.simulation.simulated_scene import Building, Terrain, undulating_terrain
from pipeline.ruler.simulation.solids import building_solid, has_steps, truth_record
from pipeline.ruler.simulation.suites import SUITES

SIZES = {
    RoofShape.FLAT: RoofDimensions(length_m=11.0, width_m=8.0),
    RoofShape.PENT: RoofDimensions(length_m=11.0, width_m=8.0, pitch_deg=15.0),
    RoofShape.GABLE: RoofDimensions(length_m=11.0, width_m=8.0, pitch_deg=35.0),
    RoofShape.HIP: RoofDimensions(length_m=11.0, width_m=8.0, pitch_deg=35.0),
    RoofShape.L_SHAPE: RoofDimensions(length_m=12.0, width_m=8.0, pitch_deg=40.0, wing_length_m=5.0, wing_width_m=6.0),
}
GABLE = placed(RoofShape.GABLE, SIZES[RoofShape.GABLE])


def drawn(shape: RoofShape, seed: int, *, furnished: bool) -> Building:
    """A building anywhere, of any size, with or without dormers and boxes, on a slope."""
    random = np.random.default_rng([seed, list(RoofShape).index(shape)])
    size = random_dimensions(shape, random)
    if furnished:
        dormers = random_dormers(shape, size, random)
        boxes = random_superstructures(shape, size, random, besides=dormers)
        size = dataclasses.replace(size, additions=dormers + boxes)
    x, y, azimuth_deg = (float(value) for value in random.uniform((0, 0, 0), (2000, 2000, 360)))
    slope = undulating_terrain(30.0, float(random.uniform(0, 25)), 140.0, 1.0, 60.0, random)
    return placed(shape, size, at=(x, y), azimuth_deg=azimuth_deg, eave_height_m=3.0, terrain=slope)


def signed_volume(solid: Solid) -> float:
    """Volume by the divergence theorem: a third of corner times area vector, over all faces."""
    total = 0.0
    for face in solid.faces:
        first = solid.vertices[face.rings[0][0]]
        for ring in face.rings:
            corners = solid.vertices[list(ring)]
            area = np.cross(corners - first, np.roll(corners, -1, axis=0) - first).sum(axis=0) / 2
            total += float(first @ area) / 3
    return total


@pytest.mark.parametrize("seeds", [range(3), pytest.param(range(100, 150), marks=pytest.mark.slow)])
@pytest.mark.parametrize("shape", list(RoofShape))
@pytest.mark.parametrize("furnished", [False, True], ids=["bare", "furnished"])
def test_buildings_of_any_size_are_valid_wherever_they_look(shape: RoofShape, furnished: bool, seeds: range) -> None:
    for seed in seeds:
        (solid,) = truth_record(drawn(shape, seed, furnished=furnished), (0.0, 0.0, 0.0)).solids
        assert check_solid(solid) == (), seed


@pytest.mark.parametrize("shape", list(RoofShape))
@pytest.mark.parametrize("furnished", [False, True], ids=["bare", "furnished"])
def test_the_volume_is_the_integral_of_the_roof_over_the_floor(shape: RoofShape, furnished: bool) -> None:
    """The integral of a plane over a polygon is its area times the height at its centroid."""
    for seed in range(3):
        building = drawn(shape, seed, furnished=furnished)
        integral = 0.0
        for polygon, plane in zip(building.roof_polygons(), building.planes, strict=True):
            middle = shapely.force_2d(polygon).centroid
            integral += polygon.area * (plane.a * middle.x + plane.b * middle.y + plane.c - building.floor_z_m)
        (solid,) = truth_record(building, (0.0, 0.0, 0.0)).solids
        assert signed_volume(solid) == pytest.approx(integral, rel=5e-4)


@pytest.mark.parametrize("name", ["suburb", "town"])
def test_all_buildings_of_a_suite_are_valid(name: str) -> None:
    scene = SUITES[name].make(5, (200.0, 200.0))
    assert len(scene.buildings) > 30
    for building in scene.buildings:
        (solid,) = truth_record(building, scene.origin).solids
        assert check_solid(solid) == (), building.building_id


def test_a_gable_looks_to_both_sides_of_its_ridge_and_has_two_walls_of_five_corners() -> None:
    assert sorted(plane.aspect_deg for plane in GABLE.planes) == pytest.approx([123.0, 303.0])
    walls = [face for face in building_solid(GABLE).faces if face.kind is FaceKind.WALL]
    assert sorted(len(face.rings[0]) for face in walls) == [4, 4, 5, 5]


def test_inner_steps_get_walls_down_to_the_lower_roof() -> None:
    building = placed(RoofShape.MULTI_LEVEL_FLAT, TWO_LEVELS, at=(0.0, 0.0), azimuth_deg=90.0)
    assert has_steps(building)
    solid = building_solid(building)
    walls = [solid.vertices[list(face.rings[0])] for face in solid.faces if face.kind is FaceKind.WALL]
    (step,) = [wall for wall in walls if np.ptp(wall[:, 0]) == 0.0 and wall[0, 0] == 0.0]
    # Over the lower roof and, in the same plane, beside it down to the floor.
    assert sorted(map(tuple, step[:, 1:].tolist())) == [
        *((-5.0, 34.0), (-5.0, 37.0), (3.0, 30.0), (3.0, 34.0), (5.0, 30.0), (5.0, 37.0))
    ]
    assert signed_volume(solid) == pytest.approx(100.0 * 7.0 + 80.0 * 4.0)


def test_a_roof_face_around_a_box_has_a_hole_in_record_and_solid() -> None:
    shaft = Addition(kind=AdditionKind.BOX, u_m=1.0, v_m=0.5, length_m=2.0, width_m=3.0, height_m=1.5)
    size = dataclasses.replace(SIZES[RoofShape.FLAT], additions=(shaft,))
    record = truth_record(placed(RoofShape.FLAT, size, at=(0.0, 0.0), azimuth_deg=20.0), (0.0, 0.0, 0.0))
    assert [len(face.polygon.interiors) for face in record.faces] == [1, 0]
    assert [face.polygon.area for face in record.faces] == pytest.approx([82.0, 6.0], abs=0.02)
    assert [len(face.rings) for face in record.solids[0].faces if face.kind is FaceKind.ROOF] == [2, 1]
    assert record.footprint is not None
    assert record.footprint.area == pytest.approx(88.0, abs=0.02)
    assert signed_volume(record.solids[0]) == pytest.approx(88.0 * 4.0 + 6.0 * 1.5, rel=5e-4)


def test_the_front_of_a_gable_dormer_is_one_wall_and_the_roof_beneath_has_no_corner_under_its_ridge() -> None:
    dormer = Addition(kind=AdditionKind.GABLE_DORMER, u_m=0.0, v_m=-2.2, length_m=2.0, width_m=2.2, height_m=1.0)
    size = dataclasses.replace(SIZES[RoofShape.GABLE], additions=(dormer,))
    solid = building_solid(placed(RoofShape.GABLE, size, at=(0.0, 0.0), azimuth_deg=77.0))
    walls = [face.rings[0] for face in solid.faces if face.kind is FaceKind.WALL]
    assert sorted(len(ring) for ring in walls) == [3, 3, 4, 4, 5, 5, 5]
    (around,) = [face.rings for face in solid.faces if len(face.rings) == 2]
    assert [len(ring) for ring in around] == [4, 5]
    assert {vertex for face in solid.faces for ring in face.rings for vertex in ring} == set(range(len(solid.vertices)))


def test_a_courtyard_is_a_hole_in_footprint_and_floor() -> None:
    size = RoofDimensions(length_m=24.0, width_m=20.0, pitch_deg=30.0, wing_width_m=6.0)
    building = placed(RoofShape.COURTYARD, size, at=(5.0, 5.0), azimuth_deg=20.0)
    assert not has_steps(building)
    record = truth_record(building, (0.0, 0.0, 0.0))
    assert isinstance(record.footprint, shapely.Polygon)
    assert [shapely.Polygon(hole).area for hole in record.footprint.interiors] == pytest.approx([96.0], abs=0.02)
    (floor,) = [face for face in record.solids[0].faces if face.kind is FaceKind.GROUND]
    assert [len(ring) for ring in floor.rings] == [4, 4]


def test_a_square_hip_roof_is_a_pyramid() -> None:
    size = RoofDimensions(length_m=8.0, width_m=8.0, pitch_deg=30.0)
    building = placed(RoofShape.HIP, size, at=(0, 0), azimuth_deg=0)
    assert [len(face[0]) for face in building.faces] == [3, 3, 3, 3]
    assert check_solid(building_solid(building)) == ()


def test_walls_start_at_the_lowest_terrain_and_eaves_stand_over_the_highest() -> None:
    slope = Terrain(base_z_m=30.0, slope_x=math.tan(math.radians(15.0)))
    building = placed(RoofShape.GABLE, SIZES[RoofShape.GABLE], azimuth_deg=90.0, terrain=slope)  # ridge along the fall
    reach = 5.5 * math.tan(math.radians(15.0))
    middle = 30.0 + 51.3 * math.tan(math.radians(15.0))
    assert building.floor_z_m == pytest.approx(middle - reach, abs=0.002)
    assert building.eave_z_m == pytest.approx(middle + reach + 4.0, abs=0.002)


def test_terrain_falls_as_steep_and_where_it_should_and_waves_stay_small() -> None:
    random = np.random.default_rng(0)
    plain = undulating_terrain(10.0, 8.0, 90.0, 0.0, 100.0, random)
    fall = plain.elevation(np.array([0.0]), np.array([5.0])) - plain.elevation(np.array([1.0]), np.array([5.0]))
    assert math.degrees(math.atan(float(fall[0]))) == pytest.approx(8.0)
    waved = undulating_terrain(10.0, 0.0, 0.0, 0.7, 50.0, random)
    z = waved.elevation(*(random.uniform(0, 500, (2, 10_000)))) - 10.0
    assert 0.4 < np.abs(z).max() <= 0.7


def test_the_truth_record_names_type_planes_and_block() -> None:
    building = placed(RoofShape.L_SHAPE, SIZES[RoofShape.L_SHAPE])
    record = truth_record(building, (500_000.0, 5_000_000.0, 0.0))
    assert record.roof_type is RoofType.L_SHAPE
    assert record.origin == (500_051.0, 5_000_047.0, 30.0)
    assert len(record.planes) == len(record.faces) == 4
    for face in record.faces:
        corners = shapely.get_coordinates(face.polygon, include_z=True)
        plane = record.planes[face.plane]
        assert np.abs(plane.a * corners[:, 0] + plane.b * corners[:, 1] + plane.c - corners[:, 2]).max() < 0.002
