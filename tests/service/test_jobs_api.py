"""Jobs over HTTP: the one-call form, list and filters, status, dismissal."""

import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from live_service import POINTS

from service.jobs import Fault, JobFailure, JobStatus
from service.keys import Scope
from service.routes import jobs as jobs_routes

FEWER = POINTS[: len(POINTS) // 2].rpartition(b"\n")[0] + b"\n"
"""Half of them."""


def send(service, *tiles: tuple[str, bytes], headers: dict | None = None, **fields: str):
    files = [("tile", (name, content, "application/octet-stream")) for name, content in tiles]
    return service.client.post("/jobs", files=files, data=fields, headers=headers)


def kept_files(service) -> list[Path]:
    return sorted((service.settings.state / "uploads").rglob("*"))


# --- one call


def test_one_call_sends_tiles_and_starts_a_job(local_service) -> None:
    answer = send(
        local_service,
        ("a.xyz", POINTS),
        ("b.xyz", FEWER),
        crs="EPSG:28992",
        method="fuzzy-sart",
        settings='{"candidates": {"min_area_m2": 15}}',
        bbox="0, 0, 10, 10",
        outputs="report,buildings",
        priority="-3",
        title="two tiles",
    )
    assert answer.status_code == 201, answer.text
    assert answer.headers["location"].endswith(answer.json()["jobID"])
    job = local_service.store.get(answer.json()["jobID"])
    kept = [local_service.store.upload(tile.value) for tile in job.request.tiles]
    assert [upload.filename for upload in kept] == ["a.xyz", "b.xyz"]
    files = [local_service.settings.state / "uploads" / upload.upload_id / upload.filename for upload in kept]
    assert [path.read_bytes() for path in files] == [POINTS, FEWER]
    assert (job.priority, job.request.title, job.request.outputs) == (-3, "two tiles", ("buildings", "report"))
    assert job.request.settings == {"candidates": {"min_area_m2": 15}, "method": "fuzzy-sart"}


def test_a_tile_of_the_form_may_be_an_href(local_service) -> None:
    upload = local_service.upload()
    files = {"tile": (None, f"/uploads/{upload}"), "crs": (None, "EPSG:28992")}
    answer = local_service.client.post("/jobs", files=files)
    assert answer.status_code == 201, answer.text
    assert local_service.store.get(answer.json()["jobID"]).request.tiles[0].value == upload


@pytest.mark.parametrize(
    ("tiles", "fields", "status"),
    [
        ((("a.xyz", POINTS), ("b.laz", b"LASF" + bytes(100))), {}, 422),
        ((("a.xyz", POINTS), ("b.exe", b"MZ")), {}, 400),
        ((("a.xyz", POINTS),), {"method": "guess"}, 400),
        ((("a.xyz", POINTS),), {"settings": "{"}, 400),
        ((("a.xyz", POINTS),), {"crs": "EPSG:4326"}, 400),
        ((("a.xyz", POINTS),), {"colour": "red"}, 400),
        ((), {"crs": "EPSG:28992"}, 400),
    ],
)
def test_nothing_is_kept_of_a_call_that_is_refused(local_service, tiles, fields, status) -> None:
    answer = send(local_service, *tiles, **fields)
    assert answer.status_code == status, answer.text
    assert kept_files(local_service) == []
    assert local_service.client.get("/jobs").json()["jobs"] == []


def test_nothing_is_kept_of_a_call_that_a_full_line_refuses(starting) -> None:
    service = starting(max_queued=1)
    service.waiting()
    assert send(service, ("a.xyz", POINTS), crs="EPSG:28992").status_code == 429
    assert kept_files(service) == []


def test_a_tile_with_too_many_bytes_is_refused_while_it_comes(starting) -> None:
    service = starting(max_upload_bytes=1000)
    taken = 0

    def body() -> Iterator[bytes]:
        nonlocal taken
        yield b'--x\r\nContent-Disposition: form-data; name="tile"; filename="a.xyz"\r\n\r\n'
        for _ in range(100):
            taken += 1
            yield b"1 2 3\n" * 200_000
        yield b"\r\n--x--\r\n"

    answer = service.client.post("/jobs", content=body(), headers={"Content-Type": "multipart/form-data; boundary=x"})
    assert answer.status_code == 413
    assert kept_files(service) == []


@pytest.mark.parametrize(
    ("content_type", "body"),
    [
        ("", b""),
        ("application/json", b"{}"),
        ("multipart/form-data", b"--x--"),
        ("multipart/form-data; boundary=x", b""),
        ("multipart/form-data; boundary=x", b"no form"),
        ("multipart/form-data; boundary=x", b'--x\r\nContent-Disposition: form-data; name="crs"\r\n\r\nEPSG'),
        ("multipart/form-data; boundary=x", b"--x\r\nContent-Disposition: form-data\r\n\r\na\r\n--x--\r\n"),
        ("multipart/form-data; boundary=" + "x" * 300, b""),
        (
            "multipart/form-data; boundary=x",
            b'--x\r\nContent-Disposition: form-data; name="crs"\r\n\r\n\xff\r\n--x--\r\n',
        ),
    ],
)
def test_a_body_that_is_no_form_is_refused(local_service, content_type: str, body: bytes) -> None:
    answer = local_service.client.post("/jobs", content=body, headers={"Content-Type": content_type})
    assert answer.status_code == 400, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["errors"]


def test_fields_together_have_the_limit_of_a_body(starting) -> None:
    service = starting(max_body_bytes=1000)
    assert send(service, ("a.xyz", POINTS), title="t" * 600, licence="l" * 600).status_code == 413
    assert kept_files(service) == []


def test_a_form_with_endless_parts_is_refused(local_service) -> None:
    part = b'--x\r\nContent-Disposition: form-data; name="f"\r\n\r\n1\r\n'
    body = part * (local_service.settings.max_inputs + 100) + b"--x--\r\n"
    form = {"Content-Type": "multipart/form-data; boundary=x"}
    assert local_service.client.post("/jobs", content=body, headers=form).status_code == 400


def test_a_form_may_come_in_any_pieces(local_service) -> None:
    head = b'--x-y\r\nContent-Disposition: form-data; name="tile"; filename="a.xyz"\r\n\r\n'
    crs = b'\r\n--x-y\r\nContent-Disposition: form-data; name="crs"\r\n\r\nEPSG:28992'
    title = b'\r\n--x-y\r\nContent-Disposition: form-data; name="title"\r\n\r\nno\r\n--x-\r\nboundary'
    whole = head + FEWER + crs + title + b"\r\n--x-y--\r\n"
    form = {"Content-Type": 'multipart/form-data; boundary="x-y"'}
    for size in (1, 7, 1000):
        pieces = [whole[start : start + size] for start in range(0, len(whole), size)]
        answer = local_service.client.post("/jobs", content=iter(pieces), headers=form)
        request = local_service.request_of(answer)
        kept = local_service.settings.state / "uploads" / request.tiles[0].value / "a.xyz"
        assert kept.read_bytes() == FEWER
        assert request.title == "no\r\n--x-\r\nboundary"


# --- list


def listed(service, query: str = "") -> list[str]:
    answer = service.client.get(f"/jobs{query}")
    assert answer.status_code == 200, answer.text
    return [job["jobID"] for job in answer.json()["jobs"]]


def test_filters_hold_in_the_links_too(local_service) -> None:
    for _ in range(3):
        local_service.waiting()
    page = local_service.client.get("/jobs?status=accepted&processID=reconstruct&limit=1").json()
    following = next(link["href"] for link in page["links"] if link["rel"] == "next")
    query = urlsplit(following).query.split("&")
    assert set(query) == {"status=accepted", "processID=reconstruct", "limit=1", "offset=1"}


def test_jobs_are_filtered_by_status_and_process(local_service) -> None:
    held, waits = local_service.running(), local_service.waiting()
    assert listed(local_service, "?status=running") == [held.job_id]
    assert listed(local_service, "?status=running,accepted") == [waits.job_id, held.job_id]
    assert listed(local_service, "?status=running&status=failed") == [held.job_id]
    assert listed(local_service, "?processID=other") == []
    assert listed(local_service, "?processID=other&processID=reconstruct") == [waits.job_id, held.job_id]
    assert listed(local_service, "?type=process") == [waits.job_id, held.job_id]
    assert listed(local_service, "?type=other") == []


def test_jobs_are_searched_by_words_and_counted_on_all_pages(local_service) -> None:
    made = [local_service.waiting(title=f"Delft & {part}").job_id for part in ("West", "Oost", "Noord")]
    local_service.waiting()
    assert listed(local_service, "?q=west%20DELFT") == [made[0]]
    assert listed(local_service, f"?q={made[1][:12]}") == [made[1]]
    assert listed(local_service, "?q=compare") == []
    page = local_service.client.get("/jobs?q=delft%20%26&limit=2").json()
    assert (page["numberMatched"], len(page["jobs"])) == (3, 2)
    following = next(link["href"] for link in page["links"] if link["rel"] == "next")
    rest = local_service.client.get(following).json()
    assert [job["jobID"] for job in rest["jobs"]] == [made[0]]
    assert local_service.client.get("/jobs?type=other").json()["numberMatched"] == 0


def test_jobs_are_filtered_by_when_they_were_created(local_service) -> None:
    job = local_service.waiting()
    reported = local_service.client.get(f"/jobs/{job.job_id}").json()["created"]
    assert listed(local_service, f"?datetime={reported}") == [job.job_id]
    for interval in (f"{reported}/..", "../2100-01-01T00:00:00Z", "2000-01-01/2100-01-01", f"{reported}/"):
        assert listed(local_service, f"?datetime={interval}") == [job.job_id], interval
    last = "9999-12-31T23:59:59.999999Z"
    for interval in ("../2000-01-01T00:00:00Z", "2100-01-01T00:00:00+02:00/..", "2000-01-01T00:00:00Z", last):
        assert listed(local_service, f"?datetime={interval}") == [], interval


@pytest.mark.parametrize(
    "query",
    [
        "limit=0",
        "limit=10001",
        "limit=x",
        "offset=-1",
        "status=done",
        "datetime=yesterday",
        "datetime=",
        "datetime=2026-01-01/2025-01-01",
        "datetime=a/b/c",
        "datetime=0001-01-01T00:00:00%2B14:00",
        "minDuration=-1",
        "minDuration=nan",
        "maxDuration=inf",
        pytest.param(f"q={'q' * 201}", id="q of 201 signs"),
    ],
)
def test_a_filter_that_cannot_be_is_refused_by_its_name(local_service, query: str) -> None:
    answer = local_service.client.get(f"/jobs?{query}")
    assert answer.status_code == 400
    assert query.partition("=")[0] in answer.json()["detail"]


def test_a_key_sees_its_own_jobs_and_an_admin_all(local_service) -> None:
    one, other, admin = (local_service.key(scope) for scope in (Scope.SUBMIT, Scope.READ, Scope.ADMIN))
    job_id = send(local_service, ("a.xyz", POINTS), headers=one, crs="EPSG:28992").json()["jobID"]
    found = [local_service.client.get("/jobs", headers=key).json()["jobs"] for key in (one, other, admin)]
    assert list(map(len, found)) == [1, 0, 1]
    assert local_service.client.get(f"/jobs/{job_id}", headers=other).status_code == 404
    assert local_service.client.get(f"/jobs/{job_id}/events?f=json", headers=other).status_code == 404
    assert local_service.client.delete(f"/jobs/{job_id}", headers=other).status_code == 403
    assert local_service.client.delete(f"/jobs/{job_id}", headers=admin).json()["status"] == "dismissed"


# --- one job


def test_status_has_the_fields_of_both_versions_of_the_standard(local_service) -> None:
    job = local_service.running()
    reported = local_service.client.get(f"/jobs/{job.job_id}").json()
    assert reported["jobID"] == reported["id"] == job.job_id
    assert reported["type"] == "process"
    assert reported["processingEntityType"] == "ogc-api-processes"
    assert (reported["status"], reported["progress"]) == ("running", 0)
    assert {"created", "started", "updated", "message", "request"} <= set(reported)
    assert "finished" not in reported
    assert {"self", "monitor"} <= {link["rel"] for link in reported["links"]}


def test_a_failed_job_says_why_as_a_problem(local_service) -> None:
    job = local_service.running()
    local_service.store.fail(job, JobFailure(fault=Fault.INPUT, detail="tile.laz: no points. Get it again"))
    reported = local_service.client.get(f"/jobs/{job.job_id}").json()
    assert (reported["status"], reported["exception"]["status"]) == ("failed", 422)
    assert reported["exception"]["detail"] == "tile.laz: no points. Get it again"
    results = next(link for link in reported["links"] if link["rel"].endswith("exceptions"))
    assert local_service.client.get(results["href"]).json()["type"] == reported["exception"]["type"]


def test_dismissing_a_running_job_waits_until_its_driver_lets_go(local_service, monkeypatch) -> None:
    monkeypatch.setattr(jobs_routes, "DISMISSAL_S", 60.0)
    job = local_service.running()
    reported_to_stop = threading.Event()

    def drive() -> None:
        while not local_service.store.renew(job, lease_s=3600.0):
            reported_to_stop.wait(0.01)
        reported_to_stop.set()
        local_service.store.dismissed(job)

    driver = threading.Thread(target=drive)
    driver.start()
    answer = local_service.client.delete(f"/jobs/{job.job_id}")
    driver.join(60.0)
    assert reported_to_stop.is_set()
    assert (answer.status_code, answer.json()["status"]) == (200, "dismissed")


def test_a_driver_that_does_not_let_go_is_reported_honestly(local_service, monkeypatch) -> None:
    monkeypatch.setattr(jobs_routes, "DISMISSAL_S", 0.05)
    job = local_service.running()
    answer = local_service.client.delete(f"/jobs/{job.job_id}")
    assert answer.status_code == 200
    assert answer.json()["status"] == "running"
    assert "dismissal was requested" in answer.json()["message"]
    assert local_service.store.renew(job, lease_s=1.0) is True


def test_a_job_that_is_over_is_removed_with_its_files(local_service) -> None:
    job = local_service.running()
    folder = local_service.settings.state / "jobs" / job.job_id / "attempt-1" / "outputs"
    folder.mkdir(parents=True)
    (folder / "report.json").write_text("{}")
    local_service.store.succeed(job, message="done", summary={})
    answer = local_service.client.delete(f"/jobs/{job.job_id}")
    assert (answer.status_code, answer.json()["status"]) == (200, "dismissed")
    assert not (local_service.settings.state / "jobs" / job.job_id).exists()
    assert local_service.client.get(f"/jobs/{job.job_id}").status_code == 404
    assert local_service.client.delete(f"/jobs/{job.job_id}").status_code == 404


@pytest.mark.parametrize("job_id", ["0" * 32, "..%2f..%2fservice.db", "x" * 2000, "%00", "%ff"])
def test_an_id_that_is_none_is_no_such_job(local_service, job_id: str) -> None:
    for answer in (local_service.client.get(f"/jobs/{job_id}"), local_service.client.delete(f"/jobs/{job_id}")):
        assert answer.status_code == 404
        assert answer.headers["content-type"] == "application/problem+json"
    assert (local_service.settings.state / "service.db").exists()


def test_a_key_to_read_may_not_submit(local_service) -> None:
    answer = send(local_service, ("a.xyz", POINTS), headers=local_service.key(Scope.READ), crs="EPSG:28992")
    assert answer.status_code == 403
    assert kept_files(local_service) == []


# --- another try


def ended(service, **fields: str) -> str:
    """The id of a job that failed."""
    job_id = send(service, ("a.xyz", POINTS), crs="EPSG:28992", **fields).json()["jobID"]
    held = service.store.claim("a driver", lease_s=3600.0, max_attempts=3)
    assert held.job_id == job_id
    service.store.fail(held, JobFailure(fault=Fault.SETTINGS, detail="x"))
    return job_id


def retried(service, job_id: str, **changes: object):
    return service.client.post(f"/jobs/{job_id}/retry", json=changes)


def test_a_job_that_is_over_is_tried_again_as_it_was(local_service) -> None:
    job_id = ended(local_service, method="kmeans", title="a title", outputs="report", priority="-2")
    for answer in (local_service.client.post(f"/jobs/{job_id}/retry"), retried(local_service, job_id)):
        assert answer.status_code == 201, answer.text
        again = local_service.store.get(answer.json()["jobID"])
        before = local_service.store.get(job_id)
        assert (again.request, again.priority) == (before.request, before.priority)
        assert (again.status, before.status) == (JobStatus.ACCEPTED, JobStatus.FAILED)
        assert answer.headers["location"].endswith(again.job_id)


def test_another_try_may_change_inputs_settings_and_outputs(local_service) -> None:
    settings = '{"candidates": {"min_area_m2": 15, "min_height_m": 3.0}, "preset": "robust"}'
    job_id = ended(local_service, method="kmeans", settings=settings, title="before", outputs="report")
    changes = {
        "inputs": {
            "method": "fuzzy-sart",
            "title": None,
            "bbox": [0, 0, 9, 9],
            "settings": {"candidates": {"min_area_m2": 20, "min_height_m": None}, "preset": None},
        },
        "outputs": {"cityjson": {}},
    }
    answer = retried(local_service, job_id, **changes)
    request = local_service.request_of(answer)
    assert request.settings == {"method": "fuzzy-sart", "candidates": {"min_area_m2": 20}}
    assert (request.title, request.bbox, request.outputs) == (None, (0.0, 0.0, 9.0, 9.0), ("cityjson",))
    assert request.tiles == local_service.store.get(job_id).request.tiles
    without = local_service.request_of(retried(local_service, job_id, inputs={"settings": None, "method": None}))
    assert without.settings == {}


def test_faults_of_changes_are_reported_together_and_make_no_job(local_service) -> None:
    job_id = ended(local_service)
    answer = retried(local_service, job_id, inputs={"method": "guess", "settings": {"roof": {"x": 1}}, "colour": 1})
    assert answer.status_code == 400
    for words in ("method is", "[roof] x", '"colour" is not an input'):
        assert words in answer.text.replace('\\"', '"')
    assert len(local_service.client.get("/jobs").json()["jobs"]) == 1


def test_a_job_that_is_not_over_is_not_tried_again(local_service) -> None:
    job = local_service.waiting()
    answer = retried(local_service, job.job_id)
    assert (answer.status_code, answer.json()["type"]) == (409, "urn:gablework:problem:job-not-over")
    assert retried(local_service, "0" * 32).status_code == 404


def test_another_try_whose_upload_is_gone_says_so(local_service) -> None:
    job_id = ended(local_service)
    (tile,) = local_service.store.get(job_id).request.tiles
    assert local_service.client.delete(f"/uploads/{tile.value}").status_code == 204
    answer = retried(local_service, job_id)
    assert answer.status_code == 400
    assert tile.value in answer.json()["detail"]


# --- kept jobs


def test_a_job_is_kept_until_its_client_says_otherwise(local_service) -> None:
    job_id = ended(local_service)
    place = f"/jobs/{job_id}"
    assert "keep" not in local_service.client.get(place).json()
    for keep in (True, False):
        answer = local_service.client.patch(place, json={"keep": keep})
        assert (answer.status_code, answer.json().get("keep", False)) == (200, keep)
        assert local_service.store.get(job_id).keep is keep
    for body in ({}, {"keep": "yes"}, {"keep": True, "colour": 1}):
        assert local_service.client.patch(place, json=body).status_code == 400
    assert local_service.client.patch(f"/jobs/{'0' * 32}", json={"keep": True}).status_code == 404


def test_only_its_own_key_keeps_a_job(starting) -> None:
    service = starting()
    owner, other = service.key(Scope.SUBMIT), service.key(Scope.SUBMIT)
    job_id = send(service, ("a.xyz", POINTS), headers=owner, crs="EPSG:28992").json()["jobID"]
    assert service.client.patch(f"/jobs/{job_id}", json={"keep": True}, headers=other).status_code == 404
    assert service.client.patch(f"/jobs/{job_id}", json={"keep": True}, headers=owner).status_code == 200
