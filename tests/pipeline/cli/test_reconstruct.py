"""The main job on the command line: a simulated tile in, a run directory out."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import laspy
import pytest
from checkout import ROOT
from command_line import invoke

from pipeline.console import ExitCode

Run = tuple[Path, dict[str, Any], list[dict[str, Any]]]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a simulated gable roof."""
    folder = tmp_path_factory.mktemp("scene")
    code, said, _ = invoke("simulate", "gable", "--out", str(folder), "--size", "40", "40", "--json")
    assert code == 0
    assert json.loads(said)["buildings"] == 1
    return folder


@pytest.fixture(scope="module")
def run(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run on it in this process: directory, JSON document, events."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    tile = str(scene / "gable.laz")
    code, said, events = invoke("reconstruct", tile, "--out", str(folder), "--workers", "0", "--json")
    assert code == 0
    return folder, json.loads(said), [json.loads(line) for line in events.splitlines()]


def test_the_gable_becomes_one_gable(run: Run) -> None:
    _, summary, _ = run
    assert summary["statuses"] == {"ok": 1}
    assert summary["roof_types"] == {"gable": 1}
    assert summary["failed_tiles"] == []


def test_the_run_directory_is_laid_out_as_documented(run: Run) -> None:
    folder, _, _ = run
    page = ROOT / "docs" / "run_directory.md"
    documented = {line.split("/")[0].split(" ")[0] for line in page.read_text().split("```")[1].splitlines() if line}
    assert {entry.name for entry in folder.iterdir()} == documented - {"run.html", "points", "terrain"}
    assert invoke("report", str(folder))[0] == 0
    assert {entry.name for entry in folder.iterdir()} == documented - {"points", "terrain"}
    (folder / "run.html").unlink()
    assert len(list(folder.glob("meshes/*/*.obj"))) == 1


def test_inspect_adds_up_the_figures_and_reasons_of_a_run(run: Run) -> None:
    folder, summary, _ = run
    code, said, _ = invoke("inspect", str(folder), "--json")
    assert code == 0
    statistics = json.loads(said)["statistics"]
    assert statistics["roof_types"] == {"gable": 1}
    assert statistics["rejected_reasons"] == summary["rejected"]
    _, said, _ = invoke("inspect", str(folder))
    assert "Candidates" in said


def test_inspect_refuses_for_a_run_what_only_tiles_need(run: Run, tmp_path: Path) -> None:
    settings = tmp_path / "fine.toml"
    settings.write_text("[settings]\n")
    for option, value in (("--settings", str(settings)), ("--crs", "EPSG:25832"), ("--vertical-unit", "m")):
        code, said, error = invoke("inspect", str(run[0]), option, value)
        assert (code, said) == (2, "")
        assert f"{option} {value}" in " ".join(error.split())
        assert "Leave them out" in " ".join(error.split())


def test_levels_of_detail_are_written_side_by_side(scene: Path, run: Run, tmp_path: Path) -> None:
    words = ("reconstruct", str(scene / "gable.laz"), "--out", str(tmp_path / "run"), "--workers", "0", "--json")
    code, said, _ = invoke(*words, "--lods", "2.2, 1.2,1.3")
    assert code == 0
    assert json.loads(said)["statuses"] == {"ok": 1}
    assert json.loads((tmp_path / "run" / "run.json").read_text())["settings"]["general"]["lods"] == "1.2,1.3,2.2"
    (own,) = run[0].glob("meshes/*/*.obj")
    meshes = {path.name: path for path in tmp_path.glob("run/meshes/*/*.obj")}
    assert set(meshes) == {own.name, f"{own.stem}-lod12.obj", f"{own.stem}-lod13.obj"}
    assert meshes[own.name].read_bytes() == own.read_bytes()
    code, said, _ = invoke(*words, "--lods", "2.1")
    assert code == ExitCode.USAGE
    assert "lods is '2.1': use one of 1.2, 1.3, 2.0, 2.2" in said


def test_the_stages_are_reported_in_order(run: Run) -> None:
    stages = [event["stage"] for event in run[2] if event["kind"] == "stage"]
    assert stages == ["ingest", "cells", "ground", "split", "join", "outline", "reconstruct", "publish"]


def test_a_building_is_overridden_and_the_run_brought_in_line(scene: Path, run: Run, tmp_path: Path) -> None:
    folder, summary, _ = run
    name = next(folder.glob("meshes/*/*.obj")).stem
    overrides = tmp_path / "overrides.toml"
    overrides.write_text(f'[[building]]\nbuilding_id = "{name}"\naction = "reject"\n')
    out = str(tmp_path / "run")
    tile = str(scene / "gable.laz")
    whole = ("reconstruct", tile, "--out", out, "--overrides", str(overrides), "--workers", "0", "--json")
    code, said, _ = invoke(*whole)
    assert code == 0
    rejected = json.loads(said)
    assert (rejected["statuses"], rejected["rejected"]["overridden"]) == ({}, 1)
    overrides.write_text("")
    # by children, as nothing says otherwise
    code, said, _ = invoke("rerun", out, "--json")
    assert code == 0
    assert json.loads(said)["buildings"] == {name: "ok"}
    assert json.loads(said)["digest"] == summary["digest"]
    assert invoke("rerun", out, "--only", "abc", "--workers", "0")[0] == 4
    overrides.write_text("[[building]]\naction = 'drop'")
    assert invoke("rerun", out, "--workers", "0")[0] == invoke(*whole, "--overwrite")[0] == 2


def test_digest_prints_what_the_run_reported(run: Run) -> None:
    folder, summary, _ = run
    assert invoke("digest", str(folder)) == (0, f"{summary['digest']}\n", "")


def test_a_second_run_needs_leave_to_overwrite_and_gives_the_same(scene: Path, run: Run, tmp_path: Path) -> None:
    folder, summary, _ = run
    # by children, as nothing says otherwise; the first run was serial
    again = ("reconstruct", str(scene), "--out", str(folder), "--json")
    code, said, _ = invoke(*again)
    assert code == 4
    assert "--overwrite" in json.loads(said)["error"]["message"]
    assert len(json.loads((folder / "run.json").read_text())["peak_memory_bytes"]) == 1
    code, said, _ = invoke(*again, "--overwrite", "--meshes", "none")
    assert code == 0
    assert json.loads(said)["digest"] == summary["digest"]
    assert len(json.loads((folder / "run.json").read_text())["peak_memory_bytes"]) > 1
    assert not list(folder.glob("meshes/*/*.obj"))


def test_a_settings_file_decides_and_the_command_line_wins(scene: Path, tmp_path: Path) -> None:
    settings = tmp_path / "run.toml"
    settings.write_text('[settings]\nclasses = "ignore"\n[settings.candidates]\nmin_area_m2 = 900.0\n')
    tile = str(scene / "gable.laz")
    words = ("--out", str(tmp_path / "run"), "--workers", "0", "--settings", str(settings), "--classes", "audit")
    code, said, _ = invoke("reconstruct", tile, *words, "--json")
    assert code == 0
    assert json.loads(said)["statuses"] == {}
    manifest = json.loads((tmp_path / "run" / "run.json").read_text())
    assert manifest["settings"]["general"]["classes"] == "audit"
    assert manifest["settings"]["candidates"]["min_area_m2"] == 900.0


def test_people_get_tables(scene: Path, tmp_path: Path) -> None:
    words = ("--out", str(tmp_path / "run"), "--workers", "0", "--licence", "CC0")
    code, said, log = invoke("reconstruct", str(scene / "gable.laz"), *words)
    assert code == 0
    assert "Roof types" in said
    assert str(tmp_path / "run") in said
    assert "reconstruct 1/1" in log
    assert json.loads((tmp_path / "run" / "run.json").read_text())["source_licence"] == "CC0"


@pytest.mark.parametrize(
    ("bbox", "code"),
    [(("0", "0", "1", "1"), 3), (("9", "9", "1", "1"), 2)],
    ids=["nothing inside", "upside down"],
)
def test_a_rectangle_without_points_or_sense_is_refused(
    scene: Path, tmp_path: Path, bbox: tuple[str, ...], code: int
) -> None:
    words = ("--out", str(tmp_path / "run"), "--workers", "0", "--bbox", *bbox)
    assert invoke("reconstruct", str(scene / "gable.laz"), *words)[0] == code


def test_the_query_of_the_docs_finds_the_building(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    import duckdb

    page = ROOT / "docs" / "run_directory.md"
    query = page.read_text().split("```sql")[-1].split("```")[0]
    monkeypatch.chdir(run[0].parent)
    rows = duckdb.sql(query).fetchall()
    assert [row[1] for row in rows] == ["gable"]
    assert rows[0][4].startswith("x")


@pytest.mark.parametrize(
    ("field", "said"), [("failed_tiles", "tile x1_y2 failed"), ("tiles_without_points", "tile x1_y2 has no points")]
)
def test_a_tile_that_lacks_something_is_exit_code_1(
    scene: Path, run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, field: str, said: str
) -> None:
    import pipeline.runtime.run as module

    whole = module.run

    def run_with_a_failed_tile(request: module.RunRequest, listener: Any) -> module.RunSummary:
        return dataclasses.replace(whole(request, listener), **{field: ("x1_y2",)})

    monkeypatch.setattr(module, "run", run_with_a_failed_tile)
    words = ("--out", str(tmp_path / "run"), "--workers", "0")
    code, _, log = invoke("reconstruct", str(scene / "gable.laz"), *words)
    assert code == 1
    assert [line for line in log.splitlines() if "x1_y2" in line] == [f"warning: {said}"]


def test_points_of_class_2_alone_are_named_on_the_first_line(scene: Path, tmp_path: Path) -> None:
    las = laspy.read(scene / "gable.laz")
    las.classification[:] = 2
    las.write(tmp_path / "ground.laz")
    code, said, log = invoke(
        "reconstruct", str(tmp_path / "ground.laz"), "--out", str(tmp_path / "run"), "--workers", "0"
    )
    assert code == 0
    first = said.splitlines()[0]
    assert (said + log).count(first.removeprefix("warning: ")) == 1
    assert first.startswith(f"warning: all {len(las.points)} points are of class 2 (ground), so none can be a roof")
    arguments = ("--out", str(tmp_path / "again"), "--workers", "0", "--json")
    summary = json.loads(invoke("reconstruct", str(tmp_path / "ground.laz"), *arguments)[1])
    assert summary["headline"] == summary["warnings"][0] == first.removeprefix("warning: ")


@pytest.mark.parametrize(
    ("crs", "words"),
    [("EPSG:25832", "none of its footprints lies on the data"), (None, "in degrees, which x 0, y 5e+06 cannot be")],
)
def test_footprints_off_the_data_end_with_the_exit_code_of_an_input(
    scene: Path, tmp_path: Path, crs: str | None, words: str
) -> None:
    ring = [[0.0, 5e6], [10.0, 5e6], [10.0, 5_000_010.0], [0.0, 5e6]]
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    named = {} if crs is None else {"crs": {"type": "name", "properties": {"name": crs}}}
    given = tmp_path / "a.geojson"
    given.write_text(json.dumps({"type": "FeatureCollection", "features": [feature], **named}))
    tile, out = str(scene / "gable.laz"), str(tmp_path / "run")
    code, _, error = invoke("reconstruct", tile, "--out", out, "--workers", "0", "--footprints", str(given))
    assert code == ExitCode.INPUT
    assert words.replace("x 0, y 5e+06", "x 10, y 5000010") in " ".join(error.split())
    assert not Path(out).exists()
    code, _, error = invoke("reconstruct", tile, "--out", out, "--workers", "0", "--layer", "sheds")
    assert code == ExitCode.USAGE
    assert "--layer sheds names a layer of footprints, and none are given" in error
