"""Runs side by side: one table, one page, nothing hidden, and views of one place at one scale."""

import dataclasses
import json
import random
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import roofs_by_hand as by_hand
import shapely
import small_buildings as small
from page_reader import Reader, assert_loads_nothing, assert_pictures_have_words_and_ids_are_unique, count, pixels
from small_runs import moved

from pipeline.errors import RunError, SettingsError
from pipeline.io import ReadOptions, Source, SourceInfo
from pipeline.model import BuildingResult, Reason, RoofType, Status
from pipeline.report.palette import ROOF_COLOURS
from pipeline.ruler.evaluation.evaluate import evaluate
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.report import comparison_page, comparison_points
from pipeline.ruler.report.comparison import ComparedRun, PointFiles, write_comparison
from pipeline.ruler.report.comparison_choice import CASES, DIFFERENT, Choice, chosen_buildings
from pipeline.ruler.report.comparison_pictures import BLOCK_COLOUR, REACH_M, draw_building, place_of
from pipeline.ruler.report.comparison_points import points_within
from pipeline.ruler.report.comparison_records import ComparedBuilding, Record, differences
from pipeline.ruler.report.section import RESIDUAL_CLASSES
from pipeline.runtime.manifest import write_manifest
from pipeline.runtime.manifest_reading import read_manifest

MakeRun = Callable[..., Path]
EVIL = '"><script>alert(1)</script>'


def flat(building_id: str, **changes: object) -> BuildingResult:
    """A flat box of 10 m by 8 m, 4 m high."""
    corners = [(0.0, 0.0, 4.0), (10.0, 0.0, 4.0), (10.0, 8.0, 4.0), (0.0, 8.0, 4.0)]
    solid = small.roofed_solid(corners, [[[0, 1, 2, 3]]], 0.0)
    return small.building(building_id, solid, **{"roof_type": RoofType.FLAT, **changes})


def block(building_id: str) -> BuildingResult:
    """The box in place of a model."""
    detail = {"reason": Reason.NO_PLANE, "reason_detail": "0 planes, at least 1"}
    return flat(building_id, status=Status.FALLBACK, lod="1.2", rmse_m=0.7, **detail)


def lost(building_id: str) -> BuildingResult:
    return dataclasses.replace(small.failed(building_id), footprint=shapely.box(0.0, 0.0, 10.0, 8.0))


@pytest.fixture
def runs(make_run: MakeRun) -> list[ComparedRun]:
    """Three runs over four candidates: all agree on a gable; a flat roof; a block; a failure."""
    makers = {
        "sound": [small.gable, small.gable, small.gable, small.gable],
        "flattening": [small.gable, flat, small.gable, small.gable],
        "broken": [small.gable, small.gable, block, lost],
    }
    names = ["agreed", "flattened", "blocked", "gone"]
    found = []
    for label, made in makers.items():
        results = [moved(make(name), 40.0 * place) for place, (make, name) in enumerate(zip(made, names, strict=True))]
        folder = make_run(results, label)
        seconds = dict.fromkeys(names, 0.25) if label != "broken" else {"agreed": 1.5}
        found.append(ComparedRun(label=label, method=label, preset="robust", run_dir=str(folder), seconds=seconds))
    return found


@pytest.fixture
def points(tmp_path: Path) -> PointFiles:
    """Points on four gables, as text."""
    gable = gable_points()
    gables = [gable + np.array([40.0 * place, 0.0, 0.0]) for place in range(4)]
    ground = np.column_stack([gable[:, :2] + np.array([25.0, 0.0]), np.full(len(gable), small.ORIGIN[2])])
    path = tmp_path / "points.xyz"
    np.savetxt(path, np.vstack([*gables, ground]), fmt="%.3f")
    return PointFiles(paths=(str(path),))


def evaluated(runs: list[ComparedRun]) -> list[ComparedRun]:
    """The runs measured against the first of them."""
    truth = read_models(runs[0].run_dir)
    reference = dataclasses.replace(by_hand.reference(truth.models, extent=None), name="the first run")
    return [dataclasses.replace(run, evaluation=evaluate(read_models(run.run_dir), reference)) for run in runs]


def test_the_table_has_a_row_a_building_and_run_with_what_the_records_say(
    runs: list[ComparedRun], tmp_path: Path
) -> None:
    path, _, _ = write_comparison(tmp_path / "out", runs)
    table = pq.read_table(path)
    rows = table.to_pylist()
    assert [(row["building_id"], row["label"]) for row in rows] == [
        (name, run.label) for name in ("agreed", "blocked", "flattened", "gone") for run in runs
    ]
    by_key = {(row["building_id"], row["label"]): row for row in rows}
    blocked = by_key["blocked", "broken"]
    facts = {"status": "fallback", "reason": "no_plane", "lod": "1.2", "rmse_m": 0.7}
    assert {name: blocked[name] for name in facts} == facts
    gone = by_key["gone", "broken"]
    facts = {"status": "failed", "reason": "too_few_points", "lod": None, "rmse_m": None, "seconds": None}
    assert {name: gone[name] for name in facts} == facts
    assert by_key["agreed", "broken"]["seconds"] == 1.5
    assert {row["difference"] for row in rows if row["building_id"] == "agreed"} == {0.0}
    assert all(row["difference"] > 0.0 for row in rows if row["building_id"] != "agreed")
    assert shapely.from_wkb(by_key["agreed", "sound"]["geometry"]).area == pytest.approx(80.0)
    geo = json.loads(table.schema.metadata[b"geo"])
    assert geo["primary_column"] == "geometry"
    assert geo["columns"]["geometry"]["crs"] is None
    assert "outcome" not in table.column_names


def test_with_a_truth_every_building_has_its_outcome_and_one_true_building_whatever_a_run_made_of_it(
    runs: list[ComparedRun], tmp_path: Path
) -> None:
    path, report, page = write_comparison(tmp_path / "out", evaluated(runs))
    rows = {(row["building_id"], row["label"]): row for row in pq.read_table(path).to_pylist()}
    assert all(row["true_id"] == name for (name, _), row in rows.items())
    outcomes = {key: row["outcome"] for key, row in rows.items()}
    wrong = {key for key, outcome in outcomes.items() if outcome != "correct"}
    assert wrong == {("flattened", "flattening"), ("blocked", "broken"), ("gone", "broken")}
    assert all(outcomes[key] == "false" for key in wrong)
    assert rows["gone", "broken"]["faces_found"] == 0
    assert rows["gone", "sound"]["faces_found"] == rows["gone", "sound"]["faces_to_find"] == 2
    facts = report.read_text()
    assert "| gable | 4 / 0 / 0 (100.0 % correct of 4) | 3 / 0 / 1 (75.0 % correct of 4) | 2 / 0 / 2" in facts
    assert "Against the first run" in page.read_text()
    assert sum((image["alt"] or "").startswith("The true model") for image in Reader(page.read_text()).all("img")) == 4


def test_runs_without_a_building_have_a_page_that_says_so_with_and_without_a_truth(
    runs: list[ComparedRun], make_run: MakeRun, tmp_path: Path
) -> None:
    empty = [dataclasses.replace(run, run_dir=str(make_run([], f"no-{run.label}"))) for run in runs]
    reference = evaluated(runs)[0].evaluation.reference
    against = [dataclasses.replace(run, evaluation=evaluate(read_models(run.run_dir), reference)) for run in empty]
    for number, given in enumerate((empty, against)):
        path, report, page = write_comparison(tmp_path / f"out{number}", given)
        table = pq.read_table(path)
        assert table.num_rows == 0
        assert ("outcome" in table.column_names) == (given is against)
        assert "0 buildings" in page.read_text()
        assert "side by side\n" not in report.read_text()


def test_runs_of_different_candidates_are_refused_unless_tiles_of_one_failed(
    runs: list[ComparedRun], make_run: MakeRun, tmp_path: Path
) -> None:
    folder = make_run([small.gable("agreed"), moved(small.gable("stranger"), 300.0)], "other")
    other = ComparedRun(label="other", method="m", preset="robust", run_dir=str(folder))
    with pytest.raises(RunError, match="4 buildings are not in all runs: sound has blocked, other has not"):
        write_comparison(tmp_path / "out", [*runs, other])
    manifest = read_manifest(folder)
    write_manifest(folder, dataclasses.replace(manifest, failed_tiles=("t2",)))
    path, report, _ = write_comparison(tmp_path / "out", [*runs, other])
    assert {row["building_id"] for row in pq.read_table(path).to_pylist()} == {"agreed"}
    assert "4 buildings that not all runs have are left out" in report.read_text()
    assert "other: 1 tile failed" in report.read_text()
    _, report, _ = write_comparison(tmp_path / "judged", evaluated([*runs, other]))
    assert "left out below, except from the evaluations of the runs" in report.read_text()


def test_no_run_and_two_of_one_label_are_refused(runs: list[ComparedRun], tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="no runs are given"):
        write_comparison(tmp_path, [])
    with pytest.raises(SettingsError, match="labelled sound more than once"):
        write_comparison(tmp_path, [runs[0], runs[1], runs[0]])
    with pytest.raises(RunError, match="does not exist"):
        write_comparison(tmp_path, [dataclasses.replace(runs[0], run_dir=str(tmp_path / "nothing"))])


def record(**changes: object) -> Record:
    fields: dict[str, object] = {
        "status": Status.OK,
        "roof_type": "gable",
        "n_planes": 2,
        "rmse_m": 0.05,
        "footprint_area_m2": 80.0,
        "touches_data_edge": False,
        "outcome": None,
    } | changes
    return fields | {"is_model": Status(str(fields["status"])).has_roof}


def test_differences_are_the_shares_and_ranges_of_the_page() -> None:
    apart = differences(
        [
            record(),
            record(roof_type="hip", n_planes=4, rmse_m=0.15, outcome="false"),
            record(outcome="correct"),
            record(status=Status.FALLBACK, roof_type="flat", n_planes=1, rmse_m=3.0),
        ]
    )
    # 3 of 6 pairs hold the block; it has no say in types, planes and residuals.
    wanted = {"status": 3 / 6, "outcome": 1.0, "roof_type": 2 / 3, "faces": (4 - 2) / 4, "residual": 0.1 / 0.2}
    assert apart == pytest.approx(wanted)
    assert not any(differences([record(), record()]).values())
    assert not any(differences([record(status=Status.FAILED, rmse_m=None)] * 2).values())


def compared(name: str, *records: Record) -> ComparedBuilding:
    return ComparedBuilding(building_id=name, records=records, true_id=None, difference=differences(records))


def names(choices: list[Choice]) -> list[str]:
    return [choice.building.building_id for choice in choices]


def test_buildings_are_chosen_for_each_kind_of_difference_and_typical_ones_beside_them() -> None:
    agreeing = [compared(f"flat{k}", *[record(roof_type="flat", footprint_area_m2=50.0 + k)] * 2) for k in range(9)]
    agreeing += [compared(f"hip{k}", *[record(roof_type="hip", footprint_area_m2=50.0 + k)] * 2) for k in range(5)]
    others = [compared(f"status{k}", record(), record(status=Status.FAILED)) for k in range(20)]
    others += [compared(f"type{k}", record(), record(roof_type="hip")) for k in range(20)]
    others += [compared(f"planes{k}", record(), record(n_planes=3 + k)) for k in range(20)]
    others += [compared(f"rmse{k}", record(), record(rmse_m=0.11 + 0.001 * k)) for k in range(20)]
    edge = compared("edge", record(), record(status=Status.FAILED, touches_data_edge=True))
    buildings = [*agreeing, *others, edge]
    chosen = chosen_buildings(buildings)
    facts = names(chosen)
    assert len(set(facts)) == CASES
    assert "edge" not in facts
    # The largest of each kind first: the most planes, the largest RMSE; of equal ones the first name.
    assert facts[:4] == ["status0", "type0", "planes19", "rmse19"]
    assert facts[DIFFERENT:] == ["flat4", "hip2", "flat3"]
    assert [choice.why for choice in chosen[:2]] == ["differs in status", "differs in roof type"]
    for seed in range(3):
        random.Random(seed).shuffle(buildings)
        assert names(chosen_buildings(buildings)) == facts
    assert names(chosen_buildings([edge])) == ["edge"]
    assert len(chosen_buildings(agreeing)) == CASES
    assert len(set(names(chosen_buildings([*others[:40], agreeing[0]])))) == CASES


def test_points_of_buildings_are_those_within_their_areas_each_once(tmp_path: Path) -> None:
    made = np.round(np.random.default_rng(4).uniform(0.0, 300.0, (4000, 3)), 2)
    for name, part in (("west", made[made[:, 0] < 180.0]), ("east", made[made[:, 0] > 120.0]), ("far", made + 5000.0)):
        np.savetxt(tmp_path / f"{name}.xyz", part, fmt="%.2f")
    files = PointFiles(paths=tuple(str(tmp_path / f"{name}.xyz") for name in ("west", "east", "far")))
    areas = [shapely.Point(150.0, 100.0).buffer(40.0), shapely.box(0.0, 0.0, 20.0, 300.0), shapely.Polygon()]
    found = points_within(files, areas)
    for area, xyz in zip(areas, found, strict=True):
        wanted = made[shapely.intersects_xy(area, made[:, 0], made[:, 1])]
        assert len(wanted) > 100 or area.is_empty
        assert xyz.tolist() == sorted(np.unique(wanted, axis=0).tolist())
    feet = dataclasses.replace(files, options=ReadOptions(crs="EPSG:2263", vertical_unit="m"))
    scale = np.array([1200.0 / 3937.0, 1200.0 / 3937.0, 1.0])
    in_feet = points_within(feet, [shapely.transform(area, lambda xy: xy * scale[:2]) for area in areas[:2]])
    for xyz, same in zip(in_feet, found, strict=False):
        assert xyz == pytest.approx(same * scale, abs=1e-6)


def test_of_copc_a_window_a_building_is_read_and_gives_the_same_points(
    points: PointFiles, monkeypatch: pytest.MonkeyPatch
) -> None:
    x, y, _ = small.ORIGIN
    areas = [shapely.box(x + 40.0 * place, y, x + 40.0 * place + reach, y + 8.0) for place, reach in ((0, 10), (2, 4))]
    wanted = points_within(points, areas)
    windows = []

    class Copc(Source):
        """A source that says that it can be queried by windows."""

        @property
        def info(self) -> SourceInfo:
            return dataclasses.replace(super().info, format="copc")

    def opened(path: str, options: ReadOptions) -> Source:
        if options.bbox is not None:
            windows.append(options.bbox)
        return Copc(Path(path), options)

    monkeypatch.setattr(comparison_points, "open_source", opened)
    found = points_within(points, areas)
    assert [len(xyz) for xyz in found] == [320, 128]
    assert all(np.array_equal(one, other) for one, other in zip(found, wanted, strict=True))
    assert [(east - west, north - south) for west, south, east, north in windows] == [(12.0, 10.0), (6.0, 10.0)]


def gable_model(runs: list[ComparedRun], place: int, name: str) -> RoofModel:
    return next(model for model in read_models(runs[place].run_dir).models if model.building_id == name)


def gable_points() -> np.ndarray:
    """Points on the gable of `small_buildings`."""
    steps = np.arange(0.25, 10.0, 0.5)
    x, y = (axis.ravel() for axis in np.meshgrid(steps, steps[:16]))
    return np.column_stack([x, y, 6.0 - 0.75 * np.abs(y - 4.0)]) + np.array(small.ORIGIN)


def raised(model: RoofModel, up_m: float) -> RoofModel:
    x, y, z = model.solid_origin
    surfaces = tuple(by_hand.lifted(one, up_m) for one in model.surfaces)
    return dataclasses.replace(model, surfaces=surfaces, solid_origin=(x, y, z + up_m))


def test_all_views_of_a_building_look_from_one_place_at_one_scale(runs: list[ComparedRun]) -> None:
    model = gable_model(runs, 0, "agreed")
    higher = raised(model, 2.0)
    drawn = draw_building([model, higher, model, None], model, gable_points())
    assert drawn.views[0] == drawn.views[2]
    assert drawn.views[3] is None
    sizes = {pixels(png).shape[:2] for png in (drawn.plan, drawn.truth, *drawn.views[:3]) if png is not None}
    assert sizes == {(drawn.height_px, drawn.width_px)}
    alone = draw_building([model, higher], None, np.zeros((0, 3)))
    masks = [pixels(png)[:, :, 3] > 0.5 for png in alone.views if png is not None]
    spans = [(np.ptp(np.flatnonzero(mask.any(axis=0))), np.ptp(np.flatnonzero(mask.any(axis=1)))) for mask in masks]
    assert spans[0] == pytest.approx(spans[1], abs=1)
    tops = [int(np.flatnonzero(mask.any(axis=1))[0]) for mask in masks]
    lefts = [int(np.flatnonzero(mask.any(axis=0))[0]) for mask in masks]
    assert tops[0] - tops[1] > 20
    assert lefts[0] == lefts[1]
    assert alone.plan is None


def test_points_in_a_view_have_the_colours_of_their_distances_to_that_model(runs: list[ComparedRun]) -> None:
    model = gable_model(runs, 0, "agreed")
    models = [model, raised(model, 0.3), raised(model, -1.0)]
    drawn = draw_building(models, None, gable_points())
    counts = [[count(png, entry.colour) for entry in RESIDUAL_CLASSES] for png in drawn.views if png is not None]
    bad = (0, 1, 3, 4, 5)
    assert max(counts[0][kind] for kind in bad) < 50
    bare = draw_building(models, None, np.zeros((0, 3))).views[0]
    assert bare is not None
    assert drawn.views[0] is not None
    assert np.sum(np.abs(pixels(drawn.views[0]) - pixels(bare)).max(axis=2) > 0.1) > 1000
    for found, wanted in zip(counts[1:], (1, 4), strict=True):
        assert found[wanted] > 500
        assert max(found[kind] for kind in bad if kind != wanted) < 50
    # The scale bar is in metres of the plan: the roof is 10 m wide.
    assert drawn.plan is not None
    shown = np.flatnonzero((pixels(drawn.plan)[:, :, 3] > 0.5).any(axis=0))
    assert np.ptp(shown) / (drawn.width_px * drawn.scale[1] / drawn.scale[0]) == pytest.approx(10.0, abs=0.7)


def test_points_are_those_of_half_the_runs_so_that_one_that_spreads_brings_no_neighbours_in(
    runs: list[ComparedRun],
) -> None:
    model = gable_model(runs, 0, "agreed")
    wide = dataclasses.replace(model, footprint=model.footprint.buffer(10.0), surfaces=())
    missing = dataclasses.replace(model, footprint=shapely.Polygon(), surfaces=())
    own = model.footprint.buffer(REACH_M, join_style="mitre")

    def area(*models: RoofModel, truth: RoofModel | None = None) -> float:
        return float(place_of(models, truth).area)

    assert area(model, wide, model) == area(model, missing, missing) == pytest.approx(own.area)
    assert area(model, wide) == pytest.approx(wide.footprint.buffer(REACH_M, join_style="mitre").area)
    assert area(model, missing, truth=wide) == pytest.approx(own.area)  # an outline without roofs adds nothing
    assert area(missing, truth=model) == pytest.approx(own.area)
    assert place_of([missing], None).is_empty


def test_a_block_is_grey_and_hatched_and_never_looks_like_a_model(runs: list[ComparedRun]) -> None:
    boxed = gable_model(runs, 2, "blocked")
    as_model = dataclasses.replace(boxed, status=Status.OK)
    drawn = draw_building([boxed, as_model], None, np.zeros((0, 3)))
    grey, coloured = (pixels(png) for png in drawn.views if png is not None)

    def shades(picture: np.ndarray, colour: str) -> int:
        """Opaque pixels of the hue of a colour in any light."""
        base = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)], np.float64)
        rgb = picture[:, :, :3] / np.maximum(picture[:, :, :3].max(axis=2, keepdims=True), 1e-9)
        return int(np.sum((np.abs(rgb - base / base.max()).max(axis=2) < 0.02) & (picture[:, :, 3] > 0.9)))

    assert shades(grey, BLOCK_COLOUR) > 5000
    assert shades(grey, ROOF_COLOURS[RoofType.FLAT]) < 200
    assert shades(coloured, ROOF_COLOURS[RoofType.FLAT]) > 5000
    # Hatched: along its middle the roof changes its shade again and again.
    row = grey[grey.shape[0] // 3, :, 0][grey[grey.shape[0] // 3, :, 3] > 0.9]
    same = coloured[grey.shape[0] // 3, :, 0][coloured[grey.shape[0] // 3, :, 3] > 0.9]
    assert np.sum(np.abs(np.diff(row)) > 0.04) > 10 + np.sum(np.abs(np.diff(same)) > 0.04)


def test_the_page_is_one_file_that_loads_nothing_and_shows_every_run_of_every_chosen_building(
    runs: list[ComparedRun], points: PointFiles, tmp_path: Path
) -> None:
    steps: list[str] = []
    paths = write_comparison(tmp_path / "out", runs, points=points, on_step=steps.append)
    assert [path.name for path in paths] == ["buildings.parquet", "compare.md", "index.html"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(path.name for path in paths)
    assert steps == ["records", "points", "pictures", "page"]
    text = paths[2].read_text()
    read = assert_loads_nothing(text, scripts=1)
    # Four buildings: a plan each, three views each, less the one that failed.
    assert len(read.all("img")) == 4 + 3 * 4 - 1
    assert sum(part.strip() == "no model" for part in read.texts) == 1
    assert "too_few_points: 2 points, at least 6" in text
    assert "no_plane: 0 planes, at least 1" in text
    assert_pictures_have_words_and_ids_are_unique(read)
    assert all("scope" in head for head in read.all("th"))
    assert len(text) < 5_000_000 / 4


@pytest.mark.slow
def test_a_page_of_five_methods_and_twelve_buildings_stays_below_five_megabytes(
    make_run: MakeRun, tmp_path: Path
) -> None:
    drawn = 2
    folder = make_run([moved(small.two_parts(f"b{k}"), 40.0 * k) for k in range(drawn)], "one")
    cloud = np.random.default_rng(1).uniform([0.0, 0.0, 3.0], [40.0 * drawn, 8.0, 6.0], (20_000, 3))
    path = tmp_path / "noise.xyz"
    np.savetxt(path, cloud + np.array(small.ORIGIN), fmt="%.3f")
    runs = [
        ComparedRun(label=f"method-{k}", method="m", preset="robust", run_dir=str(folder), seconds=None)
        for k in range(5)
    ]
    paths = write_comparison(tmp_path / "out", runs, points=PointFiles(paths=(str(path),)))
    assert len(Reader(paths[2].read_text()).all("img")) == drawn * 6
    assert paths[2].stat().st_size * CASES / drawn < 5_000_000


def test_names_from_outside_are_text_and_never_markup(runs: list[ComparedRun], tmp_path: Path) -> None:
    evil = [dataclasses.replace(run, label=f"{run.label}{EVIL}", method=EVIL, preset=EVIL) for run in runs]
    _, report, page = write_comparison(tmp_path / "out", evil)
    text = page.read_text()
    assert text.count("<script") == 1
    assert "<script" not in report.read_text()
    read = Reader(text)
    assert sum(EVIL in part for part in read.texts) >= 10


def test_the_table_of_the_page_is_bounded_and_says_so(
    runs: list[ComparedRun], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(comparison_page, "MAX_ROWS", 2)
    path, _, page = write_comparison(tmp_path / "out", runs)
    text = page.read_text()
    rows = re.findall(r'<tr><th scope="row"><code>(\w+)</code>', text)
    assert len(rows) == 2
    assert "agreed" not in rows
    assert "The 2 of 4 buildings with the largest differences" in text
    assert pq.read_table(path).num_rows == 4 * len(runs)


def test_the_report_counts_statuses_reasons_planes_and_times(runs: list[ComparedRun], tmp_path: Path) -> None:
    _, report, _ = write_comparison(tmp_path / "out", runs)
    lines = report.read_text().splitlines()
    for wanted in (
        "| models by the method | 4 (100.0 %) | 4 (100.0 %) | 2 (50.0 %) |",
        "| blocks in their place | 0 (0.0 %) | 0 (0.0 %) | 1 (25.0 %) (no_plane 1) |",
        "| failed | 0 (0.0 %) | 0 (0.0 %) | 1 (25.0 %) (too_few_points 1) |",
        "| roof planes of the models | 8 (2.0 a model) | 7 (1.8 a model) | 4 (2.0 a model) |",
        "| flat | 0 | 1 | 0 |",
        "| gable | 4 | 3 | 2 |",
        "| median | 0.250 s | 0.250 s | 1.50 s |",
        "| buildings with a known time | 4 | 4 | 1 |",
        "| RMSE of a building, median, blocks counted | 0.031 m (n = 4) | 0.031 m (n = 4) | 0.031 m (n = 3) |",
        "| RMSE of a building, median, where all have a model | 0.031 m (n = 2) | 0.031 m (n = 2) | 0.031 m (n = 2) |",
    ):
        assert wanted in lines


def test_what_is_written_does_not_depend_on_when_and_where(
    runs: list[ComparedRun], points: PointFiles, tmp_path: Path
) -> None:
    written = [write_comparison(tmp_path / name, runs, points=points) for name in ("one", "two")]
    for first, second in zip(*written, strict=True):
        assert first.read_bytes() == second.read_bytes()
