"""Levels of detail on request: the finest is the record's, others come with it, a requested block is not a fault."""

import dataclasses

import numpy as np
import pytest
import shapely
from candidates_by_hand import candidate
from method_by_hand import MethodByHand

from pipeline.errors import SettingsError
from pipeline.extras.lods.main_roof import main_planes
from pipeline.methods import LODS, ReconstructSettings
from pipeline.model import (
    BuildingResult,
    Candidate,
    Doubt,
    Plane,
    PreparedCloud,
    Reason,
    RoofFace,
    RoofType,
    Segmentation,
    Status,
)
from pipeline.parameters import Parameters
from pipeline.quality.validity import check_solid
from pipeline.recipe import reconstruct_building
from pipeline.settings import RunSettings


def house(n: int = 2_400, seed: int = 0) -> Candidate:
    """A gable of 12 m by 8 m with the eaves at 5 m, and a flat annexe of 5 m by 8 m at 2.6 m."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, 17, n), rng.uniform(0, 8, n)
    z = np.where(x < 12.0, 5.0 + 0.7 * np.minimum(y, 8.0 - y), 2.6) + rng.normal(0, 0.02, n)
    return candidate(np.column_stack((x, y, z)), footprint=shapely.box(0, 0, 17, 8))


@pytest.fixture
def planeless(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes a method of the name `planeless`, which finds no plane."""

    def segment(cloud: PreparedCloud, _: Parameters) -> Segmentation:
        return Segmentation(planes=(), labels=np.full(len(cloud.points), -1, np.int32))

    method = MethodByHand(name="planeless", segment=segment)
    monkeypatch.setattr("pipeline.recipe.method_named", lambda _: method)


def modelled(candidate: Candidate, *lods: str, method: str = "arrangement") -> BuildingResult:
    return reconstruct_building(candidate, method, ReconstructSettings(lods=lods))


def vertices(result: BuildingResult) -> dict[str, list[bytes]]:
    """The solids of every level of detail."""
    models = {result.lod: result.solids, **{model.lod: model.solids for model in result.coarser}}
    return {lod: [solid.vertices.tobytes() for solid in solids] for lod, solids in models.items()}


@pytest.mark.parametrize("method", ["arrangement", "fuzzy-sart"])
def test_the_finest_is_the_record_and_the_others_stand_beside_it(method: str) -> None:
    result = modelled(house(), *LODS, method=method)
    assert (result.status, result.lod, result.roof_type) == (Status.OK, "2.2", RoofType.GABLE)
    assert [model.lod for model in result.coarser] == ["2.0", "1.3", "1.2"]
    main, levels, block = result.coarser
    assert main.planes == result.planes
    assert sorted(plane.c for plane in levels.planes) == pytest.approx([2.6, 5.0 + 0.7 * 0.7 * 4.0], abs=0.1)
    assert [len(block.planes), len(block.solids), len(levels.solids)] == [1, 1, 1]
    assert [check_solid(solid) for model in result.coarser for solid in model.solids] == [(), (), ()]
    alone = modelled(house(), "2.2", method=method)
    assert dataclasses.replace(result, coarser=()).rmse_m == alone.rmse_m
    assert vertices(result)["2.2"] == vertices(alone)["2.2"]


@pytest.mark.parametrize(
    "asked", [("1.2",), ("1.3",), ("2.0",), ("1.2", "1.3"), ("1.3", "2.0"), ("2.0", "2.2"), ("1.2", "2.2")]
)
def test_a_level_is_the_same_whatever_stands_beside_it(asked: tuple[str, ...]) -> None:
    everything = vertices(modelled(house(), *LODS))
    result = modelled(house(), *asked)
    assert (result.status, result.reason, result.lod) == (Status.OK, None, asked[-1])
    assert vertices(result) == {lod: everything[lod] for lod in asked}
    assert result.roof_type is RoofType.GABLE


def test_figures_are_those_of_the_finest_level() -> None:
    detailed, levels, block = (modelled(house(), lod) for lod in ("2.2", "1.3", "1.2"))
    assert 2.0 * detailed.rmse_m < levels.rmse_m < 1.2 < block.rmse_m
    assert [len(result.planes) for result in (levels, block)] == [2, 1]
    assert levels.coverage == block.coverage == 1.0


@pytest.mark.usefixtures("planeless")
def test_a_block_that_was_asked_for_is_no_fallback() -> None:
    result = modelled(house(), "1.2", method="planeless")
    assert (result.status, result.reason, result.lod) == (Status.OK, None, "1.2")
    assert check_solid(result.solids[0]) == ()


@pytest.mark.usefixtures("planeless")
@pytest.mark.parametrize("asked", [("2.2",), LODS, ("1.3",), ("1.2", "1.3")])
def test_a_fallback_is_a_block_and_nothing_stands_beside_it(asked: tuple[str, ...]) -> None:
    result = modelled(house(), *asked, method="planeless")
    assert (result.status, result.reason, result.lod) == (Status.FALLBACK, Reason.NO_PLANE, "1.2")
    assert result.coarser == ()
    assert vertices(result) == vertices(modelled(house(), "1.2", method="planeless"))


def test_settings_name_the_levels_and_change_the_hash() -> None:
    assert RunSettings.from_mapping({}).building.lods == ("2.2",)
    some = RunSettings.from_mapping({"lods": "1.2,2.2"})
    assert some.building.lods == ("1.2", "2.2")
    assert some.settings_hash != RunSettings.from_mapping({}).settings_hash
    with pytest.raises(SettingsError, match=r"lods is '2\.2,1\.2': use one of 1\.2, 1\.3, 2\.0, 2\.2, 2\.3, 1\.2,1\.3"):
        RunSettings.from_mapping({"lods": "2.2,1.2"})


def test_boxes_need_the_level_that_shows_them() -> None:
    with pytest.raises(SettingsError, match=r"superstructures is true, and lods has no 2\.2"):
        RunSettings.from_mapping({"lods": "1.3,2.0", "roof": {"superstructures": True}})
    assert RunSettings.from_mapping(
        {"lods": "2.0,2.2", "roof": {"superstructures": True}}
    ).building.roof.superstructures


@pytest.mark.parametrize(("lod", "status"), [("2.2", Status.DOUBTFUL), ("2.0", Status.DOUBTFUL), ("1.3", Status.OK)])
def test_slopes_that_points_do_not_support_are_doubtful_without_dormers_too(
    monkeypatch: pytest.MonkeyPatch, lod: str, status: Status
) -> None:
    doubt = Doubt.of(Reason.POOR_FIT, "on purpose", "share_within", 0.1, 0.7)
    monkeypatch.setattr("pipeline.building.form_search.doubt_of", lambda *_: doubt)
    assert modelled(house(), lod).status is status


@pytest.mark.parametrize(("top_m", "main"), [(8.5, [0, 0]), (36.0, [0, 1])])
def test_a_tower_is_no_dormer(top_m: float, main: list[int]) -> None:
    levels = (6.0, top_m)
    tower = shapely.box(4, 4, 12, 12)
    shapes = (shapely.box(0, 0, 20, 20).difference(tower), tower)
    faces = [RoofFace(plane=k, polygon=shapely.force_3d(shape, levels[k])) for k, shape in enumerate(shapes)]
    planes = [Plane(a=0.0, b=0.0, c=level, n_points=9, rmse_m=0.0) for level in levels]
    assert main_planes(faces, planes, {(0, 1): 32_000.0}) == main


def test_the_main_roof_has_no_dormer_and_its_planes_are_those_of_the_record() -> None:
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0, 12, 3_000), rng.uniform(0, 8, 3_000)
    z = 5.0 + 0.7 * np.minimum(y, 8.0 - y)
    dormer = (x > 4.0) & (x < 6.5) & (y > 1.0) & (y < 3.0)
    z = np.where(dormer, 7.4, z) + rng.normal(0, 0.02, 3_000)
    one = candidate(np.column_stack((x, y, z)), footprint=shapely.box(0, 0, 12, 8))
    both = modelled(one, "2.0", "2.2")
    assert len(both.planes) == 3
    (main,) = both.coarser
    assert main.planes == both.planes
    roofs = {face.plane for solid in main.solids for face in solid.faces if face.plane >= 0}
    assert sorted(both.planes[k].slope_deg for k in roofs) == pytest.approx([35.0, 35.0], abs=0.5)
    alone = modelled(one, "2.0")
    assert (alone.lod, len(alone.planes), alone.roof_type) == ("2.0", 2, RoofType.GABLE)
    assert alone.boxes is None
