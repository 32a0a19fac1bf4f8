"""LoD2.3 beside LoD2.2: from points, from settings, beyond a given footprint; why a building has none."""

import dataclasses

import numpy as np
import pytest
import shapely
from candidates_by_hand import candidate

from pipeline.errors import SettingsError
from pipeline.extras.lods.overhangs import UndrawableError, floor_m2
from pipeline.methods import OVERHANGS, ReconstructSettings
from pipeline.model import BuildingResult, Candidate, FaceKind, FloatArray, NoOverhang, Outcome, OverhangSource, Solid
from pipeline.quality.validity import check_solid
from pipeline.recipe import reconstruct_building
from pipeline.roof.roof_settings import RoofSettings
from pipeline.settings import RunSettings

EAVES = shapely.box(0.0, 0.0, 12.0, 8.0)


def roof() -> FloatArray:
    """A gable over the eaves, from 5 m to 7.8 m."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0.2, 12.0, 0.4), np.arange(0.2, 8.0, 0.4)))
    return np.column_stack((x, y, 5.0 + 0.7 * np.minimum(y, 8.0 - y)))


def street() -> FloatArray:
    """Ground around the eaves."""
    xy = np.random.default_rng(9).uniform((-2.0, -2.0), (14.0, 10.0), (1500, 2))
    xy = xy[~shapely.contains_xy(EAVES, xy[:, 0], xy[:, 1])]
    return np.column_stack((xy, np.zeros(len(xy))))


def southern_wall(overhang_m: float) -> FloatArray:
    random = np.random.default_rng(3)
    off = overhang_m + random.normal(0.0, 0.03, 60)
    return np.column_stack((random.uniform(0.5, 11.5, 60), off, random.uniform(0.0, 4.4, 60)))


def house(*beside: FloatArray, footprint: shapely.Polygon | None = None) -> Candidate:
    made = candidate(roof(), footprint=footprint)
    return dataclasses.replace(made, ground_z_m=0.0, beside=np.concatenate((street(), *beside)))


def modelled(building: Candidate, **roof_settings: float) -> BuildingResult:
    settings = ReconstructSettings(roof=RoofSettings(**roof_settings), lods=("2.2", OVERHANGS))
    return reconstruct_building(building, "arrangement", settings)


def area(solid: Solid, kind: FaceKind) -> float:
    """Plan area of the faces of a kind, without holes."""
    return sum(shapely.Polygon(solid.vertices[list(f.rings[0]), :2]).area for f in solid.faces if f.kind is kind)


def test_walls_that_points_show_carry_the_roof_and_lod22_stays_as_it_is() -> None:
    result = modelled(house(southern_wall(0.5)))
    alone = reconstruct_building(house(southern_wall(0.5)), "arrangement", ReconstructSettings())
    assert result.overhangs is not None
    assert (result.overhangs.source, result.overhangs.reason) == (OverhangSource.SEEN, None)
    (solid,) = result.overhangs.solids
    assert check_solid(solid) == ()
    assert floor_m2(solid) == pytest.approx(11.0 * 7.0, rel=0.03)
    assert area(solid, FaceKind.CEILING) == pytest.approx(area(solid, FaceKind.ROOF) - floor_m2(solid), abs=0.01)
    assert {f.plane for f in solid.faces if f.kind is FaceKind.ROOF} == set(range(len(result.planes)))
    for field in ("solids", "planes", "faces", "rmse_m", "lod"):
        assert repr(getattr(result, field)) == repr(getattr(alone, field))
    assert alone.overhangs is None
    assert [(d.name, d.outcome) for d in result.decisions][-1] == (OVERHANGS, Outcome.CHOSEN)


def test_a_usual_overhang_is_for_buildings_whose_walls_are_not_seen() -> None:
    usual = modelled(house(), usual_overhang_m=0.4).overhangs
    assert usual is not None
    assert usual.source is OverhangSource.USUAL
    assert floor_m2(usual.solids[0]) == pytest.approx(11.2 * 7.2, rel=0.03)
    seen = modelled(house(southern_wall(0.6)), usual_overhang_m=0.3).overhangs
    assert seen is not None
    assert seen.source is OverhangSource.SEEN
    assert floor_m2(seen.solids[0]) == pytest.approx(10.8 * 6.8, rel=0.03)


def test_a_roof_reaches_beyond_a_given_footprint_as_far_as_the_settings_say() -> None:
    result = modelled(house(footprint=EAVES), beyond_footprint_m=0.4)
    assert result.overhangs is not None
    assert result.overhangs.source is OverhangSource.GIVEN
    (solid,) = result.overhangs.solids
    assert floor_m2(solid) == pytest.approx(96.0, abs=0.01)
    assert area(solid, FaceKind.ROOF) == pytest.approx(12.8 * 8.8, abs=0.1)
    # the eaves are lower than the top of the walls beneath them
    assert solid.vertices[solid.vertices[:, 2] > 0.5, 2].min() == pytest.approx(5.0 - 0.7 * 0.4 - 0.2, abs=0.05)


@pytest.mark.parametrize(
    ("building", "changes", "reason"),
    [
        (house(), {}, NoOverhang.NO_WALL_SEEN),
        (house(southern_wall(0.14)), {}, NoOverhang.OVERHANG_TOO_SMALL),
        (house(footprint=EAVES), {}, NoOverhang.FOOTPRINT_GIVEN),
        (house(footprint=EAVES), {"beyond_footprint_m": 0.1}, NoOverhang.OVERHANG_TOO_SMALL),
        (dataclasses.replace(house(), beside=np.zeros((0, 3))), {"usual_overhang_m": 0.4}, NoOverhang.NO_OPEN_GROUND),
    ],
)
def test_a_building_without_overhangs_has_a_reason(
    building: Candidate, changes: dict[str, float], reason: NoOverhang
) -> None:
    result = modelled(building, **changes)
    assert result.overhangs is not None
    assert (result.lod, result.overhangs.solids, result.overhangs.source) == ("2.2", (), None)
    assert result.overhangs.reason is reason
    assert result.decisions[-1].outcome is Outcome.UNDRAWABLE
    assert result.decisions[-1].detail.startswith(f"{reason}: ")


def test_overhangs_that_cannot_be_drawn_leave_lod22(monkeypatch: pytest.MonkeyPatch) -> None:
    def undrawable(*_: object) -> list[Solid]:
        raise UndrawableError(NoOverhang.INVALID_SOLID, "no form")

    monkeypatch.setattr("pipeline.extras.lods.overhang_model.overhanging_solids", undrawable)
    result = modelled(house(southern_wall(0.5)))
    assert (result.status, result.lod, len(result.solids)) == ("ok", "2.2", 1)
    assert result.overhangs is not None
    assert result.overhangs.reason is NoOverhang.INVALID_SOLID


def test_a_block_has_no_overhangs() -> None:
    scattered = np.random.default_rng(1).uniform((0, 0, 3), (12, 8, 9), (400, 3))
    result = modelled(candidate(scattered))
    if result.lod == "1.2":
        assert result.overhangs is not None
        assert result.overhangs.reason is NoOverhang.NO_LOD22


def test_lod23_brings_lod22_and_looks_for_walls() -> None:
    chosen = RunSettings.from_mapping({"lods": "1.2,2.3"}).building
    assert (chosen.lods, chosen.record_lods, chosen.further_lods) == (
        ("1.2", "2.2", "2.3"), ("1.2", "2.2"), ("1.2", "2.3"),
    )  # fmt: skip
    assert chosen.roof.finds_walls
    assert not chosen.roof.needs_facades(is_drawn=True, is_given=True)
    without = RunSettings.from_mapping({}).building
    assert (without.further_lods, without.roof.finds_walls) == ((), False)


@pytest.mark.parametrize("change", [{"outline": "walls"}, {"straight_eaves": False}])
def test_lod23_needs_outlines_at_straight_eaves(change: dict[str, object]) -> None:
    with pytest.raises(SettingsError, match=f"lods has 2.3, and {next(iter(change))} is"):
        RunSettings.from_mapping({"lods": "2.2,2.3", "roof": change})


def test_settings_of_overhangs_count_in_the_hash_only_where_they_are_set() -> None:
    usual = RunSettings.from_mapping({})
    names = ("min_overhang_m", "overhang_thickness_m", "beyond_footprint_m")
    fields = {name: getattr(usual.building.roof, name) for name in names}
    assert RunSettings.from_mapping({"roof": fields}).settings_hash == usual.settings_hash
    for name in names:
        assert RunSettings.from_mapping({"roof": {name: 0.33}}).settings_hash != usual.settings_hash
