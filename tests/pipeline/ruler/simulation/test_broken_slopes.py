"""Each form of the suite has the faces that its name promises, on exact planes and in closed solids."""

import numpy as np
import pytest
import shapely

from pipeline.roof.roof_settings import RoofTypeSettings
from pipeline.roof.roof_type import roof_type
from pipeline.ruler.simulation.broken_slopes import FORMS, broken_slopes
from pipeline.ruler.simulation.plots import OF_EACH
from pipeline.ruler.simulation.roofs import ROOF_TYPES, BrokenForm
from pipeline.ruler.simulation.simulated_scene import Building, Scene
from pipeline.ruler.simulation.solids import truth_record

FACES = {
    BrokenForm.GAMBREL: {4},
    BrokenForm.KICKED_HIP: {8},
    BrokenForm.KICKED_GABLE: {4},
    BrokenForm.JERKINHEAD: {4},
    BrokenForm.CROSS_GABLE: {6, 8},
    BrokenForm.HEXAGONAL_PYRAMID: {6},
    BrokenForm.SAWTOOTH: {3, 4, 5, 6, 8, 10},
    BrokenForm.BUTTERFLY: {2},
    BrokenForm.GABLE_DORMERS: {4, 6, 8},
    BrokenForm.SHED_DORMERS: {3, 4, 5},
    BrokenForm.HIPPED_DORMERS: {5, 8, 11},
    BrokenForm.PARAPET: {2},
    BrokenForm.PARAPET_GABLE: {6},
}


@pytest.fixture(scope="module", params=[1_000, 90_000])
def scene(request: pytest.FixtureRequest) -> Scene:
    return broken_slopes(request.param)


def of_form(scene: Scene, form: BrokenForm) -> list[Building]:
    return [one for one in scene.buildings if one.building_id.rpartition("-")[0] == form]


def test_there_are_four_of_each_form_with_its_faces(scene: Scene) -> None:
    assert set(FORMS) == set(BrokenForm)
    assert set(FORMS) <= set(ROOF_TYPES)
    for form in FORMS:
        found = of_form(scene, form)
        assert len(found) == OF_EACH
        assert {one.shape for one in found} == {form}
        if form in FACES:
            assert {len(one.faces) for one in found} <= FACES[form], form


def test_faces_lie_on_their_planes_and_close_a_solid(scene: Scene) -> None:
    for one in scene.buildings:
        for polygon, plane in zip(one.roof_polygons(), one.planes, strict=True):
            x, y, z = shapely.get_coordinates(polygon, include_z=True).T
            assert plane.a * x + plane.b * y + plane.c == pytest.approx(z, abs=1e-6)
        assert one.vertices[:, 2].min() >= one.eave_z_m - 1e-6
        assert len(truth_record(one, scene.origin).solids) == 1


def test_a_true_roof_has_the_name_of_its_form(scene: Scene) -> None:
    for one in scene.buildings:
        truth = truth_record(one, scene.origin)
        found = roof_type(truth.planes, truth.faces, truth.solids, RoofTypeSettings())
        assert found is ROOF_TYPES[BrokenForm(one.shape)], one.building_id


def test_slopes_break_by_six_to_thirty_degrees(scene: Scene) -> None:
    for form, least, most in (
        (BrokenForm.KICKED_HIP, 6.0, 20.0),
        (BrokenForm.KICKED_GABLE, 6.0, 20.0),
        (BrokenForm.GAMBREL, 9.0, 30.0),
        (BrokenForm.MANSARD, 9.0, 30.0),
    ):
        for one in of_form(scene, form):
            slopes = np.unique(np.round([plane.slope_deg for plane in one.planes], 3))
            assert len(slopes) == 2
            assert least <= np.ptp(slopes) <= most
