"""A run with the buildings of some statuses only, and what is published of it."""

import contextlib
import dataclasses
import datetime as dt
import hashlib
import json
import shutil
import sqlite3
from collections.abc import Sequence
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import small_buildings as small
from command_line import app
from small_runs import TREE, content, moved, street
from typer.testing import CliRunner

from pipeline.errors import RunError
from pipeline.export.geoparquet import read_table
from pipeline.export.record_rows import RecordContext
from pipeline.export.tile import write_tile
from pipeline.extras.publish.selection import run_of, select_run
from pipeline.io import storage_at
from pipeline.model import BuildingResult, Doubt, Reason, Status
from pipeline.runtime.manifest import RunManifest, RunStatus, write_manifest
from pipeline.runtime.manifest_reading import read_manifest

DOUBT = Doubt.of(Reason.SCATTERED, "its roof returns scatter by 0.32 m, more than 0.15 m", "scatter_m", 0.32, 0.15)


def buildings() -> list[BuildingResult]:
    """Four buildings, one of each status; the doubtful one has two parts."""
    return [one.doubted(DOUBT) if one.building_id == "two_parts" else one for one in street()]


def write_run(folder: Path, meshes: str = "building", *extra: BuildingResult, lods: Sequence[str] = ()) -> Path:
    """A finished run of two tiles, as a run leaves it."""
    reference = small.Reference(horizontal_unit_m=1.0, vertical_unit_m=1.0)
    context = RecordContext(reference=reference, settings_hash="ab", engine_version="0", further_lods=tuple(lods))
    results = buildings()
    for tile, owned in (("t1", results[:2]), ("t2", [*results[2:], *extra])):
        made = write_tile(folder, tile, owned, [TREE] if tile == "t1" else [], context, meshes=meshes)
        state = {"tile": tile, "state": "done", "error": "", "files": dict(made.digests)}
        storage_at(folder).put(f"state/{tile}.json", json.dumps(state, indent=1).encode())
    counts = {"candidates": 4 + len(extra), **dict.fromkeys(map(str, Status), 1), "ok": 1 + len(extra), "rejected": 1}
    manifest = RunManifest(
        status=RunStatus.FINISHED,
        engine_version="0",
        method="fuzzy-sart",
        settings={},
        settings_hash="ab",
        started_at=dt.datetime(2026, 1, 1, tzinfo=dt.UTC),
        crs={"horizontal_unit_m": 1.0, "vertical_unit_m": 1.0},
        counts={**counts, "roof_faces": 8 + 2 * len(extra)},
        content_sha256="cd",
    )
    write_manifest(folder, manifest)
    return folder


def ids(folder: Path, table: str = "buildings") -> set[str]:
    """The buildings of a table."""
    return set(read_table(str(folder), table)["building_id"].to_pylist())


@pytest.mark.parametrize("meshes", ["building", "tile", "glb", "none"])
def test_a_selection_of_all_statuses_is_the_run_to_the_byte(tmp_path: Path, meshes: str) -> None:
    run = write_run(tmp_path / "run", meshes, moved(small.levelled(), 90), lods=("1.2", "1.3"))
    assert meshes == "none" or list(run.glob("meshes/t2/*-lod12.*"))
    select_run(str(run), tmp_path / "all", list(Status))
    before, after = content(run), content(tmp_path / "all")
    assert before.pop("run.json") != after.pop("run.json")  # the digest is gone
    assert after == before


@pytest.mark.parametrize("meshes", ["building", "tile", "glb"])
@pytest.mark.parametrize("status", list(Status))
def test_a_selection_is_the_run_that_never_had_the_other_buildings(tmp_path: Path, meshes: str, status: Status) -> None:
    run = write_run(tmp_path / "run", meshes)
    select_run(str(run), tmp_path / "some", [status])
    alone = tmp_path / "alone"
    reference = small.Reference(horizontal_unit_m=1.0, vertical_unit_m=1.0)
    context = RecordContext(reference=reference, settings_hash="ab", engine_version="0")
    for tile, owned in (("t1", buildings()[:2]), ("t2", buildings()[2:])):
        kept = [one for one in owned if one.status is status]
        write_tile(alone, tile, kept, [TREE] if tile == "t1" else [], context, meshes=meshes)
    found, wanted = content(tmp_path / "some"), content(alone)
    assert {name for name in found if not name.startswith(("state/", "run.json"))} == set(wanted)
    for name, data in wanted.items():
        # in CityJSON and GLB coordinates count from the corner of the whole tile
        if not name.endswith((".jsonl", ".glb")):
            assert found[name] == data, name
    for tile in ("t1", "t2"):
        state = json.loads(found[f"state/{tile}.json"])
        assert state["files"] == {name: hashlib.sha256(found[name]).hexdigest() for name in state["files"]}
        assert set(state["files"]) == {name for name in wanted if f"{tile}/" in name}


def test_a_selection_counts_what_it_has_and_names_no_digest(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", "building", moved(small.gable("other"), 90))
    select_run(str(run), tmp_path / "ok", [Status.OK, Status.FAILED])
    manifest = read_manifest(tmp_path / "ok")
    statuses = {"ok": 2, "doubtful": 0, "fallback": 0, "failed": 1}
    assert manifest.counts == {"candidates": 3, **statuses, "rejected": 1, "roof_faces": 4}
    assert manifest.content_sha256 is None
    assert ids(tmp_path / "ok") == {"gable", "other", "failed"}
    assert ids(tmp_path / "ok", "planes") == {"gable", "other"}


def test_the_bounds_of_a_selection_are_those_of_its_buildings(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    select_run(str(run), tmp_path / "doubtful", [Status.DOUBTFUL])
    lines = {
        tile: (tmp_path / f"doubtful/cityjson/tile={tile}/part-0.city.jsonl").read_text().splitlines()
        for tile in ("t1", "t2")
    }
    assert [len(lines["t1"]), len(lines["t2"])] == [1, 2]
    assert "geographicalExtent" not in json.loads(lines["t1"][0])["metadata"]
    extent = json.loads(lines["t2"][0])["metadata"]["geographicalExtent"]
    geo = json.loads(pq.read_metadata(tmp_path / "doubtful/buildings/tile=t2/part-0.parquet").metadata[b"geo"])
    x0, y0, x1, y1 = geo["columns"]["geometry"]["bbox"]
    assert [extent[0], extent[1], extent[3], extent[4]] == pytest.approx([x0, y0, x1, y1], abs=1e-6)


def test_a_run_of_before_the_status_is_selected_from(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    for path in (run / "buildings").rglob("*.parquet"):
        table = pq.read_table(path, partitioning=None)
        pq.write_table(table.drop_columns(["share_below_roof"]), path)
    shutil.rmtree(run / "decisions")
    for path in (run / "state").iterdir():
        state = json.loads(path.read_text())
        files = {name: digest for name, digest in state["files"].items() if not name.startswith("decisions/")}
        path.write_text(json.dumps({**state, "files": files}))
    select_run(str(run), tmp_path / "ok", [Status.OK])
    assert ids(tmp_path / "ok") == {"gable"}


def test_a_run_without_its_rows_or_its_end_is_refused(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    manifest = read_manifest(run)
    write_manifest(run, dataclasses.replace(manifest, counts={**manifest.counts, "candidates": 5}))
    with pytest.raises(RunError, match=r"has 4 rows, but run\.json counts 5"):
        select_run(str(run), tmp_path / "ok", [Status.OK])
    write_manifest(run, dataclasses.replace(manifest, status=RunStatus.RUNNING))
    with pytest.raises(RunError, match="is running: run it to its end first"):
        select_run(str(run), tmp_path / "again", [Status.OK])


def test_all_statuses_need_no_copy_and_a_fault_names_the_run(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    for statuses in ([], list(Status)):
        with run_of(str(run), statuses) as place:
            assert place == str(run)
    with run_of(str(run), [Status.OK]) as place:
        assert ids(Path(place)) == {"gable"}
    assert not Path(place).exists()
    with (
        pytest.raises(RunError, match=f"no model in {run} \\(only ok, doubtful\\)"),
        run_of(str(run), [Status.DOUBTFUL, Status.OK]) as place,
    ):
        raise RunError(f"no model in {place}")
    with pytest.raises(RunError, match=f"{run} \\(only ok\\): nothing to show"), run_of(str(run), [Status.OK]):
        raise RunError("nothing to show")


def test_the_command_publishes_the_buildings_of_some_statuses(tmp_path: Path) -> None:
    run, out = write_run(tmp_path / "run"), tmp_path / "some.gpkg"
    command = ["publish", str(run), "--as", "geopackage", "--out", str(out)]
    done = CliRunner().invoke(app, [*command, "--status", "ok,doubtful", "--status", "failed", "--json"])
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    assert (document["status"], document["run"]) == (["ok", "doubtful", "failed"], str(run))
    assert document["rows"]["buildings"] == 3
    with contextlib.closing(sqlite3.connect(out)) as found:
        rows = found.execute("SELECT building_id, status FROM buildings ORDER BY 1").fetchall()
        assert rows == [("failed", "failed"), ("gable", "ok"), ("two_parts", "doubtful")]
        assert found.execute("SELECT count(*) FROM rejected").fetchone() == (1,)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--as", "geopackage", "--out", "x.gpkg", "--status", "fine"], "--status 'fine': use one of ok, doubtful"),
        (["--as", "stac", "--out", "x", "--status", "ok"], "--status ok cannot be used with --as stac"),
        (["--as", "geopackage", "--out", "run/x.gpkg", "--status", "ok"], "lies in the run directory"),
    ],
)
def test_a_status_that_cannot_be_used_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str], said: str
) -> None:
    write_run(tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    refused = CliRunner().invoke(app, ["publish", "run", *options])
    assert refused.exit_code == 2
    assert said in " ".join(refused.output.split())
