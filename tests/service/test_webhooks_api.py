"""Webhooks over HTTP: receivers, secrets, the log, replay, and who may do what."""

import base64
from typing import Any

import pytest
from webhook_store_contract import settle, take

from service.jobs import Subscriber
from service.keys import Scope
from service.webhooks import EventType, Result, retry_policy

LISTED = "http://127.0.0.1:9"
HOOK = f"{LISTED}/hook"
POLICY = retry_policy(1.0, 100.0)


@pytest.fixture
def local_service(starting):
    """A service without keys that may send to one port of this machine."""
    return starting(webhook_hosts=(LISTED,))


@pytest.fixture
def keyed(starting):
    """A service with keys."""
    return starting(webhook_hosts=(LISTED,), open_without_keys=False)


def make(service, headers: dict[str, str] | None = None, **values: Any) -> dict[str, Any]:
    answer = service.client.post("/webhooks", json={"url": HOOK} | values, headers=headers)
    assert answer.status_code == 201, answer.text
    return dict(answer.json())


def execute(service, headers: dict[str, str] | None = None, **subscriber: str):
    upload = service.upload(**(headers or {}))
    asked = {"inputs": {"tiles": [{"href": f"/uploads/{upload}"}], "crs": "EPSG:28992"}, "subscriber": subscriber}
    return service.client.post("/processes/reconstruct/execution", json=asked, headers=headers)


# --- receivers


def test_a_webhook_is_made_with_a_secret_that_is_shown_once(local_service) -> None:
    answer = local_service.client.post("/webhooks", json={"url": HOOK, "description": "ours"})
    made = answer.json()
    place = f"/webhooks/{made['webhookID']}"
    assert answer.headers["location"].endswith(place)
    assert len(base64.b64decode(made["secret"].removeprefix("whsec_"))) == 32
    assert made["events"] == ["job.successful", "job.failed", "job.dismissed"]
    assert (made["enabled"], made["description"]) == (True, "ours")
    shown = local_service.client.get(place).json()
    assert shown == {name: value for name, value in made.items() if name != "secret"}
    assert local_service.client.get("/webhooks").json()["webhooks"] == [shown]


def test_a_webhook_that_is_made_twice_under_one_key_is_there_once(local_service) -> None:
    headers = {"Idempotency-Key": '"once"'}
    first, second = make(local_service, headers), make(local_service, headers)
    assert first == second
    assert len(local_service.client.get("/webhooks").json()["webhooks"]) == 1


def test_a_webhook_is_removed_and_what_waits_for_it_is_dropped(local_service) -> None:
    made = make(local_service, events=["job.accepted", "job.accepted"])
    place = f"/webhooks/{made['webhookID']}"
    assert made["events"] == ["job.accepted"]
    local_service.waiting()
    assert local_service.client.delete(place).status_code == 204
    assert local_service.client.get(place).status_code == 404
    listed = local_service.client.get(f"/webhooks/deliveries?webhook={made['webhookID']}").json()["deliveries"]
    assert [(one["state"], one["reason"]) for one in listed] == [("dropped", "the webhook was removed")]


def test_the_list_names_all_events_in_words_and_the_default(local_service) -> None:
    kinds = local_service.client.get("/webhooks").json()["eventTypes"]
    assert [kind["type"] for kind in kinds] == [event.value for event in EventType]
    assert [kind["type"] for kind in kinds if kind["isDefault"]] == make(local_service)["events"]
    local_service.store.dismiss(local_service.waiting().job_id)
    (delivery,) = local_service.client.get("/webhooks/deliveries").json()["deliveries"]
    assert delivery["title"] == "a job was cancelled"
    assert {"type": delivery["type"], "title": delivery["title"], "isDefault": True} in kinds


@pytest.mark.parametrize(
    ("body", "status", "words"),
    [
        ({}, 400, "url is missing: give the URL that receives the messages"),
        ({"url": HOOK, "events": []}, 400, "events is []: use at least 1 entries"),
        ({"url": HOOK, "events": ["job.lost"]}, 400, 'events[0] is "job.lost": use one of job.accepted'),
        ({"url": HOOK, "secret": "mine"}, 400, '"secret" is not a member'),
        ({"url": "http://example.org/"}, 403, "webhooks go over https"),
        ({"url": "https://127.0.0.1/"}, 403, "127.0.0.1, which is not a public address"),
        ({"url": "https://localhost/"}, 403, "not a public address"),
        ({"url": "nonsense"}, 403, "is not a URL that can be called"),
    ],
)
def test_a_webhook_that_cannot_be_is_refused_with_the_reason(
    local_service, body: dict, status: int, words: str
) -> None:
    answer = local_service.client.post("/webhooks", json=body)
    assert (answer.status_code, words in answer.text.replace('\\"', '"')) == (status, True), answer.text


# --- subscribers


def test_a_subscriber_is_stored_with_the_job_and_shown_to_its_client(local_service) -> None:
    answer = execute(local_service, successUri=HOOK, failedUri=f"{HOOK}?bad=1")
    request = local_service.request_of(answer)
    assert request.subscriber == Subscriber(success_uri=HOOK, failed_uri=f"{HOOK}?bad=1", base="http://127.0.0.1:8000")
    shown = local_service.client.get(f"/jobs/{answer.json()['jobID']}").json()["request"]["subscriber"]
    assert shown == {"successUri": HOOK, "failedUri": f"{HOOK}?bad=1"}


def test_a_job_that_is_tried_again_keeps_its_subscriber(local_service) -> None:
    first = execute(local_service, successUri=HOOK).json()["jobID"]
    local_service.client.delete(f"/jobs/{first}")
    again = local_service.client.post(f"/jobs/{first}/retry")
    subscriber = local_service.request_of(again).subscriber
    assert subscriber is not None
    assert subscriber.success_uri == HOOK


@pytest.mark.parametrize("uri", ["https://10.0.0.1/", "http://example.org/", "https://localhost/", "x"])
@pytest.mark.parametrize("name", ["successUri", "inProgressUri", "failedUri"])
def test_a_subscriber_that_leads_inside_is_refused_and_nothing_is_kept(local_service, name: str, uri: str) -> None:
    answer = execute(local_service, **{name: uri})
    assert answer.status_code == 403, answer.text
    assert answer.json()["type"] == "urn:gablework:problem:target-refused"
    assert local_service.client.get("/jobs").json()["jobs"] == []


def test_a_schedule_has_a_subscriber_and_so_have_its_jobs(local_service) -> None:
    upload = local_service.upload()
    asked = {
        "cron": "30 2 * * *",
        "execute": {
            "inputs": {"tiles": [{"href": f"/uploads/{upload}"}], "crs": "EPSG:28992"},
            "subscriber": {"failedUri": HOOK},
        },
    }
    made = local_service.client.post("/schedules", json=asked)
    assert made.status_code == 201, made.text
    assert made.json()["execute"]["subscriber"] == {"failedUri": HOOK}
    job = local_service.client.post(f"/schedules/{made.json()['scheduleID']}/run").json()["jobID"]
    local_service.store.dismiss(job)
    (delivery,) = local_service.client.get(f"/webhooks/deliveries?job={job}").json()["deliveries"]
    assert (delivery["type"], delivery["url"]) == ("job.dismissed", HOOK)
    asked["execute"]["subscriber"] = {"failedUri": "https://10.0.0.1/"}
    assert local_service.client.post("/schedules", json=asked).status_code == 403


def test_the_form_has_a_subscriber(local_service) -> None:
    files = {"tile": ("points.xyz", b"84000 447000 3\n84002 447003 4\n84005 447001 2\n")}
    data = {"crs": "EPSG:28992", "subscriber": f'{{"successUri": "{HOOK}"}}'}
    request = local_service.request_of(local_service.client.post("/jobs", files=files, data=data))
    assert request.subscriber is not None
    assert request.subscriber.success_uri == HOOK
    answer = local_service.client.post("/jobs", files=files, data=data | {"subscriber": '{"uri": "x"}'})
    assert (answer.status_code, '\\"uri\\" is not a member' in answer.text) == (400, True), answer.text


# --- the log


def test_the_log_shows_every_attempt_and_replays(local_service) -> None:
    job = execute(local_service, failedUri=HOOK).json()["jobID"]
    local_service.store.dismiss(job)
    refused = Result(duration_ms=12, status=500, error="the receiver answered 500", body='{"a": 1}')
    settle(local_service.store, take(local_service.store), refused)
    (listed,) = local_service.client.get(f"/webhooks/deliveries?job={job}&state=waiting").json()["deliveries"]
    assert "attempts" not in listed
    place = f"/webhooks/deliveries/{listed['deliveryID']}"
    shown = local_service.client.get(place).json()
    (attempt,) = shown.pop("attempts")
    assert shown.pop("body") == '{"a": 1}'
    assert shown == listed
    assert (attempt["number"], attempt["status"], attempt["durationMilliseconds"]) == (1, 500, 12)
    assert attempt["error"] == shown["reason"] == "the receiver answered 500"
    replayed = local_service.client.post(f"{place}/replay")
    assert (replayed.status_code, replayed.json()["state"]) == (202, "waiting")
    again = take(local_service.store)
    assert (again.delivery.delivery_id, again.delivery.body) == (listed["deliveryID"], '{"a": 1}')
    busy = local_service.client.post(f"{place}/replay")
    assert (busy.status_code, busy.json()["type"]) == (409, "urn:gablework:problem:not-replayable")
    for wrong in ("x", "f" * 32):
        assert local_service.client.get(f"/webhooks/deliveries/{wrong}").status_code == 404
        assert local_service.client.post(f"/webhooks/deliveries/{wrong}/replay").status_code == 404


def test_the_log_has_pages(local_service) -> None:
    make(local_service, events=["job.accepted"])
    for _ in range(3):
        local_service.waiting()
    page = local_service.client.get("/webhooks/deliveries?limit=2&state=waiting").json()
    assert len(page["deliveries"]) == 2
    following = next(link["href"] for link in page["links"] if link["rel"] == "next")
    assert len(local_service.client.get(following).json()["deliveries"]) == 1
    assert local_service.client.get("/webhooks/deliveries?state=lost").status_code == 400


def test_the_metrics_count_deliveries(local_service) -> None:
    make(local_service, events=["job.accepted"])
    local_service.waiting()
    text = local_service.client.get("/metrics").text
    assert 'gablework_webhook_deliveries{state="waiting"} 1.0' in text
    assert 'gablework_webhook_deliveries{state="failed"} 0.0' in text


# --- limits, and webhooks that do not keep up


def test_a_webhook_is_sent_what_failed_when_its_owner_replays_it(local_service) -> None:
    store = local_service.store
    place = f"/webhooks/{make(local_service, events=['job.dismissed'])['webhookID']}"
    job = local_service.waiting()
    store.dismiss(job.job_id)
    for _ in range(2):
        parcel = take(store)
        assert parcel.delivery.job_id == job.job_id
        refused = Result(duration_ms=12, status=403, error="refused", is_final=True, body="{}")
        settle(store, parcel, refused)
        replayed = local_service.client.post(f"{place}/replay")
        assert (replayed.status_code, replayed.json()["enabled"]) == (202, True)
    assert local_service.client.post(f"/webhooks/{'0' * 32}/replay").status_code == 404


# --- who may do what


def test_only_an_admin_manages_webhooks_and_owners_see_their_own_deliveries(keyed) -> None:
    admin, mine, yours = (keyed.key(scope) for scope in (Scope.ADMIN, Scope.SUBMIT, Scope.SUBMIT))
    reading = keyed.key(Scope.READ)
    made = make(keyed, admin, events=["job.accepted"])
    place = f"/webhooks/{made['webhookID']}"
    client = keyed.client
    for headers in (mine, reading):
        answers = [
            client.post("/webhooks", json={"url": HOOK}, headers=headers),
            client.get("/webhooks", headers=headers),
            client.get(place, headers=headers),
            client.delete(place, headers=headers),
            client.post(f"{place}/replay", headers=headers),
        ]
        assert {answer.status_code for answer in answers} == {403}
    jobs = {}
    for name, headers in (("mine", mine), ("yours", yours)):
        jobs[name] = execute(keyed, headers, failedUri=HOOK).json()["jobID"]
        keyed.store.dismiss(jobs[name])
    listed = client.get("/webhooks/deliveries", headers=mine).json()["deliveries"]
    assert [(one["jobID"], one["type"]) for one in listed] == [(jobs["mine"], "job.dismissed")]
    everything = client.get("/webhooks/deliveries", headers=admin).json()["deliveries"]
    assert len(everything) == 4
    foreign = [one["deliveryID"] for one in everything if one["deliveryID"] != listed[0]["deliveryID"]]
    for delivery_id in foreign:
        assert client.get(f"/webhooks/deliveries/{delivery_id}", headers=mine).status_code == 404
        assert client.post(f"/webhooks/deliveries/{delivery_id}/replay", headers=mine).status_code == 404
    own = listed[0]["deliveryID"]
    assert client.post(f"/webhooks/deliveries/{own}/replay", headers=mine).status_code == 202
    assert client.post(f"/webhooks/deliveries/{own}/replay", headers=reading).status_code == 403


def test_each_key_reads_and_replaces_its_own_secret(keyed) -> None:
    mine, yours = keyed.key(Scope.SUBMIT), keyed.key(Scope.SUBMIT)
    client = keyed.client
    first = client.get("/webhooks/secret", headers=mine)
    assert first.headers["cache-control"] == "no-store"
    assert client.get("/webhooks/secret", headers=mine).json() == first.json()
    assert client.get("/webhooks/secret", headers=yours).json()["secret"] != first.json()["secret"]
    rotated = client.post("/webhooks/secret/rotate", headers=mine).json()
    assert rotated["secret"] != first.json()["secret"]
    assert client.get("/webhooks/secret", headers=mine).json() == rotated
    assert client.get("/webhooks/secret", headers=keyed.key(Scope.READ)).status_code == 403
    assert client.get("/webhooks/secret").status_code == 401
