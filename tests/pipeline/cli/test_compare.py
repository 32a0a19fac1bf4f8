"""`gablework compare` as a user runs it: one command, one folder, one page."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import invoke

Compared = tuple[Path, dict[str, Any]]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a small simulated suburb."""
    folder = tmp_path_factory.mktemp("scene")
    size = ("--size", "70", "70", "--density", "4", "--seed", "3")
    assert invoke("simulate", "suburb", "--out", str(folder), *size, "--quiet")[0] == 0
    return folder


@pytest.fixture(scope="module")
def compared(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Compared:
    """Three variants measured against the truth: the folder, and the JSON document."""
    out = tmp_path_factory.mktemp("compared") / "out"
    methods = ("--methods", "fuzzy-sart,kmeans:faithful", "--methods", "parameter-space-3d")
    options = ("--truth", str(scene / "truth"), "--workers", "0", "--json")
    code, said, reported = invoke("compare", str(scene / "suburb.laz"), *methods, "--out", str(out), *options)
    assert code == 0, reported
    return out, json.loads(said)


def test_everything_is_in_one_folder(compared: Compared) -> None:
    out, _ = compared
    files = {"compare.json", "buildings.parquet", "compare.md", "index.html"}
    assert {entry.name for entry in out.iterdir()} == files | {"runs"}
    labels = {"fuzzy-sart", "kmeans-faithful", "parameter-space-3d"}
    assert {entry.name for entry in (out / "runs").iterdir()} == labels


def test_the_document_is_what_compare_json_holds(compared: Compared) -> None:
    out, document = compared
    stored = json.loads((out / "compare.json").read_text())
    assert {name: document[name] for name in stored} == stored
    candidates = {reported["counts"]["candidates"] for reported in stored["variants"]}
    assert len(candidates) == 1
    for reported in stored["variants"]:
        assert sum(reported["statuses"].values()) == candidates.copy().pop()
        manifest = json.loads((out / reported["run_dir"] / "run.json").read_text())
        assert manifest["content_sha256"] == reported["content_sha256"]
        assert reported["seconds_a_building"]["median"] > 0.0
        table = pq.read_table(out / "buildings.parquet", columns=["label", "seconds"])
        seconds = [row["seconds"] for row in table.to_pylist() if row["label"] == reported["label"]]
        expected = {"mean": np.mean(seconds), "median": np.median(seconds), "p95": np.quantile(seconds, 0.95)}
        assert reported["seconds_a_building"] == pytest.approx(expected, abs=1e-6)


def test_every_building_has_a_row_a_method(compared: Compared) -> None:
    out, document = compared
    table = pq.read_table(out / "buildings.parquet")
    candidates = document["variants"][0]["counts"]["candidates"]
    assert table.num_rows == 3 * candidates
    assert set(table.column("label").to_pylist()) == {reported["label"] for reported in document["variants"]}
    assert "outcome" in table.column_names


def test_the_page_names_every_method_and_every_building(compared: Compared) -> None:
    out, document = compared
    page = (out / "index.html").read_text()
    for reported in document["variants"]:
        assert reported["label"] in page
    for building_id in set(pq.read_table(out / "buildings.parquet").column("building_id").to_pylist()):
        assert building_id in page


def test_children_give_what_this_process_gives(scene: Path, compared: Compared, tmp_path: Path) -> None:
    methods = ("--methods", "fuzzy-sart,kmeans:faithful,parameter-space-3d")
    options = ("--truth", str(scene / "truth"), "--json")
    out = ("--out", str(tmp_path / "out"))
    code, said, reported = invoke("compare", str(scene / "suburb.laz"), *methods, *out, *options)
    assert code == 0, reported
    local, serial = json.loads(said)["variants"], compared[1]["variants"]
    for name in ("label", "statuses", "counts", "content_sha256"):
        assert [one[name] for one in local] == [one[name] for one in serial]
    for one in local:
        manifest = json.loads((tmp_path / "out" / one["run_dir"] / "run.json").read_text())
        assert len(manifest["peak_memory_bytes"]) > 1, "this process, and children"


def test_bad_variants_are_refused_before_anything_is_written(scene: Path, tmp_path: Path) -> None:
    methods = ("--methods", "magic,fuzzy-sart:bold")
    code, _, reported = invoke("compare", str(scene / "suburb.laz"), *methods, "--out", str(tmp_path / "out"))
    assert code == 2
    assert "magic" in reported
    assert "bold" in reported
    assert not (tmp_path / "out").exists()


def test_a_reference_that_cannot_be_read_is_reported_before_the_runs(scene: Path, tmp_path: Path) -> None:
    nowhere = ("--truth", str(tmp_path / "nowhere"), "--workers", "0")
    methods = ("--methods", "fuzzy-sart,fuzzy-sart:faithful")
    code, _, reported = invoke("compare", str(scene / "suburb.laz"), *methods, "--out", str(tmp_path / "out"), *nowhere)
    assert code != 0
    assert "nowhere" in reported
    assert not (tmp_path / "out").exists()
