"""What the store does with webhooks on every database: the same tests for SQLite and PostgreSQL."""

import datetime as dt
import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import sqlalchemy as sa
from migrated import add_row, at_revision
from store_contract import DatabaseContract, claim, happened, running, submit, until

from service.errors import (
    LeaseLostError,
    NoSuchDeliveryError,
    NoSuchWebhookError,
    NotReplayableError,
    TooManyWebhooksError,
)
from service.jobs import Fault, Job, JobFailure, JobRequest, JobStatus, Subscriber
from service.receivers import Avoided, Receivers
from service.store import DeliveryFilter, JobStore
from service.store.tables import WEBHOOK_DELIVERIES, WEBHOOK_EVENTS, WEBHOOK_SECRETS, WEBHOOKS
from service.webhooks import PROGRESS_S, Delivery, DeliveryState, EventType, Parcel, Result, retry_policy, snapshot_of

URL = "https://hooks.example.org/a"
SUBSCRIBER = Subscriber(
    success_uri="https://a.example/s",
    in_progress_uri="https://a.example/p",
    failed_uri="https://a.example/f",
    base="http://h",
)
POLICY = retry_policy(1.0, 100.0)
TAKEN = Result(duration_ms=3, status=204, body="{}")
REFUSED = Result(duration_ms=3, status=500, error="the receiver answered 500", body="{}")


def log(store: JobStore, **criteria: Any) -> list[Delivery]:
    return store.webhooks.deliveries(DeliveryFilter(limit=1000, **criteria))


def events(store: JobStore, **criteria: Any) -> list[str]:
    """Types of the deliveries, the oldest first."""
    return [one.event.value for one in reversed(log(store, **criteria))]


def endpoint(store: JobStore, *wanted: EventType, url: str = URL) -> str:
    made, _ = store.webhooks.create(url, events=wanted or [*EventType], base="http://h")
    return made.endpoint_id


def claim_next(store: JobStore, driver: str = "d", *, lease_s: float = 60.0) -> Parcel | None:
    """The delivery that is due for the longest time; None if nothing is due."""
    found = store.webhooks.claim_some(driver, lambda line: line[:1], lease_s=lease_s)
    return found[0] if found else None


def settle(store: JobStore, parcel: Parcel, result: Result) -> DeliveryState | None:
    """Write how an attempt ended."""
    return store.webhooks.settle_all([(parcel, result)], POLICY)[0]


def take(store: JobStore, driver: str = "d", *, lease_s: float = 60.0) -> Parcel:
    parcel = claim_next(store, driver, lease_s=lease_s)
    assert parcel is not None
    return parcel


def send_all(store: JobStore, result: Result = TAKEN) -> list[Parcel]:
    """Settle all that is due in the same way."""
    sent = []
    while (parcel := claim_next(store)) is not None:
        settle(store, parcel, result)
        sent.append(parcel)
    return sent


def count(store: JobStore, table: sa.Table) -> int:
    with store._database.read() as connection:
        return connection.execute(sa.select(sa.func.count()).select_from(table)).scalar_one()


def dismissed(store: JobStore, number: int) -> list[str]:
    """Jobs that ended at once."""
    jobs = [submit(store).job_id for _ in range(number)]
    for job_id in jobs:
        store.dismiss(job_id)
    return jobs


def shift(store: JobStore, hours: float) -> None:
    """Let all deliveries and events be older."""
    times = ("created_at", "tried_since", "due_at", "finished_at", "lease_until", "at")
    with store._database.write() as connection:
        for table in (WEBHOOK_DELIVERIES, WEBHOOK_EVENTS):
            key = next(iter(table.primary_key))
            for row in connection.execute(sa.select(table)).mappings().all():
                past = {
                    name: row[name] - dt.timedelta(hours=hours) for name in times if row.get(name, None) is not None
                }
                connection.execute(sa.update(table).where(key == row[key.name]).values(**past))


class WebhookStoreContract(DatabaseContract):
    """What a store does with webhooks."""

    # --- what is written with a change of a job

    def test_each_change_of_status_is_written_for_the_endpoints_that_want_it(self, store: JobStore) -> None:
        every = endpoint(store)
        ends = endpoint(store, EventType.SUCCESSFUL, EventType.FAILED, EventType.DISMISSED)
        held = running(store)
        store.release(held, lost=True)
        store.succeed(claim(store), message="two buildings", summary={"digest": "d"})
        expected = ["job.accepted", "job.running", "job.accepted", "job.running", "job.successful"]
        assert events(store, endpoint_id=every) == expected
        assert events(store, endpoint_id=ends) == ["job.successful"]
        parcels = {one.delivery.delivery_id: one for one in send_all(store)}
        last = parcels[log(store, endpoint_id=ends)[0].delivery_id]
        assert (last.job.status, last.job.message, last.job.progress) == (JobStatus.SUCCESSFUL, "two buildings", 100)
        assert last.job.summary == {"digest": "d"}
        first = parcels[log(store, endpoint_id=every)[-1].delivery_id]
        # as it was then, whatever came later
        assert (first.job.status, first.job.finished_at) == (JobStatus.ACCEPTED, None)

    @pytest.mark.parametrize(
        ("end", "uri", "event"),
        [
            ("succeed", SUBSCRIBER.success_uri, "job.successful"),
            ("fail", SUBSCRIBER.failed_uri, "job.failed"),
            ("dismiss", SUBSCRIBER.failed_uri, "job.dismissed"),
        ],
    )
    def test_a_subscriber_gets_the_start_the_progress_and_the_end(
        self, store: JobStore, end: str, uri: str, event: str
    ) -> None:
        submit(store, owner="k", subscriber=SUBSCRIBER)
        held = claim(store)
        store.record(held, [happened("progress", stage="split", progress=40)])
        if end == "succeed":
            store.succeed(held, message="", summary={})
        elif end == "fail":
            store.fail(held, JobFailure(fault=Fault.INPUT, detail="no points"))
        else:
            store.dismissed(held)
        assert events(store, job_id=held.job_id) == ["job.running", "job.progress", event]
        assert [one.url for one in log(store)] == [uri, SUBSCRIBER.in_progress_uri, SUBSCRIBER.in_progress_uri]
        assert {(one.owner, one.endpoint_id) for one in log(store)} == {("k", None)}
        found = {one.delivery.event: one.job for one in send_all(store)}[EventType(event)]
        if end == "fail":
            assert found.failure == JobFailure(fault=Fault.INPUT, detail="no points")

    def test_without_receivers_nothing_is_written(self, store: JobStore) -> None:
        held = running(store)
        store.record(held, [happened("progress", stage="split", progress=40)])
        store.succeed(held, message="", summary={})
        assert log(store) == []

    def test_a_change_that_is_rolled_back_has_no_news(self, store: JobStore) -> None:
        endpoint(store)
        held = running(store)
        store.give_up("a", max_attempts=3)
        before = len(log(store))
        with pytest.raises(LeaseLostError):
            store.succeed(held, message="", summary={})
        assert len(log(store)) == before

    def test_progress_is_reported_at_most_once_in_a_while(self, store: JobStore) -> None:
        endpoint(store)
        submit(store, subscriber=SUBSCRIBER)
        held = claim(store)
        for percent in range(50):
            store.record(held, [happened("progress", stage="split", progress=percent)])
        first = {one.delivery_id for one in log(store) if one.event is EventType.PROGRESS}
        assert len(first) == 2
        shift(store, PROGRESS_S / 3600.0)
        for percent in range(50, 90):
            store.record(held, [happened("progress", stage="split", progress=percent)])
        reports = [one for one in log(store) if one.event is EventType.PROGRESS]
        # those that waited report the later progress, under the ids that clients know
        assert {one.delivery_id for one in reports} == first
        assert [one.state.value for one in reports] == ["waiting", "waiting"]
        assert {one.job.progress for one in send_all(store) if one.delivery.event is EventType.PROGRESS} == {50}

    def test_a_report_of_progress_that_was_tried_keeps_its_content_and_makes_room_for_the_next(
        self, store: JobStore
    ) -> None:
        endpoint(store, EventType.PROGRESS)
        held = running(store)
        store.record(held, [happened("progress", stage="split", progress=10)])
        send_all(store, REFUSED)
        shift(store, PROGRESS_S / 3600.0)
        store.record(held, [happened("progress", stage="split", progress=60)])
        assert [(one.state.value, one.attempts) for one in log(store)] == [("waiting", 0), ("dropped", 1)]
        assert log(store)[1].reason == "overtaken by job.progress"
        assert [one.job.progress for one in send_all(store)] == [60]

    def test_progress_that_was_not_sent_is_dropped_when_the_job_ends(self, store: JobStore) -> None:
        endpoint(store, EventType.PROGRESS, EventType.SUCCESSFUL)
        held = running(store)
        store.record(held, [happened("progress", stage="split", progress=10)])
        parcel = take(store)
        store.succeed(held, message="", summary={})
        settle(store, parcel, REFUSED)
        states = {one.event.value: (one.state.value, one.reason) for one in log(store)}
        assert states["job.progress"] == ("dropped", "overtaken by job.successful")
        assert states["job.successful"] == ("waiting", None)

    # --- sent

    def test_a_delivery_is_taken_once(self, store: JobStore) -> None:
        for number in range(20):
            endpoint(store, EventType.ACCEPTED, url=f"https://h{number}.example/")
        submit(store)
        gate = threading.Barrier(6)

        def work(name: str) -> list[str]:
            gate.wait()
            found = []
            while (parcel := claim_next(store, name)) is not None:
                found.append(parcel.delivery.delivery_id)
            return found

        with ThreadPoolExecutor(6) as crew:
            taken = [one for found in crew.map(work, "abcdef") for one in found]
        assert len(taken) == len(set(taken)) == 20

    def test_one_receiver_gets_one_message_at_a_time(self, store: JobStore) -> None:
        endpoint(store, EventType.ACCEPTED)
        endpoint(store, EventType.ACCEPTED, url="https://other.example/")
        submit(store)
        submit(store)
        first, second = take(store), take(store)
        assert {first.delivery.url, second.delivery.url} == {URL, "https://other.example/"}
        assert claim_next(store) is None
        settle(store, first, TAKEN)
        assert take(store).delivery.url == first.delivery.url

    def test_a_dead_drivers_delivery_is_sent_by_another(self, store: JobStore) -> None:
        endpoint(store, EventType.ACCEPTED)
        submit(store)
        lost = take(store, "first", lease_s=0.02)
        again = until(lambda: claim_next(store, "second"))
        assert again.delivery.delivery_id == lost.delivery.delivery_id
        assert settle(store, lost, TAKEN) is None
        settle(store, again, TAKEN)
        found = store.webhooks.delivery(again.delivery.delivery_id)
        assert [(one.driver, one.status, one.error) for one in found.log] == [
            ("first", None, "the driver ended during this attempt"),
            ("second", 204, None),
        ]

    def test_the_deliveries_of_a_driver_that_is_known_to_be_dead_are_due_at_once(self, store: JobStore) -> None:
        endpoint(store, EventType.ACCEPTED)
        submit(store)
        lost = take(store, "first", lease_s=3600.0)
        assert claim_next(store, "second") is None
        store.give_up("first", max_attempts=3)
        assert take(store, "second").delivery.delivery_id == lost.delivery.delivery_id

    def test_a_refused_message_is_tried_again_later_and_not_for_ever(self, store: JobStore) -> None:
        endpoint(store, EventType.ACCEPTED)
        submit(store)
        before = store.now()
        send_all(store, REFUSED)
        (waiting,) = log(store)
        assert (waiting.state, waiting.reason) == (DeliveryState.WAITING, "the receiver answered 500")
        assert waiting.due_at is not None
        assert 50.0 <= (waiting.due_at - before).total_seconds() <= 155.0
        # whatever chance adds to the pauses, the second attempt is in time and the third one is not
        for hours in (0.5, 0.6):
            shift(store, hours)
            send_all(store, REFUSED)
        (failed,) = log(store)
        assert (failed.state, failed.attempts) == (DeliveryState.FAILED, 3)
        assert failed.reason == "tried for 1 hours; the last time: the receiver answered 500"

    def test_the_receiver_may_ask_for_a_longer_pause(self, store: JobStore) -> None:
        endpoint(store, EventType.ACCEPTED)
        submit(store)
        busy = Result(duration_ms=1, status=503, error="the receiver answered 503", retry_after_s=1200.0, body="{}")
        now = store.now()
        send_all(store, busy)
        due_at = log(store)[0].due_at
        assert due_at is not None
        assert (due_at - now).total_seconds() >= 1200.0

    def test_gone_ends_the_deliveries_of_an_endpoint(self, store: JobStore) -> None:
        one = endpoint(store)
        running(store)
        parcel = take(store)
        gone = Result(duration_ms=1, status=410, error="the receiver answered 410", body="{}")
        settle(store, parcel, gone)
        assert [found.state.value for found in log(store)] == ["dropped", "gone"]
        found = store.webhooks.get(one)
        assert (found.is_enabled, found.disabled_reason) == (False, log(store)[0].reason)
        submit(store)
        assert len(log(store)) == 2
        # what happens while it is disabled is not sent; a replay enables it
        assert store.webhooks.replay_all(one).is_enabled
        submit(store)
        assert log(store)[0].state is DeliveryState.WAITING

    def test_gone_ends_the_deliveries_of_a_jobs_uri(self, store: JobStore) -> None:
        submit(store, subscriber=SUBSCRIBER)
        held = claim(store)
        gone = Result(duration_ms=1, status=410, error="the receiver answered 410", body="{}")
        send_all(store, gone)
        store.record(held, [happened("progress", stage="split", progress=10)])
        assert events(store) == ["job.running"]
        # the others still want news
        store.succeed(held, message="", summary={})
        assert events(store) == ["job.running", "job.successful"]

    def test_a_removed_endpoint_drops_what_waits_with_a_reason(self, store: JobStore) -> None:
        one = endpoint(store)
        submit(store)
        store.webhooks.remove(one)
        words = "the webhook was removed"
        assert [(found.state.value, found.reason) for found in log(store)] == [("dropped", words)]
        submit(store)
        assert len(log(store)) == 1
        with pytest.raises(NotReplayableError, match=words):
            store.webhooks.replay(log(store)[0].delivery_id)

    def test_a_row_that_was_written_while_its_endpoint_was_closed_is_not_sent(self, store: JobStore) -> None:
        one = endpoint(store, EventType.ACCEPTED)
        submit(store)
        with store._database.write() as connection:
            connection.execute(sa.delete(WEBHOOKS).where(WEBHOOKS.c.endpoint_id == one))
        assert claim_next(store) is None
        assert [(found.state.value, found.reason) for found in log(store)] == [("dropped", "the webhook was removed")]

    # --- secrets

    def test_each_key_has_a_secret_for_its_subscribers(self, store: JobStore) -> None:
        mine, yours = store.webhooks.own_secret("me"), store.webhooks.own_secret("you")
        assert mine != yours
        assert store.webhooks.own_secret("me") == mine
        submit(store, owner="me", subscriber=SUBSCRIBER)
        claim(store)
        assert take(store).secret == mine
        submit(store, owner="new", subscriber=SUBSCRIBER)
        claim(store)
        with store._database.write() as connection:
            connection.execute(sa.update(WEBHOOK_DELIVERIES).values(lease_owner=None, lease_until=None))
        parcels = [take(store)]
        settle(store, parcels[0], TAKEN)
        parcels.append(take(store))
        by_owner = {one.delivery.owner: one.secret for one in parcels}
        assert by_owner["new"] == store.webhooks.own_secret("new")
        new = store.webhooks.replace_own_secret("me")
        assert new != mine
        assert store.webhooks.own_secret("me") == new

    def test_many_may_ask_for_a_secret_that_is_not_there_yet(self, store: JobStore) -> None:
        with ThreadPoolExecutor(6) as crew:
            found = list(crew.map(lambda _: store.webhooks.own_secret(None), range(12)))
        assert len(set(found)) == 1
        with store._database.read() as connection:
            assert connection.execute(sa.select(sa.func.count()).select_from(WEBHOOK_SECRETS)).scalar_one() == 1

    # --- the log

    @pytest.mark.parametrize("result", [TAKEN, REFUSED])
    def test_a_delivery_can_be_replayed_with_the_same_id_and_body(self, store: JobStore, result: Result) -> None:
        endpoint(store, EventType.ACCEPTED)
        submit(store)
        first = take(store)
        with pytest.raises(NotReplayableError, match="is being sent"):
            store.webhooks.replay(first.delivery.delivery_id)
        settle(store, first, result)
        shift(store, 100.0)
        replayed = store.webhooks.replay(first.delivery.delivery_id)
        assert (replayed.state, replayed.body) == (DeliveryState.WAITING, "{}")
        again = take(store)
        assert again.delivery.delivery_id == first.delivery.delivery_id
        # its hours count from the replay
        assert settle(store, again, REFUSED) is DeliveryState.WAITING

    def test_an_owner_sees_the_deliveries_to_its_subscribers_and_an_admin_sees_all(self, store: JobStore) -> None:
        one = endpoint(store, EventType.RUNNING)
        for owner in ("me", "you"):
            submit(store, owner=owner, subscriber=SUBSCRIBER)
            claim(store)
        assert len(log(store)) == 4
        mine = log(store, owner="me")
        assert [(found.owner, found.endpoint_id) for found in mine] == [("me", None)]
        assert len(log(store, endpoint_id=one)) == 2
        assert store.webhooks.delivery(mine[0].delivery_id, owner="me").delivery_id == mine[0].delivery_id
        hidden = [found for found in log(store) if found not in mine]
        for found in hidden:
            for action in (store.webhooks.delivery, store.webhooks.replay):
                with pytest.raises(NoSuchDeliveryError):
                    action(found.delivery_id, owner="me")

    def test_the_log_is_filtered_and_has_pages(self, store: JobStore) -> None:
        endpoint(store, EventType.ACCEPTED)
        jobs = [submit(store) for _ in range(3)]
        settle(store, take(store), TAKEN)
        assert [one.job_id for one in log(store, job_id=jobs[1].job_id)] == [jobs[1].job_id]
        assert len(log(store, state=DeliveryState.WAITING)) == 2
        assert len(log(store, state=DeliveryState.DELIVERED)) == 1
        assert store.webhooks.counts()[DeliveryState.WAITING] == 2
        page = store.webhooks.deliveries(DeliveryFilter(limit=1, offset=1))
        assert page == log(store)[1:2]

    def test_old_finished_deliveries_are_removed_and_no_others(self, store: JobStore) -> None:
        endpoint(store, EventType.ACCEPTED)
        submit(store)
        submit(store)
        settle(store, take(store), TAKEN)
        shift(store, 48.0)
        assert store.webhooks.forget(3.0) == 0
        assert store.webhooks.forget(1.0) > 0
        assert [one.state for one in log(store)] == [DeliveryState.WAITING]

    def test_deliveries_outlive_their_job(self, store: JobStore) -> None:
        endpoint(store)
        job = submit(store)
        store.dismiss(job.job_id)
        store.remove(job.job_id)
        sent = send_all(store)
        assert [one.job.status for one in sent] == [JobStatus.ACCEPTED, JobStatus.DISMISSED]

    @pytest.mark.parametrize("wrong", ["f" * 32, "x", "", "'; --"])
    def test_what_does_not_exist_is_reported(self, store: JobStore, wrong: str) -> None:
        for action in (store.webhooks.get, store.webhooks.remove, store.webhooks.replay_all):
            with pytest.raises(NoSuchWebhookError):
                action(wrong)
        with pytest.raises(NoSuchDeliveryError):
            store.webhooks.delivery(wrong)

    # --- receivers that do not keep up

    def test_ends_beyond_what_may_wait_fail_and_are_sent_in_order_when_the_webhook_is_replayed(
        self, store: JobStore, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("service.store.outbox.MAX_WAITING", 4)
        one = endpoint(store, EventType.ACCEPTED, EventType.DISMISSED)
        jobs = dismissed(store, 6)
        assert events(store) == ["job.accepted"] * 4 + ["job.dismissed"] * 6
        failed = log(store, state=DeliveryState.FAILED)
        assert len(failed) == 6
        assert "more than 4 messages wait for this receiver: replay it" in str(failed[0].reason)
        for job_id in jobs:
            store.remove(job_id)
        store.webhooks.replay_all(one)
        sent = send_all(store)
        assert Counter(parcel.delivery.job_id for parcel in sent if parcel.delivery.event.is_end) == Counter(jobs)
        times = [parcel.delivery.created_at for parcel in sent]
        assert times == sorted(times)
        # and it goes on
        dismissed(store, 1)
        assert len(send_all(store)) == 2

    def test_a_replayed_webhook_sends_the_ends_that_failed_with_their_ids_and_no_other_news(
        self, store: JobStore
    ) -> None:
        one = endpoint(store, EventType.ACCEPTED, EventType.DISMISSED)
        jobs = dismissed(store, 3)
        final = Result(duration_ms=1, status=403, error="the receiver answered 403", is_final=True, body="{}")
        first = send_all(store, final)
        store.webhooks.replay_all(one)
        again = send_all(store)
        assert [parcel.delivery.job_id for parcel in again] == jobs
        ends = [parcel for parcel in first if parcel.delivery.event.is_end]
        assert [p.delivery.delivery_id for p in again] == [p.delivery.delivery_id for p in ends]

    def test_the_waiting_messages_of_a_keys_subscribers_are_bounded_and_ends_can_be_replayed(
        self, store: JobStore, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("service.store.outbox.MAX_WAITING", 4)
        held: list[Job] = []
        for _ in range(4):
            submit(store, owner="k", subscriber=SUBSCRIBER)
            held.append(claim(store))
        for job in held:
            store.succeed(job, message="", summary={})
        assert store.webhooks.counts()[DeliveryState.WAITING] == 4
        failed = log(store, state=DeliveryState.FAILED)
        assert {one.event.value for one in failed} == {"job.successful"}
        # other keys have room
        submit(store, owner="other", subscriber=SUBSCRIBER)
        claim(store)
        assert store.webhooks.counts()[DeliveryState.WAITING] == 5
        assert store.webhooks.replay(failed[0].delivery_id, owner="k").state is DeliveryState.WAITING

    def test_an_event_is_stored_once_for_all_endpoints(self, store: JobStore) -> None:
        for number in range(5):
            endpoint(store, EventType.DISMISSED, url=f"https://h{number}.example/")
        dismissed(store, 1)
        assert (len(log(store)), count(store, WEBHOOK_EVENTS)) == (5, 1)

    def test_the_log_has_at_most_so_many_entries_and_their_events_go_with_them(
        self, store: JobStore, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("service.store.webhook_store._AT_ONCE", 2)
        endpoint(store, EventType.DISMISSED)
        dismissed(store, 8)
        sent = [parcel.delivery.job_id for parcel in send_all(store)]
        shift(store, 1.0)
        store.webhooks.forget(30.0, most=5)
        assert [one.job_id for one in reversed(log(store))] == sent[2:]
        while store.webhooks.forget(30.0, most=5):
            continue
        assert [one.job_id for one in reversed(log(store))] == sent[3:]
        assert count(store, WEBHOOK_EVENTS) == 5

    def test_many_messages_to_one_receiver_leave_room_in_the_line_for_all_others(
        self, store: JobStore, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("service.store.delivery_line._LINE", 3)
        endpoint(store, EventType.DISMISSED, url="https://busy.example/")
        dismissed(store, 5)
        endpoint(store, EventType.DISMISSED, url="https://late.example/")
        dismissed(store, 1)
        lines: list[list[str]] = []
        store.webhooks.claim_some("d", lambda line: lines.append([due.receiver for due in line]) or [], lease_s=60.0)
        assert len(lines[0]) == len(set(lines[0])) == 2

    def test_a_key_makes_so_many_webhooks_and_not_more_also_at_once(self, store: JobStore) -> None:
        def make(number: int) -> bool:
            url = f"https://h{number}.example/"
            try:
                store.webhooks.create(url, events=[EventType.FAILED], base="http://h", owner="k", most=3)
            except TooManyWebhooksError as error:
                assert "there are 3 webhooks of this key, the limit is 3: remove one" in str(error)  # noqa: PT017
                return False
            return True

        with ThreadPoolExecutor(4) as crew:
            assert sum(crew.map(make, range(8))) == 3
        made, _ = store.webhooks.create("https://o.example/", events=[EventType.FAILED], base="http://h", owner="o")
        assert made.owner == "o"
        store.webhooks.remove(next(one.endpoint_id for one in store.webhooks.list() if one.owner == "k"))
        assert make(9)

    def test_slow_receivers_and_keys_with_their_share_are_passed_over(self, store: JobStore) -> None:
        for owner in ("a", "b"):
            for number in range(3):
                url = f"https://{owner}{number}.example/"
                store.webhooks.create(url, events=[EventType.ACCEPTED], base="http://h", owner=owner)
        submit(store)
        first = log(store)[0].endpoint_id
        assert first is not None
        owner = store.webhooks.get(first).owner
        avoided = Avoided(receivers=frozenset({first}), payers=frozenset({"b" if owner == "a" else "a"}))
        found = store.webhooks.claim_some("d", list, lease_s=60.0, avoided=avoided)
        assert (len(found), {parcel.payer for parcel in found}) == (2, {owner})
        assert first not in {parcel.receiver for parcel in found}
        everything = store.webhooks.claim_some("d", lambda line: Receivers(1.0).chosen(line, 0.0), lease_s=60.0)
        assert len(everything) == 4

    def test_failed_deliveries_have_a_bound_of_their_own(self, store: JobStore) -> None:
        submit(store, owner="k", subscriber=SUBSCRIBER)
        held = claim(store)
        final = Result(duration_ms=1, error="refused", is_final=True, body="{}")
        settle(store, take(store), final)
        store.record(held, [happened("progress", stage="split", progress=10)])
        store.succeed(held, message="", summary={})
        send_all(store)
        assert store.webhooks.forget(30.0, most=1) > 0
        assert Counter(one.state.value for one in log(store)) == {"failed": 1, "delivered": 1}

    def test_events_that_no_one_wants_are_not_stored(self, store: JobStore) -> None:
        endpoint(store, EventType.FAILED)
        dismissed(store, 2)
        assert count(store, WEBHOOK_EVENTS) == 0
        assert events(store) == []

    def test_a_delivery_that_was_refused_in_a_batch_is_tried_again(self, store: JobStore) -> None:
        for number in range(3):
            endpoint(store, EventType.ACCEPTED, url=f"https://h{number}.example/")
        submit(store)
        found = store.webhooks.claim_some("d", list, lease_s=60.0)
        results = [TAKEN, REFUSED, TAKEN]
        with store._database.write() as connection:
            lost = WEBHOOK_DELIVERIES.c.delivery_id == found[2].delivery.delivery_id
            connection.execute(sa.update(WEBHOOK_DELIVERIES).where(lost).values(lease_owner="other"))
        states = store.webhooks.settle_all(list(zip(found, results, strict=True)), POLICY)
        assert states == [DeliveryState.DELIVERED, DeliveryState.WAITING, None]
        logs = [store.webhooks.delivery(one.delivery.delivery_id).log[0] for one in found]
        assert [(one.status, one.error) for one in logs] == [(204, None), (500, REFUSED.error), (None, None)]

    def test_what_waited_for_room_before_the_upgrade_is_sent(self, url: str) -> None:
        """Revision 0011 had events without deliveries, replays that waited, and bodies that endpoints shared."""
        at, hook = dt.datetime(2026, 1, 1, tzinfo=dt.UTC), "e" * 32
        ended = Job(
            job_id="a" * 32,
            owner=None,
            request=JobRequest(tiles=()),
            status=JobStatus.DISMISSED,
            created_at=at,
            updated_at=at,
        )
        of_job = {"job_id": ended.job_id, "event": "job.dismissed"}
        snapshot = snapshot_of(ended)
        with JobStore(url) as store:
            with at_revision(store, "0011") as connection:
                known = {"created_at": at, "updated_at": at, "changed_at": at, "sent_until": at - dt.timedelta(hours=1)}
                known |= {"events": ["job.dismissed"], "is_enabled": True, "secret": "whsec_AAAA", "is_behind": True}
                add_row(connection, "webhooks", endpoint_id=hook, url=URL, base="http://h", **known)
                for number in range(3):
                    event = {"event_id": f"{number:032x}", "at": at, "snapshot": snapshot, **of_job}
                    add_row(connection, "webhook_events", base="http://h", body=f"{{{number}}}", **event)
                to = {"endpoint_id": hook, "url": URL, "base": "http://h", "created_at": at, "tried_since": at}
                to |= {"snapshot": None, "attempts": 1, "finished_at": at, **of_job}
                rows = [{"state": "delivered", "event_id": "0" * 32}]
                rows += [{"state": "failed", "event_id": f"{1:032x}", "replay_at": at}]
                # older than the table of events
                rows += [{"state": "delivered", "snapshot": snapshot, "body": "{}"}]
                for number, row in enumerate(rows):
                    add_row(connection, "webhook_deliveries", **to | {"delivery_id": f"d{number:031x}"} | row)
            store.migrate()
            assert [store.webhooks.delivery(f"d{number:031x}").body for number in (0, 2)] == ["{0}", "{}"]
            assert len(log(store)) == 4
            sent = send_all(store)
            assert {parcel.job.status for parcel in sent} == {JobStatus.DISMISSED}
            assert len(sent) == 2
            store.webhooks.replay(f"d{2:031x}")
            assert take(store).job.job_id == ended.job_id
