"""Publishing a run: all of it, nothing of it changed, and a file that is whole or the one of before."""

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyogrio
import pyproj
import pytest
from command_line import invoke
from small_runs import content, moved, restated, street, write_run, write_whole_run

import pipeline.extras.publish.publishing as publishing
from pipeline.errors import RunError, SettingsError
from pipeline.export.geoparquet import read_table
from pipeline.export.records import KEYS
from pipeline.export.tile import write_tile
from pipeline.extras.publish.cityjson_file import city_of
from pipeline.extras.publish.publishing import publish_cityjson, publish_geopackage, publish_pmtiles
from pipeline.extras.publish_gis.geopackage import LAYERS, Layer, stored_batch
from pipeline.io import storage_at
from pipeline.runtime.digest import run_digest
from pipeline.runtime.manifest import RunStatus


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


def test_a_run_gives_the_same_bytes_each_time(run_dir: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "a.gpkg", tmp_path / "b.gpkg"
    for path in (first, second):
        publish_geopackage(str(run_dir), str(path))
    assert first.read_bytes() == second.read_bytes()


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


@pytest.mark.parametrize("status", [status for status in RunStatus if status is not RunStatus.FINISHED])
def test_a_run_that_is_not_finished_is_refused(run_dir: Path, tmp_path: Path, status: RunStatus) -> None:
    restated(run_dir, status=status, tiles=("t1", "t2"), failed_tiles=("t2",))
    with pytest.raises(RunError, match=rf"{run_dir} is {status.value}") as refused:
        publish_geopackage(str(run_dir), str(tmp_path / "run.gpkg"))
    assert ("1 of 2 tiles failed (t2)" in str(refused.value)) == (status is RunStatus.INCOMPLETE)
    assert not (tmp_path / "run.gpkg").exists()


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"run\.json does not exist: give the directory that a run wrote"):
        publish_geopackage(str(tmp_path), str(tmp_path.parent / "run.gpkg"))


def test_an_existing_file_is_replaced_only_where_asked(run_dir: Path, tmp_path: Path) -> None:
    out = tmp_path / "run.gpkg"
    out.write_text("of before")
    with pytest.raises(RunError, match=r"run\.gpkg exists already.*--overwrite"):
        publish_geopackage(str(run_dir), str(out))
    assert out.read_text() == "of before"
    publish_geopackage(str(run_dir), str(out), overwrite=True)
    assert out.read_bytes().startswith(b"SQLite")


def test_a_place_that_cannot_be_a_geopackage_is_refused(run_dir: Path, tmp_path: Path) -> None:
    places = {
        "s3://bucket/run.gpkg": "Give a path of this machine",
        str(tmp_path / "run.zip"): r"ends in \.zip: give a name that ends in \.gpkg",
        str(run_dir / "run.gpkg"): "lies in the run directory",
    }
    before = content(tmp_path)
    for place, words in places.items():
        with pytest.raises(SettingsError, match=words):
            publish_geopackage(str(run_dir), place, overwrite=True)
    (tmp_path / "folder.gpkg").mkdir()
    with pytest.raises(RunError, match=r"folder\.gpkg is a folder"):
        publish_geopackage(str(run_dir), str(tmp_path / "folder.gpkg"), overwrite=True)
    assert content(tmp_path) == before


def fails_at(tile: str, fault: BaseException) -> Callable[..., pa.RecordBatch]:
    """A `stored_batch` that raises at one tile of the second layer."""

    def broken(batch: pa.RecordBatch, layer: Layer, at: str) -> pa.RecordBatch:
        if (layer.name, at) == ("planes", tile):
            raise fault
        return stored_batch(batch, layer, at)

    return broken


@pytest.mark.parametrize("fault", [RunError("the disk is gone"), KeyboardInterrupt(), MemoryError()])
def test_where_publishing_breaks_off_the_old_file_stays(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: BaseException
) -> None:
    out = tmp_path / "run.gpkg"
    publish_geopackage(str(run_dir), str(out))
    before = content(tmp_path)
    monkeypatch.setattr(publishing, "stored_batch", fails_at("t2", fault))
    with pytest.raises(type(fault)):
        publish_geopackage(str(run_dir), str(out), overwrite=True)
    assert content(tmp_path) == before


def test_a_run_that_changes_meanwhile_is_not_published(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def changing(batch: pa.RecordBatch, layer: Layer, tile: str) -> pa.RecordBatch:
        restated(run_dir, status=RunStatus.RUNNING)
        return stored_batch(batch, layer, tile)

    monkeypatch.setattr(publishing, "stored_batch", changing)
    with pytest.raises(RunError, match="changed while it was published"):
        publish_geopackage(str(run_dir), str(tmp_path / "run.gpkg"))
    assert not (tmp_path / "run.gpkg").exists()


@pytest.mark.parametrize("layer", LAYERS, ids=lambda layer: layer.name)
def test_a_run_that_lost_a_file_is_not_published(run_dir: Path, tmp_path: Path, layer: Layer) -> None:
    publish_geopackage(str(run_dir), str(tmp_path / "whole.gpkg"))
    shutil.rmtree(run_dir / layer.name / "tile=t2")
    with pytest.raises(RunError, match=rf"{layer.name}/tile=t2/part-0\.parquet of the run .* is gone"):
        publish_geopackage(str(run_dir), str(tmp_path / "run.gpkg"))
    assert not (tmp_path / "run.gpkg").exists()


def test_a_run_with_other_rows_than_it_counts_is_not_published(run_dir: Path, tmp_path: Path) -> None:
    restated(run_dir, counts={"candidates": 4, "rejected": 1})
    publish_geopackage(str(run_dir), str(tmp_path / "whole.gpkg"))
    restated(run_dir, counts={"candidates": 5, "rejected": 1})
    with pytest.raises(RunError, match=r"has 4 rows, but run\.json counts 5"):
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

    monkeypatch.setattr(publishing, "stored_batch", watched)
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
    (tmp_path / "file").write_text("mine")
    before = content(tmp_path)
    with pytest.raises(RunError, match=r"holds mine\.city\.json, which is not of this run"):
        publish_cityjson(str(run_dir), str(out), overwrite=True)
    with pytest.raises(RunError, match="is a file: give the name of a folder"):
        publish_cityjson(str(run_dir), str(tmp_path / "file"), overwrite=True)
    places = {"s3://bucket/city": "path of this machine", str(run_dir / "x"): "in the run directory"}
    for place, words in places.items():
        with pytest.raises(SettingsError, match=words):
            publish_cityjson(str(run_dir), place)
    assert content(tmp_path) == before


@pytest.mark.parametrize("fault", [RunError("the disk is gone"), KeyboardInterrupt()])
def test_where_cityjson_breaks_off_the_old_folder_stays(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: BaseException
) -> None:
    out = tmp_path / "city"
    publish_cityjson(str(run_dir), str(out))
    before = content(tmp_path)

    def breaking(lines: list[str]) -> dict[str, Any]:
        if "t2" in lines[0]:
            raise fault
        return city_of(lines)

    monkeypatch.setattr(publishing, "city_of", breaking)
    with pytest.raises(type(fault)):
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


@pytest.mark.parametrize(
    ("write", "name"), [(publish_geopackage, "out.gpkg"), (publish_cityjson, "out"), (publish_pmtiles, "out.pmtiles")]
)
def test_a_place_that_cannot_be_written_is_named(run_dir: Path, write: Callable[..., Any], name: str) -> None:
    restated(run_dir, crs={"wkt": pyproj.CRS.from_epsg(25832).to_wkt()})
    with pytest.raises(RunError, match="/proc/nothing"):
        write(str(run_dir), f"/proc/nothing/{name}")


@pytest.mark.slow
def test_a_run_in_an_object_store_is_published(run_dir: Path, tmp_path: Path, bucket: str) -> None:
    stored = storage_at(f"{bucket}/run")
    for name, data in content(run_dir).items():
        stored.put(name, data)
    for place, out in ((f"{bucket}/run", "remote.gpkg"), (str(run_dir), "local.gpkg")):
        publish_geopackage(place, str(tmp_path / out))
    assert (tmp_path / "remote.gpkg").read_bytes() == (tmp_path / "local.gpkg").read_bytes()


def test_the_command_prints_what_it_wrote_and_ends_with_the_code_of_the_fault(run_dir: Path, tmp_path: Path) -> None:
    out = tmp_path / "run.gpkg"
    words = ("publish", str(run_dir), "--as", "geopackage", "--out", str(out), "--json")
    code, said, _ = invoke(*words)
    document = json.loads(said)
    assert code == 0
    assert (document["as"], document["place"], document["rows"]["buildings"]) == ("geopackage", str(out), 4)
    assert invoke(*words)[0] == 4
    assert invoke(*words, "--overwrite")[0] == 0
    assert invoke("publish", str(run_dir), "--as", "geopackage", "--out", "run.zip")[0] == 2
    assert invoke("publish", str(run_dir), "--as", "papyrus", "--out", str(out))[0] == 2
