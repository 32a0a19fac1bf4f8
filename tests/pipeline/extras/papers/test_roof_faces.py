"""Which methods arrange their roof faces, and what that changes."""

import math

import numpy as np
import pytest
import shapely
from candidates_by_hand import candidate

from pipeline.errors import SettingsError
from pipeline.extras.papers.paper_settings import RoofFaceSettings
from pipeline.methods import METHODS, ReconstructSettings, method_named
from pipeline.model import BuildingResult, Candidate, RoofType, Status
from pipeline.recipe import reconstruct_building
from pipeline.settings import RunSettings

OF_PAPERS = [name for name, entry in METHODS.items() if entry.follows_paper]
OUTLINE = shapely.box(0.0, 0.0, 12.0, 8.0)


def hip(n: int) -> Candidate:
    """Points on a hip roof of 40 % all around, its ridge at 4.6 m."""
    rng = np.random.default_rng(2)
    x, y = rng.uniform((0.0, 0.0), (12.0, 8.0), (n, 2)).T
    z = 3.0 + 0.4 * np.minimum(np.minimum(x, 12.0 - x), np.minimum(y, 8.0 - y))
    return candidate(np.column_stack((x, y, z + rng.normal(0.0, 0.02, n))), footprint=OUTLINE)


def modelled(name: str, faces: str, one: Candidate) -> BuildingResult:
    settings = RunSettings.from_mapping({"method": name, name: {"faces": faces}})
    return reconstruct_building(one, name, settings.building)


@pytest.mark.parametrize("name", OF_PAPERS)
def test_the_robust_preset_arranges_and_the_faithful_one_traces(name: str) -> None:
    entry = method_named(name)
    assert issubclass(entry.settings_type, RoofFaceSettings)
    assert ReconstructSettings().arranges(entry)
    assert ReconstructSettings(method=entry.preset("robust")).arranges(entry)
    assert not ReconstructSettings(method=entry.preset("faithful")).arranges(entry)


def test_the_arrangement_has_no_such_choice() -> None:
    assert ReconstructSettings().arranges(method_named("arrangement"))
    for table in ("arrangement", "roof"):
        with pytest.raises(SettingsError, match=rf"\[{table}\] faces is not a setting"):
            RunSettings.from_mapping({table: {"faces": "traced"}})


def test_settings_of_another_method_tell_nothing_of_this_one() -> None:
    other = ReconstructSettings(method=METHODS["kmeans"].settings_type())
    with pytest.raises(SettingsError, match="KMeansSettings: use FuzzySartSettings"):
        other.arranges(method_named("fuzzy-sart"))


@pytest.mark.parametrize("name", OF_PAPERS)
def test_arranged_ridges_and_hips_meet_in_one_point(name: str) -> None:
    one = hip(900)
    for faces in ("arranged", "traced"):
        result = modelled(name, faces, one)
        assert (result.status, result.roof_type) == (Status.OK, RoofType.HIP)
        corners = {tuple(xy) for face in result.faces for xy in shapely.get_coordinates(face.polygon).tolist()}
        inner = [xy for xy in corners if OUTLINE.boundary.distance(shapely.Point(xy)) > 0.1]
        if faces == "arranged":
            assert len(inner) == 2
            for (x, y), ridge_x in zip(sorted(inner), (4.0, 8.0), strict=True):
                assert math.hypot(x - ridge_x, y - 4.0) < 0.3


@pytest.mark.parametrize("name", OF_PAPERS)
def test_where_no_plane_is_found_a_simple_shape_stands_in_only_for_arranged_faces(name: str) -> None:
    points = [(1, 1, 3.0), (11, 1, 2.98), (2, 7, 3.01), (7, 6, 3.0), (11, 7, 2.99)]
    one = candidate(points, footprint=OUTLINE)
    arranged, traced = (modelled(name, faces, one) for faces in ("arranged", "traced"))
    assert (arranged.status, arranged.lod, arranged.roof_type) == (Status.OK, "2.2", RoofType.FLAT)
    assert (traced.status, traced.lod) == (Status.FALLBACK, "1.2")
