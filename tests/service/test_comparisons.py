"""The process `compare`: what it takes, what a driver makes of it, and what its results answer."""

import dataclasses
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import finished_runs as runs
import jsonschema
import pyarrow.parquet as pq
import pytest
from driver_bench import Bench
from finished_runs import execute, faults_of
from live_service import POINTS
from starlette.testclient import TestClient

from pipeline.backoff import Backoff
from pipeline.errors import ClusterError, SettingsError
from pipeline.extras.compare import compare
from pipeline.methods import METHODS
from service.driver.attempt import compare_request
from service.fetching import JobFiles
from service.jobs import Fault, InputReference, JobRequest, JobStatus
from service.outputs import COMPARISON_OUTPUTS, OUTPUTS
from service.outputs.comparison_files import RUNS
from service.outputs.kinds import ON_REQUEST
from service.run_settings import VARIANTS
from service.settings import ServiceSettings

TWO = ["fuzzy-sart", "fuzzy-sart:faithful"]
COMPARISON: dict[str, Any] = {"process_id": "compare", "methods": tuple(TWO)}
ROBUST, FAITHFUL = runs.LABELS
OGC = "http://www.opengis.net/def/exceptions/ogcapi-processes-1/1.0/"


# --- what it takes


def test_it_takes_what_a_reconstruction_takes_but_several_methods(local_service) -> None:
    reconstruct, compared = (
        local_service.client.get(f"/processes/{name}").json() for name in ("reconstruct", "compare")
    )
    of_one = {"method", "preset", "lods", "points", "publish", "geoidHeight"}
    assert set(compared["inputs"]) == set(reconstruct["inputs"]) - of_one | {"methods"}
    for name in set(compared["inputs"]) - {"methods"}:
        assert compared["inputs"][name] == reconstruct["inputs"][name]
    assert compared["jobControlOptions"] == reconstruct["jobControlOptions"]
    assert set(compared["outputs"]) == set(COMPARISON_OUTPUTS)
    assert compared["inputs"]["methods"]["minOccurs"] == 1
    schema = compared["inputs"]["methods"]["schema"]
    jsonschema.validate(TWO, schema)
    assert {word.partition(":")[0] for word in schema["items"]["enum"]} == set(METHODS)
    for wrong in (TWO[:1], [TWO[0]] * 2, ["guess", *TWO]):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(wrong, schema)


def test_every_method_that_the_description_names_can_be_run(local_service) -> None:
    schema = local_service.client.get("/processes/compare").json()["inputs"]["methods"]["schema"]
    for word in schema["items"]["enum"]:
        assert compare.Variant.parse(word).method in METHODS


def test_a_comparison_waits_as_what_it_is_and_can_be_sent_again(local_service) -> None:
    first = execute(local_service, methods=["fuzzy-sart:robust", TWO[1]], title="both", outputs={"page": {}})
    assert first.status_code == 201, first.text
    reported = first.json()
    assert (reported["processID"], reported["status"]) == ("compare", "accepted")
    assert reported["request"]["inputs"]["methods"] == TWO
    again = local_service.client.post(f"/processes/{reported['processID']}/execution", json=reported["request"]).json()
    one, other = (local_service.store.get(job["jobID"]).request for job in (reported, again))
    assert one == other
    assert (one.process_id, one.methods, one.outputs, one.settings) == ("compare", tuple(TWO), ("page",), {})


def test_jobs_are_listed_by_their_process(local_service) -> None:
    ids = {
        name: execute(local_service, name, **more).json()["jobID"]
        for name, more in (("compare", {"methods": TWO}), ("reconstruct", {}))
    }
    for name, job_id in ids.items():
        listed = local_service.client.get("/jobs", params={"processID": name}).json()["jobs"]
        assert [(job["jobID"], job["processID"]) for job in listed] == [(job_id, name)]
    assert len(local_service.client.get("/jobs?processID=compare,reconstruct").json()["jobs"]) == 2


@pytest.mark.parametrize(
    ("inputs", "words"),
    [
        ({}, "methods is missing: give 2 to 8 of arrangement"),
        ({"methods": TWO[:1]}, f"methods is {json.dumps(TWO[:1])}: give 2 to 8 of {', '.join(VARIANTS)}"),
        ({"methods": "fuzzy-sart"}, "give 2 to 8 of arrangement, arrangement:robust"),
        ({"methods": ["fuzzy-sart", "guess"]}, 'methods[1] is "guess": use one of arrangement, arrangement:robust'),
        ({"methods": ["fuzzy-sart", "fuzzy-sart:loose"]}, "fuzzy-sart:loose"),
        ({"methods": ["fuzzy-sart", "fuzzy-sart:robust"]}, "methods holds fuzzy-sart twice: give each once"),
        ({"methods": {"a": 1}}, "methods[0] is {"),
        ({"methods": [TWO]}, "methods[0] is ["),
        ({"methods": [None, 7]}, "methods[1] is 7"),
        ({"methods": TWO, "method": "fuzzy-sart"}, '"method" is not an input'),
        ({"methods": TWO, "points": True}, "submit reconstruct with points once per method"),
        ({"methods": TWO, "settings": {"preset": "faithful"}}, "settings.preset"),
        ({"methods": TWO, "settings": {"method": "fuzzy-sart"}}, "settings.method"),
        ({"methods": TWO, "settings": {"kmeans": {}}}, "settings has the table kmeans, which is not compared"),
        ({"methods": TWO, "classes": "audit", "settings": {"classes": "trust"}}, "classes is audit"),
    ],
)
def test_faults_of_a_comparison_are_reported(local_service, inputs: dict[str, Any], words: str) -> None:
    assert words in faults_of(execute(local_service, **inputs))
    assert local_service.client.get("/jobs").json()["jobs"] == []


def test_outputs_are_those_of_the_process(local_service) -> None:
    assert "is not an output: use page, table" in faults_of(execute(local_service, outputs={"planes": {}}, methods=TWO))
    assert "is not an output: use buildings" in faults_of(execute(local_service, "reconstruct", outputs={"page": {}}))


def send_form(service, **fields: object):
    files = {"tile": ("a.xyz", POINTS)}
    return service.client.post("/jobs", files=files, data={"crs": "EPSG:28992", **fields})


@pytest.mark.parametrize("methods", [["fuzzy-sart, fuzzy-sart:faithful"], TWO])
def test_one_call_with_several_methods_compares_them(local_service, methods: list[str]) -> None:
    form = {"methods": methods, "outputs": "page,summary"}
    answer = send_form(local_service, **form)
    asked = local_service.request_of(answer)
    assert (asked.process_id, asked.methods, asked.outputs) == ("compare", tuple(TWO), ("page", "summary"))
    assert '"preset" is not an input' in faults_of(send_form(local_service, **form, preset="robust"))


@pytest.mark.parametrize("left_empty", ["", " , "])
def test_one_call_takes_a_preset_and_no_methods_for_none(local_service, left_empty: str) -> None:
    answer = send_form(local_service, method="kmeans", preset="faithful", methods=left_empty)
    asked = local_service.request_of(answer)
    assert (asked.process_id, asked.settings) == ("reconstruct", {"method": "kmeans", "preset": "faithful"})


def test_jobs_from_before_there_were_comparisons_are_read() -> None:
    request = JobRequest(tiles=(InputReference(kind="path", value="/data/a.laz"),), **COMPARISON)
    stored = json.loads(json.dumps(request.as_dict()))
    assert JobRequest.from_dict(stored) == request
    del stored["methods"], stored["process_id"]
    before = JobRequest.from_dict(stored)
    assert (before.methods, before.process_id) == ((), "reconstruct")


# --- what a driver makes of it


def test_a_driver_compares_and_says_how_it_goes(bench: Bench) -> None:
    job = bench.submit(COMPARISON, priority=4)
    bench.driver()
    done = bench.over(job)
    assert (done.status, done.progress) == (JobStatus.SUCCESSFUL, 100), done.failure
    by_status = "2 ok, 0 doubtful, 0 fallback, 0 failed"
    assert done.message == f"2 methods on 2 buildings: {ROBUST} {by_status}; {FAITHFUL} {by_status}"
    assert list(done.summary["runs"]) == [ROBUST, FAITHFUL]
    assert done.summary["runs"][FAITHFUL]["digest"] == "d" * 64
    (request,) = bench.script.compared
    assert [variant.label for variant in request.variants] == [ROBUST, FAITHFUL]
    assert Path(request.run.out) == bench.folder.comparison(job.job_id, 1)
    assert bench.script.seen[0][1].priority == 4
    assert not bench.folder.inputs(job.job_id, 1).exists()
    events = bench.store.events(job.job_id)
    stages = [event.message for event in events if event.kind == "stage" and event.stage == "reconstruct"]
    assert stages == [f"{label}: buildings are modelled" for label in (ROBUST, FAITHFUL)]
    reported = [event.progress for event in events[1:]]
    assert reported == sorted(reported)
    assert str(bench.folder.root) not in str([*events, done.summary, done.message])


def test_a_running_comparison_that_is_dismissed_stops_and_leaves_no_file(bench: Bench) -> None:
    job = bench.submit(COMPARISON)
    bench.script.waits()
    bench.driver()
    bench.runs()
    bench.store.dismiss(job.job_id)
    assert bench.over(job).status is JobStatus.DISMISSED
    assert not bench.folder.job(job.job_id).exists()


def test_a_comparison_whose_cluster_is_lost_is_tried_again(bench: Bench) -> None:
    bench.patch.setattr("service.driver.attempt_records.LOST_CLUSTER", Backoff(first_s=0.0))
    job = bench.submit(COMPARISON)
    bench.script.raises(ClusterError("the scheduler was lost"))
    bench.driver()
    done = bench.over(job)
    assert (done.status, done.attempt, done.lost_attempts) == (JobStatus.SUCCESSFUL, 2, 1)


def test_a_process_that_a_driver_does_not_know_fails_with_those_that_it_does(bench: Bench) -> None:
    job = bench.submit({"process_id": "paint"})
    bench.driver()
    done = bench.over(job)
    assert done.failure.fault is Fault.INPUT
    assert "does not run the process paint, only reconstruct, compare, classify, echo" in done.failure.detail


def request_of(tmp_path: Path, *methods: str, **settings: Any) -> compare.CompareRequest:
    tiles = (InputReference(kind="path", value="/data/a.laz"),)
    asked = JobRequest(tiles=tiles, process_id="compare", methods=methods, settings=settings)
    return compare_request(asked, JobFiles(tiles=[]), tmp_path / "out", ServiceSettings(state=tmp_path))


def test_shared_settings_count_for_all_methods_and_a_methods_own_table_for_its_variants(tmp_path: Path) -> None:
    entry = METHODS["fuzzy-sart"]
    robust, faithful = (dataclasses.asdict(entry.preset(preset)) for preset in ("robust", "faithful"))
    name = next(name for name in robust if robust[name] != faithful[name])
    own = {"fuzzy-sart": {name: robust[name]}}
    request = request_of(tmp_path, "kmeans", TWO[1], candidates={"min_area_m2": 17.0}, **own)
    assert {variant.method for variant in request.variants} == {"kmeans", "fuzzy-sart"}
    settings = {
        variant: compare.settings_of(request.run.settings, variant, request.tables) for variant in request.variants
    }
    for variant, chosen in settings.items():
        assert chosen.scene.candidates.min_area_m2 == 17.0
        assert chosen.general.method == variant.method
        wanted = dataclasses.asdict(METHODS[variant.method].preset(variant.preset))
        assert dataclasses.asdict(chosen.building.method) == {**wanted, **own.get(variant.method, {})}


def test_a_setting_out_of_range_is_found_before_anything_runs(tmp_path: Path) -> None:
    with pytest.raises(SettingsError):
        request_of(tmp_path, *TWO, halo_m=0.001)


# --- what its results answer


@pytest.fixture(scope="module")
def job_id(service: runs.Service) -> str:
    """A comparison with all outputs."""
    return service.compared()


def test_the_runs_lie_where_the_pipeline_puts_them() -> None:
    assert RUNS == compare.RUNS
    assert COMPARISON_OUTPUTS["summary"].filename == compare.SUMMARY


def test_the_results_are_those_of_the_comparison(client: TestClient, job_id: str) -> None:
    found = client.get(f"/jobs/{job_id}/results").json()
    assert list(found) == list(COMPARISON_OUTPUTS)
    for name, entry in found.items():
        answer = client.get(entry["href"])
        assert answer.status_code == 200
        assert answer.headers["content-type"].partition(";")[0] == entry["type"] == COMPARISON_OUTPUTS[name].media_type
        assert len(answer.content) == entry["bytes"]
        assert answer.headers["etag"] == f'"{entry["sha256"]}"'


def test_with_a_method_the_results_are_those_of_its_run(client: TestClient, job_id: str) -> None:
    counted = {}
    for label in runs.LABELS:
        found = client.get(f"/jobs/{job_id}/results", params={"method": label}).json()
        assert list(found) == [name for name in OUTPUTS if name not in ON_REQUEST]
        for entry in found.values():
            answer = client.get(entry["href"])
            assert len(answer.content) == entry["bytes"]
            assert label in answer.headers["content-disposition"]
        counted[label] = client.get(found["report"]["href"]).json()["buildings"]["candidates"]
        table = pq.read_table(io.BytesIO(client.get(found["buildings"]["href"]).content))
        assert table.num_rows == counted[label]
    assert counted == {ROBUST: 6, FAITHFUL: 1}


def test_buildings_are_those_of_the_first_method_unless_another_is_named(client: TestClient, job_id: str) -> None:
    place = f"/jobs/{job_id}/buildings"
    assert client.get(place).json()["numberMatched"] == 6
    page = client.get(place, params={"method": ROBUST, "limit": 2}).json()
    assert (page["numberMatched"], page["numberReturned"]) == (6, 2)
    links = {link["rel"]: link["href"] for link in page["links"]}
    assert client.get(links["next"]).json()["features"][0]["id"] not in {f["id"] for f in page["features"]}
    assert f"method={ROBUST}" in links["next"]
    only = client.get(place, params={"method": FAITHFUL}).json()
    assert [feature["id"] for feature in only["features"]] == [runs.ident("gable")]


def test_one_building_has_a_record_by_every_method(client: TestClient, job_id: str) -> None:
    place = f"/jobs/{job_id}/buildings/{runs.ident('gable')}"
    for label in runs.LABELS:
        found = client.get(place, params={"method": label})
        assert found.status_code == 200
        for link in found.json()["links"]:
            if link["rel"] != "collection":
                assert f"method={label}" in link["href"]
                assert client.get(link["href"]).status_code == 200
        assert client.get(place, params={"method": label, "f": "obj"}).text.count("\nv ") > 3
        assert client.get(place, params={"method": label, "f": "cityjson"}).json()["CityObjects"]
    other = f"/jobs/{job_id}/buildings/{runs.ident('pent')}"
    assert client.get(other).status_code == 200
    runs.problem(client.get(other, params={"method": FAITHFUL}), 404, "no-such-building")


def test_the_answer_to_a_method_that_was_not_compared_names_those_that_were(
    service: runs.Service, client: TestClient, job_id: str
) -> None:
    alone = service.finished()
    for path in ("results", "results/report", "buildings", f"buildings/{runs.ident('gable')}"):
        reported = runs.problem(client.get(f"/jobs/{job_id}/{path}?method=../x"), 400, "invalid-request")
        assert f"use one of {ROBUST}, {FAITHFUL}" in reported
        reported = runs.problem(client.get(f"/jobs/{alone}/{path}?method={ROBUST}"), 400, "invalid-request")
        assert "this job ran one method" in reported


def test_an_output_of_a_run_says_how_to_ask_for_it(client: TestClient, job_id: str) -> None:
    for path in ("results/cityjson", "results?outputs=cityjson"):
        reported = runs.problem(client.get(f"/jobs/{job_id}/{path}"), 404, "no-such-output")
        assert f"add ?method= and one of {ROBUST}, {FAITHFUL}" in reported
    runs.problem(client.get(f"/jobs/{job_id}/results/page?method={ROBUST}"), 404, "no-such-output")


def test_the_status_leads_to_the_page(service: runs.Service, client: TestClient, job_id: str) -> None:
    reported = client.get(f"/jobs/{job_id}").json()
    assert reported["processID"] == "compare"
    (page,) = [link["href"] for link in reported["links"] if link["type"] == "text/html"]
    assert client.get(page).text.startswith("<!doctype html>")
    without = client.get(f"/jobs/{service.compared(outputs=('table',))}").json()
    assert [link for link in without["links"] if link["type"] == "text/html"] == []


def test_the_page_may_show_itself_and_nothing_else(client: TestClient, job_id: str) -> None:
    answer = client.get(f"/jobs/{job_id}/results/page", headers={"Accept": "text/html"})
    assert answer.headers["content-type"] == "text/html; charset=utf-8"
    assert answer.headers["content-disposition"].startswith("inline; ")
    assert answer.headers["x-content-type-options"] == "nosniff"
    known = client.get(f"/jobs/{job_id}/results/page", headers={"If-None-Match": answer.headers["etag"]})
    assert known.status_code == 304
    for found in (answer, known):
        (policy,) = found.headers.get_list("content-security-policy")
        rules = dict(rule.strip().partition(" ")[::2] for rule in policy.split(";"))
        assert rules["default-src"] == "'none'"
        assert rules["frame-ancestors"] == "'none'"
        # an origin of its own: neither the service's storage nor its answers can be read
        assert "allow-same-origin" not in rules["sandbox"]
        assert "'self'" not in policy
        assert "http" not in policy
    assert "sandbox" not in client.get("/", headers={"Accept": "text/html"}).headers["content-security-policy"]


def test_the_archive_holds_the_whole_comparison_and_no_folder_of_the_server(
    service: runs.Service, client: TestClient, job_id: str
) -> None:
    content = client.get(f"/jobs/{job_id}/results/archive").content
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        names = archive.namelist()
        texts = {name: archive.read(name).decode() for name in names if name.endswith((".json", ".html", ".md"))}
    assert {"index.html", "compare.json", "compare.md", "buildings.parquet"} <= set(names)
    for label in runs.LABELS:
        assert f"runs/{label}/run.json" in names
        assert any(name.startswith(f"runs/{label}/buildings/tile=") for name in names)
    assert not [name for name in names if "quarantine" in name]
    reported = {f"/jobs/{job_id}/results/{name}" for name in ("page", "summary")}
    for text in [*texts.values(), *(client.get(path).text for path in reported)]:
        assert runs.SERVER_FOLDER not in text
        assert "uploads/0f0f" not in text
        assert runs.LINKED_FOLDER not in text
        assert "node-7" not in text
        assert str(service.folder.root) not in text
    manifest = json.loads(texts["runs/fuzzy-sart/run.json"])
    assert manifest["inputs"][0]["path"] == "tile.laz"
    assert manifest["request"]["footprints"] == "outlines.gpkg"
    assert sorted(manifest["peak_memory_bytes"].values()) == [3_000_000, 5_000_000]
    assert json.loads(texts["compare.json"])["share"] == 0.1
    again = service.compared()
    assert client.get(f"/jobs/{again}/results/archive").content == content


def test_a_comparison_that_is_not_over_has_no_results(service: runs.Service, client: TestClient) -> None:
    job = service.running(**COMPARISON)
    for path in ("results", "results?method=fuzzy-sart", "results/page", "buildings", "buildings?method=x"):
        runs.problem(client.get(f"/jobs/{job.job_id}/{path}"), 404, f"{OGC}result-not-ready")
