"""What planes see of the sky, held against the formulas of theory and against a search along rays."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
import shapely
from examples import examples
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.extras.solar.figures import figures
from pipeline.extras.solar.horizon import horizons, obstacles_of
from pipeline.extras.solar.roof_planes import LIFT_M, RoofPlanes
from pipeline.extras.solar.sectors import SECTOR_RAD, SECTORS
from pipeline.extras.solar.sky_view import sky_views
from pipeline.extras.solar.solar_settings import SolarSettings
from pipeline.model import FloatArray

AZIMUTHS = np.arange(SECTORS) * SECTOR_RAD
HERE = np.zeros((1, 3))


def ring_of(corners: FloatArray) -> FloatArray:
    """The edges of a closed ring, (n, 6), in the form of obstacles."""
    return np.hstack([corners, np.roll(corners, -1, axis=0)])


def box(x0: float, y0: float, x1: float, y1: float, z: float) -> FloatArray:
    """The upper edges of a block."""
    return ring_of(np.array([(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)], float))


def tangents_of(*buildings: FloatArray, point: FloatArray = HERE, reach_m: float = 1e6) -> FloatArray:
    """(SECTORS,) tangents of the horizon of one point among buildings."""
    numbers = np.repeat(np.arange(len(buildings)), [len(edges) for edges in buildings])
    obstacles = obstacles_of(np.concatenate([np.zeros((0, 6)), *buildings]), numbers)
    found: FloatArray = horizons(point, np.zeros(1, np.int64), obstacles, reach_m)[0]
    return found


def normal_of(tilt_deg: float, azimuth_deg: float = 180.0) -> FloatArray:
    """(1, 3) the normal of a plane."""
    tilt, azimuth = math.radians(tilt_deg), math.radians(azimuth_deg)
    horizontal = math.sin(tilt)
    return np.array([[horizontal * math.sin(azimuth), horizontal * math.cos(azimuth), math.cos(tilt)]])


def plane(corners: list[tuple[float, float, float]], slope_deg: float = 0.0, aspect_deg: float = 0.0) -> RoofPlanes:
    """One plane of one face."""
    return RoofPlanes(
        faces=np.array([shapely.Polygon(corners)], dtype=object),
        building=np.zeros(1, np.int64),
        slope_deg=np.array([slope_deg]),
        aspect_deg=np.array([aspect_deg]),
        through=np.array(corners[:1]),
    )


def alone(planes: RoofPlanes) -> Any:
    """The figures of planes that only their own faces could shade."""
    return figures(planes, obstacles_of(*planes.edges()), SolarSettings(), None)


def test_a_level_plane_in_the_open_sees_the_whole_sky() -> None:
    found = alone(plane([(0, 0, 5), (9, 0, 5), (9, 4, 5), (0, 4, 5)]))
    assert found.sky_view == pytest.approx([1.0], abs=1e-12)
    assert (found.horizon_deg == 0.0).all()
    assert 10 <= found.samples[0] <= 30


@settings(deadline=None, max_examples=examples(60))
@given(tilt=st.floats(0.0, 89.0), azimuth=st.floats(0.0, 360.0))
def test_an_inclined_plane_in_the_open_sees_the_share_of_theory(tilt: float, azimuth: float) -> None:
    seen = sky_views(np.zeros((1, SECTORS)), normal_of(tilt, azimuth))[0]
    assert seen == pytest.approx((1.0 + math.cos(math.radians(tilt))) / 2.0, abs=3e-4)


def test_the_face_of_an_inclined_plane_does_not_shade_itself() -> None:
    rise = 4.0 * math.tan(math.radians(40.0))
    found = alone(plane([(0, 0, 5), (9, 0, 5), (9, 4, 5 + rise), (0, 4, 5 + rise)], 40.0, 180.0))
    assert found.sky_view == pytest.approx([(1.0 + math.cos(math.radians(40.0))) / 2.0], abs=3e-4)


@settings(deadline=None, max_examples=examples(60))
@given(height=st.floats(0.1, 80.0), distance=st.floats(2.0, 80.0))
def test_a_long_wall_gives_the_horizon_and_the_sky_of_theory(height: float, distance: float) -> None:
    tangents = tangents_of(box(-1e6, distance, 1e6, distance + 10.0, height))
    toward = np.cos(AZIMUTHS) > 1e-3
    assert tangents[toward] == pytest.approx(height / distance * np.cos(AZIMUTHS[toward]))
    assert (tangents[np.cos(AZIMUTHS) < 0.0] == 0.0).all()
    # an endless wall takes the part of the sky that an inclined plane does: (1 - cos of its elevation) / 2
    expected = (1.0 + math.cos(math.atan2(height, distance))) / 2.0
    # a sector of 5 degrees in the east and one in the west are half behind the wall, and count as open
    assert sky_views(tangents[None], normal_of(0.0))[0] == pytest.approx(expected, abs=0.5 / SECTORS)


@settings(deadline=None, max_examples=examples(30))
@given(radius=st.floats(1.0, 50.0), height=st.floats(0.1, 50.0))
def test_the_middle_of_a_round_courtyard_sees_the_share_of_theory(radius: float, height: float) -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    corners = np.column_stack([radius * np.sin(angles), radius * np.cos(angles), np.full(720, height)])
    tangents = tangents_of(ring_of(corners))
    assert tangents == pytest.approx(height / radius, rel=1e-4)
    expected = radius**2 / (radius**2 + height**2)
    assert sky_views(tangents[None], normal_of(0.0))[0] == pytest.approx(expected, rel=1e-3)


def test_a_square_courtyard_has_the_horizon_of_its_four_walls() -> None:
    tangents = tangents_of(box(-5.0, -5.0, 5.0, 5.0, 8.0))
    assert tangents == pytest.approx(8.0 / 5.0 * np.maximum(abs(np.sin(AZIMUTHS)), abs(np.cos(AZIMUTHS))))


def test_what_is_lower_or_beyond_the_reach_blocks_nothing() -> None:
    far, low = box(-5.0, 40.0, 5.0, 50.0, 8.0), box(-5.0, 10.0, 5.0, 20.0, -0.5)
    assert (tangents_of(far, low, reach_m=39.0) == 0.0).all()
    assert tangents_of(far, low, reach_m=40.0)[0] == pytest.approx(8.0 / 40.0)
    assert (tangents_of() == 0.0).all()


def test_reach_is_measured_from_each_point_and_not_from_its_building() -> None:
    points = np.array([(0.0, 0.0, 0.0), (0.0, -30.0, 0.0)])
    edges = box(-5.0, 40.0, 5.0, 50.0, 8.0)
    found = horizons(points, np.zeros(2, np.int64), obstacles_of(edges, np.zeros(4, np.int64)), 45.0)
    assert found[:, 0] == pytest.approx([0.2, 0.0])


gables = st.lists(
    st.tuples(st.floats(-40, 40), st.floats(-40, 40), st.floats(2, 15), st.floats(2, 15), st.floats(-3, 12)),
    min_size=1,
    max_size=4,
)


@settings(deadline=None, max_examples=examples(20))
@given(gables, st.floats(0.5, 6.0))
def test_horizons_are_those_that_a_search_along_rays_finds(blocks: list[tuple[float, ...]], rise: float) -> None:
    roofs, buildings = [], []
    for x, y, width, depth, eave in blocks:
        if shapely.box(x - 0.3, y - 0.3, x + width + 0.3, y + depth + 0.3).contains(shapely.Point(0, 0)):
            continue
        middle, ridge = y + depth / 2.0, eave + rise
        south = np.array([(x, y, eave), (x + width, y, eave), (x + width, middle, ridge), (x, middle, ridge)])
        north = np.array(
            [(x, middle, ridge), (x + width, middle, ridge), (x + width, y + depth, eave), (x, y + depth, eave)]
        )
        buildings.append(np.concatenate([ring_of(south), ring_of(north)]))
        roofs.append((x, y, width, depth, eave))
    tangents = tangents_of(*buildings)
    for sector in range(0, SECTORS, 5):
        # of roofs a little smaller and a little larger: a search by steps may miss what a ray only touches
        assert searched(roofs, rise, AZIMUTHS[sector], -1e-6) <= tangents[sector] + 1e-9
        assert tangents[sector] <= searched(roofs, rise, AZIMUTHS[sector], 0.1) + 0.05


def searched(roofs: list[tuple[float, ...]], rise: float, azimuth: float, grown_m: float) -> float:
    """The tangent of the horizon that steps along a ray find over gabled roofs, whose plans grow on all sides."""
    distance = np.arange(0.05, 80.0, 0.002)
    east, north, best = distance * math.sin(azimuth), distance * math.cos(azimuth), 0.0
    for x, y, width, depth, eave in roofs:
        aside, along = abs(east - x - width / 2), abs(north - y - depth / 2)
        over = (aside < width / 2 + grown_m) & (along < depth / 2 + grown_m)
        z = eave + rise * np.maximum(0.0, 1.0 - along / (depth / 2))
        best = max(best, float((z / distance)[over].max(initial=0.0)))
    return best


def test_a_turned_scene_has_turned_horizons() -> None:
    edges = np.concatenate([box(5.0, 8.0, 20.0, 14.0, 6.0), box(-30.0, -9.0, -12.0, 3.0, 11.0)])
    turn = 7 * SECTOR_RAD
    clockwise = np.array([(math.cos(turn), -math.sin(turn)), (math.sin(turn), math.cos(turn))])
    turned = edges.copy()
    for first in (0, 3):
        turned[:, first : first + 2] = edges[:, first : first + 2] @ clockwise
    assert tangents_of(turned) == pytest.approx(np.roll(tangents_of(edges), 7), abs=1e-9)


def test_samples_lie_inside_their_faces_and_just_above_them() -> None:
    ell = [(0, 0, 5), (12, 0, 5), (12, 3, 5), (3, 3, 5), (3, 12, 5), (0, 12, 5)]
    points, owner = plane([(x, y, z + 0.5 * x) for x, y, z in ell], math.degrees(math.atan(0.5)), 270.0).samples(40)
    assert shapely.contains_xy(shapely.Polygon(ell), points[:, 0], points[:, 1]).all()
    assert points[:, 2] == pytest.approx(5.0 + 0.5 * points[:, 0] + LIFT_M)
    assert 25 <= len(points) == len(owner) <= 80


def test_a_sliver_has_one_sample_and_a_plane_without_a_face_none() -> None:
    faces = [shapely.Polygon([(0, 0, 1), (50, 50, 1), (50, 50.001, 1)]), None, shapely.Polygon()]
    planes = RoofPlanes(
        faces=np.array(faces, dtype=object),
        building=np.zeros(3, np.int64),
        slope_deg=np.zeros(3),
        aspect_deg=np.zeros(3),
        through=np.ones((3, 3)),
    )
    found = alone(planes)
    assert found.samples.tolist()[1:] == [0, 0]
    assert found.samples[0] >= 1
    assert found.sky_view == pytest.approx([1.0, np.nan, np.nan], nan_ok=True)


def test_an_edge_between_two_faces_is_kept_once() -> None:
    faces = [
        shapely.Polygon([(0, 0, 1), (4, 0, 1), (4, 2, 2), (0, 2, 2)]),
        shapely.Polygon([(0, 2, 2), (4, 2, 2), (4, 4, 1), (0, 4, 1)]),
    ]
    planes = RoofPlanes(
        faces=np.array(faces, dtype=object),
        building=np.zeros(2, np.int64),
        slope_deg=np.zeros(2),
        aspect_deg=np.zeros(2),
        through=np.zeros((2, 3)),
    )
    edges, building = planes.edges()
    assert len(edges) == len(building) == 7
    both = dataclasses.replace(
        planes, faces=np.array([shapely.MultiPolygon(faces), None], dtype=object), building=np.array([0, 7])
    )
    assert (both.edges()[0] == edges).all()
    assert both.edges()[1].tolist() == [0] * 7
    # side by side, so that the shared edge is the last of the first building and the first of the second
    turned = shapely.transform(planes.faces, lambda xyz: xyz[:, [1, 0, 2]], include_z=True)
    others = RoofPlanes(**{**vars(planes), "faces": turned, "building": np.array([0, 1])})
    assert others.edges()[1].tolist() == [0] * 4 + [1] * 4


def test_a_wing_is_shaded_by_the_higher_part_of_its_own_building() -> None:
    wing = plane([(0, 0, 3), (10, 0, 3), (10, 10, 3), (0, 10, 3)])
    tower = box(0.0, 10.0, 10.0, 20.0, 13.0)
    edges, building = wing.edges()
    both = obstacles_of(np.concatenate([edges, tower]), np.concatenate([building, np.zeros(4, np.int64)]))
    found = figures(wing, both, SolarSettings(samples=400), None)
    assert 0.6 < found.sky_view[0] < 0.85
    assert found.horizon_deg[0, 0] > 45.0 - 10.0
    assert found.horizon_deg[0, SECTORS // 2] == 0.0
