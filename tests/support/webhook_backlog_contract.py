"""Webhooks that do not keep up, on every database: what waits, what is paused, what is replayed, what is removed."""

import datetime as dt
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import pytest
import sqlalchemy as sa
from store_contract import DatabaseContract, claim, happened, submit
from webhook_store_contract import POLICY, REFUSED, SUBSCRIBER, TAKEN, endpoint, events, log, send_all, shift, take

from service.errors import NotReplayableError, TooManyWebhooksError
from service.jobs import Job
from service.receivers import Avoided, Receivers
from service.store import JobStore
from service.store.tables import WEBHOOK_DELIVERIES, WEBHOOK_EVENTS, WEBHOOKS
from service.webhooks import KEEPS_UP_S, ROOM, UNDER_WAY, DeliveryState, EventType, Parcel, Result

MANY = 3 * ROOM
LATE_H = (KEEPS_UP_S + 1.0) / 3600.0


def count(store: JobStore, table: sa.Table, *conditions: sa.ColumnElement[bool]) -> int:
    with store._database.read() as connection:
        return connection.execute(sa.select(sa.func.count()).select_from(table).where(*conditions)).scalar_one()


def waiting(store: JobStore) -> int:
    return store.webhooks.counts()[DeliveryState.WAITING]


def dismissed(store: JobStore, number: int) -> list[str]:
    """Jobs that ended at once."""
    jobs = [submit(store).job_id for _ in range(number)]
    for job_id in jobs:
        store.dismiss(job_id)
    return jobs


def send_and_refill(store: JobStore, result: Result = TAKEN) -> list[Parcel]:
    """Send all, and all that has room then."""
    sent: list[Parcel] = []
    while parcels := send_all(store, result):
        sent += parcels
        store.webhooks.refill(max_waiting=MANY)
    return sent


def in_order(sent: list[Parcel]) -> bool:
    """Whether messages were sent in the order of their events."""
    times = [parcel.delivery.created_at for parcel in sent]
    return times == sorted(times)


def age_places(store: JobStore) -> None:
    """Let the place of each endpoint in the events be old enough to be moved."""
    with store._database.write() as connection:
        for row in connection.execute(sa.select(WEBHOOKS)).all():
            place = {"sent_until": row.sent_until - 2 * UNDER_WAY}
            connection.execute(sa.update(WEBHOOKS).where(WEBHOOKS.c.endpoint_id == row.endpoint_id).values(**place))


def paused(store: JobStore, *wanted: EventType, most: int = ROOM) -> tuple[str, list[str]]:
    """An endpoint that did not keep up, and the jobs whose ends it did not get."""
    one = endpoint(store, *(wanted or (EventType.DISMISSED,)))
    jobs = dismissed(store, MANY)
    shift(store, LATE_H)
    assert store.webhooks.refill(max_waiting=most).paused == (one,)
    return one, jobs


class WebhookBacklogContract(DatabaseContract):
    """Bounds of what waits for webhooks."""

    def test_few_deliveries_wait_and_every_end_arrives_once_and_in_order(self, store: JobStore) -> None:
        endpoint(store, EventType.DISMISSED)
        jobs = dismissed(store, MANY)
        assert waiting(store) == ROOM
        sent = send_and_refill(store)
        assert in_order(sent)
        assert Counter(one.delivery.job_id for one in sent) == Counter(jobs)
        assert store.webhooks.refill(max_waiting=MANY).added == 0

    def test_an_event_is_stored_once_for_all_endpoints_and_so_is_its_body(self, store: JobStore) -> None:
        for number in range(5):
            endpoint(store, EventType.DISMISSED, url=f"https://h{number}.example/")
        store.webhooks.create("https://other.example/", events=[EventType.DISMISSED], base="http://elsewhere")
        dismissed(store, 1)
        assert (waiting(store), count(store, WEBHOOK_EVENTS)) == (6, 1)
        bodies = {}
        while (parcel := store.webhooks.claim("d", lease_s=60.0)) is not None:
            body = f'{{"links": "{parcel.base}"}}'
            store.webhooks.settle(parcel, Result(duration_ms=1, status=204, body=body), POLICY)
            bodies[parcel.delivery.delivery_id] = body
        assert {one: store.webhooks.delivery(one).body for one in bodies} == bodies
        assert count(store, WEBHOOK_DELIVERIES, WEBHOOK_DELIVERIES.c.body.is_not(None)) in {1, 5}

    def test_a_quick_webhook_is_not_paused_by_a_burst(self, store: JobStore) -> None:
        one = endpoint(store, EventType.DISMISSED)
        dismissed(store, MANY)
        found = store.webhooks.refill(max_waiting=1)
        assert (found.paused, store.webhooks.get(one).paused_at) == ((), None)
        assert store.webhooks.get(one).not_sent == MANY - ROOM

    def test_a_webhook_that_does_not_keep_up_is_paused_and_nothing_is_sent_to_it(self, store: JobStore) -> None:
        one, _ = paused(store)
        found = store.webhooks.get(one)
        assert found.is_enabled
        assert found.paused_at is not None
        assert found.not_sent == MANY == store.webhooks.list()[0].not_sent
        assert store.webhooks.claim("d", lease_s=60.0) is None
        dismissed(store, 2)
        assert (waiting(store), store.webhooks.get(one).not_sent) == (ROOM, MANY + 2)
        assert store.webhooks.refill(max_waiting=ROOM).added == 0
        with pytest.raises(NotReplayableError, match="paused: replay the webhook"):
            store.webhooks.replay(log(store)[0].delivery_id)

    def test_a_paused_webhook_gets_all_ends_when_it_is_replayed(self, store: JobStore) -> None:
        one, jobs = paused(store)
        jobs += dismissed(store, 3)
        # jobs may be removed meanwhile, and old entries of the log, too
        for job_id in jobs:
            store.remove(job_id)
        store.webhooks.forget(1.0, most=1)
        assert store.webhooks.replay_all(one).paused_at is None
        sent = send_and_refill(store)
        assert Counter(parcel.delivery.job_id for parcel in sent) == Counter(jobs)
        found = store.webhooks.get(one)
        assert (found.not_sent, found.paused_at) == (0, None)
        # and it goes on
        assert [parcel.delivery.job_id for parcel in (dismissed(store, 1) and send_all(store))]

    def test_ends_that_failed_are_replayed_with_the_webhook_as_it_has_room(self, store: JobStore) -> None:
        one = endpoint(store, EventType.ACCEPTED, EventType.DISMISSED)
        jobs = dismissed(store, MANY)
        final = Result(duration_ms=1, status=403, error="the receiver answered 403", is_final=True, body="{}")
        first = send_and_refill(store, final)
        assert len(first) == 2 * MANY
        store.webhooks.replay_all(one)
        assert store.webhooks.get(one).not_sent == MANY
        store.webhooks.refill(max_waiting=MANY)
        assert 0 < waiting(store) <= ROOM
        again = send_and_refill(store)
        assert in_order(again)
        assert Counter(parcel.delivery.job_id for parcel in again) == Counter(jobs)
        # the same messages, not new ones
        assert {parcel.delivery.delivery_id for parcel in again} < {parcel.delivery.delivery_id for parcel in first}
        assert store.webhooks.get(one).not_sent == 0

    def test_a_single_replay_waits_for_room(self, store: JobStore) -> None:
        endpoint(store, EventType.DISMISSED)
        dismissed(store, 1)
        send_all(store)
        (done,) = log(store)
        dismissed(store, ROOM)
        replayed = store.webhooks.replay(done.delivery_id)
        assert (replayed.state, waiting(store)) == (DeliveryState.DELIVERED, ROOM)
        sent = send_and_refill(store)
        assert done.delivery_id in {parcel.delivery.delivery_id for parcel in sent}

    def test_a_webhook_whose_receiver_answered_410_is_enabled_by_a_replay(self, store: JobStore) -> None:
        one, jobs = paused(store)
        store.webhooks.replay_all(one)
        gone = Result(duration_ms=1, status=410, error="the receiver answered 410", body="{}")
        store.webhooks.settle(take(store), gone, POLICY)
        found = store.webhooks.get(one)
        assert (found.is_enabled, found.paused_at, found.not_sent, waiting(store)) == (False, None, 0, 0)
        # what happens meanwhile is not sent
        dismissed(store, 1)
        assert store.webhooks.replay_all(one).is_enabled
        store.webhooks.refill(max_waiting=MANY)
        sent = send_and_refill(store)
        assert {parcel.delivery.job_id for parcel in sent} <= set(jobs)
        assert len(sent) == ROOM

    def test_an_event_that_was_committed_late_arrives_still(self, store: JobStore) -> None:
        """Its endpoint had no room, and was noted as keeping up by another transaction at that moment."""
        one = endpoint(store, EventType.DISMISSED)
        jobs = dismissed(store, ROOM + 1)
        with store._database.write() as connection:
            connection.execute(sa.update(WEBHOOKS).values(is_behind=False))
        sent = send_and_refill(store)
        assert len(sent) == ROOM
        age_places(store)
        store.webhooks.refill(max_waiting=MANY)
        sent += send_all(store)
        assert Counter(parcel.delivery.job_id for parcel in sent) == Counter(jobs)
        # its place moves on, but not up to the present
        store.webhooks.refill(max_waiting=MANY)
        with store._database.read() as connection:
            place = connection.execute(sa.select(WEBHOOKS.c.sent_until)).scalar_one()
        assert store.now() - 2 * UNDER_WAY < place < store.now() - UNDER_WAY + dt.timedelta(seconds=1)
        assert store.webhooks.get(one).not_sent == 0

    def test_many_drivers_put_an_event_in_line_once(self, store: JobStore) -> None:
        endpoint(store, EventType.DISMISSED)
        dismissed(store, MANY)
        send_all(store)
        with ThreadPoolExecutor(4) as crew:
            added = list(crew.map(lambda _: store.webhooks.refill(max_waiting=MANY).added, range(8)))
        assert sum(added) == ROOM == waiting(store)

    # --- subscribers

    def test_the_waiting_messages_of_a_keys_subscribers_are_bounded_and_ends_can_be_replayed(
        self, store: JobStore, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("service.store.outbox.MAX_SUBSCRIBED", 4)
        held: list[Job] = []
        for _ in range(4):
            submit(store, owner="k", subscriber=SUBSCRIBER)
            held.append(claim(store))
        for job in held:
            store.succeed(job, message="", summary={})
        assert waiting(store) == 4
        failed = log(store, state=DeliveryState.FAILED)
        assert {one.event.value for one in failed} == {"job.successful"}
        assert "more than 4 messages to subscribers of this key wait" in str(failed[0].reason)
        # other keys have room
        submit(store, owner="other", subscriber=SUBSCRIBER)
        claim(store)
        assert waiting(store) == 5
        assert store.webhooks.replay(failed[0].delivery_id, owner="k").state is DeliveryState.WAITING

    # --- limits and shares

    def test_many_messages_to_one_receiver_leave_room_in_the_line_for_all_others(
        self, store: JobStore, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("service.store.webhook_deliveries._LINE", 3)
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

    # --- what is removed

    def test_the_log_has_at_most_so_many_entries_and_nothing_is_sent_twice_for_it(self, store: JobStore) -> None:
        endpoint(store, EventType.DISMISSED)
        jobs = dismissed(store, ROOM)
        assert len(send_all(store)) == ROOM
        # as long as an event may be missing still, the log shows who has it
        assert store.webhooks.forget(30.0, most=5) == 0
        age_places(store)
        shift(store, 4 * UNDER_WAY.total_seconds() / 3600.0)
        store.webhooks.refill(max_waiting=MANY)
        while store.webhooks.forget(30.0, most=5):
            continue
        left = log(store)
        assert {one.job_id for one in left} <= set(jobs)
        assert len(left) == 5
        assert count(store, WEBHOOK_EVENTS) == 5
        age_places(store)
        store.webhooks.refill(max_waiting=MANY)
        assert waiting(store) == 0

    def test_failed_deliveries_have_a_bound_of_their_own(self, store: JobStore) -> None:
        submit(store, owner="k", subscriber=SUBSCRIBER)
        held = claim(store)
        final = Result(duration_ms=1, error="refused", is_final=True, body="{}")
        store.webhooks.settle(take(store), final, POLICY)
        store.record(held, [happened("progress", stage="split", progress=10)])
        store.succeed(held, message="", summary={})
        send_all(store)
        assert store.webhooks.forget(30.0, most=1) > 0
        assert Counter(one.state.value for one in log(store)) == {"failed": 1, "delivered": 1}

    def test_old_events_are_removed_unless_a_webhook_waits_for_the_end_of_a_job(self, store: JobStore) -> None:
        one, jobs = paused(store, EventType.ACCEPTED, EventType.DISMISSED)
        shift(store, 2.0)
        with store._database.write() as connection:
            place = {"sent_until": store.now() - dt.timedelta(hours=3)}
            connection.execute(sa.update(WEBHOOKS).values(**place))
        assert store.webhooks.forget(30.0) > 0
        left = count(store, WEBHOOK_EVENTS, WEBHOOK_EVENTS.c.event == EventType.DISMISSED.value)
        assert left == len(jobs)
        # news other than ends is old after an hour, unless it is in line already
        assert count(store, WEBHOOK_EVENTS) == left + ROOM
        assert store.webhooks.get(one).not_sent == left + ROOM
        shift(store, 24.0 * 31.0)
        while store.webhooks.forget(30.0):
            continue
        assert count(store, WEBHOOK_EVENTS) == ROOM

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
