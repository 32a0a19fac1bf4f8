"""The form of outlines whose figures are known by hand."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from epochs_by_hand import ORIGIN as PLACE
from epochs_by_hand import house, write_epoch
from roofs_by_hand import ORIGIN, flat, gable, model, moved, rectangle, surface, values
from shapely import affinity

from pipeline.errors import InputError
from pipeline.model import RoofType
from pipeline.ruler.evaluation.evaluate import evaluate
from pipeline.ruler.evaluation.evaluate_files import EvaluationRequest, evaluate_files
from pipeline.ruler.evaluation.form_scores import measures, score_form
from pipeline.ruler.evaluation.models import ModelSet, RoofModel

Ring = Sequence[tuple[float, float]]


def shed(name: str, ring: Ring, z: float = 6.0) -> RoofModel:
    """A flat roof over a ring."""
    return model(name, RoofType.FLAT, [surface(ring, (0.0, 0.0, z))])


def drawn(ring: Ring) -> shapely.Polygon:
    return affinity.translate(shapely.Polygon(ring), ORIGIN[0], ORIGIN[1])


def form(models: Sequence[RoofModel], outlines: Sequence[shapely.Geometry] = ()) -> dict[str, float]:
    return values(measures(score_form(models, outlines)))


def denominators(models: Sequence[RoofModel], outlines: Sequence[shapely.Geometry] = ()) -> dict[str, int]:
    return {one.name.removeprefix("form."): one.n for one in measures(score_form(models, outlines))}


L_SHAPE = [(0, 0), (14, 0), (14, 6), (6, 6), (6, 12), (0, 12)]


@pytest.mark.parametrize("ring", [rectangle(0, 0, 10, 8), L_SHAPE])
@pytest.mark.parametrize("turn_deg", [0.0, 27.0, 88.0])
def test_right_angles_are_regular_in_every_direction(ring: Ring, turn_deg: float) -> None:
    found = form([moved(shed("a", ring), 0.0, 0.0, 0.0, turn_deg)])
    assert {name: value for name, value in found.items() if not name.startswith(("inner_", "wall_"))} == pytest.approx(
        {
            "two_directions": 1.0,
            "right_corners": 1.0,
            "acute_outlines": 0.0,
            "short_edges": 0.0,
            "triangles": 0.0,
            "corners": float(len(ring)),
        }
    )


def test_a_triangle_of_3_4_and_5_metres() -> None:
    found = form([shed("a", [(0, 0), (4, 0), (0, 3)])])
    assert found["two_directions"] == pytest.approx(7.0 / 12.0)  # the legs; the longest side alone has 5 m
    assert found["right_corners"] == pytest.approx(1.0 / 3.0)
    assert (found["acute_outlines"], found["triangles"], found["corners"]) == (1.0, 1.0, 3.0)


def test_a_spike_is_acute_whether_it_points_out_or_in() -> None:
    out = [(0, 0), (10, 0), (10, 4), (15, 4.5), (10, 5), (10, 8), (0, 8)]
    inwards = [(x if x <= 10 else 20 - x, y) for x, y in out]
    for ring in (out, inwards):
        assert form([shed("a", ring)])["acute_outlines"] == 1.0
    assert form([shed("a", rectangle(0, 0, 10, 8)), shed("b", [(x + 50, y) for x, y in out])])["acute_outlines"] == 0.5


def test_short_edges_count_per_100_m_and_corners_on_a_straight_edge_do_not() -> None:
    notch = [(0, 0), (10, 0), (10, 9.5), (9.5, 9.5), (9.5, 10), (0, 10)]
    found = form([shed("a", notch)])
    assert (found["short_edges"], found["corners"]) == (pytest.approx(5.0), 6.0)
    dent = [(0, 0), (5, 0.04), (10, 0), (10, 10), (0, 10)]
    assert form([shed("a", dent)])["corners"] == 4.0


def test_all_parts_and_all_models_count_by_length() -> None:
    slanted = [(0, 0), (10, 0), (10, 10), (0, 10 - 10 * math.tan(math.radians(20)))]
    left = 10 - 10 * math.tan(math.radians(20))
    oblique = 10 / math.cos(math.radians(20))
    found = form([shed("a", slanted), shed("b", rectangle(50, 0, 60, 10))])
    assert found["two_directions"] == pytest.approx((20 + left + 40) / (20 + left + oblique + 40))
    assert found["right_corners"] == 6 / 8


def test_a_common_wall_of_two_houses() -> None:
    pair = [shed("a", rectangle(0, 0, 10, 8)), shed("b", rectangle(10, 0, 20, 8))]
    found = form(pair)
    assert (found["inner_short_edges"], found["inner_two_directions"]) == (0.0, 1.0)
    assert denominators(pair)["inner_two_directions"] == denominators(pair)["wall_two_directions"] == 8
    assert denominators([pair[0], shed("b", rectangle(12, 0, 20, 8))])["inner_two_directions"] == 0


def test_a_wall_that_others_meet_is_one_piece() -> None:
    row = [
        shed("a", rectangle(0, 0, 10, 8)),
        shed("b", rectangle(10, 0, 20, 0.6)),
        shed("c", rectangle(10, 0.6, 20, 8)),
    ]
    assert form(row)["inner_short_edges"] == 0.0
    assert denominators(row)["inner_short_edges"] == 18  # 8 m, and 10 m between b and c


def test_a_wall_in_steps_and_a_slanted_wall() -> None:
    steps = [(10 + (k + 1) // 2 * 0.5, k // 2 * 0.5) for k in range(5)]  # four edges of 0.5 m
    left = shed("a", [(0, 0), *steps, (11, 8), (0, 8)])
    right = shed("b", [(20, 0), (20, 8), (11, 8), *reversed(steps)])
    found = form([left, right])
    assert denominators([left, right])["inner_short_edges"] == 9  # 2 m in steps and 7 m
    assert found["inner_short_edges"] == pytest.approx(100.0 * 3 / 9.0)  # the last goes on straight
    assert found["inner_two_directions"] == 1.0
    slant = [shed("a", [(0, 0), (8, 0), (12, 8), (0, 8)]), shed("b", [(8, 0), (20, 0), (20, 8), (12, 8)])]
    assert form(slant)["inner_two_directions"] == 0.0


def test_steps_are_inner_edges_and_ridges_are_not() -> None:
    def halves(rise: float) -> list[RoofModel]:
        left, right = (surface(rectangle(x, 0, x + 5, 8), (0.0, 0.0, 6.0 + x / 5 * rise), int(x)) for x in (0, 5))
        return [model("a", RoofType.FLAT, [left, right])]

    assert denominators(halves(2.0))["inner_two_directions"] == 8
    assert denominators(halves(2.0))["wall_two_directions"] == 0
    assert denominators(halves(0.1))["inner_two_directions"] == 0
    assert denominators([gable("a")])["inner_two_directions"] == 0


SAME = ("block_iou_median", "corner_precision_1m", "corner_recall_1m", "corner_f1_1m", "corner_f1_0_5m")


def test_outlines_as_drawn_are_perfect() -> None:
    found = form([shed("a", L_SHAPE)], [drawn(L_SHAPE)])
    assert [found[name] for name in SAME] == pytest.approx([1.0] * len(SAME))
    assert found["blocks"] == found["drawn_right_corners"] == 1.0
    assert found["outline_distance_p90"] == pytest.approx(0.0, abs=1e-5)
    assert math.isnan(found["oblique_found"])


def test_an_outline_that_is_0_7_m_off_has_its_corners_at_a_metre_only() -> None:
    found = form([shed("a", rectangle(0.7, 0, 10.7, 8))], [drawn(rectangle(0, 0, 10, 8))])
    assert found["block_iou_median"] == pytest.approx(9.3 / 10.7)
    assert (found["corner_f1_1m"], found["corner_f1_0_5m"]) == (1.0, 0.0)
    # The places of the long sides fall 0.1 m beside those drawn, those of the short sides are 0.7 m away.
    assert found["outline_distance_median"] == pytest.approx(0.1, abs=0.01)
    assert found["outline_distance_p90"] == pytest.approx(0.7, abs=0.01)


def test_it_does_not_matter_at_which_corner_a_ring_begins() -> None:
    again = [*L_SHAPE[3:], *L_SHAPE[:3]]
    assert form([shed("a", again)], [drawn(L_SHAPE)])["outline_distance_p90"] == pytest.approx(0.0, abs=1e-5)


def test_extra_corners_cost_precision_and_missing_ones_recall() -> None:
    found = form(
        [shed("a", rectangle(0, 0, 14, 12))], [drawn([(0, 0), (14, 0), (14, 10), (12, 10), (12, 12), (0, 12)])]
    )
    assert (found["corner_precision_1m"], found["corner_recall_1m"]) == (0.75, 0.5)
    assert found["corner_f1_1m"] == pytest.approx(0.6)


def test_houses_that_touch_are_one_block_however_they_are_divided() -> None:
    row = [drawn(rectangle(0, 0, 10, 8)), drawn(rectangle(10.2, 0, 20, 8))]
    made = [shed("a", rectangle(0, 0, 14, 8)), shed("b", rectangle(14, 0, 20, 8))]
    found = form(made, row)
    assert (found["blocks"], found["corner_f1_0_5m"], found["block_iou_median"]) == (1.0, 1.0, pytest.approx(1.0))
    apart = form(made, [row[0], drawn(rectangle(10.4, 0, 20, 8))])
    assert apart["blocks"] == 0.0  # the found block lies on neither of the two by more than half and an IoU of one half
    assert math.isnan(apart["corner_f1_1m"])


def test_blocks_without_models_are_counted_and_not_compared() -> None:
    outlines = [drawn(rectangle(0, 0, 10, 8)), drawn(rectangle(50, 0, 60, 8))]
    assert form([shed("a", rectangle(0, 0, 10, 8))], outlines)["blocks"] == 1.0
    assert denominators([shed("a", rectangle(0, 0, 10, 8))], outlines)["blocks"] == 2


def test_a_drawn_oblique_edge_is_found_by_an_edge_of_its_direction_alone() -> None:
    cut = [(0, 0), (10, 0), (10, 4), (6, 8), (0, 8)]
    outlines = [drawn(cut)]
    assert denominators([shed("a", cut)], outlines)["oblique_found"] == round(math.hypot(4, 4))
    for ring, share in ((cut, 1.0), ([(x + 0.5, y) for x, y in cut], 1.0), (rectangle(0, 0, 10, 8), 0.0)):
        assert form([shed("a", ring)], outlines)["oblique_found"] == share
    apart = [surface(ring, (0.0, 0.0, 6.0)) for ring in (cut, rectangle(20, 0, 24, 4))]
    assert form([model("a", RoofType.FLAT, apart)], outlines)["oblique_found"] == 1.0
    half = [(0, 0), (10, 0), (10, 4), (8, 6), (8, 8), (0, 8)]  # and 1 m beyond its end
    assert form([shed("a", half)], outlines)["oblique_found"] == pytest.approx(
        (math.hypot(2, 2) + 1) / math.hypot(4, 4), abs=0.04
    )


def test_turned_and_moved_scenes_have_the_same_figures() -> None:
    made = [shed("a", L_SHAPE), shed("b", [(14, 0), (20, 1), (20, 7), (14, 6)]), gable("c", 40.0)]
    outlines = [drawn(L_SHAPE), drawn(rectangle(40, 0, 52, 8.5)), drawn([(14, 0), (19, 0), (21, 6), (14, 6)])]
    found = form(made, outlines)
    cosine, sine = math.cos(math.radians(33)), math.sin(math.radians(33))
    turned = [affinity.affine_transform(one, [cosine, -sine, sine, cosine, 500, -70]) for one in outlines]
    again = form([moved(one, 500.0, -70.0, 5.0, 33.0) for one in made], turned)
    distance = {name for name in found if "distance" in name}  # places begin at another corner
    assert {name: again[name] for name in found.keys() - distance} == pytest.approx(
        {name: found[name] for name in found.keys() - distance}, abs=1e-6
    )


def test_without_a_reference_the_form_is_measured_and_tabled() -> None:
    made = ModelSet(name="m", kind="obj", path=".", models=(flat("a"), flat("b", 40.0, width=0.9)))
    evaluation = evaluate(made)
    assert evaluation.measure("form.short_edges").value == pytest.approx(100.0 * 2 / (36 + 17.8))
    rows = evaluation.tables["outlines"].to_pylist()
    assert [(row["model_id"], row["short"], row["corners"]) for row in rows] == [("a", 0, 4), ("b", 2, 4)]
    assert "blocks" not in evaluation.tables
    assert evaluate(ModelSet(name="m", kind="obj", path=".", models=())).measure("form.right_corners").n == 0


def outlines_file(path: Path, polygons: Sequence[shapely.Geometry]) -> str:
    features = [{"type": "Feature", "properties": {}, "geometry": json.loads(shapely.to_geojson(p))} for p in polygons]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}))
    return str(path)


def test_drawn_outlines_need_no_points(tmp_path: Path) -> None:
    run = write_epoch(tmp_path / "run", [house("a"), house("b", 40.0)])
    shape = shapely.from_wkb(run_geometry(run))
    request: dict[str, Any] = {"models": str(run)}
    evaluation = evaluate_files(EvaluationRequest(**request, footprints=outlines_file(tmp_path / "f.geojson", [shape])))
    assert evaluation.measure("form.blocks").value == 1.0
    assert evaluation.measure("form.corner_f1_0_5m").value == 1.0
    (row,) = evaluation.tables["blocks"].to_pylist()
    assert (row["found"], row["drawn"], row["right_1m"]) == (4, 4, 4)
    away = outlines_file(tmp_path / "g.geojson", [affinity.translate(shape, 5000.0)])
    with pytest.raises(InputError, match="none of its footprints lies on the data"):
        evaluate_files(EvaluationRequest(**request, footprints=away))


def run_geometry(run: Path) -> bytes:
    """The outline of the first house of a run."""
    import pyarrow.parquet as pq

    table = pq.read_table(run / "buildings", columns=["geometry", "building_id"]).to_pydict()
    assert np.allclose(shapely.from_wkb(table["geometry"][0]).centroid.coords, [PLACE[:2]], atol=0.01)
    return bytes(table["geometry"][0])
