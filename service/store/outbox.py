"""The outbox: news of a job for its receivers, written in the transaction that changes the job.

An event is one row, and each receiver gets a delivery. An endpoint for which too many deliveries wait gets this one
later (`backlog`), so an event costs little however many endpoints do not keep up.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import uuid
from collections.abc import Mapping, Sequence
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.jobs import Subscriber
from service.store.records import job_of, storable
from service.store.tables import JOBS, WEBHOOK_DELIVERIES, WEBHOOK_EVENTS, WEBHOOKS
from service.webhooks import MAX_SUBSCRIBED, PROGRESS_S, ROOM, DeliveryState, EventType, snapshot_of

_TABLE = WEBHOOK_DELIVERIES.c
_EVENTS = WEBHOOK_EVENTS.c
_PROGRESS = EventType.PROGRESS.value
_WAITING = DeliveryState.WAITING.value


@dataclasses.dataclass(frozen=True, kw_only=True)
class Receiver:
    """Where a message goes."""

    endpoint_id: str | None
    url: str
    base: str
    has_room: bool = True
    """Whether a delivery may wait for it now; otherwise its event waits."""

    @property
    def key(self) -> tuple[str | None, str]:
        """What makes two receivers of one job the same."""
        return (None, self.url) if self.endpoint_id is None else (self.endpoint_id, "")


def announce(connection: Connection, job: sa.Row[Any], event: EventType, now: dt.datetime) -> None:
    """Write an event of a job, which is changed already, and a delivery per receiver that wants it and has room.

    Parameters
    ----------
    connection : Connection
        Holds the job's row.
    job : Row
        The job, before or after the change.
    event : EventType
        What happened.
    now : datetime
        The present.
    """
    reports = sa.and_(_TABLE.job_id == job.job_id, _TABLE.event == _PROGRESS)
    if event.is_end:
        drop(connection, reports, f"overtaken by {event}", now)
    receivers = [*_endpoints(connection, event), *_subscriber(connection, job, event)]
    if not receivers or (event is EventType.PROGRESS and not _is_progress_due(connection, job.job_id, now)):
        return
    changed = connection.execute(sa.select(JOBS).where(JOBS.c.job_id == job.job_id)).one()
    made = {
        "event_id": uuid.uuid4().hex,
        "job_id": job.job_id,
        "owner": job.owner,
        "event": event.value,
        "at": now,
        "snapshot": snapshot_of(job_of(changed)),
    }
    connection.execute(sa.insert(WEBHOOK_EVENTS).values(**made))
    if event is EventType.PROGRESS:
        replaced = _replace_progress(connection, reports, made["event_id"], receivers, now)
        receivers = [one for one in receivers if one.key not in replaced]
    add(connection, [(made, one) for one in receivers if one.has_room], now)
    if event is EventType.PROGRESS:
        # one that finds no room is not needed: a later one follows, or the end
        return
    full = [one for one in receivers if not one.has_room]
    _let_wait(connection, [one.endpoint_id for one in full if one.endpoint_id is not None])
    if event.is_end:
        reason = f"more than {MAX_SUBSCRIBED} messages to subscribers of this key wait: replay it when they are sent"
        add(connection, [(made, one) for one in full if one.endpoint_id is None], now, refused=reason)


def add(
    connection: Connection,
    news: Sequence[tuple[sa.RowMapping | Mapping[str, Any], Receiver]],
    now: dt.datetime,
    *,
    refused: str | None = None,
) -> None:
    """Write a delivery per event and receiver; with a reason they have failed already."""
    if not news:
        return
    state: dict[str, Any] = {"state": _WAITING, "due_at": now}
    if refused is not None:
        state = {"state": DeliveryState.FAILED.value, "reason": storable(refused), "finished_at": now}
    rows = [
        {
            "delivery_id": uuid.uuid4().hex,
            "endpoint_id": one.endpoint_id,
            "job_id": event["job_id"],
            "owner": event["owner"],
            "url": one.url,
            "base": one.base,
            "event": event["event"],
            "event_id": event["event_id"],
            # JSON's null: the event has it
            "snapshot": None,
            "attempts": 0,
            "created_at": event["at"],
            "tried_since": now,
            **state,
        }
        for event, one in news
    ]
    connection.execute(sa.insert(WEBHOOK_DELIVERIES), rows)


def drop(connection: Connection, chosen: sa.ColumnElement[bool], reason: str, now: dt.datetime) -> None:
    """Drop the deliveries that still wait; one that is being sent now is dropped if that attempt fails.

    Rows that another transaction holds are passed over: a change of a job never waits for a webhook. Such a row is
    looked at again when it is settled or claimed.
    """
    waiting = sa.select(_TABLE.delivery_id).where(chosen, _TABLE.state == DeliveryState.WAITING.value)
    free = waiting.with_for_update(skip_locked=True)
    values = {"state": DeliveryState.DROPPED.value, "reason": storable(reason), "due_at": None, "finished_at": now}
    connection.execute(sa.update(WEBHOOK_DELIVERIES).where(_TABLE.delivery_id.in_(free)).values(**values))


def _let_wait(connection: Connection, endpoint_ids: list[str]) -> None:
    """Note that events wait for room at endpoints.

    Rows that another transaction holds are passed over: a change of a job never waits for a webhook. Such an endpoint
    gets the event when its place in the events is moved.
    """
    if endpoint_ids:
        keeps_up = sa.and_(WEBHOOKS.c.endpoint_id.in_(endpoint_ids), WEBHOOKS.c.is_behind.is_(sa.false()))
        free = sa.select(WEBHOOKS.c.endpoint_id).where(keeps_up).with_for_update(skip_locked=True)
        connection.execute(sa.update(WEBHOOKS).where(WEBHOOKS.c.endpoint_id.in_(free)).values(is_behind=True))


def _replace_progress(
    connection: Connection,
    reports: sa.ColumnElement[bool],
    event_id: str,
    receivers: Sequence[Receiver],
    now: dt.datetime,
) -> set[tuple[str | None, str]]:
    """Let reports that wait and were never tried be about the new event; which receivers need none besides.

    Those that were tried once keep their content, so they are dropped.
    """
    wanted = {one.key for one in receivers}
    waiting = sa.select(_TABLE.delivery_id, _TABLE.endpoint_id, _TABLE.url, _TABLE.attempts).where(
        reports, _TABLE.state == _WAITING, _TABLE.lease_owner.is_(None)
    )
    replaced: dict[tuple[str | None, str], str] = {}
    old = []
    for row in connection.execute(waiting.with_for_update(skip_locked=True)):
        key = (None, row.url) if row.endpoint_id is None else (row.endpoint_id, "")
        if key in wanted and row.attempts == 0 and key not in replaced:
            replaced[key] = row.delivery_id
        elif key in wanted:
            old.append(row.delivery_id)
    if replaced:
        values = {"event_id": event_id, "created_at": now}
        chosen = _TABLE.delivery_id.in_(list(replaced.values()))
        connection.execute(sa.update(WEBHOOK_DELIVERIES).where(chosen).values(**values))
    leased = sa.and_(reports, _TABLE.lease_owner.is_not(None))
    drop(connection, sa.or_(_TABLE.delivery_id.in_(old), leased), f"overtaken by {EventType.PROGRESS}", now)
    return set(replaced)


def _endpoints(connection: Connection, event: EventType) -> list[Receiver]:
    """The endpoints that want an event."""
    columns = WEBHOOKS.c
    waiting = sa.select(_TABLE.endpoint_id, sa.func.count()).where(
        _TABLE.state == _WAITING, _TABLE.endpoint_id.is_not(None)
    )
    wants = [row for row in connection.execute(sa.select(WEBHOOKS).where(columns.is_enabled)) if event in row.events]
    if not wants:
        return []
    counts = {row[0]: row[1] for row in connection.execute(waiting.group_by(_TABLE.endpoint_id))}
    return [
        Receiver(
            endpoint_id=row.endpoint_id,
            url=row.url,
            base=row.base,
            has_room=row.paused_at is None and not row.is_behind and counts.get(row.endpoint_id, 0) < ROOM,
        )
        for row in wants
    ]


def _subscriber(connection: Connection, job: sa.Row[Any], event: EventType) -> list[Receiver]:
    """The subscriber's URI for an event, unless its receiver has answered that it wants nothing more."""
    given = job.request.get("subscriber")
    subscriber = Subscriber(**given) if given else Subscriber()
    url = uri_for(subscriber, event)
    if url is None:
        return []
    ended = sa.select(_TABLE.delivery_id).where(
        _TABLE.job_id == job.job_id,
        _TABLE.endpoint_id.is_(None),
        _TABLE.url == url,
        _TABLE.state == DeliveryState.GONE.value,
    )
    if connection.execute(ended.limit(1)).first() is not None:
        return []
    same = _TABLE.owner.is_(None) if job.owner is None else _TABLE.owner == job.owner
    waiting = sa.select(_TABLE.delivery_id).where(same, _TABLE.endpoint_id.is_(None), _TABLE.state == _WAITING)
    has_room = connection.execute(waiting.offset(MAX_SUBSCRIBED - 1).limit(1)).first() is None
    return [Receiver(endpoint_id=None, url=url, base=subscriber.base, has_room=has_room)]


def uri_for(subscriber: Subscriber, event: EventType) -> str | None:
    """The URI that gets an event, if there is one. That a job waits is known to its client.

    >>> uri_for(Subscriber(failed_uri="https://example.org/f"), EventType.DISMISSED)
    'https://example.org/f'
    """
    return None if event.uri_field is None else getattr(subscriber, event.uri_field)


def _is_progress_due(connection: Connection, job_id: str, now: dt.datetime) -> bool:
    """Whether the last report of a job's progress is old enough."""
    last = sa.select(sa.func.max(_EVENTS.at)).where(_EVENTS.job_id == job_id, _EVENTS.event == _PROGRESS)
    at: dt.datetime | None = connection.execute(last).scalar_one()
    return at is None or at <= now - dt.timedelta(seconds=PROGRESS_S)
