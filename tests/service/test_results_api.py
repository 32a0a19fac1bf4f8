"""Results by REST: what is listed, what a file's answer carries, and what a job without results says."""

import hashlib
import io
import json
import shutil
from pathlib import Path

import finished_runs as runs
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from requests.utils import parse_header_links
from starlette.testclient import TestClient

from service.jobs import Fault, JobFailure
from service.outputs import KINDS, OUTPUTS

OGC = "http://www.opengis.net/def/exceptions/ogcapi-processes-1/1.0/"


@pytest.fixture(scope="module")
def job_id(service: runs.Service) -> str:
    """A job with all outputs but those on request."""
    return service.finished()


# --- the document ----------------------------------------------------------------------------------------------------


def test_a_job_with_raw_response_lists_its_outputs_in_links_alone(service: runs.Service) -> None:
    job_id = service.finished(response="raw", outputs=("report", "meshes"))
    answer = service.client.get(f"/jobs/{job_id}/results")
    assert (answer.status_code, answer.content) == (204, b"")
    links = {found["title"]: found for found in parse_header_links(answer.headers["link"])}
    assert list(links) == ["meshes", "report"]
    for name, found in links.items():
        assert (found["rel"], found["type"]) == ("item", OUTPUTS[name].media_type)
        assert service.client.get(found["url"]).status_code == 200
    assert service.client.get(f"/jobs/{job_id}").json()["request"]["response"] == "raw"


def test_outputs_can_be_chosen(client: TestClient, job_id: str) -> None:
    chosen = client.get(f"/jobs/{job_id}/results", params={"outputs": "geojson,report"}).json()
    again = client.get(f"/jobs/{job_id}/results", params={"outputs": ["report", "geojson"]}).json()
    assert list(chosen) == list(again) == ["geojson", "report"]


def test_the_answer_to_an_unknown_output_names_the_known_ones(client: TestClient, job_id: str) -> None:
    answer = client.get(f"/jobs/{job_id}/results", params={"outputs": "report,colours"})
    assert "'colours': use buildings, planes" in runs.problem(answer, 400, "invalid-request")


def test_the_answer_to_an_output_that_was_not_made_names_those_that_were(service: runs.Service) -> None:
    job_id = service.finished(outputs=("report", "meshes"))
    assert list(service.client.get(f"/jobs/{job_id}/results").json()) == ["meshes", "report"]
    for path in (f"/jobs/{job_id}/results?outputs=planes", f"/jobs/{job_id}/results/planes"):
        assert "it has: meshes, report" in runs.problem(service.client.get(path), 404, "no-such-output")


# --- files -----------------------------------------------------------------------------------------------------------


def test_a_file_has_a_name_to_save_and_its_sha256_as_etag(client: TestClient, job_id: str) -> None:
    answer = client.get(f"/jobs/{job_id}/results/cityjson")
    sha256 = hashlib.sha256(answer.content).hexdigest()
    assert answer.headers["etag"] == f'"{sha256}"'
    name = f"gablework-{job_id[:8]}-buildings.city.jsonl"
    assert answer.headers["content-disposition"] == f'attachment; filename="{name}"'


def test_a_client_that_has_the_file_gets_304(client: TestClient, job_id: str) -> None:
    path = f"/jobs/{job_id}/results/report"
    etag = client.get(path).headers["etag"]
    for known in (etag, f'"other", W/{etag}', "*"):
        answer = client.get(path, headers={"If-None-Match": known})
        assert (answer.status_code, answer.content) == (304, b"")
        assert answer.headers["etag"] == etag
    assert client.get(path, headers={"If-None-Match": '"other"'}).status_code == 200


@pytest.mark.parametrize(
    ("asked", "start", "end"), [("bytes=0-3", 0, 4), ("bytes=-4", -4, None), ("bytes=5-", 5, None), ("Bytes=2-2", 2, 3)]
)
def test_ranges_of_bytes_are_served(client: TestClient, job_id: str, asked: str, start: int, end: int | None) -> None:
    path = f"/jobs/{job_id}/results/buildings"
    whole = client.get(path).content
    part = client.get(path, headers={"Range": asked})
    assert part.status_code == 206
    assert part.content == whole[start:end]


@pytest.mark.parametrize("asked", ["bytes=9-3", "rows=1-2", "bytes=a-b", "bytes=", "nonsense", "bytes=1-2-3"])
def test_a_range_that_means_nothing_is_ignored(client: TestClient, job_id: str, asked: str) -> None:
    answer = client.get(f"/jobs/{job_id}/results/buildings", headers={"Range": asked})
    assert answer.status_code == 200
    assert answer.content[:4] == answer.content[-4:] == b"PAR1"


@pytest.mark.parametrize("asked", ["bytes=999999999-", "bytes=-0", "bytes=0-1,999999999-"])
def test_a_range_behind_the_end_is_refused_with_the_size(client: TestClient, job_id: str, asked: str) -> None:
    path = f"/jobs/{job_id}/results/buildings"
    size = client.head(path).headers["content-length"]
    answer = client.get(path, headers={"Range": asked})
    assert f"the file has {size} bytes" in runs.problem(answer, 416, "about:blank")
    assert answer.headers["content-range"] == f"bytes */{size}"


def test_a_range_of_a_file_that_changed_is_the_whole_file(client: TestClient, job_id: str) -> None:
    path = f"/jobs/{job_id}/results/buildings"
    assert client.get(path, headers={"Range": "bytes=0-3", "If-Range": '"another"'}).status_code == 200
    etag = client.head(path).headers["etag"]
    assert client.get(path, headers={"Range": "bytes=0-3", "If-Range": etag}).status_code == 206


class Remote(io.RawIOBase):
    """A file behind HTTP, read by ranges as DuckDB and GDAL do."""

    def __init__(self, client: TestClient, path: str) -> None:
        self.client, self.path, self.at, self.requests = client, path, 0, 0
        self.size = int(client.head(path).headers["content-length"])

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = 0) -> int:
        self.at = offset + (0, self.at, self.size)[whence]
        return self.at

    def tell(self) -> int:
        return self.at

    def read(self, size: int = -1) -> bytes:
        end = self.size if size is None or size < 0 else min(self.at + size, self.size)
        if end <= self.at:
            return b""
        answer = self.client.get(self.path, headers={"Range": f"bytes={self.at}-{end - 1}"})
        assert answer.status_code == 206
        self.at, self.requests = end, self.requests + 1
        return answer.content


def test_the_parquet_is_read_from_afar_by_ranges_alone(client: TestClient, job_id: str) -> None:
    remote = Remote(client, f"/jobs/{job_id}/results/buildings")
    table = pq.read_table(pa.PythonFile(remote), columns=["roof_type"])
    assert sorted(table["roof_type"].to_pylist()) == ["flat", "gable", "gable", "gable", "none", "pent"]
    assert remote.requests > 1


@pytest.mark.parametrize(
    ("accept", "status"),
    [("*/*", 200), ("", 200), ("application/*", 200), ("application/vnd.apache.parquet", 200),
     ("text/html, */*;q=0.1", 200), ("text/html", 406), ("application/json", 406),
     ("application/vnd.apache.parquet;q=0, image/*", 406)],
)  # fmt: skip
def test_a_client_that_takes_the_type_gets_it(client: TestClient, job_id: str, accept: str, status: int) -> None:
    answer = client.get(f"/jobs/{job_id}/results/buildings", headers={"Accept": accept})
    assert answer.status_code == status
    assert status == 200 or "application/vnd.apache.parquet" in runs.problem(answer, 406, "about:blank")


# --- jobs without results --------------------------------------------------------------------------------------------


def paths(job_id: str) -> list[str]:
    """All paths that need results."""
    place = f"/jobs/{job_id}"
    building = f"{place}/buildings/{runs.ident('gable')}"
    return [f"{place}/results", f"{place}/results/report", f"{place}/buildings", building]


def test_a_running_job_is_not_ready(service: runs.Service) -> None:
    results, report, buildings, building = paths(service.running().job_id)
    for path in (results, report):
        detail = runs.problem(service.client.get(path), 404, f"{OGC}result-not-ready")
        assert "is running (0 %)" in detail
    # its buildings can be read as they are modelled
    assert service.client.get(buildings).json()["complete"] is False
    assert "it may come" in runs.problem(service.client.get(building), 404, f"{OGC}result-not-ready")


def test_a_dismissed_job_has_no_results(service: runs.Service) -> None:
    job = service.running()
    service.store.dismiss(job.job_id)
    service.store.dismissed(job)
    for path in paths(job.job_id):
        assert "was dismissed" in runs.problem(service.client.get(path), 404, f"{OGC}result-not-ready")


@pytest.mark.parametrize(("fault", "status"), [(Fault.INPUT, 422), (Fault.SETTINGS, 422), (Fault.CLUSTER, 503)])
def test_a_failed_job_answers_with_its_cause(service: runs.Service, fault: Fault, status: int) -> None:
    job_id = service.failed(JobFailure(fault=fault, detail="tile.laz has no points: send another"))
    for path in paths(job_id):
        detail = runs.problem(service.client.get(path), status, f"job-failed-{fault.value}")
        assert detail == "tile.laz has no points: send another"


def test_no_job_is_no_job(client: TestClient) -> None:
    for path in paths("0" * 32) + paths("x"):
        runs.problem(client.get(path), 404, f"{OGC}no-such-job")


def test_results_whose_files_are_gone_are_not_found(service: runs.Service) -> None:
    job_id = service.finished()
    shutil.rmtree(service.folder.job(job_id))
    for path in paths(job_id):
        assert "no longer in the state folder" in runs.problem(service.client.get(path), 404, "no-such-output")


def test_a_building_whose_job_is_being_removed_is_not_found(service: runs.Service) -> None:
    job_id = service.finished()
    (service.folder.outputs(job_id, 1) / "rows.sqlite").unlink()
    shutil.rmtree(service.folder.run(job_id, 1))
    for path in ("buildings", f"buildings/{runs.ident('gable')}"):
        answer = service.client.get(f"/jobs/{job_id}/{path}")
        assert "no longer in the state folder" in runs.problem(answer, 404, "no-such-output")


def test_results_of_another_key_are_no_results(tmp_path: Path) -> None:
    with runs.service(tmp_path) as service:
        (owner, mine), (_, theirs) = service.keys("owner", "other")
        job_id = service.finished(owner=owner, publish=("3dtiles", "stac"))
        below = ("points/tileset.json", "points/x850_y4470/r.glb", f"buildings/{runs.ident('gable')}/points",
                 "results/3dtiles/tileset.json", "results/stac/x850_y4470/x850_y4470.json",
                 "run/buildings/tile=x850_y4470/part-0.parquet")  # fmt: skip
        for path in [*paths(job_id), *(f"/jobs/{job_id}/{name}" for name in below)]:
            assert service.client.get(path, headers=mine).status_code == 200
            runs.problem(service.client.get(path, headers=theirs), 404, f"{OGC}no-such-job")
            runs.problem(service.client.get(path), 401, "unauthorized")


# --- the description -------------------------------------------------------------------------------------------------


def test_the_openapi_document_declares_every_answer_with_its_type(client: TestClient) -> None:
    described = client.get("/openapi.json").json()["paths"]
    for path in ("/jobs/{jobID}/results", "/jobs/{jobID}/results/{outputID}"):
        answers = described[path]["get"]["responses"]
        assert {"200", "400", "401", "403", "404", "422", "429", "500", "503"} <= set(answers)
    file = described["/jobs/{jobID}/results/{outputID}"]["get"]["responses"]
    assert set(file["200"]["content"]) == {kind.media_type for kind in KINDS.values()}
    assert {"206", "304", "406", "416"} <= set(file)
    assert all(set(file[status]["content"]) == {"application/problem+json"} for status in ("404", "406", "416"))
    listed = described["/jobs/{jobID}/results"]["get"]["responses"]["200"]["content"]["application/json"]
    assert json.dumps(listed["example"])
