"""Results with the buildings of some statuses only: by REST, with the client and its command."""

import errno
import hashlib
import io
import json
import shutil
import sys
import zipfile
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import finished_runs as runs
import pyarrow.parquet as pq
import pytest
from client_site import Site
from command_line import app
from processes import wait_for
from starlette.testclient import TestClient
from typer.testing import CliRunner

from pipeline.extras.publish import selection
from pipeline.extras.publish.finished_run import disk_at
from pipeline.extras.publish_gis import geopackage
from pipeline.model import Doubt, Reason, Status
from service.errors import SelectionBusyError
from service.outputs import selected
from service.outputs.kinds import SELECTABLE

pytestmark = pytest.mark.slow  # each selection is made by a process

DOUBT = Doubt.of(Reason.POOR_FIT, "45% of its roof returns lie within 0.2 m", "share_on_roof", 0.45, 0.7)


def write_run(run_dir: Path) -> Path:
    """A run with two models that are ok, a doubtful one, a block and a failure."""
    tiles = runs.four_tiles()
    tiles["x850_y4471"] = [one.doubted(DOUBT) if n == 0 else one for n, one in enumerate(tiles["x850_y4471"])]
    return runs.write_run(run_dir, tiles)


OK = {runs.ident(name) for name in ("gable", "two_parts", "far")}
DOUBTFUL = {runs.ident("pent")}


@pytest.fixture(scope="module")
def job_id(service: runs.Service) -> str:
    return service.finished(write_run, publish=("geopackage", "cityjson", "stac", "3dtiles"))


def test_every_output_of_buildings_holds_those_of_the_status_alone(client: TestClient, job_id: str) -> None:
    found = client.get(f"/jobs/{job_id}/results", params={"status": "ok"}).json()
    whole = client.get(f"/jobs/{job_id}/results").json()
    assert list(found) == [name for name in whole if name in SELECTABLE]
    assert set(found) == set(SELECTABLE) - {"pmtiles"}  # which the job was not asked for
    files = {}
    for name, entry in found.items():
        assert entry["href"] == f"http://127.0.0.1/jobs/{job_id}/results/{name}?status=ok"
        answer = client.get(entry["href"])
        assert answer.headers["content-disposition"].partition("-ok-")[2]
        assert (hashlib.sha256(answer.content).hexdigest(), len(answer.content)) == (entry["sha256"], entry["bytes"])
        files[name] = answer.content
    assert set(pq.read_table(io.BytesIO(files["buildings"]))["building_id"].to_pylist()) == OK
    assert set(pq.read_table(io.BytesIO(files["planes"]))["building_id"].to_pylist()) == OK
    assert {json.loads(line)["id"] for line in files["cityjson"].splitlines()[1:]} == OK
    assert {feature["id"] for feature in json.loads(files["geojson"])["features"]} == OK
    with zipfile.ZipFile(io.BytesIO(files["meshes"])) as archive:
        assert {Path(name).stem for name in archive.namelist()} == OK
    assert len(files["geopackage"]) > 0
    again = client.get(found["buildings"]["href"], headers={"If-None-Match": f'"{found["buildings"]["sha256"]}"'})
    assert again.status_code == 304


def test_statuses_come_in_any_order_and_the_whole_stays_as_it_was(client: TestClient, job_id: str) -> None:
    before = client.get(f"/jobs/{job_id}/results").json()
    both = client.get(f"/jobs/{job_id}/results/geojson", params={"status": "doubtful,ok"})
    assert {feature["id"] for feature in both.json()["features"]} == OK | DOUBTFUL
    again = client.get(f"/jobs/{job_id}/results/geojson", params={"status": ["ok", "doubtful"]})
    assert again.headers["etag"] == both.headers["etag"]
    assert "-ok-doubtful-" in again.headers["content-disposition"]
    assert client.get(f"/jobs/{job_id}/results").json() == before


@pytest.mark.parametrize("name", ["report", "rejected", "stac", "3dtiles", "colours"])
def test_an_output_without_a_status_is_refused(client: TestClient, job_id: str, name: str) -> None:
    answer = client.get(f"/jobs/{job_id}/results/{name}", params={"status": "ok"})
    assert "leave out status, or use buildings, planes" in runs.problem(answer, 404, "no-such-output")


@pytest.mark.parametrize(
    ("below", "outputs", "status"),
    [
        ("", "points", 404),  # which no selection has
        ("", "pmtiles", 404),  # which the job was not asked for
        ("", "buildings,nonsense", 400),
        ("/pmtiles", None, 404),
        ("/points", None, 404),
        ("/nonsense", None, 404),
    ],
)
def test_no_selection_is_made_for_an_output_that_is_not_there(
    service: runs.Service, below: str, outputs: str | None, status: int
) -> None:
    job_id = service.finished(write_run)
    asked = {"status": "ok"} if outputs is None else {"status": "ok", "outputs": outputs}
    answer = service.client.get(f"/jobs/{job_id}/results{below}", params=asked)
    assert answer.status_code == status
    assert not (service.folder.outputs(job_id, 1) / "selected").exists()


def test_a_word_that_is_not_a_status_is_refused(client: TestClient, job_id: str) -> None:
    answer = client.get(f"/jobs/{job_id}/results", params={"status": "fine"})
    assert "use one of ok, doubtful, fallback, failed" in runs.problem(answer, 400, "invalid-request")


def test_a_selection_without_a_model_has_empty_files_and_no_tileset(client: TestClient, job_id: str) -> None:
    found = client.get(f"/jobs/{job_id}/results", params={"status": "failed"}).json()
    assert "3dtiles-zip" not in found
    rows = pq.read_table(io.BytesIO(client.get(found["buildings"]["href"]).content))["status"].to_pylist()
    assert rows == ["failed"]


def test_one_method_of_a_comparison_is_selected_from(service: runs.Service) -> None:
    job_id = service.compared()
    path = f"/jobs/{job_id}/results"
    refused = runs.problem(service.client.get(path, params={"status": "ok"}), 404, "no-such-output")
    assert "add ?method=" in refused
    label = runs.LABELS[1]
    found = service.client.get(path, params={"status": "ok", "method": label}).json()
    assert found["buildings"]["href"].endswith(f"?method={label}&status=ok")
    rows = pq.read_table(io.BytesIO(service.client.get(found["buildings"]["href"]).content))["status"].to_pylist()
    assert rows == ["ok"]


def test_a_client_is_asked_to_come_again_until_the_selection_is_made(
    service: runs.Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = service.finished(write_run)
    monkeypatch.setattr(selected, "WAIT_S", 0.0)
    path = f"/jobs/{job_id}/results/buildings?status=ok"
    first = service.client.get(path)
    assert "is being made: ask again" in runs.problem(first, 503, "selection-busy")
    assert first.headers["retry-after"] == "2"
    answers = []

    def is_made() -> bool:
        answers.append(service.client.get(path).status_code)
        return answers[-1] != 503

    wait_for(is_made, "the selection")
    assert answers[-1] == 200
    outputs = service.folder.outputs(job_id, 1) / "selected"
    wait_for(lambda: [place.name for place in outputs.iterdir()] == ["ok"], "the end of the process")


def test_a_run_whose_files_are_gone_is_an_error_that_names_no_folder(service: runs.Service) -> None:
    job_id = service.finished(write_run)
    shutil.rmtree(service.folder.run(job_id, 1) / "planes")
    answer = service.client.get(f"/jobs/{job_id}/results", params={"status": "ok"})
    said = runs.problem(answer, 404, "no-such-output")
    assert said == "files of this job's run are gone or damaged: submit the job again"
    assert list((service.folder.outputs(job_id, 1) / "selected").iterdir()) == []


def test_a_full_disk_is_said_before_anything_is_written(service: runs.Service, monkeypatch: pytest.MonkeyPatch) -> None:
    job_id = service.finished(write_run)
    monkeypatch.setattr(selected.Disk, "free_bytes", property(lambda _: 1000))
    answer = service.client.get(f"/jobs/{job_id}/results", params={"status": "ok"})
    assert "a selection of buildings" in runs.problem(answer, 507, "no-space")
    assert not (service.folder.outputs(job_id, 1) / "selected").exists()


@pytest.mark.parametrize("fails", ["select_run", "file_outside"])
def test_a_disk_that_fills_up_meanwhile_is_said_and_no_output_stays_missing(
    service: runs.Service, monkeypatch: pytest.MonkeyPatch, fails: str
) -> None:
    job_id = service.finished(write_run, publish=("geopackage",))
    run_dir, out_dir = service.folder.run(job_id, 1), service.folder.outputs(job_id, 1)
    place = selected.folder_of(out_dir, [Status.OK])
    asked = {"run_dir": str(run_dir), "out_dir": str(place), "names": ["buildings", "geopackage"]}
    monkeypatch.setattr(sys, "argv", ["", json.dumps({**asked, "statuses": ["ok"], "geoid_height_m": None})])
    monkeypatch.setattr(selected, "_end_with_owner", lambda: None)

    def full(*_: object, **__: object) -> None:
        with disk_at(place):
            raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(selection if fails == "select_run" else geopackage, fails, full)
        code = selected.main()
    assert not place.exists()
    assert list(place.parent.iterdir()) == []
    with monkeypatch.context() as patch:
        patch.setattr(selected, "_COMMAND", (sys.executable, "-c", f"import sys; sys.exit({code})"))
        answer = service.client.get(f"/jobs/{job_id}/results", params={"status": "ok"})
        assert "Remove finished jobs or uploads" in runs.problem(answer, 507, "no-space")
    assert "geopackage" in service.client.get(f"/jobs/{job_id}/results", params={"status": "ok"}).json()


def test_selections_that_stand_still_are_ended_and_block_nothing(
    service: runs.Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    job_id = service.finished(write_run)
    path = f"/jobs/{job_id}/results"
    with monkeypatch.context() as patch:
        patch.setattr(selected, "_COMMAND", (sys.executable, "-c", "input()"))  # until its owner ends
        patch.setattr(selected, "LIMIT_S", 0.3)
        for statuses in ("ok", "failed", "fallback"):
            runs.problem(service.client.get(path, params={"status": statuses}), 500, "internal")
    assert service.client.get(path, params={"status": "ok"}).status_code == 200


def test_few_requests_wait_for_a_selection(service: runs.Service, tmp_path: Path) -> None:
    job_id = service.finished(write_run)
    selections = selected.Selections()
    place = selected.folder_of(service.folder.outputs(job_id, 1), [Status.OK])
    under_way = selections._under_way[place] = Future()
    arguments = (service.folder.run(job_id, 1), service.folder.outputs(job_id, 1), [Status.OK], selected.Disk(tmp_path))
    with ThreadPoolExecutor(selected._MOST_WAITING) as pool:
        waiting = [pool.submit(selections.make, *arguments, None) for _ in range(selected._MOST_WAITING)]
        wait_for(lambda: selections._waiting._value == 0, "all waiters")
        with pytest.raises(SelectionBusyError):
            selections.make(*arguments, None)
        assert not any(one.done() for one in waiting)
        under_way.set_result(None)
        assert {one.result() for one in waiting} == {place}


def test_the_client_and_its_command_fetch_a_selection(site: Site) -> None:
    job_id = site.runs.finished(write_run)
    out, client = site.folder / "out", site.client()
    (file,) = client.fetch(job_id, out, ["buildings"], status=["ok"])
    assert file.path.name == "ok-buildings.parquet"
    assert set(pq.read_table(file.path)["building_id"].to_pylist()) == OK
    assert {one.id for one in client.results(job_id, status=["doubtful"])} == {
        one.id for one in client.results(job_id, status=["ok"])
    }
    command = ["fetch", job_id, "geojson", "--out", str(out), "--url", site.url, "--status", "doubtful"]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    features = json.loads((out / "doubtful-buildings.geojson").read_text())["features"]
    assert [feature["properties"]["status"] for feature in features] == ["doubtful"]
