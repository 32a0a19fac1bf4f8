"""What the store does with webhooks on every database: the same tests for SQLite and PostgreSQL."""

import datetime as dt
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import sqlalchemy as sa
from store_contract import DatabaseContract, claim, happened, running, submit, until

from service.errors import LeaseLostError, NoSuchDeliveryError, NoSuchWebhookError, NotReplayableError
from service.jobs import Fault, Job, JobFailure, JobStatus, Subscriber
from service.store import DeliveryFilter, JobStore
from service.store.tables import WEBHOOK_DELIVERIES, WEBHOOK_EVENTS, WEBHOOK_SECRETS, WEBHOOKS
from service.webhooks import PROGRESS_S, ROOM, Delivery, DeliveryState, EventType, Parcel, Result, retry_policy

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


def take(store: JobStore, driver: str = "d", *, lease_s: float = 60.0) -> Parcel:
    parcel = store.webhooks.claim(driver, lease_s=lease_s)
    assert parcel is not None
    return parcel


def send_all(store: JobStore, result: Result = TAKEN) -> list[Parcel]:
    """Settle all that is due in the same way."""
    sent = []
    while (parcel := store.webhooks.claim("d", lease_s=60.0)) is not None:
        store.webhooks.settle(parcel, result, POLICY)
        sent.append(parcel)
    return sent


def shift(store: JobStore, hours: float) -> None:
    """Let all deliveries and events be older, and the places of the endpoints in the events."""
    times = ("created_at", "tried_since", "due_at", "finished_at", "lease_until", "at", "sent_until")
    with store._database.write() as connection:
        for table in (WEBHOOK_DELIVERIES, WEBHOOK_EVENTS, WEBHOOKS):
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
        assert events(store).count("job.progress") == 2
        shift(store, PROGRESS_S / 3600.0)
        for percent in range(50, 90):
            store.record(held, [happened("progress", stage="split", progress=percent)])
        reports = [one for one in log(store) if one.event is EventType.PROGRESS]
        # those that waited are about the later progress now
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
        store.webhooks.settle(parcel, REFUSED, POLICY)
        states = {one.event.value: (one.state.value, one.reason) for one in log(store)}
        assert states["job.progress"][0] == "dropped"
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
            while (parcel := store.webhooks.claim(name, lease_s=60.0)) is not None:
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
        assert store.webhooks.claim("d", lease_s=60.0) is None
        store.webhooks.settle(first, TAKEN, POLICY)
        assert take(store).delivery.url == first.delivery.url

    def test_a_dead_drivers_delivery_is_sent_by_another(self, store: JobStore) -> None:
        endpoint(store, EventType.ACCEPTED)
        submit(store)
        lost = take(store, "first", lease_s=0.02)
        again = until(lambda: store.webhooks.claim("second", lease_s=60.0))
        assert again.delivery.delivery_id == lost.delivery.delivery_id
        with pytest.raises(LeaseLostError):
            store.webhooks.settle(lost, TAKEN, POLICY)
        store.webhooks.settle(again, TAKEN, POLICY)
        found = store.webhooks.delivery(again.delivery.delivery_id)
        assert [(one.driver, one.status, one.error) for one in found.log] == [
            ("first", None, "the driver ended during this attempt"),
            ("second", 204, None),
        ]

    def test_the_deliveries_of_a_driver_that_is_known_to_be_dead_are_due_at_once(self, store: JobStore) -> None:
        endpoint(store, EventType.ACCEPTED)
        submit(store)
        lost = take(store, "first", lease_s=3600.0)
        assert store.webhooks.claim("second", lease_s=60.0) is None
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
        store.webhooks.settle(parcel, gone, POLICY)
        assert [found.state.value for found in log(store)] == ["dropped", "gone"]
        found = store.webhooks.get(one)
        assert (found.is_enabled, found.disabled_reason) == (False, log(store)[0].reason)
        submit(store)
        assert len(log(store)) == 2
        # what happens while it is disabled is not sent; a replay enables it
        assert store.webhooks.replay_all(one).is_enabled
        submit(store)
        store.webhooks.refill(max_waiting=ROOM)
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
        assert store.webhooks.claim("d", lease_s=60.0) is None
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
        store.webhooks.settle(parcels[0], TAKEN, POLICY)
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
        store.webhooks.settle(first, result, POLICY)
        shift(store, 100.0)
        replayed = store.webhooks.replay(first.delivery.delivery_id)
        assert (replayed.state, replayed.body) == (DeliveryState.WAITING, "{}")
        again = take(store)
        assert again.delivery.delivery_id == first.delivery.delivery_id
        # its hours count from the replay
        assert store.webhooks.settle(again, REFUSED, POLICY) is DeliveryState.WAITING

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
        store.webhooks.settle(take(store), TAKEN, POLICY)
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
        store.webhooks.settle(take(store), TAKEN, POLICY)
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

    def test_jobs_that_were_submitted_before_webhooks_go_on(self, store: JobStore) -> None:
        """The upgrade with a job in flight: its stored request has no subscriber."""
        held: Job = running(store)
        with store._database.write() as connection:
            row = connection.exec_driver_sql("SELECT request FROM jobs").scalar_one()
        assert "subscriber" in str(row)
        from alembic import command
        from schedule_store_contract import migrate

        from service.store.tables import JOBS

        old = {name: value for name, value in held.request.as_dict().items() if name != "subscriber"}
        with store._database.write() as connection:
            connection.execute(sa.update(JOBS).values(request=old))
            migrate(connection, command.downgrade, "0004")
        store.migrate()
        endpoint(store)
        store.succeed(held, message="done", summary={})
        assert events(store) == ["job.successful"]
        assert store.get(held.job_id).request == held.request
