"""The score is perfect for the truth, and known damage moves each measure as predicted."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import shapely

from pipeline.model import RoofType
from pipeline.report.roof_models import RoofModel, RoofSurface, joined_blocks
from pipeline.report.truth_score import (
    lattice_inside,
    match_footprints,
    matched_faces,
    score_against_truth,
)

ORIGIN = (1000.0, 2000.0, 0.0)


def gable(name: str, x: float = 0.0, *, slope: float = 0.7, lift: float = 0.0, edge: bool = False) -> RoofModel:
    """A gable of 12 x 8 m, eave at 4 m, its ridge along x in the middle of it."""
    sides = []
    for low, high, rise, level in ((0.0, 4.0, slope, 4.0), (4.0, 8.0, -slope, 4.0 + 8 * slope)):
        polygon = shapely.box(1000 + x, 2000 + low, 1012 + x, 2000 + high)
        sides.append(RoofSurface(polygon=polygon, coefficients=(0.0, rise, level + lift), origin=ORIGIN))
    footprint = shapely.box(1000 + x, 2000, 1012 + x, 2008)
    return RoofModel(
        building_id=name, footprint=footprint, roof_type=RoofType.GABLE, surfaces=tuple(sides), touches_data_edge=edge
    )


TRUTH = [gable("a"), gable("b", 20.0), gable("c", 40.0)]


def test_the_truth_scored_against_itself_is_perfect() -> None:
    score = score_against_truth(TRUTH, TRUTH)
    assert [one.building_id for one in score.buildings] == ["a", "b", "c"]
    for one in score.buildings:
        assert one.found
        assert one.type_right
        assert (one.iou, one.coverage, one.within_good, one.rmse_m) == (1.0, 1.0, 1.0, 0.0)
        assert one.true_faces == one.model_faces == one.matched_faces == 2
    assert score.false_alarms == score.unmatched == ()
    table = dict(score.table())
    assert table["buildings found (IoU >= 0.5)"] == table["roof type right"] == "3 of 3"
    assert table["roof faces >= 10 m2 found"] == "6 of 6"
    assert table["vertical difference, RMSE"] == "0.000 m"
    assert table["roof within 0.2 m, mean of all buildings"] == "100.0 %"
    assert score.confusion() == {(RoofType.GABLE, RoofType.GABLE): 3}


def test_a_dropped_building_is_missed_and_all_its_roof_too() -> None:
    score = score_against_truth([TRUTH[0], TRUTH[2]], TRUTH)
    assert [one.found for one in score.buildings] == [True, False, True]
    assert math.isnan(score.buildings[1].rmse_m)
    table = dict(score.table())
    assert table["buildings found (IoU >= 0.5)"] == "2 of 3"
    assert table["roof within 0.2 m, mean of all buildings"] == "66.7 %"
    assert score.confusion()[RoofType.GABLE, RoofType.NONE] == 1


def test_a_lifted_roof_is_off_by_the_lift() -> None:
    score = score_against_truth([gable("m", lift=0.3)], TRUTH[:1])
    (one,) = score.buildings
    assert one.median_m == pytest.approx(0.3)
    assert one.bias_m == pytest.approx(0.3)
    assert score.rmse_m == pytest.approx(0.3)
    assert one.within_good == 0.0
    assert one.matched_faces == 2  # 0.3 m upwards are 0.25 m across the plane


def test_a_flatter_roof_is_off_by_the_integral_over_it() -> None:
    (one,) = score_against_truth([gable("m", slope=0.6)], TRUTH[:1], sample_m=0.05).buildings
    assert one.rmse_m == pytest.approx(0.1 * 4.0 / math.sqrt(3), rel=0.01)
    assert one.bias_m == pytest.approx(-0.2, rel=0.01)
    assert one.within_good == pytest.approx(0.5, abs=0.02)


def test_a_turned_face_is_no_longer_found() -> None:
    true = gable("t").surfaces
    assert matched_faces(true, gable("m", slope=math.tan(math.atan(0.7) - math.radians(8.0))).surfaces) == 0  # too deep
    turned = [
        dataclasses.replace(true[0], coefficients=(rise, 0.7, 4.0 - 6.0 * rise))  # about the middle of the face
        for rise in (0.0, math.tan(math.radians(9.0)), math.tan(math.radians(16.0)))
    ]
    assert [matched_faces(true[:1], [face]) for face in turned] == [1, 1, 0]


def test_faces_match_one_to_one() -> None:
    true = gable("t").surfaces
    assert matched_faces(true, [true[0], true[0]]) == 1
    halves = [dataclasses.replace(true[0], polygon=shapely.box(1000 + x, 2000, 1006 + x, 2004)) for x in (0.0, 6.0)]
    assert matched_faces(true[:1], halves) == 1
    thirds = [
        dataclasses.replace(true[0], polygon=shapely.box(1000 + x, 2000, 1004 + x, 2004)) for x in (0.0, 4.0, 8.0)
    ]
    assert matched_faces(true[:1], thirds) == 0


def test_shrunk_footprints_cover_less_and_cannot_buy_a_better_score() -> None:
    whole = gable("m")
    shrunk = dataclasses.replace(
        whole,
        footprint=whole.footprint.buffer(-0.5, join_style="mitre"),
        surfaces=tuple(
            dataclasses.replace(s, polygon=s.polygon.intersection(whole.footprint.buffer(-0.5, join_style="mitre")))
            for s in whole.surfaces
        ),
    )
    (one,) = score_against_truth([shrunk], TRUTH[:1]).buildings
    share = 11.0 * 7.0 / 96.0
    assert one.iou == pytest.approx(share)
    assert one.coverage == pytest.approx(share, abs=0.01)
    assert one.within_good == pytest.approx(share, abs=0.01)
    assert one.rmse_m == 0.0


def test_models_beside_buildings_are_false_alarms_and_parts_of_one_are_not() -> None:
    tree = gable("tree", 200.0)
    half = dataclasses.replace(TRUTH[0], building_id="half", footprint=shapely.box(1000, 2000, 1005, 2008))
    score = score_against_truth([tree, half], TRUTH)
    assert score.false_alarms == ("tree",)
    assert score.unmatched == ("half",)
    assert not any(one.found for one in score.buildings)
    assert math.isnan(score.rmse_m)
    assert dict(score.table())["vertical difference, RMSE"] == "none"


def test_buildings_cut_by_the_end_of_the_data_do_not_count() -> None:
    truth = [TRUTH[0], gable("cut", 20.0, edge=True)]
    score = score_against_truth([TRUTH[0], gable("beyond", 300.0, edge=True)], truth)
    assert dict(score.table())["buildings found (IoU >= 0.5)"] == "1 of 1"
    assert score.false_alarms == ()


def test_each_model_stands_for_one_building_and_the_best_overlap_wins() -> None:
    true = [shapely.box(0, 0, 10, 10), shapely.box(30, 0, 40, 10)]
    models = [shapely.box(0, 0, 10, 7), shapely.box(0, 1, 10, 10), shapely.box(33, 0, 43, 10)]
    matches = match_footprints(models, true)
    assert {t: model for t, (model, _) in matches.items()} == {0: 1, 1: 2}
    assert [iou for _, iou in matches.values()] == pytest.approx([0.9, 7 / 13])
    assert match_footprints([], true) == {}
    assert match_footprints(models, []) == {}


def test_a_wrong_type_is_told_in_the_confusion() -> None:
    wrong = dataclasses.replace(TRUTH[0], roof_type=RoofType.HIP)
    score = score_against_truth([wrong], TRUTH[:1])
    assert score.confusion() == {(RoofType.GABLE, RoofType.HIP): 1}
    assert dict(score.table())["roof type right"] == "0 of 1"


def test_the_lattice_does_not_depend_on_the_footprint() -> None:
    x, _ = lattice_inside(shapely.box(0.1, 0.1, 3.9, 2.9), 0.5)
    assert len(x) == 8 * 6
    assert np.allclose((x / 0.5 - 0.5) % 1, 0)
    more, _ = lattice_inside(shapely.MultiPolygon([shapely.box(0, 0, 4, 3), shapely.box(10, 0, 11, 1)]), 0.5)
    assert len(more) == 48 + 4


def test_where_faces_overlap_the_upper_one_is_the_roof() -> None:
    low = gable("low")
    model = dataclasses.replace(low, surfaces=low.surfaces + gable("high", lift=2.0).surfaces)
    x, y = np.array([1001.0, 1005.0, 999.0]), np.array([2001.0, 2006.0, 2001.0])
    assert np.allclose(model.top(x, y)[:2], low.top(x, y)[:2] + 2.0)
    assert math.isnan(model.top(x, y)[2])


def test_no_models_at_all_score_nothing() -> None:
    score = score_against_truth([], TRUTH)
    assert dict(score.table())["buildings found (IoU >= 0.5)"] == "0 of 3"
    assert dict(score_against_truth(TRUTH, []).table())["models where no building is"] == "3"


def test_houses_of_a_row_become_one_block() -> None:
    row = [dataclasses.replace(gable(name, x), source_id="row") for name, x in (("a", 0.0), ("b", 12.0))]
    flat = dataclasses.replace(gable("c", 24.0, edge=True), roof_type=RoofType.FLAT, source_id="row")
    alone = gable("d", 80.0)
    block, single = joined_blocks([*row, alone])
    assert single is alone
    assert block.footprint.equals(shapely.box(1000, 2000, 1024, 2008))
    assert (block.building_id, block.roof_type, len(block.surfaces)) == ("a", RoofType.GABLE, 4)
    mixed, _ = joined_blocks([*row, flat, alone])
    assert mixed.roof_type is RoofType.COMBINATION
    assert mixed.touches_data_edge
    score = score_against_truth([block], row)
    assert [one.found for one in score.buildings] == [True, False]
    assert score_against_truth([block], [block]).buildings[0].type_right
