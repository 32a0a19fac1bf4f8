"""Schedules over HTTP: made, listed, changed, run by hand, removed, and how their jobs tell of them."""

import base64
import datetime as dt
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from live_service import POINTS

from pipeline.schedule import Cron
from service.driver.janitor import tidy_uploads
from service.files import StateFolder
from service.jobs import JobStatus
from service.keys import Scope
from service.store.tables import UPLOADS

HOUR = dt.timedelta(hours=1)


def body(upload: str, **values: Any) -> dict[str, Any]:
    execute = {"inputs": {"tiles": [{"href": f"/uploads/{upload}"}], "crs": "EPSG:28992"}, "outputs": {"report": {}}}
    return {"cron": "30 2 * * *", "timeZone": "Europe/Amsterdam", "execute": execute} | values


def make(service, headers: dict[str, str] | None = None, **values: Any) -> dict[str, Any]:
    answer = service.client.post("/schedules", json=body(service.upload(**(headers or {})), **values), headers=headers)
    assert answer.status_code == 201, answer.text
    return dict(answer.json())


def patch(service, made: dict[str, Any], headers: dict[str, str] | None = None, **values: Any):
    return service.client.patch(f"/schedules/{made['scheduleID']}", json=values, headers=headers)


def kept_files(service) -> list[Path]:
    return sorted((service.settings.state / "uploads").rglob("*"))


# --- made


def test_a_schedule_is_made_and_says_when_it_runs(local_service) -> None:
    asked = body(local_service.upload(), title="every night", overlap="wait", missed="skip", graceSeconds=60)
    answer = local_service.client.post("/schedules", json=asked)
    assert answer.status_code == 201, answer.text
    shown = answer.json()
    assert answer.headers["location"].endswith(f"/schedules/{shown['scheduleID']}")
    assert answer.headers["etag"] == '"1"'
    assert (shown["state"], shown["processID"], shown["version"]) == ("active", "reconstruct", 1)
    assert (shown["title"], shown["overlap"]) == ("every night", "wait")
    assert (shown["missed"], shown["graceSeconds"]) == ("skip", 60.0)
    assert shown["execute"]["inputs"]["tiles"][0]["href"].endswith(asked["execute"]["inputs"]["tiles"][0]["href"])
    assert shown["execute"]["outputs"] == {"report": {}}
    assert shown["counts"] == {"submitted": 0, "skipped": 0, "missed": 0, "failed": 0}
    times = [dt.datetime.fromisoformat(text) for text in shown["nextTimes"]]
    cron = Cron("30 2 * * *", "Europe/Amsterdam")
    assert times == cron.next_times(dt.datetime.fromisoformat(shown["created"]), 5)
    again = local_service.client.get(f"/schedules/{shown['scheduleID']}")
    assert again.json() == shown
    assert again.headers["etag"] == '"1"'


def test_the_request_that_a_schedule_shows_makes_the_same_schedule_again(local_service) -> None:
    made = make(local_service)
    copied = {name: made[name] for name in ("cron", "timeZone", "execute", "missed", "overlap", "graceSeconds")}
    answer = local_service.client.post("/schedules", json=copied)
    assert answer.status_code == 201, answer.text
    first, second = (local_service.store.schedules.get(one["scheduleID"]).definition for one in (made, answer.json()))
    assert first == second


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        ({"cron": "61 * * * *"}, "its minute is '61', use 0 to 59"),
        ({"cron": 5}, "cron is 5: use a text"),
        ({"timeZone": "Europe/Amstedam"}, "did you mean Europe/Amsterdam"),
        ({"timeZone": None}, "timeZone is null"),
        ({"missed": "never"}, "use one of run-latest, skip"),
        ({"overlap": ["skip"]}, "use one of skip, wait"),
        ({"graceSeconds": -1}, "graceSeconds is -1: use 0 or more"),
        ({"graceSeconds": True}, "use a number"),
        ({"graceSeconds": 10**400}, "use a number"),
        ({"paused": "yes"}, "use true or false"),
        ({"title": 5}, "use a text"),
        ({"title": "x" * 501}, "at most 500 characters"),
        ({"processID": "paint"}, "use one of reconstruct, compare"),
        ({"colour": "red"}, '"colour" is not a member: use title, cron'),
        ({"execute": []}, "execute is []: use an object"),
        ({"execute": {"inputs": {}}}, "execute: tiles is missing"),
        ({"execute": {"inputs": {"tiles": {"href": "/uploads/x"}, "colour": 1}}}, 'execute: "colour" is not an input'),
    ],
)
def test_a_schedule_that_does_not_fit_is_refused_with_the_fix(local_service, values, fault) -> None:
    answer = local_service.client.post("/schedules", json=body("0" * 32, **values))
    assert answer.status_code == 400, answer.text
    assert any(fault in found for found in answer.json()["errors"]), answer.text
    assert local_service.client.get("/schedules").json()["schedules"] == []


def test_every_fault_is_reported_at_once(local_service) -> None:
    answer = local_service.client.post("/schedules", json={"timeZone": "Mars/Olympus", "paused": 1, "colour": 2})
    assert answer.status_code == 400
    faults = " ".join(answer.json()["errors"])
    assert all(word in faults for word in ("cron is missing", "Mars/Olympus", "paused", "colour", "execute is missing"))


@pytest.mark.parametrize("number", ["Infinity", "NaN"])
def test_a_grace_that_is_no_number_is_refused(local_service, number: str) -> None:
    content = f'{{"cron": "@daily", "graceSeconds": {number}, "execute": {{}}}}'
    answer = local_service.client.post("/schedules", content=content, headers={"Content-Type": "application/json"})
    assert answer.status_code == 400
    assert any("graceSeconds" in fault for fault in answer.json()["errors"])


def test_no_schedule_exists_that_could_never_run(starting, tmp_path: Path) -> None:
    service = starting(input_roots=(tmp_path / "tiles",))
    (tmp_path / "tiles").mkdir()
    tile = tmp_path / "tiles" / "a.xyz"

    def status(href: str, **inputs: Any) -> int:
        execute = {"inputs": {"tiles": [{"href": href}], **inputs}}
        return int(service.client.post("/schedules", json={"cron": "@daily", "execute": execute}).status_code)

    assert status(f"/uploads/{'0' * 32}") == 400
    assert status("/etc/passwd") == 403
    assert status("https://elsewhere.example/a.laz") == 403
    assert status(str(tile)) == 400
    tile.write_bytes(POINTS)
    assert status(str(tile)) == 201
    assert status(str(tile), method="guess") == 400


def test_files_within_the_request_are_kept_as_long_as_the_schedule_is_there(local_service) -> None:
    inline = {"value": base64.b64encode(POINTS).decode(), "mediaType": "text/plain"}
    execute = {"inputs": {"tiles": [inline], "crs": "EPSG:28992"}}
    answer = local_service.client.post("/schedules", json={"cron": "@daily", "execute": execute})
    assert answer.status_code == 201, answer.text
    made = answer.json()
    store, folder = local_service.store, StateFolder(local_service.settings.state)
    (upload,) = store.upload_ids()
    with store._database.write() as connection:
        connection.execute(sa.update(UPLOADS).values(expires_at=store.now() - HOUR))
    assert tidy_uploads(store, folder) == []
    refused = local_service.client.delete(f"/uploads/{upload}")
    assert (refused.status_code, refused.json()["title"]) == (409, "The upload is still needed")
    assert "1 schedules need" in refused.json()["detail"]
    assert local_service.client.delete(f"/schedules/{made['scheduleID']}").status_code == 204
    assert tidy_uploads(store, folder) == [folder.upload(upload)]


def test_nothing_is_kept_of_a_schedule_that_is_refused(starting) -> None:
    service = starting(max_schedules_per_key=1)
    make(service)
    before = kept_files(service)
    inline = {"value": base64.b64encode(POINTS).decode(), "mediaType": "text/plain"}
    for execute in (
        {"inputs": {"tiles": [inline], "crs": "EPSG:28992"}},
        {"inputs": {"tiles": [inline, {"href": "/uploads/" + "0" * 32}], "crs": "EPSG:28992"}},
    ):
        answer = service.client.post("/schedules", json={"cron": "@daily", "execute": execute})
        assert answer.status_code in {400, 409}, answer.text
    assert kept_files(service) == before
    assert len(service.client.get("/schedules").json()["schedules"]) == 1


# --- listed


def test_schedules_are_listed_in_pages_and_by_state_and_process(local_service) -> None:
    made = [make(local_service, title=str(n), paused=n == 1) for n in range(3)]

    def ids(query: str) -> list[str]:
        answer = local_service.client.get(f"/schedules?{query}")
        assert answer.status_code == 200, answer.text
        return [one["scheduleID"] for one in answer.json()["schedules"]]

    every = ids("")
    assert sorted(every) == sorted(one["scheduleID"] for one in made)
    assert ids("state=paused") == [made[1]["scheduleID"]]
    assert len(ids("state=active")) == 2
    assert ids("processID=compare") == []
    first = local_service.client.get("/schedules?state=active&limit=1").json()
    following = next(link["href"] for link in first["links"] if link["rel"] == "next")
    second = local_service.client.get(following).json()
    assert {one["scheduleID"] for one in (*first["schedules"], *second["schedules"])} == set(ids("state=active"))
    assert "execute" not in first["schedules"][0]
    assert local_service.client.get("/schedules?state=asleep").status_code == 400


# --- changed


def test_a_schedule_is_paused_and_resumed(local_service) -> None:
    made = make(local_service)
    paused = patch(local_service, made, paused=True)
    assert (paused.status_code, paused.json()["state"], paused.json()["nextTimes"]) == (200, "paused", [])
    assert paused.headers["etag"] == '"2"'
    assert paused.json()["execute"] == made["execute"]
    resumed = patch(local_service, made, paused=False)
    assert (resumed.json()["state"], resumed.json()["version"]) == ("active", 3)
    assert resumed.json()["nextTimes"]


def test_what_is_not_given_stays_and_a_title_can_be_taken_away(local_service) -> None:
    made = make(local_service, title="night", overlap="wait", graceSeconds=7)
    answer = local_service.client.patch(
        f"/schedules/{made['scheduleID']}",
        content='{"timeZone": "America/New_York", "title": null}',
        headers={"Content-Type": "application/merge-patch+json"},
    )
    changed = answer.json()
    assert (changed["cron"], changed["timeZone"]) == ("30 2 * * *", "America/New_York")
    assert (changed["overlap"], changed["graceSeconds"], "title" in changed) == ("wait", 7.0, False)
    assert all(text[-6:] in {"-05:00", "-04:00"} for text in changed["nextTimes"])


def test_the_request_of_a_schedule_is_changed_as_a_whole_and_its_old_upload_may_go(local_service) -> None:
    made = make(local_service)
    old = made["execute"]["inputs"]["tiles"][0]["href"].rpartition("/")[2]
    new = local_service.upload()
    execute = {"inputs": {"tiles": [{"href": f"/uploads/{new}"}], "crs": "EPSG:7415"}}
    answer = patch(local_service, made, execute=execute)
    assert answer.status_code == 200, answer.text
    assert answer.json()["execute"]["inputs"]["crs"] == "EPSG:7415"
    assert "outputs" not in answer.json()["execute"]
    assert local_service.client.delete(f"/uploads/{old}").status_code == 204
    assert local_service.client.delete(f"/uploads/{new}").status_code == 409


def test_a_changed_request_is_one_of_the_schedule_s_process(local_service) -> None:
    methods = ["arrangement", "kmeans"]
    inputs = {"tiles": [{"href": f"/uploads/{local_service.upload()}"}], "crs": "EPSG:28992"}
    made = make(local_service, processID="compare", execute={"inputs": {**inputs, "methods": methods}})
    changed = patch(local_service, made, execute={"inputs": {**inputs, "methods": methods[::-1]}})
    assert changed.status_code == 200, changed.text
    assert changed.json()["execute"]["inputs"]["methods"] == methods[::-1]
    refused = patch(local_service, made, execute={"inputs": inputs})
    assert refused.status_code == 400
    assert "execute: methods is missing" in refused.json()["detail"]


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        ({}, "nothing is given"),
        ({"cron": "every night"}, "with 2 fields"),
        ({"cron": None}, "cron is null"),
        ({"processID": "compare"}, "give execute, too"),
        ({"execute": {"inputs": {}}}, "tiles is missing"),
        ({"paused": None}, "use true or false"),
    ],
)
def test_a_change_that_does_not_fit_changes_nothing(local_service, values, fault) -> None:
    made = make(local_service)
    answer = patch(local_service, made, **values)
    assert answer.status_code == 400, answer.text
    assert fault in answer.json()["detail"]
    assert local_service.client.get(f"/schedules/{made['scheduleID']}").json() == made


def test_a_change_of_what_the_client_did_not_see_is_refused(local_service) -> None:
    made = make(local_service)
    assert patch(local_service, made, {"If-Match": '"1"'}, title="first").status_code == 200
    lost = patch(local_service, made, {"If-Match": '"1"'}, title="second")
    assert (lost.status_code, lost.json()["type"]) == (412, "urn:gablework:problem:changed-meanwhile")
    assert 'has the ETag "2"' in lost.json()["detail"]
    assert patch(local_service, made, {"If-Match": 'W/"2"'}, title="weak").status_code == 412
    assert patch(local_service, made, {"If-Match": '"7", "2"'}, title="third").status_code == 200
    assert patch(local_service, made, {"If-Match": "*"}, title="fourth").json()["title"] == "fourth"


# --- run


def test_a_run_by_hand_is_a_job_that_names_its_schedule(local_service) -> None:
    made = make(local_service, title="every night", paused=True)
    place = f"/schedules/{made['scheduleID']}"
    answer = local_service.client.post(f"{place}/run")
    assert answer.status_code == 201, answer.text
    job = answer.json()
    assert answer.headers["location"].endswith(f"/jobs/{job['jobID']}")
    assert (job["status"], job["title"], job["scheduleID"]) == ("accepted", "every night", made["scheduleID"])
    assert any(link["rel"] == "schedule" and link["href"].endswith(place) for link in job["links"])
    listed = local_service.client.get("/jobs").json()["jobs"]
    assert [one["scheduleID"] for one in listed] == [made["scheduleID"]]
    local_service.waiting()
    of_schedule = next(link["href"] for link in made["links"] if link["rel"] == "jobs")
    assert [one["jobID"] for one in local_service.client.get(of_schedule).json()["jobs"]] == [job["jobID"]]
    shown = local_service.client.get(place).json()
    assert (shown["lastRun"]["trigger"], shown["lastRun"]["jobID"]) == ("hand", job["jobID"])
    assert shown["counts"]["submitted"] == 1


def test_a_run_by_hand_names_the_job_that_is_under_way(local_service) -> None:
    made = make(local_service)
    place = f"/schedules/{made['scheduleID']}"
    job = local_service.client.post(f"{place}/run").json()["jobID"]
    refused = local_service.client.post(f"{place}/run")
    assert refused.status_code == 409
    problem = refused.json()
    assert (problem["type"], problem["jobID"]) == ("urn:gablework:problem:schedule-busy", job)
    assert job in problem["detail"]
    local_service.client.delete(f"/jobs/{job}")
    assert local_service.client.post(f"{place}/run").status_code == 201


def test_the_history_of_the_slots_is_shown(local_service) -> None:
    made = make(local_service, cron="0 * * * *", timeZone="UTC")
    store = local_service.store
    start = store.schedules.get(made["scheduleID"]).next_at
    store.schedules.tick(now=start + 5 * HOUR)
    store.schedules.tick(now=start + 6 * HOUR)
    answer = local_service.client.get(f"/schedules/{made['scheduleID']}/runs")
    skipped, submitted, missed = answer.json()["runs"]
    assert [one["outcome"] for one in (skipped, submitted, missed)] == ["skipped", "submitted", "missed"]
    assert missed["slots"] == 5
    assert missed["firstSlot"] == start.isoformat(timespec="milliseconds").replace("+00:00", "Z")
    assert skipped["jobID"] == submitted["jobID"]
    assert "still under way" in skipped["message"]
    assert submitted["links"][0]["href"].endswith(f"/jobs/{submitted['jobID']}")
    page = local_service.client.get(f"/schedules/{made['scheduleID']}/runs?limit=1&offset=1").json()
    assert [one["number"] for one in page["runs"]] == [2]
    assert {link["rel"] for link in page["links"]} == {"self", "next", "prev", "up"}
    shown = local_service.client.get(f"/schedules/{made['scheduleID']}").json()
    assert shown["counts"] == {"submitted": 1, "skipped": 1, "missed": 5, "failed": 0}
    figures = local_service.client.get("/metrics").text
    assert 'gablework_schedules{state="active"} 1.0' in figures
    assert 'gablework_schedules{state="paused"} 0.0' in figures
    assert 'gablework_schedule_slots{outcome="missed"} 5.0' in figures


# --- removed, and who may


def test_a_schedule_that_is_removed_is_gone_and_its_job_goes_on(local_service) -> None:
    made = make(local_service)
    place = f"/schedules/{made['scheduleID']}"
    job = local_service.client.post(f"{place}/run").json()["jobID"]
    assert local_service.client.delete(place).status_code == 204
    for answer in (
        local_service.client.get(place),
        local_service.client.delete(place),
        local_service.client.get(f"{place}/runs"),
        local_service.client.post(f"{place}/run"),
        local_service.client.patch(place, json={"paused": True}),
    ):
        assert (answer.status_code, answer.json()["type"]) == (404, "urn:gablework:problem:no-such-schedule")
    assert local_service.store.get(job).status is JobStatus.ACCEPTED


def test_who_may_read_may_not_write_and_no_key_sees_the_schedules_of_others(local_service) -> None:
    mine, other = local_service.key(Scope.SUBMIT), local_service.key(Scope.SUBMIT)
    reader, admin = local_service.key(Scope.READ), local_service.key(Scope.ADMIN)
    made = make(local_service, mine)
    place = f"/schedules/{made['scheduleID']}"
    client = local_service.client

    def statuses(headers: dict[str, str] | None) -> list[int]:
        return [
            client.get(place, headers=headers).status_code,
            client.get(f"{place}/runs", headers=headers).status_code,
            client.patch(place, json={"title": "x"}, headers=headers).status_code,
            client.post("/schedules", json={}, headers=headers).status_code,
            client.get("/schedules", headers=headers).status_code,
        ]

    assert statuses(None) == [401] * 5
    assert statuses(reader) == [404, 404, 403, 403, 200]
    assert statuses(other) == [404, 404, 404, 400, 200]
    assert statuses(mine) == [200, 200, 200, 400, 200]
    assert statuses(admin) == [200, 200, 200, 400, 200]
    assert [len(client.get("/schedules", headers=who).json()["schedules"]) for who in (mine, other, admin)] == [1, 0, 1]
    for who, expected in ((reader, 403), (other, 404)):
        assert client.post(f"{place}/run", headers=who).status_code == expected
        assert client.delete(place, headers=who).status_code == expected
    # no matter who starts it, the job is its maker's
    job = client.post(f"{place}/run", headers=admin).json()["jobID"]
    assert client.get(f"/jobs/{job}", headers=mine).status_code == 200
    assert client.delete(place, headers=mine).status_code == 204
