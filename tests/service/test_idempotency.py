"""A request that is sent again under its Idempotency-Key makes nothing new."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
from finished_runs import problem
from live_service import DEADLINE_S, POINTS, add_key, serving, settings_in
from processes import wait_for

from service.deliveries import CLAIM_S, Claim
from service.errors import KeyInUseError, StoreError
from service.keys import Scope
from service.store import JobFilter, JobStore, ScheduleFilter
from service.store import idempotency as table

KEY = {"Idempotency-Key": '"one of mine"'}


def execute(upload: str, **more: Any) -> dict[str, Any]:
    return {"inputs": {"tiles": [{"href": f"/uploads/{upload}"}], "crs": "EPSG:28992", **more}}


def made_things(service: Any) -> tuple[int, int, int, int]:
    """How many jobs, schedules, uploads and folders of uploads there are."""
    store = service.store
    folders = [path for path in (service.settings.state / "uploads").iterdir() if path.is_dir()]
    schedules = store.schedules.list(ScheduleFilter())
    return len(store.list(JobFilter())), len(schedules), len(store.upload_ids()), len(folders)


def submit_form(service: Any, upload: str, headers: dict[str, str]) -> httpx.Response:
    files = {"tile": ("a.xyz", POINTS)}
    return service.client.post("/jobs", data={"crs": "EPSG:28992"}, files=files, headers=headers)


def start_process(service: Any, upload: str, headers: dict[str, str]) -> httpx.Response:
    return service.client.post("/processes/reconstruct/execution", json=execute(upload), headers=headers)


def send_file(service: Any, upload: str, headers: dict[str, str]) -> httpx.Response:
    return service.client.post("/uploads?filename=b.xyz", content=POINTS, headers=headers)


def send_form(service: Any, upload: str, headers: dict[str, str]) -> httpx.Response:
    return service.client.post("/uploads", files={"file": ("c.xyz", POINTS)}, headers=headers)


def make_schedule(service: Any, upload: str, headers: dict[str, str]) -> httpx.Response:
    asked = {"cron": "30 2 * * *", "execute": execute(upload)}
    return service.client.post("/schedules", json=asked, headers=headers)


def run_schedule(service: Any, upload: str, headers: dict[str, str]) -> httpx.Response:
    known = service.store.schedules.list(ScheduleFilter())
    where = known[0].schedule_id if known else make_schedule(service, upload, {}).json()["scheduleID"]
    return service.client.post(f"/schedules/{where}/run", headers=headers)


CREATING = [submit_form, start_process, send_file, send_form, make_schedule, run_schedule]
Create = Callable[[Any, str, dict[str, str]], httpx.Response]


@pytest.mark.parametrize("create", CREATING, ids=lambda create: create.__name__)
def test_the_same_request_again_makes_nothing_and_gets_the_same_answer(local_service: Any, create: Create) -> None:
    upload = local_service.upload()
    first = create(local_service, upload, KEY)
    assert first.status_code == 201, first.text
    before = made_things(local_service)
    again = create(local_service, upload, KEY)
    assert (again.status_code, again.content) == (201, first.content)
    for name in ("location", "content-type", "etag"):
        assert again.headers.get(name) == first.headers.get(name)
    assert "idempotency-replayed" not in first.headers
    assert again.headers["idempotency-replayed"] == "true"
    assert made_things(local_service) == before
    if create is not run_schedule:
        assert create(local_service, upload, {}).json() != first.json()


@pytest.mark.parametrize(
    ("path", "content"),
    [
        ("/uploads?filename=b.xyz", POINTS[:-8]),
        ("/uploads?filename=b.xyz", POINTS * 2),
        ("/uploads?filename=c.xyz", POINTS),
    ],
)
def test_another_request_under_the_same_key_is_refused(local_service: Any, path: str, content: bytes) -> None:
    send_file(local_service, "", KEY)
    before = made_things(local_service)
    detail = problem(local_service.client.post(path, content=content, headers=KEY), 422, "key-reused")
    assert "use a new key" in detail
    assert made_things(local_service) == before
    other = local_service.client.post("/processes/reconstruct/execution", json=execute("0" * 32), headers=KEY)
    problem(other, 422, "key-reused")


def test_a_form_whose_boundary_differs_is_the_same_request_and_one_with_other_fields_is_not(
    local_service: Any,
) -> None:
    def form(boundary: str, crs: str) -> httpx.Response:
        lines = [f"--{boundary}", 'Content-Disposition: form-data; name="tile"; filename="a.xyz"', "", POINTS.decode()]
        lines += [f"--{boundary}", 'Content-Disposition: form-data; name="crs"', "", crs, f"--{boundary}--", ""]
        headers = {**KEY, "Content-Type": f"multipart/form-data; boundary={boundary}"}
        return local_service.client.post("/jobs", content="\r\n".join(lines).encode(), headers=headers)

    first = form("a1", "EPSG:28992")
    assert first.status_code == 201, first.text
    assert form("another", "EPSG:28992").content == first.content
    problem(form("a1", "EPSG:28993"), 422, "key-reused")


def test_a_request_that_failed_frees_its_key(local_service: Any) -> None:
    missing = local_service.client.post("/processes/reconstruct/execution", json=execute("0" * 32), headers=KEY)
    assert missing.status_code == 400
    upload = local_service.upload()
    assert start_process(local_service, upload, KEY).status_code == 201


def test_keys_of_different_clients_do_not_meet(starting: Any) -> None:
    service = starting()
    mine, others = service.key(Scope.SUBMIT), service.key(Scope.SUBMIT)
    first, second = (send_file(service, "", {**KEY, **key}) for key in (mine, others))
    assert first.json()["uploadID"] != second.json()["uploadID"]
    assert send_file(service, "", {**KEY, **mine}).content == first.content


@pytest.mark.parametrize("key", ["", '""', '"a', "a b", "a,b", "a;b", "x" * 256, '"tab\there"', "caf\u00e9".encode()])
def test_a_malformed_key_is_refused(local_service: Any, key: str | bytes) -> None:
    headers = {b"Idempotency-Key": key if isinstance(key, bytes) else key.encode()}
    answer = local_service.client.post("/uploads?filename=b.xyz", content=POINTS, headers=headers)
    problem(answer, 400, "invalid-request")
    assert made_things(local_service) == (0, 0, 0, 0)


def test_two_keys_are_one_too_many(local_service: Any) -> None:
    headers = [("Idempotency-Key", "a"), ("Idempotency-Key", "b")]
    answer = local_service.client.post("/uploads?filename=b.xyz", content=POINTS, headers=headers)
    assert "2 times" in problem(answer, 400, "invalid-request")


def test_quotes_do_not_change_a_key(local_service: Any) -> None:
    first = send_file(local_service, "", {"Idempotency-Key": "a-1"})
    assert send_file(local_service, "", {"Idempotency-Key": '"a-1"'}).content == first.content


def test_while_the_first_request_runs_a_second_one_is_refused(tmp_path: Path) -> None:
    settings = settings_in(tmp_path)
    began, go_on = threading.Event(), threading.Event()

    def slowly() -> Any:
        yield POINTS
        began.set()
        assert go_on.wait(DEADLINE_S)
        yield POINTS

    def send(url: str, content: Any) -> httpx.Response:
        return httpx.post(f"{url}/uploads?filename=a.xyz", content=content, headers=KEY, timeout=DEADLINE_S)

    with serving(settings) as url, ThreadPoolExecutor(1) as crew:
        first = crew.submit(send, url, slowly())
        assert began.wait(DEADLINE_S)
        with JobStore(settings.database) as store:
            wait_for(lambda: is_claimed(store), "the claim of the key")
        second = send(url, POINTS * 2)
        assert int(second.headers["Retry-After"]) > 0
        problem(second, 409, "key-in-use")
        go_on.set()
        assert first.result().status_code == 201
        assert send(url, POINTS * 2).content == first.result().content


def is_claimed(store: JobStore) -> bool:
    with store._database.read() as connection:
        return connection.exec_driver_sql("SELECT count(*) FROM idempotency_keys").scalar_one() == 1


def test_a_client_that_goes_away_frees_its_key(tmp_path: Path) -> None:
    settings = settings_in(tmp_path)
    with serving(settings) as url, JobStore(settings.database) as store:

        def broken() -> Any:
            yield POINTS
            wait_for(lambda: is_claimed(store), "the claim of the key")
            raise ConnectionError

        with pytest.raises(ConnectionError):
            httpx.post(f"{url}/uploads?filename=a.xyz", content=broken(), headers=KEY, timeout=DEADLINE_S)
        wait_for(lambda: not is_claimed(store), "the free key")
        answer = httpx.post(f"{url}/uploads?filename=a.xyz", content=POINTS, headers=KEY, timeout=DEADLINE_S)
        assert answer.status_code == 201


# --- in the store


@pytest.fixture
def store(local_service: Any) -> JobStore:
    return local_service.store


def let_pass(store: JobStore, seconds: float) -> None:
    """Move all keys into the past."""
    with store._database.write() as connection:
        rows = connection.execute(table.KEYS.select()).all()
        for row in rows:
            earlier = row.until - table.dt.timedelta(seconds=seconds)
            connection.execute(table.KEYS.update().where(table.KEYS.c.key == row.key).values(until=earlier))


def test_the_claim_of_a_process_that_died_passes_on_and_the_first_one_can_make_nothing_more(
    local_service: Any, store: JobStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = (Claim(owner="", key="k") for _ in range(2))
    assert store.claim_key(first) is None
    with pytest.raises(KeyInUseError):
        store.claim_key(second)
    let_pass(store, CLAIM_S / 2.0)
    store.renew_claim(first)
    let_pass(store, CLAIM_S / 2.0)
    with pytest.raises(KeyInUseError):
        store.claim_key(second)
    let_pass(store, CLAIM_S)
    assert store.claim_key(second) is None
    # the first one was only slow
    with monkeypatch.context() as patch:
        patch.setattr("service.routes.submission.Claim", lambda **_: first)
        patch.setattr(JobStore, "claim_key", lambda *_: None)
        problem(send_file(local_service, "", {"Idempotency-Key": "k"}), 409, "key-in-use")
    assert made_things(local_service) == (0, 0, 0, 0)
    # its end does not free the key of the second
    with pytest.raises(KeyInUseError):
        store.claim_key(Claim(owner="", key="k"))


def test_an_answer_that_cannot_be_kept_takes_what_was_made_with_it(
    local_service: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_arguments: Any, **_values: Any) -> None:
        raise StoreError("the database went away")

    upload = local_service.upload()
    before = made_things(local_service)
    with monkeypatch.context() as patch:
        patch.setattr(table, "keep", broken)
        assert start_process(local_service, upload, KEY).status_code == 503
    assert made_things(local_service) == before
    assert start_process(local_service, upload, KEY).status_code == 201


def test_an_answer_is_kept_for_its_time_and_then_deleted(starting: Any) -> None:
    service = starting(idempotency_hours=2.0)
    first = send_file(service, "", KEY)
    let_pass(service.store, 2.0 * 3600.0 - 60.0)
    assert service.store.forget_answers() == 0
    assert send_file(service, "", KEY).content == first.content
    let_pass(service.store, 61.0)
    assert send_file(service, "", KEY).json()["uploadID"] != first.json()["uploadID"]
    let_pass(service.store, 2.0 * 3600.0)
    assert service.store.forget_answers() == 1
    assert not is_claimed(service.store)


def test_an_answer_is_found_while_the_database_is_locked(local_service: Any) -> None:
    first = send_file(local_service, "", KEY)
    with local_service.store._database.write():
        assert send_file(local_service, "", KEY).content == first.content


def test_a_second_process_knows_the_key(tmp_path: Path) -> None:
    settings = settings_in(tmp_path)
    _, bearer = add_key(settings, Scope.SUBMIT)
    headers = {**KEY, "Authorization": bearer}
    with serving(settings) as one, serving(settings) as other:
        first, second = (
            httpx.post(f"{url}/uploads?filename=a.xyz", content=POINTS, headers=headers, timeout=DEADLINE_S)
            for url in (one, other)
        )
    assert first.json()["uploadID"] == second.json()["uploadID"]


def make_webhook(service: Any, upload: str, headers: dict[str, str]) -> httpx.Response:
    return service.client.post("/webhooks", json={"url": "https://8.8.8.8/"}, headers=headers)


def begin_upload(service: Any, upload: str, headers: dict[str, str]) -> httpx.Response:
    tus = {"Tus-Resumable": "1.0.0", "Upload-Length": "5", "Upload-Metadata": "filename cG9pbnRzLnh5eg=="}
    return service.client.post("/uploads/tus", headers={**tus, **headers})


@pytest.mark.parametrize("create", [*CREATING, make_webhook, begin_upload], ids=lambda create: create.__name__)
def test_the_answer_of_something_that_was_removed_since_is_not_given_again(local_service: Any, create: Create) -> None:
    upload = local_service.upload()
    first = create(local_service, upload, KEY)
    assert first.status_code == 201, first.text
    place = first.headers["location"]
    assert create(local_service, upload, KEY).status_code == 201
    for _ in range(2 if "/jobs/" in place else 1):  # a job that waits is dismissed, then removed
        removed = local_service.client.delete(place, headers={"Tus-Resumable": "1.0.0"})
        assert removed.status_code in {200, 204}, removed.text
    before = made_things(local_service)
    detail = problem(create(local_service, upload, KEY), 409, "removed-since")
    assert httpx.URL(place).path in detail
    assert made_things(local_service) == before
    assert create(local_service, upload, {"Idempotency-Key": "another"}).status_code == 201


def test_a_resumable_upload_that_was_finished_since_counts_as_there(local_service: Any) -> None:
    size = {"Upload-Length": str(len(POINTS))}
    first = begin_upload(local_service, "", {**KEY, **size})
    sent = {"Tus-Resumable": "1.0.0", "Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
    assert local_service.client.patch(first.headers["location"], content=POINTS, headers=sent).status_code == 204
    assert begin_upload(local_service, "", {**KEY, **size}).status_code == 201
