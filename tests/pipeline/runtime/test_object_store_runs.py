"""Runs whose inputs and results lie in an object store."""

import json
import tempfile
from pathlib import Path

import geopandas
import pytest
import shapely
from object_store import SECRET

from pipeline.errors import EmptyInputError, InputError, RunError, UnreadableInputError
from pipeline.export import tile as tile_files
from pipeline.extras.classify.classify import ClassifyRequest, classify
from pipeline.extras.overrides.rerun import RerunRequest, rerun
from pipeline.extras.remote.retries import persistently
from pipeline.extras.remote.urls import filesystem_of
from pipeline.io import storage_at
from pipeline.io.places import on_this_machine
from pipeline.report.statistics import run_statistics
from pipeline.ruler.evaluation.reading import read_models
from pipeline.runtime.digest import run_digest
from pipeline.runtime.isolation.replay_bundle import read_bundle
from pipeline.runtime.manifest import RunStatus
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import SERIAL, Resources
from pipeline.runtime.run import run
from pipeline.settings import RunSettings

SETTINGS = RunSettings.from_mapping({"tile_size_m": 62.5})
"""Several tiles."""


@pytest.fixture(scope="module")
def local(suburb, tmp_path_factory):
    """The run into a folder that all others are held against."""
    out = tmp_path_factory.mktemp("local") / "run"
    return run(RunRequest(inputs=(str(suburb),), out=str(out), settings=SETTINGS, resources=SERIAL))


@pytest.fixture
def tile(suburb, bucket, s3):
    """The suburb's tile in a bucket."""
    url = f"{bucket}/in/suburb.laz"
    filesystem_of(url).put_file(str(suburb), url, ACL="public-read")
    s3.reset()
    return url


@pytest.fixture
def quick(monkeypatch):
    """Many failures take no time: no sleep between attempts."""
    monkeypatch.setitem(persistently.__kwdefaults__, "sleep", lambda _: None)


def request(tile, bucket, scratch=None, **more):
    resources = Resources(workers=0, scratch=scratch)
    return RunRequest(inputs=(tile,), out=f"{bucket}/run", settings=SETTINGS, resources=resources, **more)


def files(place):
    """Keys and content of a run, without run.json, which has times."""
    storage = storage_at(place)
    names = storage.keys()
    return {key: storage.get(key) for key in names if key != "run.json"}


@pytest.mark.slow
def test_a_run_in_a_bucket_is_that_in_a_folder_byte_by_byte(local, tile, bucket):
    summary = run(request(tile, bucket))
    assert summary.digest == local.digest == run_digest(f"{bucket}/run")
    assert files(f"{bucket}/run") == files(local.run_dir)
    here, there = read_manifest(local.run_dir), read_manifest(f"{bucket}/run")
    assert there.status is RunStatus.FINISHED
    assert there.tiles == here.tiles
    assert len(there.tiles) > 1
    assert there.counts == here.counts
    assert there.inputs[0].path == tile
    assert (there.inputs[0].sha256, there.inputs[0].size_bytes) == (here.inputs[0].sha256, here.inputs[0].size_bytes)


@pytest.mark.slow
def test_readers_of_a_run_take_its_url(local, tile, bucket):
    run(request(tile, bucket))
    assert run_statistics(f"{bucket}/run") == run_statistics(local.run_dir)
    here, there = read_models(local.run_dir), read_models(f"{bucket}/run")
    assert [model.building_id for model in there.models] == [model.building_id for model in here.models]
    assert all(model.solids for model in there.models if model.surfaces)
    with pytest.raises(InputError, match="no run directory is there"):
        read_models(f"{bucket}/nothing")


def test_states_come_after_their_files_and_run_json_is_first_and_last(tile, bucket, s3):
    run(request(tile, bucket))
    puts = [r.path.partition("/run/")[2] for r, answer in s3.seen if r.method == "PUT" and answer == "pass"]
    assert puts[0] == puts[-1] == "run.json"
    for state in (name for name in puts if name.startswith("state/")):
        key = state.removeprefix("state/").removesuffix(".json")
        own = [k for k, name in enumerate(puts) if key in name and not name.startswith("state/")]
        meshes = [k for k, name in enumerate(puts) if name.startswith(f"meshes/{key}/")]
        tables = [k for k, name in enumerate(puts) if key in name and name.endswith(".parquet")]
        assert max(own, default=-1) < puts.index(state)
        assert max(meshes, default=-1) < min(tables, default=len(puts))


def test_the_digest_of_a_run_needs_no_listing(tile, bucket, s3, local):
    held = []

    def script(asked):
        # as a store whose listings lag behind: nothing that was put is listed
        held.append(asked)
        return "busy" if "list-type" in asked.path and any("/state/" in r.path for r in held) else "pass"

    s3.script = script
    assert run(request(tile, bucket)).digest == local.digest


@pytest.mark.slow
def test_a_run_that_is_there_is_only_replaced_when_asked(local, tile, bucket):
    run(request(tile, bucket))
    storage = storage_at(f"{bucket}/run")
    storage.put("buildings/tile=x1_y1/part-0.parquet", b"of an earlier run")
    with pytest.raises(RunError, match=r"/run is not empty .*--overwrite"):
        run(request(tile, bucket))
    assert run(request(tile, bucket, overwrite=True)).digest == local.digest
    assert files(f"{bucket}/run") == files(local.run_dir)
    storage_at(f"{bucket}/other").put("important.txt", b"")
    with pytest.raises(RunError, match=r"no run\.json, so it is no run"):
        run(RunRequest(inputs=(tile,), out=f"{bucket}/other", resources=SERIAL, overwrite=True))


def test_a_reader_sees_while_a_run_is_replaced_that_it_is_not_finished(tile, bucket, s3):
    run(request(tile, bucket))
    met = []

    def script(asked):
        if asked.method == "DELETE" and not met:
            met.append(asked)
            return "denied"
        return "pass"

    s3.script = script
    with pytest.raises(RunError, match="cannot be removed: access is denied"):
        run(request(tile, bucket, overwrite=True))
    assert read_manifest(f"{bucket}/run").status is RunStatus.RUNNING


@pytest.mark.slow
def test_a_store_that_fails_at_every_third_request_costs_attempts_and_nothing_else(local, tile, bucket, s3, quick):
    words = ("busy", "cut", "lost")
    s3.script = lambda asked: words[asked.number // 3 % 3] if asked.number % 3 == 0 else "pass"
    assert run(request(tile, bucket)).digest == local.digest
    assert files(f"{bucket}/run") == files(local.run_dir)
    assert all(s3.count(word) for word in words)
    failed = sum(s3.count(word) for word in words)
    assert failed >= (len(s3.seen) - 1) // 3


@pytest.mark.slow
@pytest.mark.parametrize("which", [0, -1])
def test_a_tile_that_cannot_be_put_costs_only_itself(local, tile, bucket, s3, quick, which):
    local_tiles = list(read_manifest(local.run_dir).tiles)
    with_tables = sorted(path.parent.name.removeprefix("tile=") for path in Path(local.run_dir).glob("buildings/*/*"))
    broken = with_tables[which]
    others = [key for key in local_tiles if key != broken]
    s3.script = lambda asked: "busy" if asked.method == "PUT" and f"buildings/tile%3D{broken}" in asked.path else "pass"
    summary = run(request(tile, bucket))
    assert summary.failed_tiles == (broken,)
    manifest = read_manifest(f"{bucket}/run")
    assert manifest.status is RunStatus.INCOMPLETE
    assert list(manifest.tiles) == local_tiles
    state = json.loads(storage_at(f"{bucket}/run").get(f"state/{broken}.json"))
    assert state["state"] == "failed"
    assert "the server is busy at all of 6 attempts" in state["error"]
    here, there = files(local.run_dir), files(f"{bucket}/run")
    for other in others:
        assert {k: v for k, v in there.items() if other in k} == {k: v for k, v in here.items() if other in k}


@pytest.mark.slow
def test_a_tile_whose_state_cannot_be_put_is_not_finished(local, tile, bucket, s3, quick):
    broken = read_manifest(local.run_dir).tiles[0]
    s3.script = lambda asked: "cut" if asked.method == "PUT" and f"state/{broken}" in asked.path else "pass"
    summary = run(request(tile, bucket))
    assert summary.failed_tiles == (broken,)
    assert not storage_at(f"{bucket}/run").has(f"state/{broken}.json")
    assert read_manifest(f"{bucket}/run").status is RunStatus.INCOMPLETE


def test_a_run_that_breaks_off_says_so(tile, bucket, monkeypatch):
    def fail(*_args, **_kwargs):
        raise KeyboardInterrupt

    monkeypatch.setattr(tile_files, "write_tile", fail)
    with pytest.raises(KeyboardInterrupt):
        run(request(tile, bucket))
    assert read_manifest(f"{bucket}/run").status is RunStatus.CANCELLED


def test_nothing_of_the_credentials_or_of_signed_urls_is_kept(tile, bucket, s3):
    signed = f"{s3.endpoint}/{tile.removeprefix('s3://')}?signature=very-hidden"
    events = []
    # moto takes the query of an open object for none of its business
    run(RunRequest(inputs=(signed,), out=f"{bucket}/run", resources=SERIAL), events.append)
    storage = storage_at(f"{bucket}/run")
    names = storage.keys()
    kept = b"".join(storage.get(key) for key in names) + repr(events).encode()
    assert b"very-hidden" not in kept
    assert SECRET.encode() not in kept
    assert b"suburb.laz?query-" in storage.get("run.json")


@pytest.mark.slow
def test_bundles_of_poisonous_buildings_go_into_the_bucket(tile, bucket, monkeypatch, s3, quick):
    def fail(*_args, **_kwargs):
        raise ZeroDivisionError("poison")

    monkeypatch.setattr("pipeline.recipe.reconstruct_building", fail)
    summary = run(request(tile, bucket))
    kept = [key for key in storage_at(f"{bucket}/run").keys("quarantine") if key.endswith(".bundle")]
    assert len(kept) == summary.statuses["failed"] > 0
    with on_this_machine(f"{bucket}/run/{kept[0]}") as path:
        assert read_bundle(str(path)).incident.detail == "ZeroDivisionError: poison"
    s3.script = lambda asked: "busy" if "quarantine" in asked.path and asked.method == "PUT" else "pass"
    again = run(request(tile, bucket, overwrite=True))
    assert (again.statuses, again.failed_tiles) == (summary.statuses, ())
    assert any(text.startswith("there is no bundle of ") and ": s3://" in text for text in again.warnings)


@pytest.mark.slow
def test_scratch_is_on_this_machine_and_goes(tile, bucket, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    run(request(tile, bucket))
    assert list((tmp_path / "temporary").iterdir()) == []
    left = tmp_path / "scratch"
    run(request(tile, bucket, scratch=str(left), overwrite=True))
    assert list(left.iterdir()) == []
    assert not [name for name in storage_at(f"{bucket}/run").names() if "scratch" in name]


def test_workers_elsewhere_need_a_scratch_that_they_see(bucket):
    elsewhere = RunRequest(inputs=("a.laz",), out=f"{bucket}/run", resources=Resources(scheduler="tcp://127.0.0.1:1"))
    with pytest.raises(RunError, match="no scratch: give a folder that all of them and this machine see, by --scratch"):
        run(elsewhere)
    with pytest.raises(RunError, match="is a URL: give a folder"):
        run(RunRequest(inputs=("a.laz",), out=f"{bucket}/run", resources=Resources(scratch=f"{bucket}/scratch")))


def test_an_input_that_vanishes_after_the_plan_is_reported_by_its_url(tile, bucket, s3, quick):
    def script(asked):
        begun = any("run.json" in r.path for r, _ in s3.seen)
        return "denied" if begun and asked.method == "GET" and "suburb.laz" in asked.path else "pass"

    s3.script = script
    with pytest.raises(UnreadableInputError, match=r"in/suburb\.laz: cannot be fetched: access is denied"):
        run(request(tile, bucket))
    s3.reset()
    manifest = read_manifest(f"{bucket}/run")
    assert manifest.status is RunStatus.FAILED
    assert "suburb.laz: cannot be fetched" in manifest.warnings[-1]


def test_only_what_an_area_needs_is_fetched(local, tile, bucket, s3, tmp_path):
    manifest = read_manifest(local.run_dir)
    x_min, y_min, *_ = shapely.total_bounds([model.footprint for model in read_models(local.run_dir).models]).tolist()
    bbox = (x_min, y_min, x_min + 30.0, y_min + 30.0)
    far = f"{bucket}/in/far.laz"
    filesystem_of(far).cp_file(tile, far)
    square = shapely.box(x_min - 900.0, y_min - 900.0, x_min - 500.0, y_min - 500.0)
    columns = {"location": ["in/suburb.laz", "in/far.laz"]}
    index = geopandas.GeoDataFrame(columns, geometry=[shapely.box(*bbox), square], crs=manifest.crs["wkt"])
    index.to_file(tmp_path / "index.gpkg")
    storage_at(bucket).put("index.gpkg", (tmp_path / "index.gpkg").read_bytes())
    s3.reset()
    run(RunRequest(inputs=(f"{bucket}/index.gpkg",), out=f"{bucket}/run", bbox=bbox, resources=SERIAL))
    assert s3.count(path="far.laz") == 0
    assert [entry.path for entry in read_manifest(f"{bucket}/run").inputs] == [tile]
    # without an index the headers tell
    away = tuple(value + 10_000.0 for value in bbox)
    with pytest.raises(EmptyInputError, match="all 2 inputs lie off --bbox and --aoi"):
        run(RunRequest(inputs=(f"{bucket}/in/",), out=f"{bucket}/off", bbox=away, resources=SERIAL))


def test_what_only_works_in_folders_says_so(tile, bucket, tmp_path):
    with pytest.raises(RunError, match=r"only runs in folders are changed in place.*Copy the run"):
        rerun(RerunRequest(run_dir=f"{bucket}/run"))
    with pytest.raises(InputError, match="classify reads files of this machine only"):
        classify(ClassifyRequest(inputs=(tile,), out=str(tmp_path / "out"), resources=SERIAL))


def test_a_run_of_signed_urls_cannot_be_changed_later(tile, bucket, s3, tmp_path):
    signed = f"{s3.endpoint}/{tile.removeprefix('s3://')}?signature=x"
    summary = run(RunRequest(inputs=(signed,), out=str(tmp_path / "run"), resources=SERIAL))
    with pytest.raises(RunError, match=r"run\.json keeps no queries of URLs"):
        rerun(RerunRequest(run_dir=summary.run_dir, resources=SERIAL))


def test_a_run_of_remote_inputs_can_be_changed_later(tile, tmp_path):
    summary = run(RunRequest(inputs=(tile,), out=str(tmp_path / "run"), resources=SERIAL))
    (first, *_) = sorted(path.stem for path in Path(summary.run_dir, "meshes").rglob("*.obj"))
    again = rerun(RerunRequest(run_dir=summary.run_dir, only=(first,), resources=SERIAL))
    assert again.digest == summary.digest
