"""The scores of split scenes: counted by hand, and over a small city."""

import dataclasses
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import shapely
from roofs_by_hand import points_of

from benchmarks import scene_suites
from benchmarks.scene_scores import detection_score, footprint_score, is_whole, touching_united
from benchmarks.scene_suites import (
    FIGURES,
    SuiteScene,
    draw_scores,
    known_scores,
    measure_cities,
    suite_table,
    where_surveyed,
)
from benchmarks.scenes import PLOT, SCENES, fill_page, main, measure_real, real_tables, scenes_named
from pipeline.model import RoofType
from pipeline.ruler.evaluation.detection import DetectedObject, Detection, DetectionBlock
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reference import Reference, ReferencePoints
from pipeline.scene import BUILDING_CLASS
from pipeline.settings import RunSettings

PAGE = Path(__file__).resolve().parents[2] / "docs" / "results" / "scenes.md"


def model(name: str, footprint: shapely.Polygon) -> RoofModel:
    return RoofModel(building_id=name, footprint=footprint, roof_type=RoofType.UNKNOWN, surfaces=())


def reference_of(*footprints: shapely.Polygon, points: ReferencePoints | None = None) -> Reference:
    return Reference(
        name="by hand",
        kind="points",
        buildings=tuple(model(f"b{number}", footprint) for number, footprint in enumerate(footprints)),
        has_faces=False,
        outlines="given",
        tiles=() if points is None else (lambda: points,),
    )


def points_at(xy: np.ndarray, classes: np.ndarray) -> ReferencePoints:
    return points_of(np.column_stack((xy, np.zeros(len(xy)))), classes, "points")


def test_cells_add_up_over_blocks_and_objects_count_by_their_size_and_the_edge() -> None:
    block = DetectionBlock(
        row=0,
        column=0,
        both=30,
        reference=40,
        found=50,
        both_without_ring=9,
        reference_without_ring=10,
        found_without_ring=12,
    )
    objects = tuple(
        DetectedObject(name=str(k), building=k, area_m2=area, overlap=overlap, counts=counts)
        for k, (area, overlap, counts) in enumerate(((20.0, 0.6, True), (20.0, 0.4, True), (15.0, 0.0, True)))
    )
    cut = DetectedObject(name="cut", building=3, area_m2=90.0, overlap=1.0, counts=False)
    found = Detection(blocks=(block, block), buildings=(*objects, cut), models=(objects[0], cut), has_correctness=True)
    score = detection_score(found)
    assert (score.completeness, score.correctness) == (60 / 80, 60 / 100)
    assert (score.completeness_without_ring, score.correctness_without_ring) == (18 / 20, 18 / 24)
    assert (score.objects, score.object_completeness) == (2, 1 / 2)
    assert (score.models, score.object_correctness) == (1, 1.0)
    assert (score.objects_with_edge, score.object_completeness_with_edge) == (3, 2 / 3)


def test_footprints_that_nearly_touch_are_one_block_and_those_across_a_lane_are_two() -> None:
    houses = (shapely.box(0, 0, 10, 10), shapely.box(10.2, 0, 20, 10), shapely.box(21, 0, 30, 10))
    united = touching_united(reference_of(*houses))
    areas = sorted(building.footprint.area for building in united.buildings)
    assert areas == pytest.approx([90.0, 200.0], abs=1e-6)


def test_a_block_is_whole_where_no_building_points_lie_beside_it() -> None:
    places = np.array([(x, y) for x in np.arange(-5.0, 45.0, 0.5) for y in np.arange(-5.0, 15.0, 0.5)])
    inside = (places[:, 0] > 0) & (places[:, 0] < 20) & (places[:, 1] > 0) & (places[:, 1] < 10)
    alone = (places[:, 0] > 30) & (places[:, 0] < 40) & (places[:, 1] > 0) & (places[:, 1] < 10)
    points = points_at(places, np.where(inside | alone, BUILDING_CLASS, 1))
    blocks = [shapely.box(0, 0, 10, 10), shapely.box(30, 0, 40, 10)]
    assert is_whole(reference_of(*blocks, points=points), blocks) == [False, True]


def test_a_split_block_is_whole_again_for_its_iou_but_not_one_to_one() -> None:
    block = shapely.box(0, 0, 20, 10)
    halves = [model("a", shapely.box(0, 0, 8, 10)), model("b", shapely.box(8, 0, 22, 10))]
    score, rows = footprint_score(halves, reference_of(block), [True])
    assert score.iou == pytest.approx(200 / 220)
    assert score.iou_one_to_one == pytest.approx(120 / 220)
    assert (score.area_bias, score.area_bias_total) == pytest.approx((0.1, 0.1))
    assert score.offset_m == pytest.approx(2 * 20 / (60 + 64))
    assert (score.blocks, score.models, len(rows)) == (1, 2, 1)
    nothing, _ = footprint_score([], reference_of(block), [True])
    assert nothing.iou == 0.0
    assert math.isnan(nothing.area_bias)


def test_nothing_is_asked_for_where_the_survey_saw_nothing() -> None:
    places = np.array([(x, y) for x in np.arange(0.0, 100.0) for y in np.arange(0.0, 60.0)])
    wet = (np.abs(places[:, 0] - 50) < 6) & (np.abs(places[:, 1] - 30) < 6)
    points = points_at(places[~wet], np.ones(int((~wet).sum())))
    reference = reference_of(shapely.box(10, 10, 20, 20), shapely.box(10, 50, 20, 70), points=points)
    cut = where_surveyed(dataclasses.replace(reference, extent=shapely.box(0, 0, 100, 100)))
    assert [building.touches_data_edge for building in cut.buildings] == [False, True]
    assert cut.extent.bounds == pytest.approx((4, 4, 96, 56), abs=1e-6)
    assert cut.extent.area == pytest.approx(92 * 52)  # no hole where the roof was wet


@pytest.mark.slow
def test_a_small_city_is_found_measured_and_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_suites, "SIZE_M", (130.0, 110.0))
    monkeypatch.setattr(scene_suites, "PICTURED", ((20.0, 2.0),))
    scene = SuiteScene(slope_deg=20.0, density_per_m2=2.0)
    reported: list[str] = []
    (score,) = measure_cities([scene], "dev", tmp_path, 0, reported.append)
    assert score.detection.objects > 3
    assert score.detection.completeness_without_ring > 0.8
    assert score.detection.correctness_without_ring > 0.9
    assert score.ground.total < 0.05
    assert score.points > 20_000
    record = json.loads((tmp_path / "dev" / f"{scene.key}.json").read_text())
    assert record["detection"]["objects"] == score.detection.objects
    assert reported[0].startswith(scene.key)
    other = SuiteScene(slope_deg=10.0, density_per_m2=2.0)
    assert known_scores("dev", tmp_path, [other, scene]) == [score]
    draw_scores([score], tmp_path / "plot.png")
    for picture in (tmp_path / "plot.png", tmp_path / "dev" / f"{scene.key}.png"):
        assert picture.stat().st_size > 10_000
    table = suite_table([score], "object_completeness")
    assert f"| 20 deg | {score.detection.object_completeness:.3f} |" in table


def test_every_figure_of_the_suites_has_a_label_of_its_own() -> None:
    assert len({label for label, _ in FIGURES.values()}) == len(FIGURES) == 12


def test_scenes_have_names_of_their_own_and_strangers_are_named() -> None:
    assert len({scene.name for scene in SCENES}) == len(SCENES)
    assert all(scene.has_buildings for scene in scenes_named([]))
    with pytest.raises(SystemExit, match="atlantis"):
        list(scenes_named(["atlantis"]))


def test_absent_data_are_reported_and_nothing_is_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["real", "--out", str(tmp_path), "--data", str(tmp_path / "nowhere"), "--tiles", "hdf"]) == 1
    assert "hdf: ign/hdf_870000_6617100.laz is not in" in capsys.readouterr().err


def test_the_four_houses_of_a_real_tile_are_found_without_its_classes(shared_data: Path) -> None:
    (scene,) = scenes_named(["hdf"])
    result = measure_real(scene, shared_data, RunSettings.from_mapping({"classes": "ignore"}))
    assert (result.score.objects, result.score.object_completeness) == (3, 1.0)
    assert result.score.completeness_without_ring > 0.9
    assert result.unclassified_covered > 0.25  # the box around the house is larger than the house
    assert "| hdf | " in real_tables([result])


def test_the_page_has_a_part_for_everything_that_is_measured_and_is_filled(tmp_path: Path) -> None:
    text = PAGE.read_text()
    parts = {"real.md", "scenes.md", "speed.md", "large.md"}
    assert set(re.findall(r"<!-- begin (\S+) -->", text)) == set(re.findall(r"<!-- end (\S+) -->", text)) == parts
    page = tmp_path / "docs" / "page.md"
    page.parent.mkdir()
    page.write_text("<!-- begin real.md -->\nold\n<!-- end real.md -->\n")
    (tmp_path / "real.md").write_text("new\n")
    (tmp_path / PLOT).write_bytes(b"plot")
    fill_page(page, tmp_path)
    assert page.read_text() == "<!-- begin real.md -->\n\nnew\n\n<!-- end real.md -->\n"
    assert (page.parent / "pictures" / PLOT).read_bytes() == b"plot"
