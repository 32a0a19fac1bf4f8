"""Parametric buildings: exact, closed, valid."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely

from pipeline.model import FaceKind, RoofType
from pipeline.quality.validity import check_solid
from pipeline.synthetic.roofs import ROOF_TYPES, ROOFS, RoofDimensions, RoofShape
from pipeline.synthetic.scene import Building, Terrain, place_building, undulating_terrain
from pipeline.synthetic.solids import building_solid, truth_record
from pipeline.synthetic.suites import SUITES

SIZES = {
    RoofShape.FLAT: RoofDimensions(length_m=11.0, width_m=8.0),
    RoofShape.PENT: RoofDimensions(length_m=11.0, width_m=8.0, pitch_deg=15.0),
    RoofShape.GABLE: RoofDimensions(length_m=11.0, width_m=8.0, pitch_deg=35.0),
    RoofShape.HIP: RoofDimensions(length_m=11.0, width_m=8.0, pitch_deg=35.0),
    RoofShape.L_SHAPE: RoofDimensions(length_m=12.0, width_m=8.0, pitch_deg=40.0, wing_length_m=5.0, wing_width_m=6.0),
}
LEVEL = Terrain(base_z_m=30.0)


def placed(shape: RoofShape, azimuth_deg: float = 33.0, terrain: Terrain = LEVEL) -> Building:
    return place_building(
        "a", shape, SIZES[shape], x=51.3, y=47.9, azimuth_deg=azimuth_deg, eave_height_m=4.0, terrain=terrain
    )


def roof_volume(shape: RoofShape) -> float:
    """Volume between eave and roof by the formulas of solid geometry."""
    size = SIZES[shape]
    length, width, slope = size.length_m, size.width_m, math.tan(math.radians(size.pitch_deg))
    if shape is RoofShape.FLAT:
        return 0.0
    if shape is RoofShape.PENT:
        return length * width * width * slope / 2
    gable = length * width * width / 4 * slope
    if shape is RoofShape.GABLE:
        return gable
    if shape is RoofShape.HIP:
        return gable - 2 * width**3 * slope / 24
    wing, out = size.wing_width_m, size.wing_length_m
    # The wing's prism, and the part of it that stands over the main roof: a third of base times depth.
    return gable + out * wing * wing / 4 * slope + (wing * wing / 4 * slope) * (wing / 2) / 3


def signed_volume(building: Building) -> float:
    """Volume of the solid by the divergence theorem, from fans of its faces."""
    solid = building_solid(building, (51.0, 47.0, 30.0))
    total = 0.0
    for face in solid.faces:
        (ring,) = face.rings
        corners = solid.vertices[list(ring)]
        for k in range(1, len(corners) - 1):
            total += float(corners[0] @ np.cross(corners[k], corners[k + 1])) / 6
    return total


@pytest.mark.parametrize("shape", list(RoofShape))
@pytest.mark.parametrize("azimuth_deg", [0.0, 33.0, 90.0, 217.5])
def test_every_shape_is_a_valid_solid_wherever_it_looks(shape: RoofShape, azimuth_deg: float) -> None:
    slope = undulating_terrain(30.0, 12.0, 140.0, 1.0, 60.0, np.random.default_rng(3))
    assert check_solid(building_solid(placed(shape, azimuth_deg, slope))) == ()


@pytest.mark.parametrize("name", ["suburb", "town"])
def test_all_buildings_of_a_suite_are_valid_and_none_overlap(name: str) -> None:
    suite = SUITES[name]
    scene = suite.make(5, (200.0, 200.0))
    assert len(scene.buildings) > 30
    for building in scene.buildings:
        (solid,) = truth_record(building, scene.origin).solids
        assert check_solid(solid) == (), building.building_id
    outlines = [building.footprint for building in scene.buildings]
    first, second = shapely.STRtree(outlines).query(outlines, predicate="intersects")
    for a, b in zip(first, second, strict=True):
        if a < b:
            assert shapely.intersection(outlines[a], outlines[b]).area < 1e-6


@pytest.mark.parametrize("shape", list(RoofShape))
def test_the_solid_has_the_volume_of_the_formula(shape: RoofShape) -> None:
    body = placed(shape).footprint.area * 4.0
    assert signed_volume(placed(shape)) == pytest.approx(body + roof_volume(shape), rel=5e-4)


@pytest.mark.parametrize("shape", list(RoofShape))
def test_roof_faces_cover_the_footprint_once_with_the_pitch_asked_for(shape: RoofShape) -> None:
    building = placed(shape)
    polygons = building.roof_polygons()
    assert all(polygon.exterior.is_ccw for polygon in polygons)
    assert sum(polygon.area for polygon in polygons) == pytest.approx(building.footprint.area)
    for plane, face in zip(building.planes, building.faces, strict=True):
        assert plane.slope_deg == pytest.approx(SIZES[shape].pitch_deg)
        corners = building.vertices[list(face)]
        assert np.allclose(plane.a * corners[:, 0] + plane.b * corners[:, 1] + plane.c, corners[:, 2], atol=1e-9)


def test_a_gable_looks_to_both_sides_of_its_ridge() -> None:
    assert sorted(plane.aspect_deg for plane in placed(RoofShape.GABLE).planes) == pytest.approx([123.0, 303.0])


def test_a_gable_wall_is_one_face_of_five_corners() -> None:
    walls = [face for face in building_solid(placed(RoofShape.GABLE)).faces if face.kind is FaceKind.WALL]
    assert sorted(len(face.rings[0]) for face in walls) == [4, 4, 5, 5]


def test_a_square_hip_roof_is_a_pyramid() -> None:
    size = RoofDimensions(length_m=8.0, width_m=8.0, pitch_deg=30.0)
    building = place_building("p", RoofShape.HIP, size, x=0, y=0, azimuth_deg=0, eave_height_m=3, terrain=LEVEL)
    assert [len(face) for face in building.faces] == [3, 3, 3, 3]
    assert check_solid(building_solid(building)) == ()


def test_walls_start_at_the_lowest_terrain_and_eaves_stand_over_the_highest() -> None:
    slope = Terrain(base_z_m=30.0, slope_x=math.tan(math.radians(15.0)))
    building = placed(RoofShape.GABLE, 90.0, slope)  # ridge along the fall, 11 m long
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
    building = placed(RoofShape.L_SHAPE)
    record = truth_record(building, (500_000.0, 5_000_000.0, 0.0))
    assert record.roof_type is RoofType.COMBINATION
    assert record.origin == (500_051.0, 5_000_047.0, 30.0)
    assert len(record.planes) == len(record.faces) == 4
    for face in record.faces:
        corners = shapely.get_coordinates(face.polygon, include_z=True)
        plane = record.planes[face.plane]
        assert np.abs(plane.a * corners[:, 0] + plane.b * corners[:, 1] + plane.c - corners[:, 2]).max() < 0.002


def test_tables_know_every_shape() -> None:
    assert set(ROOFS) == set(ROOF_TYPES) == set(RoofShape)


def test_impossible_roofs_are_refused() -> None:
    with pytest.raises(ValueError, match="no area"):
        RoofDimensions(length_m=0.0, width_m=5.0)
    with pytest.raises(ValueError, match="pitch_deg is 80"):
        RoofDimensions(length_m=5.0, width_m=5.0, pitch_deg=80.0)
    with pytest.raises(ValueError, match="has no ridge"):
        ROOFS[RoofShape.HIP](RoofDimensions(length_m=5.0, width_m=6.0, pitch_deg=30.0))
    with pytest.raises(ValueError, match="does not fit"):
        ROOFS[RoofShape.L_SHAPE](RoofDimensions(length_m=9.0, width_m=6.0, wing_width_m=6.0, wing_length_m=3.0))
