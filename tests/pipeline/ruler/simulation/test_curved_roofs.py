"""Each form of the suite lies near its curve, on exact planes and in closed solids."""

import numpy as np
import pytest
import shapely

from pipeline.model import RoofType
from pipeline.ruler.simulation.curved_roofs import FORMS, curved_roofs
from pipeline.ruler.simulation.plots import OF_EACH
from pipeline.ruler.simulation.roofs import ROOF_TYPES, CurvedForm
from pipeline.ruler.simulation.simulated_scene import Scene
from pipeline.ruler.simulation.solids import truth_record


@pytest.fixture(scope="module")
def scene() -> Scene:
    return curved_roofs(1_000)


def test_there_are_four_of_each_form_with_a_name(scene: Scene) -> None:
    assert set(FORMS) == set(CurvedForm)
    for form in FORMS:
        found = [one for one in scene.buildings if one.building_id.rpartition("-")[0] == form]
        assert len(found) == OF_EACH
        assert {one.shape for one in found} == {form}
    assert {ROOF_TYPES[form] for form in FORMS} == {RoofType.BARREL, RoofType.CONE, RoofType.DOME}


def test_faces_lie_on_their_planes_close_a_solid_and_turn_by_little(scene: Scene) -> None:
    for one in scene.buildings:
        for polygon, plane in zip(one.roof_polygons(), one.planes, strict=True):
            x, y, z = shapely.get_coordinates(polygon, include_z=True).T
            assert plane.a * x + plane.b * y + plane.c == pytest.approx(z, abs=1e-6)
        assert len(truth_record(one, scene.origin).solids) == 1
        normals = np.array([plane.normal for plane in one.planes])
        cosines = normals @ normals.T - 2.0 * np.eye(len(normals))
        assert np.degrees(np.arccos(cosines.max(axis=1))).max() < 13.0
