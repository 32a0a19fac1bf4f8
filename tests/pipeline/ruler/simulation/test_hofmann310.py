"""The 310 buildings have the figures of the paper for every seed: the slow tests draw two more."""

import dataclasses
import json
from collections import Counter
from pathlib import Path

import laspy
import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely

from pipeline.errors import SettingsError
from pipeline.model import RoofType
from pipeline.ruler.roof_families import family_of
from pipeline.ruler.simulation.als import scan_all
from pipeline.ruler.simulation.dataset import ScenePaths, simulate
from pipeline.ruler.simulation.hofmann310 import SCANNER, hofmann310
from pipeline.ruler.simulation.roofs import RoofShape
from pipeline.ruler.simulation.simulated_scene import Defect, FaultKind, Scene

SURVEY_DEFECTS = {Defect.STRIP_SHIFT, Defect.WRONG_ROWS}


@pytest.fixture(
    scope="module",
    params=[1_000, pytest.param(90_000, marks=pytest.mark.slow), pytest.param(5, marks=pytest.mark.slow)],
)
def scene(request: pytest.FixtureRequest) -> Scene:
    return hofmann310(request.param)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> ScenePaths:
    return simulate("hofmann310", tmp_path_factory.mktemp("hofmann310"), 1_001)


def test_as_many_of_each_roof_type_exist_and_are_good_as_in_the_papers_table(scene: Scene) -> None:
    counts = {RoofType.FLAT: 3, RoofType.PENT: 17, RoofType.GABLE: 239, RoofType.HIP: 18, RoofType.COMBINATION: 33}
    good = {RoofType.PENT: 13, RoofType.GABLE: 157, RoofType.HIP: 4, RoofType.COMBINATION: 23}
    assert Counter(family_of(one.roof_type) for one in scene.buildings) == counts
    assert Counter(family_of(one.roof_type) for one in scene.buildings if one.is_good) == good


def test_sixteen_per_cent_suffer_from_strips_or_rows(scene: Scene) -> None:
    hit = [one for one in scene.buildings if set(one.defects) & SURVEY_DEFECTS]
    assert round(len(hit) / 310, 2) == 0.16
    assert len(scene.survey_faults) == len(hit)


def test_three_gables_in_ten_have_two_pitches_and_half_of_the_hips_are_bent(scene: Scene) -> None:
    gables = [one for one in scene.buildings if one.roof_type is RoofType.GABLE]
    slopes = [sorted({round(plane.slope_deg, 6) for plane in one.planes}) for one in gables if one.is_good]
    assert all(25.0 <= slope <= 45.0 for pair in slopes for slope in pair)
    unequal = [pair for pair in slopes if len(pair) == 2]
    assert min(pair[1] - pair[0] for pair in unequal) >= 5.0
    assert sum(one.shape is RoofShape.UNEQUAL_GABLE for one in gables) / len(gables) == pytest.approx(0.3, abs=0.002)
    hips = [one for one in scene.buildings if one.roof_type is RoofType.HIP]
    bent = [one for one in hips if one.shape is RoofShape.BENT_HIP]
    assert len(bent) * 2 == len(hips)
    assert all(len(set(one.groups)) < len(one.groups) for one in bent)


def test_footprints_average_160_m2_and_no_side_is_shorter_than_4_m(scene: Scene) -> None:
    areas = np.array([one.footprint.area for one in scene.buildings])
    assert areas.mean() == pytest.approx(160.0, rel=0.02)
    logs = np.log(areas)
    assert abs(float(np.mean(((logs - logs.mean()) / logs.std()) ** 3))) < 0.2  # log-normal: no skew left
    assert min(min(one.dimensions.length_m, one.dimensions.width_m) for one in scene.buildings) >= 4.0


def test_every_building_has_free_ground_of_3_m_around_it(scene: Scene) -> None:
    outlines = [one.footprint for one in scene.buildings]
    index = shapely.STRtree(outlines)
    near, _ = index.query(outlines, predicate="dwithin", distance=2.999)
    assert len(near) == len(outlines)  # only itself
    for tree in scene.trees:
        close = index.query(shapely.Point(tree.x, tree.y), predicate="dwithin", distance=tree.crown_radius_m + 2.99)
        assert len(close) <= 1  # the one that it hangs over
        assert all(Defect.OVERHANGING_TREE in scene.buildings[k].defects for k in close)


def test_defects_are_really_there(scene: Scene) -> None:
    crowns = shapely.STRtree([shapely.Point(tree.x, tree.y).buffer(tree.crown_radius_m) for tree in scene.trees])
    bare = {RoofShape.GABLE: 2, RoofShape.UNEQUAL_GABLE: 2, RoofShape.HIP: 4, RoofShape.FLAT: 1, RoofShape.PENT: 1}
    for one in scene.buildings:
        assert bool(one.wet_spots) == (Defect.WET_SPOT in one.defects)
        if Defect.OVERHANGING_TREE in one.defects:
            assert len(crowns.query(one.footprint, predicate="intersects")) > 0
        stands = bool({Defect.DORMERS, Defect.SUPERSTRUCTURE} & set(one.defects))
        assert bool(one.dimensions.additions) == stands
        if one.shape in bare:
            assert (len(one.planes) > bare[one.shape]) == stands
        for spot in one.wet_spots:
            assert one.footprint.contains(shapely.Point(spot.x, spot.y))


def test_a_survey_fault_lies_over_its_own_building_only(scene: Scene) -> None:
    index = shapely.STRtree([one.footprint for one in scene.buildings])
    for fault in scene.survey_faults:
        (only,) = index.query(shapely.box(*fault.extent), predicate="intersects")
        assert set(scene.buildings[only].defects) & SURVEY_DEFECTS
        assert any(abs(part) > 0.05 for part in fault.shift)
        if fault.share < 1.0 or fault.kind is FaultKind.STRIP_SHIFT:
            assert shapely.box(*fault.extent).contains(scene.buildings[only].footprint)


def test_every_fault_of_the_survey_is_in_the_points(scene: Scene) -> None:
    """A building is not hard for a wrong row that missed it."""
    right = scan_all(dataclasses.replace(scene, survey_faults=()), SCANNER, 5)
    wrong = scan_all(scene, SCANNER, 5)
    moved = (right.points.xyz != wrong.points.xyz).any(axis=1)
    hit = np.bincount(wrong.building[moved & (wrong.building >= 0)], minlength=len(scene.buildings))
    for number, building in enumerate(scene.buildings):
        assert (hit[number] >= 3) == bool(set(building.defects) & SURVEY_DEFECTS), building.building_id


def test_no_building_stands_on_the_border_of_two_strips(scene: Scene) -> None:
    for one in scene.buildings:
        x = one.vertices[:, 0] / SCANNER.strip_spacing_m
        assert np.floor(x.min() - 0.02) == np.floor(x.max() + 0.02)


def test_the_ground_slopes_by_0_to_15_deg(scene: Scene) -> None:
    slopes = np.array([scene.terrain.slope_deg(one.x, one.y) for one in scene.buildings])
    assert slopes.max() < 15.0
    assert np.percentile(slopes, 95) > 9.0
    assert slopes.min() < 3.0


def test_points_are_1_2_m_apart_and_single_returns(made: ScenePaths) -> None:
    assert set(np.asarray(laspy.read(made.laz).number_of_returns).tolist()) == {1}
    west, south, east, north = json.loads((made.truth / "scene.json").read_text())["extent"]
    area = (east - west) * (north - south)
    assert np.sqrt(area / made.points) == pytest.approx(1.2, abs=0.03)


def test_the_data_set_marks_the_good_ones(made: ScenePaths) -> None:
    good = pq.read_table(made.truth / "conditions.parquet", columns=["good"])["good"].to_pylist()
    assert (sum(good), len(good)) == (197, 310)


def test_its_size_cannot_be_chosen(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="the size of hofmann310 follows from its buildings"):
        simulate("hofmann310", tmp_path, size_m=(100.0, 100.0))
