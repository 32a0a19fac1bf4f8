"""A driver that sends: receivers that fail at random, signatures, bodies as the standards say."""

import json
import logging
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import finished_runs as runs
import pytest
from driver_bench import Bench
from processes import LONG_S, wait_for
from webhook_receiver import Received, Receiver, failing, receiving
from webhook_store_contract import claim_next

from service.driver.webhooks import body_of
from service.files import StateFolder
from service.jobs import Fault, Job, JobFailure, JobStatus, Subscriber
from service.settings import ServiceSettings
from service.store import DeliveryFilter, JobStore
from service.store.webhook_store import WebhookStore
from service.webhooks import DeliveryState, EventType
from service.wire.jobs import StatusInfo

BASE = "http://service.example"


@pytest.fixture
def receiver(bench: Bench) -> Iterator[Receiver]:
    """A receiver to which the bench's drivers may send."""
    with receiving() as found:
        values = {"webhook_hosts": (found.origin,), "webhook_pause_s": 1e-4}
        bench.settings = bench.settings.model_copy(update=values)
        yield found
        # nothing is sent to a receiver that is gone
        bench.script.go_on.set()
        bench.end()


def deliveries(store: JobStore, **criteria: Any) -> list[Any]:
    return store.webhooks.deliveries(DeliveryFilter(limit=10_000, **criteria))


def all_are(bench: Bench, *states: DeliveryState) -> list[Any]:
    """The deliveries, once all of them are in one of these states."""

    def found() -> list[Any] | None:
        listed = deliveries(bench.store)
        return listed if listed and {one.state for one in listed} <= set(states) else None

    return wait_for(found, f"deliveries that are {states}")


def subscriber(receiver: Receiver) -> Subscriber:
    return Subscriber(
        success_uri=f"{receiver.url}/success",
        in_progress_uri=f"{receiver.url}/progress",
        failed_uri=f"{receiver.url}/failed",
        base=BASE,
    )


def write_real_outputs(bench: Bench) -> None:
    """Let the runs of a bench have the outputs of a real one."""

    def write(run_dir: Path, out_dir: Path, wanted: Any, on_progress: Any) -> None:
        runs.write_run(run_dir.parent / "real")
        runs.write_outputs(run_dir.parent / "real", out_dir, wanted, on_progress)

    bench.script.write_outputs = write  # type: ignore[method-assign]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_receiver_that_fails_at_random_gets_every_message_signed(bench: Bench, receiver: Receiver, seed: int) -> None:
    receiver.answer = failing(seed)
    _, secret = bench.store.webhooks.create(f"{receiver.url}/all", events=[*EventType], base=BASE)
    own = bench.store.webhooks.own_secret(None)
    jobs = [bench.submit({"subscriber": subscriber(receiver)}) for _ in range(12)]
    for job in jobs[::3]:
        bench.store.dismiss(job.job_id)
    write_real_outputs(bench)
    bench.driver()
    for job in jobs:
        bench.over(job)
    sent = all_are(bench, DeliveryState.DELIVERED, DeliveryState.DROPPED)
    # reports of progress that were overtaken are not needed any longer; everything else has arrived
    assert {one.event for one in sent if one.state is DeliveryState.DROPPED} <= {EventType.PROGRESS}
    due = {one.delivery_id for one in sent if one.state is DeliveryState.DELIVERED}
    assert {message.id for message in receiver.accepted} == due
    for message in receiver.received:
        assert message.verify(secret if message.path == "/all" else own) is not None
    of_endpoint = Counter(one.event.value for one in sent if one.endpoint_id is not None)
    assert of_endpoint["job.accepted"] == 12
    assert (of_endpoint["job.successful"], of_endpoint["job.dismissed"]) == (8, 4)
    assert max(one.attempts for one in sent) > 1
    # all attempts at a message have the same bytes
    bodies = {(message.id, message.body) for message in receiver.received}
    assert len(bodies) == len({message.id for message in receiver.received})


def test_a_signature_by_another_secret_or_of_another_body_is_not_accepted(bench: Bench, receiver: Receiver) -> None:
    from standardwebhooks.webhooks import WebhookVerificationError

    _, secret = bench.store.webhooks.create(receiver.url, events=[EventType.ACCEPTED], base=BASE)
    bench.submit()
    bench.driver()
    wait_for(lambda: receiver.received, "a message")
    (message,) = receiver.received
    assert message.verify(secret) == message.document
    with pytest.raises(WebhookVerificationError):
        message.verify("whsec_" + "A" * 43 + "=")
    message.body += b" "
    with pytest.raises(WebhookVerificationError):
        message.verify(secret)


def test_bodies_are_those_of_the_standards(bench: Bench, receiver: Receiver) -> None:
    bench.store.webhooks.create(f"{receiver.url}/all", events=[EventType.SUCCESSFUL], base="http://other.example")
    write_real_outputs(bench)
    job = bench.submit({"subscriber": subscriber(receiver), "title": "a house"})
    bench.driver()
    bench.over(job)
    all_are(bench, DeliveryState.DELIVERED, DeliveryState.DROPPED)
    by_path = {message.path: message.document for message in receiver.accepted}
    results = by_path["/success"]
    assert results["buildings"]["href"] == f"{BASE}/jobs/{job.job_id}/results/buildings"
    assert set(results["report"]) == {"href", "rel", "type", "title", "bytes", "sha256"}
    started = StatusInfo.model_validate_json(json.dumps(by_path["/progress"]))
    assert (started.jobID, started.status, started.title) == (job.job_id, "running", "a house")
    event = by_path["/all"]
    assert set(event) == {"type", "timestamp", "data"}
    assert event["type"] == "job.successful"
    status = StatusInfo.model_validate_json(json.dumps(event["data"]))
    assert (status.status, status.progress, status.request) == ("successful", 100, None)
    assert event["timestamp"] == event["data"]["finished"]
    links = {link.rel.rpartition("/")[2]: link.href for link in status.links}
    assert links["results"] == f"http://other.example/jobs/{job.job_id}/results"


def test_a_failure_is_reported_with_its_reason(bench: Bench, receiver: Receiver) -> None:
    job = bench.submit({"subscriber": subscriber(receiver)})
    held = bench.store.claim("elsewhere", lease_s=60.0, max_attempts=3)
    assert held is not None
    bench.store.fail(held, JobFailure(fault=Fault.INPUT, detail="no points"))
    bench.driver()
    wait_for(lambda: [one for one in receiver.accepted if one.path == "/failed"], "the failure")
    (failed,) = (one.document for one in receiver.accepted if one.path == "/failed")
    assert (failed["jobID"], failed["status"], failed["exception"]["detail"]) == (job.job_id, "failed", "no points")


def test_the_public_url_of_the_settings_comes_before_that_of_the_request(
    bench: Bench, receiver: Receiver, tmp_path: Path
) -> None:
    bench.submit({"subscriber": subscriber(receiver)})
    bench.store.claim("elsewhere", lease_s=60.0, max_attempts=3)
    parcel = claim_next(bench.store)
    assert parcel is not None
    public = ServiceSettings(state=tmp_path, public_url="https://public.example/")
    body = json.loads(body_of(parcel, StateFolder(tmp_path), public))
    assert body["links"][0]["href"].startswith("https://public.example/jobs/")


def test_gone_ends_it_and_a_private_address_is_not_tried_again(bench: Bench, receiver: Receiver) -> None:
    receiver.answer = lambda _message: 410
    made, _ = bench.store.webhooks.create(receiver.url, events=[*EventType], base=BASE)
    inside, _ = bench.store.webhooks.create("https://127.0.0.1:1/", events=[EventType.ACCEPTED], base=BASE)
    job = bench.submit()
    bench.driver()
    bench.over(job)
    all_are(bench, DeliveryState.GONE, DeliveryState.DROPPED, DeliveryState.FAILED)
    assert len(receiver.received) == 1
    assert not bench.store.webhooks.get(made.endpoint_id).is_enabled
    (refused,) = deliveries(bench.store, endpoint_id=inside.endpoint_id)
    assert (refused.state, refused.attempts) == (DeliveryState.FAILED, 1)
    assert "127.0.0.1, which is not a public address" in refused.reason


def test_results_that_are_gone_are_reported_in_the_log(bench: Bench, receiver: Receiver) -> None:
    job = bench.submit({"subscriber": subscriber(receiver)})
    held = bench.store.claim("elsewhere", lease_s=60.0, max_attempts=3)
    assert held is not None
    bench.store.succeed(held, message="", summary={})
    bench.store.remove(job.job_id)
    bench.driver()
    failed = [one for one in all_are(bench, DeliveryState.DELIVERED, DeliveryState.FAILED) if one.reason]
    assert [(one.event.value, one.attempts) for one in failed] == [("job.successful", 1)]
    assert "no longer in the state folder" in failed[0].reason


def test_jobs_that_end_while_a_driver_drains_are_reported(bench: Bench, receiver: Receiver) -> None:
    bench.store.webhooks.create(receiver.url, events=[EventType.SUCCESSFUL], base=BASE)
    job, driver = bench.under_way()
    driver.stop()
    bench.script.go_on.set()
    bench.join()
    assert bench.store.get(job.job_id).status is JobStatus.SUCCESSFUL
    bench.driver()
    (sent,) = all_are(bench, DeliveryState.DELIVERED)
    assert sent.job_id == job.job_id


def test_a_sender_takes_the_next_message_as_soon_as_its_receiver_is_free(bench: Bench, receiver: Receiver) -> None:
    bench.store.webhooks.create(receiver.url, events=[EventType.ACCEPTED], base=BASE)
    # all are written before a driver looks for the first time; it would look again after an hour
    for _ in range(20):
        bench.submit()
    bench.driver(poll_s=3600.0)
    assert len(all_are(bench, DeliveryState.DELIVERED)) == 20


def test_a_fault_with_one_message_does_not_end_the_sender(
    bench: Bench, receiver: Receiver, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from service.driver import webhooks

    broken: list[str] = []

    def break_once(parcel: Any, *rest: Any) -> str:
        if not broken:
            broken.append(parcel.delivery.delivery_id)
            raise ZeroDivisionError
        return body_of(parcel, *rest)

    monkeypatch.setattr(webhooks, "body_of", break_once)
    bench.store.webhooks.create(receiver.url, events=[EventType.ACCEPTED], base=BASE)
    jobs: list[Job] = [bench.submit() for _ in range(3)]
    with caplog.at_level(logging.ERROR):
        bench.driver()
        sent = all_are(bench, DeliveryState.DELIVERED)
    assert len(sent) == len(jobs)
    (first,) = (one for one in sent if one.delivery_id == broken[0])
    assert bench.store.webhooks.delivery(first.delivery_id).log[0].error == (
        "an unexpected fault of the service; its log has it"
    )


def test_receivers_that_hang_hold_up_no_others(bench: Bench, receiver: Receiver) -> None:
    free = threading.Event()

    def answer(message: Received) -> int:
        if message.path.startswith("/slow"):
            free.wait(LONG_S)
        return 204

    receiver.answer = answer
    for number in range(40):
        kind = "slow" if number % 2 else "quick"
        bench.store.webhooks.create(f"{receiver.url}/{kind}/{number}", events=[EventType.ACCEPTED], base=BASE)
    try:
        bench.submit()
        bench.driver()
        wait_for(lambda: len(receiver.received) == 40, "a message to each of them")
        bench.submit()
        wait_for(lambda: len(receiver.accepted) == 40, "both messages to each that is quick")
        assert {message.path.split("/")[1] for message in receiver.accepted} == {"quick"}
        slow = [one for one in deliveries(bench.store) if "/slow/" in one.url]
        assert [one.state for one in slow] == [DeliveryState.WAITING] * 40
    finally:
        free.set()
    assert len(all_are(bench, DeliveryState.DELIVERED)) == 80


def test_an_end_that_cannot_be_written_holds_up_no_others(
    bench: Bench, receiver: Receiver, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    settle_all = WebhookStore.settle_all
    broken: list[str] = []

    def settle(self: WebhookStore, ended: Any, policy: Any) -> Any:
        ids = [parcel.delivery.delivery_id for parcel, _ in ended]
        if not broken:
            broken.append(ids[0])
        if broken[0] in ids:
            raise ZeroDivisionError
        return settle_all(self, ended, policy)

    monkeypatch.setattr(WebhookStore, "settle_all", settle)
    for number in range(5):
        bench.store.webhooks.create(f"{receiver.url}/{number}", events=[EventType.ACCEPTED], base=BASE)
    bench.submit()
    with caplog.at_level(logging.ERROR):
        bench.driver()

        def written() -> bool:
            return sum(one.state is DeliveryState.DELIVERED for one in deliveries(bench.store)) == 4

        wait_for(written, "the ends of the others")
    assert f"the end of delivery {broken[0]} cannot be written" in caplog.text
