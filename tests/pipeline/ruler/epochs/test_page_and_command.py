"""`gablework batch diff` as a user types it, and the page that it writes."""

import base64
import dataclasses
import json
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from command_line import app
from epochs_by_hand import house, write_epoch
from page_reader import Reader, assert_links_stay_within, count
from typer.testing import CliRunner

from pipeline.console import ExitCode
from pipeline.report import class_map
from pipeline.report.class_map import ClassMap
from pipeline.ruler.epochs.change_records import SCHEMA, Change
from pipeline.ruler.epochs.diff import Diff, DiffRequest, diff
from pipeline.ruler.report.epochs_map import COLOURS, epochs_map, gathering
from pipeline.ruler.report.epochs_page import page


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    """Two runs with a building of every class."""
    old = [
        *(house("a1"), house("b1", 40.0), house("c1", 80.0), house("e1", 0.0, 40.0), house("x1", 40.0, 80.0)),
        house("g1", 80.0, 80.0, at_edge=True),
    ]
    new = [
        *(house("a2"), house("b2", 40.0, eave=8.0), house("d2", 80.0, 40.0), house("e2", 0.0, 40.0, length=18.0)),
        *(house("x2", 40.0, 80.0, eave=3.0), house("g2", 80.0, 80.0)),
    ]
    return write_epoch(tmp_path / "y2019", old), write_epoch(tmp_path / "y2024", new)


def compared_on_a_map(old: Path, new: Path) -> tuple[Diff, ClassMap]:
    """What a comparison found, and the map of it."""
    rows = epochs_map()
    request = DiffRequest(old=str(old), new=str(new), out=str(new.with_name("out")))
    return diff(request, take_in=(gathering(rows),)), rows


def invoke(*words: str | Path) -> Any:
    return CliRunner().invoke(app, ["batch", "diff", *(str(word) for word in words)])


def test_the_command_writes_four_files_and_prints_the_sums(pair: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = invoke(*pair, "--out", out)
    assert result.exit_code == ExitCode.DONE, result.stderr
    assert sorted(path.name for path in out.iterdir()) == [
        f"changes.{end}" for end in ("geojson", "html", "json", "parquet")
    ]
    assert "the data of OLD end at this building" in result.stdout
    for change in Change:
        assert change.value.replace("_", " ") in result.stdout


def test_json_is_one_document_that_is_also_a_file(pair: tuple[Path, Path], tmp_path: Path) -> None:
    result = invoke(*pair, "--out", tmp_path / "out", "--json", "--no-page", "--geojson", "none")
    document = json.loads(result.stdout)
    written = [Path(path).name for path in document.pop("written")]
    assert written == ["changes.parquet", "changes.json"]
    assert document == json.loads((tmp_path / "out" / "changes.json").read_text())
    assert {name: sums["rows"] for name, sums in document["changes"].items()} == dict.fromkeys(
        (change.value for change in Change), 1
    )
    assert all(json.loads(line)["kind"] for line in result.stderr.splitlines())


def test_options_stand_above_the_file(pair: tuple[Path, Path], tmp_path: Path) -> None:
    settings = tmp_path / "diff.toml"
    settings.write_text("[diff]\nmin_height_change_m = 4.0\nmin_area_change_m2 = 500.0\n")
    words = (*pair, "--out", tmp_path / "out", "--settings", settings, "--json", "--no-page")
    changes = json.loads(invoke(*words).stdout)["changes"]
    assert (changes["raised"]["rows"], changes["reshaped"]["rows"], changes["unchanged"]["rows"]) == (0, 0, 4)
    found = json.loads(invoke(*words, "--min-height-change", "2.5").stdout)
    assert found["changes"]["raised"]["rows"] == 1
    assert found["settings"]["min_height_change_m"] == 2.5


@pytest.mark.parametrize(
    ("words", "code", "found"),
    [
        (["--min-width", "-3"], ExitCode.USAGE, "min_width_m is -3: use 0.2 to 50 m"),
        (["--settings", "nowhere.toml"], ExitCode.USAGE, "nowhere.toml cannot be read"),
    ],
)
def test_wrong_settings_end_with_their_code(
    pair: tuple[Path, Path], tmp_path: Path, words: list[str], code: ExitCode, found: str
) -> None:
    result = invoke(*pair, "--out", tmp_path / "out", *words)
    assert (result.exit_code, found in result.stderr) == (code, True), result.stderr
    assert not (tmp_path / "out").exists()


def test_runs_that_cannot_be_compared_end_with_their_code(pair: tuple[Path, Path], tmp_path: Path) -> None:
    other = write_epoch(tmp_path / "other", [house("a2")], crs="EPSG:25833+7837")
    assert invoke(pair[0], other, "--out", tmp_path / "out").exit_code == ExitCode.INPUT
    assert invoke(pair[0], tmp_path / "nowhere", "--out", tmp_path / "out").exit_code == ExitCode.RUN_DIRECTORY


def test_the_page_holds_all_that_it_shows(pair: tuple[Path, Path]) -> None:
    made, rows = compared_on_a_map(*pair)
    text = page(made, rows)
    read = Reader(text)
    assert read.open == []
    assert "Changes: y2019 to y2024" in read.texts
    assert_links_stay_within(read)
    listed = [one["data-change"] for one in read.all("tr") if "data-change" in one]
    assert sorted(listed) == sorted(change.value for change in Change if change is not Change.UNCHANGED)
    pictures = {one["alt"]: one["src"] for one in read.all("img")}
    (seen,) = (alt for alt in pictures if alt and alt.startswith("Map:"))
    png = base64.b64decode(str(pictures[seen]).split(",")[1])
    for change in Change:
        if change is not Change.NOT_COMPARABLE:  # which is hatched
            assert count(png, COLOURS[change]) > 200, change
    assert sum(alt.startswith("Outlines of") for alt in pictures if alt) == 5
    assert "min_height_change_m" in read.texts


def test_a_new_version_is_named_on_the_page_in_the_tables_and_at_each_reshaped_building(tmp_path: Path) -> None:
    old = write_epoch(tmp_path / "old", [house("a1"), house("b1", 40.0)], engine_version="0.2.0")
    new = write_epoch(tmp_path / "new", [house("a2", length=18.0), house("b2", 40.0)], engine_version="0.3.0")
    text = page(*compared_on_a_map(old, new))
    assert "the versions differ: OLD is of 0.2.0, NEW of 0.3.0" in text
    assert "may draw outlines and roofs anew where nothing was built" in text
    assert "other version" in text.partition('data-change="reshaped"')[2].partition("</tr>")[0]
    result = invoke(old, new, "--out", tmp_path / "changes")
    assert "OLD is of 0.2.0, NEW of 0.3.0" in result.stderr
    document = json.loads((tmp_path / "changes" / "changes.json").read_text())
    assert document["doubts"] == {"other_version": 1}
    assert document["changes"]["reshaped"]["without_doubt"] == 0


def test_text_of_the_users_is_no_markup(tmp_path: Path) -> None:
    evil = dataclasses.replace(house("e2"), source_id="<script>alert(1)</script>")
    made, rows = compared_on_a_map(write_epoch(tmp_path / "o", []), write_epoch(tmp_path / "new", [evil]))
    assert "<script>alert" not in page(made, rows)


@pytest.mark.slow
def test_a_map_of_very_many_buildings_keeps_its_bounds(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(class_map, "MAX_ORDINARY", 20)
    monkeypatch.setattr(class_map, "MAX_DRAWN", 10)
    houses = [house(f"h{k}_1", 30.0 * (k % 10), 30.0 * (k // 10)) for k in range(40)]
    added = [house(f"n{k}_2", 30.0 * (k % 10), 300.0 + 30.0 * (k // 10), length=10.0 + k / 10.0) for k in range(25)]
    made, rows = compared_on_a_map(
        write_epoch(tmp_path / "old", houses), write_epoch(tmp_path / "new", [*houses, *added])
    )
    assert made.summary.rows == {"new": 25, "unchanged": 40}
    drawn = rows.map(1.0)
    assert drawn is not None
    assert {entry.label: entry.count for entry in drawn.legend} == {"unchanged": 40, "new": 25}
    assert rows.left_out == 15
    assert count(drawn.png, COLOURS[Change.UNCHANGED]) > 0


def test_a_comparison_of_nothing_has_a_page_too(tmp_path: Path) -> None:
    made, rows = compared_on_a_map(*(write_epoch(tmp_path / name, []) for name in ("old", "new")))
    assert rows.map(1.0) is None
    assert Reader(page(made, rows)).all("table") != []
    gathering(rows)(SCHEMA.empty_table())
    assert isinstance(made.summary.largest, pa.Table)
