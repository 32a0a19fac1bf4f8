"""Bridges end level with the ground, vehicles keep their sizes, and wide halls reach over the edge of the data."""

import numpy as np
import pytest
import shapely

from pipeline.ruler.simulation.bridges_and_vans import (
    BRIDGES,
    VAN_HEIGHT_M,
    VAN_LENGTH_M,
    VAN_WIDTH_M,
    bridges_and_vans,
)
from pipeline.ruler.simulation.simulated_scene import Scene
from pipeline.ruler.simulation.wide_halls import HALL_M, wide_halls


@pytest.fixture(scope="module", params=[1_000, 90_000])
def street(request: pytest.FixtureRequest) -> Scene:
    return bridges_and_vans(request.param)


def sides_m(corners: np.ndarray) -> tuple[float, float]:
    first, second = np.hypot(*(corners[1] - corners[0])), np.hypot(*(corners[2] - corners[1]))
    return float(min(first, second)), float(max(first, second))


def test_a_deck_ends_at_the_ground_and_is_metres_above_it_in_the_middle(street: Scene) -> None:
    for box in street.boxes[:BRIDGES]:
        ends = np.stack([box.corners[[0, 3]].mean(axis=0), box.corners[[1, 2]].mean(axis=0)])
        ground = street.terrain.elevation(*np.vstack([ends, ends.mean(axis=0)]).T)
        assert np.abs(ground[:2] - box.top_z_m).max() < 0.75
        assert 2.5 < box.top_z_m - ground[2] < 5.0


def test_vehicles_have_the_sizes_of_vans_and_stand_apart(street: Scene) -> None:
    vans = street.boxes[BRIDGES:]
    assert len(vans) > 100
    for box in vans:
        width, length = sides_m(box.corners)
        ground = float(street.terrain.elevation(*box.corners.mean(axis=0)[:, None])[0])
        assert VAN_WIDTH_M[0] - 1e-6 <= width <= VAN_WIDTH_M[1] + 1e-6
        assert VAN_LENGTH_M[0] - 1e-6 <= length <= VAN_LENGTH_M[1] + 1e-6
        assert VAN_HEIGHT_M[0] - 1e-6 <= box.top_z_m - ground <= VAN_HEIGHT_M[1] + 1e-6
    plans = [shapely.Polygon(box.corners) for box in street.boxes]
    assert len(shapely.STRtree(plans).query(plans, predicate="intersects").T) == len(plans)


@pytest.mark.parametrize("seed", [1_000, 90_000])
def test_halls_are_wide_and_reach_over_edges_and_corners(seed: int) -> None:
    scene = wide_halls(seed)
    data, corners = shapely.box(*scene.extent), shapely.points(shapely.get_coordinates(shapely.box(*scene.extent)))
    halls = [one for one in scene.buildings if one.building_id.startswith("hall")]
    assert all(HALL_M[0] <= min(one.dimensions.length_m, one.dimensions.width_m) for one in halls)
    assert all(data.crosses(one.footprint.exterior) for one in halls)
    assert sum(bool(shapely.dwithin(one.footprint, corners, 5.0).any()) for one in halls) >= 3
    outlines = [one.footprint for one in scene.buildings]
    assert len(shapely.STRtree(outlines).query(outlines, predicate="intersects").T) == len(outlines)
