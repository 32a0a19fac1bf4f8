"""The judge of the suite `trust`: models by hand beside buildings by hand, and one scene from files to tables."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely
from roofs_by_hand import ORIGIN, flat, gable, model, rectangle, surface

from benchmarks.trust import Judged, counted, fitted_row, run_cell, table, write
from benchmarks.trust_judge import Judgement, Truth, top_of
from pipeline.model import RoofType
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.simulation.dataset import simulate
from pipeline.ruler.simulation.suites import SUITES
from pipeline.ruler.simulation.trust import CELLS

HOUSE = gable("house")
"""12 x 8 m, two faces."""


def judged(found: RoofModel, *buildings: RoofModel, tolerance_m: float = 0.2, lift_m: float = 0.0) -> Judgement:
    return Truth(buildings).judge(found, tolerance_m, lift_m)


def partly_right(share: float) -> RoofModel:
    """The house, right over a share of its length; the rest is a metre too high."""
    sides = [
        surface(rectangle(x0, y, x1, y + 4), (0.0, slope, level + up))
        for x0, x1, up in ((0, 12 * share, 0.0), (12 * share, 12, 1.0))
        for y, slope, level in ((0, 0.7, 4.0), (4, -0.7, 9.6))
    ]
    return model("found", RoofType.GABLE, sides)


def test_the_truth_itself_is_right() -> None:
    found = judged(HOUSE, HOUSE, flat("other", 40.0))
    assert (found.right, found.wrong_because, found.true_building) == (True, None, "house")
    assert (found.covered_share, found.share_under, found.share_of_building) == pytest.approx((1.0, 1.0, 1.0))
    assert found.true_area_m2 == pytest.approx(96.0)


@pytest.mark.parametrize(
    ("lift", "tolerance", "strips", "right"),
    [(0.15, 0.2, 0.0, True), (0.3, 0.2, 0.0, False), (0.3, 0.4, 0.0, True), (0.3, 0.2, 0.5, True),
     (-0.3, 0.2, 0.5, False), (0.9, 0.2, 0.5, False)],
)  # fmt: skip
def test_a_lifted_roof_is_wrong_beyond_the_tolerance_and_the_strips(
    lift: float, tolerance: float, strips: float, right: bool
) -> None:
    found = judged(gable("found", lift=lift), HOUSE, tolerance_m=tolerance, lift_m=strips)
    assert found.right == right
    assert found.wrong_because == (None if right else "roof_under_it")


def test_a_tree_is_not_a_building_whatever_stands_beside_it() -> None:
    crown = flat("found", 20.0)
    assert judged(crown).wrong_because == "not_a_building"
    assert judged(crown).true_building is None
    assert judged(crown, HOUSE).covered_share == 0.0
    # 40 % of a clump of 10 x 8 m over the end of the house
    over = judged(flat("found", 8.0, z=6.0), HOUSE)
    assert over.covered_share == pytest.approx(0.4)
    assert over.wrong_because == "not_a_building"


@pytest.mark.parametrize(("share", "right"), [(0.5, False), (0.65, False), (0.75, True)])
def test_a_roof_is_wrong_if_less_than_seventy_percent_of_it_are_near(share: float, right: bool) -> None:
    found = judged(partly_right(share), HOUSE)
    assert found.right == right
    assert found.share_under == pytest.approx(share, abs=0.02)
    assert found.share_of_building == pytest.approx(share, abs=0.02)


def test_a_level_face_through_a_slope_is_wrong() -> None:
    found = judged(flat("found", width=12.0, z=5.4), HOUSE)
    assert found.wrong_because == "roof_under_it"
    assert found.share_under == pytest.approx(0.2 / 1.4, abs=0.02)


def test_half_of_a_house_is_wrong_although_all_of_it_is_near() -> None:
    half = HOUSE.surfaces[0]
    found = judged(model("found", RoofType.PENT, [half]), HOUSE)
    assert found.share_under == pytest.approx(1.0)
    assert found.share_of_building == pytest.approx(0.5, abs=0.02)
    assert found.wrong_because == "roof_of_building"


def test_the_parts_of_a_divided_house_are_right_if_they_are_together() -> None:
    sides = [model(f"side {k}", RoofType.PENT, [face]) for k, face in enumerate(HOUSE.surfaces)]
    high = gable("high", lift=1.0)
    found = [Truth([HOUSE]).judge(one, 0.2, 0.0, top_of(sides)) for one in sides]
    assert [one.right for one in found] == [True, True]
    assert found[0].share_of_building == pytest.approx(0.5, abs=0.02)
    assert found[0].share_together == pytest.approx(1.0)
    beside = [sides[0], model("wrong side", RoofType.PENT, [high.surfaces[1]])]
    right, wrong = (Truth([HOUSE]).judge(one, 0.2, 0.0, top_of(beside)) for one in beside)
    assert (right.wrong_because, wrong.wrong_because) == ("roof_of_building", "roof_under_it")


def test_one_model_of_two_houses_that_touch_is_right() -> None:
    first, second = gable("first"), gable("second", 12.0)
    both = model("found", RoofType.GABLE, [*first.surfaces, *second.surfaces])
    found = judged(both, first, second)
    assert found.right
    assert found.true_building in {"first", "second"}


def test_buildings_without_models_and_rejected_ones_are_found() -> None:
    truth = Truth([HOUSE, flat("shed", 30.0, width=4.0, depth=4.0)])
    assert truth.without_model([HOUSE]) == ["shed"]
    assert truth.without_model([]) == ["house", "shed"]
    east, north = ORIGIN[:2]
    boxes = {
        "around the shed": (29.5, -0.5, 34.5, 4.5),
        "half of the house": (0.0, 0.0, 12.0, 3.0),
        "a wood around the shed": (20.0, -10.0, 45.0, 20.0),
        "a tree": (50.0, 0.0, 56.0, 6.0),
    }
    found = {
        name: truth.is_building(shapely.box(x0 + east, y0 + north, x1 + east, y1 + north))
        for name, (x0, y0, x1, y1) in boxes.items()
    }
    assert found == {
        "around the shed": True, "half of the house": False, "a wood around the shed": False, "a tree": False
    }  # fmt: skip
    assert not truth.is_building(None)
    assert not Truth([]).is_building(HOUSE.footprint)


def test_models_are_counted_by_any_status_and_failures_are_not_models() -> None:
    models = pa.table(
        {
            "status": ["ok", "ok", "doubtful", "fallback", "ok", "failed"],
            "right": [True, False, False, True, True, None],
        }
    )
    one = Judged(
        kind="houses", survey="d4_five", classes="ignore", draw=0, models=models,
        rejected=pa.table({"is_building": [True, False]}), buildings=7, without_model=2,
    )  # fmt: skip
    counts = counted([one, one])
    assert counts.right == {"ok": 4, "fallback": 2}
    assert counts.wrong == {"ok": 2, "doubtful": 2}
    assert (counts.wrong_ok, counts.right_not_ok) == (0.5, pytest.approx(1 / 3))
    assert (counts.buildings, counts.without_model, counts.rejected_buildings) == (14, 4, 2)
    heads, _, row = table({"houses": counts}).splitlines()
    cells = dict(zip(heads.split(" | "), row.split(" | "), strict=True))
    assert (cells["right, ok"], cells["wrong, doubtful"], cells["wrong that are ok"]) == ("4", "2", "50.0%")
    assert np.isnan(counted([]).wrong_ok)


def test_models_on_their_points_that_are_not_ok_are_counted_by_reason() -> None:
    records = [
        {"status": "ok", "reason": None, "share_within_0_2m": 0.95},
        {"status": "doubtful", "reason": "uncertain", "share_within_0_2m": 0.91},
        {"status": "doubtful", "reason": "poor_fit", "share_within_0_2m": 0.5},
        {"status": "fallback", "reason": "no_plane", "share_within_0_2m": 0.6},
        {"status": "failed", "reason": "no_footprint", "share_within_0_2m": None},
    ]
    assert fitted_row("run", records) == ["run", "4", "2", "1", "50.0%", "1 uncertain"]


@pytest.mark.slow
def test_a_scene_becomes_tables(tmp_path: Path) -> None:
    cell = next(one for one in CELLS if one.kind == "houses" and one.with_classes)
    simulate(dataclasses.replace(SUITES["trust"], cells=(cell,)), tmp_path, 1_000)
    runs = run_cell((cell, tmp_path / cell.key, 0, False))
    assert [one.classes for one in runs] == ["ignore", "trust"]
    text = write(runs, tmp_path, "dev")
    assert "## trust, by scene" in text
    rows = pq.read_table(tmp_path / "dev.parquet").to_pylist()
    assert len(rows) == sum(one.models.num_rows for one in runs) >= 8
    for row in rows:
        assert (row["right"] is None) == (row["lod"] is None)
        assert row["right"] is None or row["right"] == (row["wrong_because"] is None)
    assert sum(bool(row["right"]) for row in rows) >= 6
    assert "rmse_m" in rows[0]
    assert pq.read_table(tmp_path / "dev_rejected.parquet").column_names[:4] == ["scene", "survey", "classes", "draw"]
    both = json.loads((tmp_path / "dev.json").read_text())["all"]["all"]
    assert both["buildings"] == 2 * 8
    assert sum(both["right"].values()) + sum(both["wrong"].values()) == sum(row["right"] is not None for row in rows)


@pytest.mark.slow
def test_a_survey_in_feet_has_the_same_models_with_the_same_confidence(tmp_path: Path) -> None:
    cell = next(one for one in CELLS if one.key == "houses-d6_last")
    simulate(dataclasses.replace(SUITES["trust"], cells=(cell,)), tmp_path, 1_000)
    place = tmp_path / cell.key
    metres, feet = (run_cell((cell, place, 0, in_feet))[0] for in_feet in (False, True))
    assert (metres.survey, feet.survey) == ("d6_last", "d6_last_feet")
    found = [
        sorted((row["footprint_area_m2"], row["right"]) for row in one.models.to_pylist() if row["lod"])
        for one in (metres, feet)
    ]
    assert len(found[0]) >= 3
    assert np.allclose(*found, atol=1.0)
    confidence = [sorted(one.models.column("detection_confidence").to_pylist()) for one in (metres, feet)]
    assert np.allclose(*confidence, atol=0.02)
    assert all(
        not is_building for one in (metres, feet) for is_building in one.rejected.column("is_building").to_pylist()
    )
