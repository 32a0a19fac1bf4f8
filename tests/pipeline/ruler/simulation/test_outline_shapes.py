"""Each shape of the suite has the corners, angles and sizes that its name promises."""

import numpy as np
import pytest
import shapely

from pipeline.ruler.simulation.outline_shapes import BEND_DEG, OF_EACH, ROW, SHAPES, outline_shapes
from pipeline.ruler.simulation.simulated_scene import Building, Scene

CORNERS = {
    "hexagon": 6,
    "octagon": 8,
    "trapezoid_house": 4,
    "trapezoid_shed": 4,
    "oblique_wall": 4,
    "bend": 6,
    "rectangle": 4,
    "l_shape": 6,
    "t_shape": 8,
    "u_shape": 8,
    "small_step": 6,
    "courtyard": 4,
}


@pytest.fixture(scope="module", params=[1_000, 90_000])
def scene(request: pytest.FixtureRequest) -> Scene:
    return outline_shapes(request.param)


def of_shape(scene: Scene, shape: str) -> list[Building]:
    return [one for one in scene.buildings if one.block_id.rpartition("-")[0] == shape]


def turns_deg(building: Building) -> np.ndarray:
    """By how much each corner of the exterior turns, positive to the left."""
    ring = shapely.get_coordinates(shapely.simplify(building.footprint, 1e-4).normalize().exterior)[:0:-1]
    along = np.roll(ring, -1, axis=0) - ring
    azimuth = np.arctan2(along[:, 1], along[:, 0])
    return np.degrees((azimuth - np.roll(azimuth, 1) + np.pi) % (2 * np.pi) - np.pi)


def test_there_are_five_of_each_shape_and_houses_of_a_row_share_a_block(scene: Scene) -> None:
    assert all(len(of_shape(scene, shape)) == OF_EACH for shape in SHAPES)
    rows = of_shape(scene, ROW)
    assert len({one.block_id for one in rows}) == OF_EACH
    assert len(rows) >= 4 * OF_EACH


def test_the_number_of_corners_is_that_of_the_shape(scene: Scene) -> None:
    for shape, corners in CORNERS.items():
        assert [len(turns_deg(one)) for one in of_shape(scene, shape)] == [corners] * OF_EACH, shape


def test_a_tower_turns_by_less_than_ten_degrees_at_each_corner(scene: Scene) -> None:
    for one in of_shape(scene, "round_tower"):
        assert turns_deg(one).max() < 10.0


def test_bends_are_fifteen_degrees_and_oblique_walls_are_off_by_five_to_thirty(scene: Scene) -> None:
    for one in of_shape(scene, "bend"):
        bent = [turn for turn in turns_deg(one) if abs(turn) < 45.0]
        assert sorted(bent) == pytest.approx([-BEND_DEG, BEND_DEG])
    for one in of_shape(scene, "oblique_wall"):
        off = np.sort(np.abs(turns_deg(one) - 90.0))
        assert off[:2] == pytest.approx([0.0, 0.0], abs=1e-6)
        assert off[2] == pytest.approx(off[3])
        assert 5.0 <= off[3] <= 30.0


def test_sheds_have_eight_to_twenty_square_metres_and_steps_half_a_metre_or_more(scene: Scene) -> None:
    assert all(8.0 <= one.footprint.area <= 20.0 for one in of_shape(scene, "trapezoid_shed"))
    for one in of_shape(scene, "small_step"):
        ring = shapely.get_coordinates(shapely.simplify(one.footprint, 1e-4).exterior)
        assert 0.5 <= np.hypot(*np.diff(ring, axis=0).T).min() <= 1.5


def test_courtyards_have_a_court_and_roofs_lie_on_their_planes(scene: Scene) -> None:
    assert all(len(one.footprint.interiors) == 1 for one in of_shape(scene, "courtyard"))
    for one in scene.buildings:
        for polygon, plane in zip(one.roof_polygons(), one.planes, strict=True):
            x, y, z = shapely.get_coordinates(polygon, include_z=True).T
            assert plane.a * x + plane.b * y + plane.c == pytest.approx(z, abs=1e-6)
        assert one.vertices[:, 2].min() >= one.eave_z_m - 1e-6
