"""Low buildings keep to their sizes and heights, and stand at houses, beside them, and free."""

import numpy as np
import pytest
import shapely

from pipeline.ruler.simulation.low_buildings import AREA_M2, HEIGHT_M, OF_EACH, low_buildings
from pipeline.ruler.simulation.simulated_scene import Scene


@pytest.fixture(scope="module", params=[1_000, 90_000])
def scene(request: pytest.FixtureRequest) -> Scene:
    return low_buildings(request.param)


def test_areas_and_heights_are_in_range(scene: Scene) -> None:
    low = [one for one in scene.buildings if one.building_id.startswith("low")]
    assert len(low) == 3 * OF_EACH
    for one in low:
        assert AREA_M2[0] - 1e-6 <= one.footprint.area <= AREA_M2[1] + 1e-6
        x, y = shapely.get_coordinates(one.footprint.segmentize(0.5)).T
        ground = float(scene.terrain.elevation(x, y).max())
        assert one.eave_z_m >= ground + HEIGHT_M[0] - 2e-3
        assert one.ridge_z_m <= ground + HEIGHT_M[1] + 0.02


def test_a_third_touch_a_house_and_a_third_have_one_nearby(scene: Scene) -> None:
    houses = [one.footprint for one in scene.buildings if one.building_id.startswith("house")]
    low = [one.footprint for one in scene.buildings if one.building_id.startswith("low")]
    gaps = shapely.distance(np.array(low, object), shapely.union_all(houses))
    touching, near = gaps < 1e-6, (gaps > 0.5) & (gaps < 2.1)
    assert (int(touching.sum()), int(near.sum()), int((gaps > 2.1).sum())) == (OF_EACH, OF_EACH, OF_EACH)
