"""Publishing a run: all of it, nothing of it changed, and a file that is whole or the one of before."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyogrio
import pytest
from command_line import invoke
from small_runs import content, moved, restated, street, write_run, write_whole_run

import pipeline.extras.publish.cityjson_file
import pipeline.extras.publish_gis.geopackage
from pipeline.errors import RunError
from pipeline.export.geoparquet import read_table
from pipeline.export.record_rows import KEYS
from pipeline.export.tile import write_tile
from pipeline.extras.publish.cityjson_file import city_of, publish_cityjson
from pipeline.extras.publish_gis.geopackage import LAYERS, Layer, publish_geopackage, stored_batch
from pipeline.runtime.digest import run_digest


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """A finished run of four buildings on two tiles, whose states list their files."""
    return write_whole_run(tmp_path / "run")


def test_every_row_is_published_and_the_run_stays_as_it_is(run_dir: Path, tmp_path: Path) -> None:
    before, digest = content(run_dir), run_digest(str(run_dir))
    out = tmp_path / "new" / "run.gpkg"
    published = publish_geopackage(str(run_dir), str(out))
    assert published.place == str(out)
    assert published.size_bytes == out.stat().st_size
    assert list(published.rows) == [layer.name for layer in LAYERS]
    assert content(run_dir) == before
    assert run_digest(str(run_dir)) == digest
    for name, key in KEYS.items():
        _, read = pyogrio.read_arrow(out, layer=name)
        table = read_table(str(run_dir), name)
        assert published.rows[name] == len(read) == len(table) > 0
        ordered = read.sort_by([(column, "ascending") for column in key])
        same = [column for column in (*key, "tile", "n_points", "area_m2", "status") if column in table.column_names]
        assert ordered.select(same).to_pylist() == table.select(same).to_pylist()
    assert list(out.parent.iterdir()) == [out]


def test_a_run_without_buildings_has_empty_layers(tmp_path: Path) -> None:
    run_dir = write_run(tmp_path / "run", [])
    published = publish_geopackage(str(run_dir), str(tmp_path / "run.gpkg"))
    assert set(published.rows.values()) == {0}
    assert len(pyogrio.list_layers(tmp_path / "run.gpkg")) == len(LAYERS) + 1


def test_a_run_of_before_decisions_is_published_without_them(run_dir: Path, tmp_path: Path) -> None:
    shutil.rmtree(run_dir / "decisions")
    shutil.rmtree(run_dir / "state")
    assert list(publish_geopackage(str(run_dir), str(tmp_path / "a.gpkg")).rows) == [
        "buildings",
        "planes",
        "rejected",
    ]


@pytest.mark.parametrize("layer", LAYERS, ids=lambda layer: layer.name)
def test_a_run_that_lost_a_file_is_not_published(run_dir: Path, tmp_path: Path, layer: Layer) -> None:
    publish_geopackage(str(run_dir), str(tmp_path / "whole.gpkg"))
    shutil.rmtree(run_dir / layer.name / "tile=t2")
    with pytest.raises(RunError, match=rf"{layer.name}/tile=t2/part-0\.parquet of the run .* is gone"):
        publish_geopackage(str(run_dir), str(tmp_path / "run.gpkg"))
    assert not (tmp_path / "run.gpkg").exists()


def test_memory_holds_a_tile_and_not_the_run(
    tmp_path: Path, contexts: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    run_dir = write_run(tmp_path / "run", [])
    for number in range(8):
        row = [
            dataclasses.replace(moved(one, 100.0 * number), building_id=f"{number}-{copy}")
            for copy in range(20)
            for one in street()[2:3]
        ]
        write_tile(run_dir, f"m{number}", row, [], contexts["compound"])
    held: list[int] = []

    def watched(batch: pa.RecordBatch, layer: Layer, tile: str) -> pa.RecordBatch:
        stored = stored_batch(batch, layer, tile)
        if layer.name == "decisions" or layer.name == "planes":
            held.append(pa.total_allocated_bytes())
        return stored

    monkeypatch.setattr(pipeline.extras.publish_gis.geopackage, "stored_batch", watched)
    publish_geopackage(str(run_dir), str(tmp_path / "run.gpkg"))
    assert len(held) >= 8
    assert max(held) < 2 * held[0]


def test_each_tile_becomes_a_cityjson_file_with_its_buildings(run_dir: Path, tmp_path: Path) -> None:
    restated(run_dir, counts={"candidates": 4, "rejected": 1})
    before, out = content(run_dir), tmp_path / "new" / "city"
    published = publish_cityjson(str(run_dir), str(out))
    assert content(run_dir) == before
    files = content(out)
    assert set(files) == {"t1.city.json", "t2.city.json"}
    assert (published.place, published.rows) == (str(out), {"buildings": 4})
    assert published.size_bytes == sum(map(len, files.values()))
    for tile in ("t1", "t2"):
        lines = (run_dir / "cityjson" / f"tile={tile}" / "part-0.city.jsonl").read_text().splitlines()
        assert json.loads(files[f"{tile}.city.json"]) == city_of(lines)
    assert list(out.parent.iterdir()) == [out]


def test_files_are_replaced_only_where_asked_and_all_else_in_the_folder_stays(run_dir: Path, tmp_path: Path) -> None:
    out = tmp_path / "city"
    out.mkdir()
    (out / "notes.txt").write_text("mine")
    publish_cityjson(str(run_dir), str(out))
    fresh = content(out)
    (out / "t1.city.json").write_text("of before")
    with pytest.raises(RunError, match=r"holds t1\.city\.json already.*--overwrite"):
        publish_cityjson(str(run_dir), str(out))
    assert (out / "t1.city.json").read_text() == "of before"
    publish_cityjson(str(run_dir), str(out), overwrite=True)
    assert content(out) == fresh
    assert set(fresh) == {"t1.city.json", "t2.city.json", "notes.txt"}


def test_a_folder_with_cityjson_of_others_is_refused(run_dir: Path, tmp_path: Path) -> None:
    out = tmp_path / "city"
    out.mkdir()
    (out / "mine.city.json").write_text("mine")
    before = content(tmp_path)
    with pytest.raises(RunError, match=r"holds mine\.city\.json, which is not of this run"):
        publish_cityjson(str(run_dir), str(out), overwrite=True)
    assert content(tmp_path) == before


def test_cityjson_of_a_run_that_lost_a_file_or_has_a_torn_one_is_refused(run_dir: Path, tmp_path: Path) -> None:
    path = run_dir / "cityjson" / "tile=t2" / "part-0.city.jsonl"
    text = path.read_text()
    path.write_text(text[: len(text) // 2])
    with pytest.raises(RunError, match=r"tile=t2/part-0\.city\.jsonl of the run .* is damaged"):
        publish_cityjson(str(run_dir), str(tmp_path / "city"))
    path.unlink()
    with pytest.raises(RunError, match=r"tile=t2/part-0\.city\.jsonl of the run .* is gone"):
        publish_cityjson(str(run_dir), str(tmp_path / "city"))
    assert not (tmp_path / "city").exists()


def test_cityjson_takes_the_tables_files_alone_and_any_text(run_dir: Path, tmp_path: Path) -> None:
    (run_dir / "cityjson" / "_SUCCESS").write_bytes(b"")
    path = run_dir / "cityjson" / "tile=t1" / "part-0.city.jsonl"
    text = "one\u2028two\u0085three"
    path.write_text(path.read_text().replace('"status":"ok"', f'"status":"{text}"'))
    publish_cityjson(str(run_dir), str(tmp_path / "city"))
    city = json.loads((tmp_path / "city" / "t1.city.json").read_text())
    assert text in {thing["attributes"]["status"] for thing in city["CityObjects"].values() if "attributes" in thing}


def test_a_form_that_is_not_known_is_refused_with_those_that_are(run_dir: Path, tmp_path: Path) -> None:
    code, _, said = invoke("publish", str(run_dir), "--as", "papyrus", "--out", str(tmp_path / "a"))
    assert code == 2
    assert "use one of 3dtiles, geopackage, pmtiles, cityjson, stac" in said
