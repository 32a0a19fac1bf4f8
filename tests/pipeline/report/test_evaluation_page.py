"""The page of an evaluation: one file that shows every figure, its maps, its charts and its worst cases."""

import base64
import dataclasses
import html
import io
import itertools
import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import shapely
from damaged_suburb import (
    KINDS,
    damaged,
    damaged_evaluation,
    model_set,
    reference_of,
    roof_points,
    true_models,
)
from matplotlib.colors import to_rgb
from page_reader import Reader, assert_loads_nothing, assert_pictures_have_words_and_ids_are_unique, count, pixels
from PIL import Image
from processes import program
from roofs_by_hand import flat, reference

from pipeline.report.maps import BAD, GOOD, MISSING, Map
from pipeline.ruler.evaluation.chapters import printed
from pipeline.ruler.evaluation.counted_models import visible_share
from pipeline.ruler.evaluation.definitions import DEFINITIONS
from pipeline.ruler.evaluation.evaluate import Evaluation, evaluate
from pipeline.ruler.evaluation.evaluate_files import EvaluationRequest, evaluate_files
from pipeline.ruler.evaluation.evaluation_writing import markdown
from pipeline.ruler.evaluation.models import RoofModel, RoofSurface
from pipeline.ruler.evaluation.reference import ReferencePoints
from pipeline.ruler.report.evaluation_maps import maps
from pipeline.ruler.report.evaluation_page import HEADLINE, page, write_page
from pipeline.ruler.report.histograms import charts
from pipeline.ruler.report.model_pictures import models_view
from pipeline.ruler.report.section import RESIDUAL_CLASSES, UNCOVERED, profile_line, residual_class, section_svg
from pipeline.ruler.report.svg_chart import rebinned
from pipeline.ruler.report.worst_cases import MAX_NOT_FOUND, chosen_rows, worst_cases


def map_called(evaluation: Evaluation, title: str) -> Map:
    return next(one for one in maps(evaluation) if one.title == title)


@pytest.mark.parametrize("kind", KINDS)
def test_the_page_holds_every_measure_of_every_kind_of_evaluation(kind: dict[str, bool]) -> None:
    evaluation = damaged_evaluation(**kind)
    read = Reader(page(evaluation))
    assert read.open == []
    texts = [text.strip() for text in read.texts]
    for one in evaluation.measures:
        line = printed(one, DEFINITIONS[one.name])
        for text in (line.label, line.value, line.interval, one.name):
            assert text in {*texts, ""}
    for note in (*evaluation.notes, *evaluation.models.notes):
        assert note in texts


@pytest.mark.parametrize("kind", KINDS)
def test_the_page_is_one_file_without_scripts_that_loads_nothing(kind: dict[str, bool], tmp_path: Path) -> None:
    path = write_page(damaged_evaluation(**kind), tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]
    text = path.read_text()
    assert len(text) < 8_000_000
    assert_loads_nothing(text)


def test_pictures_say_in_words_what_they_show_and_ids_are_unique() -> None:
    read = Reader(page(damaged_evaluation()))
    assert len(read.all("img")) >= 3 + 2 * 7
    for image in read.all("img"):
        assert base64.b64decode((image["src"] or "").partition(",")[2])[:4] == b"\x89PNG"
    for drawing in read.all("svg"):
        assert drawing["role"] == "img"
        assert len(drawing["aria-label"] or "") > 20
    assert_pictures_have_words_and_ids_are_unique(read)


def test_names_from_outside_are_text_and_never_markup() -> None:
    evil = '"><script>alert(1)</script>'
    truth = true_models()
    evaluation = damaged_evaluation()
    assert evaluation.reference is not None
    named = tuple(dataclasses.replace(one, building_id=f"{evil}{n}") for n, one in enumerate(truth))
    rows = evaluation.tables["buildings"].to_pylist()
    for row, one in zip(rows, named, strict=True):
        row |= {"building_id": one.building_id, "shape": evil, "defects": [evil]}
    text = page(
        dataclasses.replace(
            evaluation,
            models=dataclasses.replace(evaluation.models, name=evil),
            reference=dataclasses.replace(evaluation.reference, name=evil, buildings=named),
            tables={**evaluation.tables, "buildings": pa.Table.from_pylist(rows)},
            notes=(evil,),
        ),
    )
    assert "<script" not in text
    read = Reader(text)
    assert "script" not in {tag for tag, _ in read.elements}
    assert sum(evil in part for part in read.texts) >= 10
    assert all(len(attributes) <= 12 and "onload" not in attributes for _, attributes in read.elements)


def test_the_figures_of_the_headline_exist_and_are_at_most_eight() -> None:
    assert {name for names in HEADLINE for name in names} <= set(DEFINITIONS)
    shown = re.findall(r'<ul class="headline">(.*?)</ul>', page(damaged_evaluation()), re.DOTALL)[0]
    assert 4 <= shown.count("<li>") <= 8
    assert html.escape("86.7 %") in shown


def test_legends_count_what_was_damaged() -> None:
    evaluation = damaged_evaluation()
    outcome = map_called(evaluation, "Buildings by outcome")
    counts = {entry.label: entry.count for entry in outcome.legend}
    # Of 15 houses every seventh from the third is missing, from the fifth a block, and two are raised.
    assert counts == {"correct": 10, "passable": 1, "false": 2, "not found": 2, "model without a building": 1}
    assert "not found: 2" in outcome.description
    faces = {entry.label: entry.count for entry in map_called(evaluation, "Roof faces").legend}
    table = evaluation.tables["true_faces"]
    assert faces["found"] + faces["missed"] == table.num_rows
    assert faces["found"] == sum(table["found"].to_pylist())


def test_colours_of_a_map_cover_the_area_of_their_buildings() -> None:
    evaluation = damaged_evaluation()
    outcome = map_called(evaluation, "Buildings by outcome")
    assert evaluation.reference is not None
    areas: dict[str, float] = {}
    for row, one in zip(evaluation.tables["buildings"].to_pylist(), evaluation.reference.buildings, strict=True):
        kind = "missing" if row["model_id"] is None else row["outcome"]
        areas[kind] = areas.get(kind, 0.0) + one.footprint.area
    good = count(outcome.png, GOOD)
    assert count(outcome.png, MISSING) / good == pytest.approx(areas["missing"] / areas["correct"], rel=0.06)
    bar_m = float(outcome.scale_label.split()[0])
    metre_px = outcome.scale_share * outcome.width_px / bar_m
    assert good / metre_px**2 == pytest.approx(areas["correct"], rel=0.06)


@pytest.mark.slow
def test_one_false_building_is_seen_on_the_map_of_a_whole_city() -> None:
    pattern = true_models()[0]
    corners = [(20.0 * (k % 100), 20.0 * (k // 100)) for k in range(10_000)]
    houses = [
        dataclasses.replace(pattern, building_id=f"h{k}", footprint=shapely.box(x, y, x + 8.0, y + 8.0))
        for k, (x, y) in enumerate(corners)
    ]
    rows = {
        "building_id": [one.building_id for one in houses],
        "model_id": [one.building_id for one in houses],
        "outcome": ["false" if k == 5050 else "correct" for k in range(len(houses))],
    }
    reference = dataclasses.replace(reference_of(true_models(), points=False), buildings=tuple(houses))
    city = dataclasses.replace(damaged_evaluation(), reference=reference, tables={"buildings": pa.table(rows)})
    (outcome,) = maps(city)
    assert count(outcome.png, BAD) >= 25
    assert len(outcome.png) < 2_000_000
    place = np.argwhere(np.abs(pixels(outcome.png)[:, :, :3] - to_rgb(BAD)).max(axis=2) < 0.03).mean(axis=0)
    # House 5050 stands in the middle of the city.
    assert place / [outcome.height_px, outcome.width_px] == pytest.approx([0.5, 0.5], abs=0.02)


def test_without_true_faces_buildings_have_the_colour_of_their_points() -> None:
    evaluation = damaged_evaluation(has_faces=False)
    (shares,) = maps(evaluation)
    counts = {entry.label: entry.count for entry in shares.legend}
    rows = [row for row in evaluation.tables["buildings"].to_pylist() if row["model_id"] is not None]
    good = sum(row["n_within"] >= 0.95 * row["n_points"] for row in rows)
    assert counts["at least 95 %"] == good
    assert counts["not found"] == 2
    assert counts["less than 50 %"] == sum(row["n_within"] < 0.5 * row["n_points"] for row in rows)


def test_without_points_or_a_reference_there_are_still_maps_but_no_invented_figures() -> None:
    assert [one.title for one in maps(damaged_evaluation(has_faces=False, points=False))] == ["Buildings found"]
    alone = damaged_evaluation(reference=False)
    (status,) = maps(alone)
    assert {entry.label: entry.count for entry in status.legend} == {"model": 12, "fallback (a block)": 2}
    assert worst_cases(alone) == []
    assert charts(alone.tables) == []
    assert "Vertical distance" not in page(damaged_evaluation(points=False))


def row_of_flats(walls: Sequence[float], name: str) -> list[RoofModel]:
    """Roofs of one row between walls, each of another elevation."""
    return [
        flat(f"{name}{k}", low, width=high - low, z=6.0 + k % 3, source_id="row")
        for k, (low, high) in enumerate(itertools.pairwise(walls))
    ]


@pytest.mark.parametrize(
    ("walls", "outcome", "hatched"),
    [((0, 6, 12, 18, 24), "correct", 0), ((0, 6, 9, 12, 18, 24), "passable", 1), ((0, 3, 6, 24), "false", 0)],
)
def test_a_row_has_the_colour_of_what_was_found(walls: tuple[float, ...], outcome: str, hatched: int) -> None:
    """A right division is as good as one model; a wrong one is hatched, and not shown as if no roof were there."""
    truth = reference(row_of_flats((0, 6, 12, 18, 24), "house"))
    found = evaluate(model_set(row_of_flats(walls, "m")), truth)
    counts = {entry.label: entry.count for entry in map_called(found, "Buildings by outcome").legend}
    torn = {"wrongly divided or joined: no model stands for it": 1} if hatched else {}
    assert counts == {outcome: 1} | torn
    gone = evaluate(model_set([flat("far", 80.0)]), truth)
    counts = {entry.label: entry.count for entry in map_called(gone, "Buildings by outcome").legend}
    assert counts == {"not found": 1, "model without a building": 1}


def test_the_page_without_a_truth_has_figures_and_a_picture() -> None:
    text = page(damaged_evaluation(reference=False))
    read = Reader(text)
    texts = [part.strip() for part in read.texts]
    for wanted in ("The models", "Roof types", "Over the models", "footprint, m2", "roof faces"):
        assert wanted in texts, wanted
    views = [image for image in read.all("img") if (image["alt"] or "").startswith("Bird's-eye view")]
    assert len(views) == 1
    assert "14 of 14 models" in (views[0]["alt"] or "")
    drawn = pixels(base64.b64decode((views[0]["src"] or "").partition(",")[2]))
    assert (drawn[:, :, 3] > 0).mean() > 0.05
    with_truth = Reader(page(damaged_evaluation()))
    assert not [image for image in with_truth.all("img") if (image["alt"] or "").startswith("Bird's-eye view. ")]
    assert "Over the models" in [part.strip() for part in with_truth.texts]


def test_the_figures_of_a_run_are_on_the_page_and_in_the_report(street_run: Path) -> None:
    found = evaluate_files(EvaluationRequest(models=str(street_run)))
    shown = [part.strip() for part in Reader(page(found)).texts]
    report = markdown(found)
    for wanted in ("Candidates", "invalid_solid", "Rejected objects", "vegetation", "rmse_m"):
        assert wanted in shown, wanted
        assert wanted.replace("_", r"\_") in report or wanted in report, wanted


def test_models_far_apart_are_drawn_where_most_roofs_are() -> None:
    near = [flat(f"m{k}", 20.0 * k) for k in range(4)]
    view = models_view([*near, flat("far", 3000.0)])
    assert view is not None
    assert "the square of 180 m with the most roof faces: 4 of 5 models" in view.caption
    assert models_view([]) is None
    assert models_view([dataclasses.replace(near[0], surfaces=(), solids=())]) is None


def case_rows(specification: Sequence[tuple[str, str | None, str | None, float]]) -> pa.Table:
    """Rows of buildings: name, model, outcome, share within."""
    return pa.Table.from_pylist(
        [
            {
                "building_id": name,
                "model_id": model,
                "outcome": outcome,
                "surface_within": share,
                "touches_data_edge": name.startswith("edge"),
            }
            for name, model, outcome, share in specification
        ]
    )


def test_worst_cases_are_false_ones_first_and_only_some_that_were_not_found() -> None:
    lost = [(f"lost{k}", None, "false", 0.0) for k in range(9)]
    false = [(f"false{k}", "m", "false", 0.1 * k) for k in range(5)]
    passable = [("passable1", "m", "passable", 0.5), ("passable0", "m", "passable", 0.05)]
    sound = [("sound", "m", "correct", 1.0), ("poor", "m", "correct", 0.9), ("edge", "m", "false", 0.0)]
    names = [row["building_id"] for row in chosen_rows(case_rows([*sound, *passable, *reversed(false), *lost]))]
    assert sum(name.startswith("lost") for name in names) == MAX_NOT_FOUND
    assert [name for name in names if not name.startswith("lost")] == [
        *(f"false{k}" for k in range(5)),
        "passable0",
        "passable1",
        "poor",
    ]
    assert chosen_rows(case_rows([("sound", "m", "correct", 1.0)])) == []


def test_in_a_shifted_survey_a_model_that_misses_its_points_is_worse_than_one_beside_the_truth() -> None:
    rows = [
        {"building_id": name, "model_id": "m", "outcome": "false", "surface_within": 0.0, "n_points": 50, "n_within": n}
        for name, n in (("shifted", 50), ("broken", 10), ("unknown", None))
    ]
    assert [row["building_id"] for row in chosen_rows(pa.Table.from_pylist(rows))] == ["unknown", "broken", "shifted"]


def test_a_building_with_many_facade_points_is_judged_by_those_that_are_seen_from_above() -> None:
    """On maps, in charts and among the worst cases; tables of older versions have all points only."""
    walls = {"building_id": "walls", "model_id": "m", "n_points": 100, "n_within": 60}
    seen = {"top_n_points": 60, "top_n_within": 60, "top_rmse_m": 0.02, "point_rmse_m": 2.0}
    poor = {"building_id": "poor", "model_id": "m", "n_points": 100, "n_within": 80}
    bad = {"top_n_points": 90, "top_n_within": 72, "top_rmse_m": 0.4, "point_rmse_m": 0.5}
    table = pa.Table.from_pylist([walls | seen, poor | bad])
    assert [row["building_id"] for row in chosen_rows(table)] == ["poor"]
    assert visible_share(table).tolist() == [1.0, 0.8]
    older = pa.Table.from_pylist([walls, poor, {**poor, "n_points": 0, "n_within": 0}])
    assert [row["building_id"] for row in chosen_rows(older)][:2] == ["walls", "poor"]
    assert visible_share(older).tolist() == pytest.approx([0.6, 0.8, math.nan], nan_ok=True)
    assert visible_share(older.drop_columns(["n_points"])) is None


def test_worst_cases_are_drawn_with_the_points_in_the_colours_of_their_distances() -> None:
    evaluation = damaged_evaluation()
    cases = {case.building_id: case for case in worst_cases(evaluation)}
    names = [row["building_id"] for row in evaluation.tables["buildings"].to_pylist()]
    below, lost = cases[names[1]], cases[names[3]]  # raised by 0.4 m; without a model
    assert count(below.plan_png, RESIDUAL_CLASSES[1].colour) > 1000
    assert count(below.plan_png, RESIDUAL_CLASSES[UNCOVERED].colour) == 0
    assert count(lost.plan_png, RESIDUAL_CLASSES[UNCOVERED].colour) > 1000
    assert lost.view_is_truth
    assert not below.view_is_truth
    assert ("model", "not found") in lost.figures or ("roof type", "flat, modelled: not found") in lost.figures


def test_without_points_worst_cases_are_drawn_without_points() -> None:
    cases = worst_cases(damaged_evaluation(points=False))
    assert cases
    for case in cases:
        assert case.section is not None
        assert "<circle" not in case.section
        assert count(case.plan_png, RESIDUAL_CLASSES[UNCOVERED].colour) == 0


def test_tiles_without_a_worst_case_are_not_read() -> None:
    evaluation = damaged_evaluation()
    assert evaluation.reference is not None
    held = roof_points(true_models())
    far = (1e6, 1e6, 1e6 + 100.0, 1e6 + 100.0)
    near = (*held.xyz.min(axis=0)[:2].tolist(), *held.xyz.max(axis=0)[:2].tolist())

    def unread() -> ReferencePoints:
        raise AssertionError("a tile far from all buildings was read")

    tiled = dataclasses.replace(evaluation.reference, tiles=(unread, lambda: held), bounds=(far, near))
    drawn = worst_cases(dataclasses.replace(evaluation, reference=tiled))
    assert [case.plan_png for case in drawn] == [case.plan_png for case in worst_cases(evaluation)]


def test_residual_classes_end_at_their_borders_and_nan_is_its_own() -> None:
    residual = np.array([-9.0, -0.5001, -0.4999, -0.2001, -0.1999, 0.0, 0.1999, 0.2001, 0.4999, 0.5001, np.nan])
    assert residual_class(residual).tolist() == [0, 0, 1, 1, 2, 2, 2, 3, 3, 4, UNCOVERED]


def test_the_section_shows_a_raised_roof_as_far_above_the_truth_as_it_is() -> None:
    truth = true_models()
    number = 1
    model = next(one for one in damaged(truth) if one.building_id == f"model-{number}")
    section = section_svg(truth[number], [model], np.zeros((0, 3)))
    assert section is not None
    lines = {
        name: np.array([[float(v) for v in corner.split(",")] for corner in corners.split()])
        for name, corners in re.findall(r'<polyline class="(truth|model)" points="([^"]+)"', section)
    }
    ends = lines["model"][1:-1]  # without the walls
    assert len(ends) == len(lines["truth"])
    width_px = ends[-1, 0] - ends[0, 0]
    rectangle = shapely.get_coordinates(shapely.minimum_rotated_rectangle(truth[number].footprint))
    width_m = float(np.hypot(*np.diff(rectangle[:3], axis=0).T).min())
    raised_m = (lines["truth"][:, 1] - ends[:, 1]) * width_m / width_px
    assert raised_m == pytest.approx(0.4, abs=0.03)
    assert section_svg(dataclasses.replace(truth[0], surfaces=()), [], np.zeros((0, 3))) is None


def test_the_section_lies_where_the_points_are_farthest_from_the_model() -> None:
    house = dataclasses.replace(true_models()[0], footprint=shapely.box(0.0, 0.0, 30.0, 10.0))
    flat = RoofSurface(polygon=house.footprint, coefficients=(0.0, 0.0, 5.0))
    house = dataclasses.replace(house, surfaces=(flat,))
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(0.25, 30.0, 0.5), np.arange(0.25, 10.0, 0.5)))
    level = np.column_stack([x, y, np.full(len(x), 5.0)])
    shed = level + np.column_stack([0.0 * x, 0.0 * x, np.where((x > 21.0) & (x < 23.0), 1.5, 0.0)])
    for points, place in ((level, 15.0), (shed, 22.0), (level + np.array([0.0, 0.0, 0.4]), 15.0), (level[:0], 15.0)):
        middle, along, half = profile_line(house, [house], points)
        assert middle == pytest.approx([place, 5.0], abs=0.6)
        assert np.abs(along) == pytest.approx([0.0, 1.0])
        assert half == pytest.approx(5.0)


def test_charts_and_tables_leave_out_what_the_edge_of_the_data_cuts() -> None:
    cut = {"building_id": "cut", "touches_data_edge": True, "iou": 0.6, "model_id": "m"}
    whole = {"building_id": "whole", "touches_data_edge": False, "iou": 0.9, "model_id": "n"}
    faces = [
        {"building_id": name, "area_m2": 30.0, "to_be_found": name == "whole", "found": name == "whole"}
        for name in ("cut", "whole")
    ]
    drawn = charts({"buildings": pa.Table.from_pylist([cut, whole]), "true_faces": pa.Table.from_pylist(faces)})
    assert drawn[0].caption.startswith("1 buildings, median 0.900.")
    assert "20-50: 100 % of 1." in drawn[1].svg


def test_rebinning_keeps_the_sum_and_agrees_with_counting_again() -> None:
    random = np.random.default_rng(3)
    values = np.abs(random.normal(0.0, 0.6, 5000))
    fine = np.concatenate([np.arange(0.0, 1.0, 0.005), np.arange(1.0, 5.0001, 0.05), [1e5]])
    wanted = np.linspace(0.0, 1.5, 31)
    counts = np.histogram(values, fine)[0].astype(np.float64)
    shared = rebinned(fine[:-1], fine[1:], counts, wanted)
    assert shared.sum() == pytest.approx(len(values))
    again = np.histogram(np.clip(values, 0.0, 1.49999), wanted)[0]
    assert shared == pytest.approx(again, abs=2.0)
    open_ended = rebinned(np.array([-math.inf, 0.0]), np.array([0.0, math.inf]), np.array([3.0, 4.0]), wanted - 0.75)
    assert open_ended.sum() == pytest.approx(7.0)


def test_charts_tell_the_figures_of_a_hand_made_case() -> None:
    tables = {
        "residual_histogram": pa.table(
            {"low_m": [0.0, 0.1, 0.2, 0.5], "high_m": [0.1, 0.2, 0.5, 1e5], "count": [50, 25, 20, 5]}
        ),
        "buildings": pa.table({"iou": [0.9, 0.8, 0.0], "model_id": ["a", "b", None]}),
        "true_faces": pa.table(
            {
                "area_m2": [4.0, 30.0, 40.0, 25.0],
                "slope_deg": [0.0, 30.0, 35.0, 45.0],
                "to_be_found": [False, True, True, True],
                "found": [True, True, False, True],
            }
        ),
    }
    drawn = {chart.title: chart for chart in charts(tables)}
    assert list(drawn) == [
        "Vertical distance of points to the models",
        "Footprint IoU of found buildings",
        "Faces found, by area",
        "Faces found, by slope",
    ]
    assert "75.0 % of them within 0.2 m" in drawn["Vertical distance of points to the models"].svg
    assert drawn["Footprint IoU of found buildings"].caption.startswith("2 buildings, median 0.850.")
    assert "0-5: 100 % of 1; 20-50: 67 % of 3." in drawn["Faces found, by area"].svg
    assert "30-40: 50 % of 2; 40-50: 100 % of 1." in drawn["Faces found, by slope"].svg
    assert drawn["Faces found, by area"].svg.count('class="bar pale"') == 2


def test_a_perfect_evaluation_has_no_worst_case() -> None:
    truth = true_models()
    rows = [
        {"building_id": one.building_id, "model_id": one.building_id, "outcome": "correct", "surface_within": 1.0}
        for one in truth
    ]
    perfect = Evaluation(
        models=model_set(truth),
        reference=reference_of(truth),
        measures=(),
        tables={"buildings": pa.Table.from_pylist(rows)},
        notes=(),
    )
    text = page(perfect)
    assert "Worst cases" not in text
    assert {entry.label for entry in map_called(perfect, "Buildings by outcome").legend} == {"correct"}


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 1440])
def test_a_browser_shows_the_page_without_complaint_or_sideways_scrolling(width: int, tmp_path: Path) -> None:
    from playwright.sync_api import sync_playwright

    path = write_page(damaged_evaluation(), tmp_path)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program("chromium"), args=["--no-sandbox"])
        shades = []
        for scheme in ("light", "dark"):
            shown = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
            complaints: list[str] = []
            requests: list[str] = []
            shown.on("console", lambda message, found=complaints: found.append(message.text))
            shown.on("request", lambda request, found=requests: found.append(request.url))
            shown.goto(path.as_uri())
            assert complaints == []
            assert [url for url in requests if not url.startswith("data:")] == [path.as_uri()]
            assert shown.evaluate("document.documentElement.scrollWidth") == width
            assert shown.evaluate("[...document.images].every(image => image.naturalWidth > 0)")
            shades.append(np.asarray(Image.open(io.BytesIO(shown.screenshot())).convert("L")).mean())
        browser.close()
    assert shades[0] > 180.0
    assert shades[1] < 80.0
