"""The outbox: news of a job for its receivers, written in the transaction that changes the job.

An event is one row with the job as it was, and each receiver gets a delivery.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import uuid
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.jobs import Subscriber
from service.store.records import job_of, storable
from service.store.tables import JOBS, WEBHOOK_DELIVERIES, WEBHOOK_EVENTS, WEBHOOKS
from service.webhooks import MAX_WAITING, PROGRESS_S, DeliveryState, EventType, snapshot_of

_TABLE = WEBHOOK_DELIVERIES.c
_EVENTS = WEBHOOK_EVENTS.c
_WAITING = DeliveryState.WAITING.value


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Receiver:
    """Where a message goes."""

    endpoint_id: str | None
    url: str
    base: str
    has_room: bool
    """Whether one more message may wait for it."""


def announce(connection: Connection, job: sa.Row[Any], event: EventType, now: dt.datetime) -> None:
    """Write an event of a job, which is changed already, and a delivery per receiver that wants it.

    If too many messages wait for a receiver, the end of a job has failed at once, and other news are left out.

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
    reports = sa.and_(_TABLE.job_id == job.job_id, _TABLE.event == EventType.PROGRESS.value)
    if event.is_end:
        drop(connection, reports, f"overtaken by {event}", now)
    receivers = [*_endpoints(connection, event), *_subscriber(connection, job, event)]
    if not receivers or (event is EventType.PROGRESS and not _is_progress_due(connection, job.job_id, now)):
        return
    changed = connection.execute(sa.select(JOBS).where(JOBS.c.job_id == job.job_id)).one()
    made = {"event_id": uuid.uuid4().hex, "job_id": job.job_id, "owner": job.owner, "event": event.value}
    connection.execute(sa.insert(WEBHOOK_EVENTS).values(**made, at=now, snapshot=snapshot_of(job_of(changed))))
    if event is EventType.PROGRESS:
        reported = _report_in_place(connection, reports, made["event_id"], now)
        receivers = [one for one in receivers if (one.endpoint_id, one.url) not in reported]
    receivers = [one for one in receivers if one.has_room or event.is_end]
    if not receivers:
        return
    refused = {
        "state": DeliveryState.FAILED.value,
        "reason": f"more than {MAX_WAITING} messages wait for this receiver: replay it when they are sent",
        "due_at": None,
        "finished_at": now,
    }
    rows = [
        {
            **made,
            "delivery_id": uuid.uuid4().hex,
            "endpoint_id": one.endpoint_id,
            "url": one.url,
            "base": one.base,
            "attempts": 0,
            "created_at": now,
            "tried_since": now,
            **({"state": _WAITING, "reason": None, "due_at": now, "finished_at": None} if one.has_room else refused),
        }
        for one in receivers
    ]
    connection.execute(sa.insert(WEBHOOK_DELIVERIES), rows)


def _report_in_place(
    connection: Connection, reports: sa.ColumnElement[bool], event_id: str, now: dt.datetime
) -> set[tuple[str | None, str]]:
    """Give reports that were never tried the new event, drop the other ones; the endpoints and URLs of the former."""
    columns = (_TABLE.delivery_id, _TABLE.endpoint_id, _TABLE.url)
    untried = connection.execute(_free(sa.and_(reports, _TABLE.attempts == 0)).with_only_columns(*columns)).all()
    ids = [row.delivery_id for row in untried]
    drop(connection, sa.and_(reports, _TABLE.delivery_id.not_in(ids)), f"overtaken by {EventType.PROGRESS}", now)
    values = {"event_id": event_id, "created_at": now}
    connection.execute(sa.update(WEBHOOK_DELIVERIES).where(_TABLE.delivery_id.in_(ids)).values(**values))
    return {(row.endpoint_id, row.url) for row in untried}


def drop(connection: Connection, chosen: sa.ColumnElement[bool], reason: str, now: dt.datetime) -> None:
    """Drop the deliveries that still wait; one that is being sent now is dropped if that attempt fails.

    Rows that another transaction holds are passed over: a change of a job never waits for a webhook. Such a row is
    looked at again when it is settled or claimed.
    """
    values = {"state": DeliveryState.DROPPED.value, "reason": storable(reason), "due_at": None, "finished_at": now}
    connection.execute(sa.update(WEBHOOK_DELIVERIES).where(_TABLE.delivery_id.in_(_free(chosen))).values(**values))


def _free(chosen: sa.ColumnElement[bool]) -> sa.Select[tuple[str]]:
    """Those of the chosen deliveries that wait and that no other transaction holds, locked."""
    return sa.select(_TABLE.delivery_id).where(chosen, _TABLE.state == _WAITING).with_for_update(skip_locked=True)


def _endpoints(connection: Connection, event: EventType) -> list[_Receiver]:
    """The endpoints that want an event."""
    wants = [row for row in connection.execute(sa.select(WEBHOOKS).where(WEBHOOKS.c.is_enabled)) if event in row.events]
    if not wants:
        return []
    waiting = sa.select(_TABLE.endpoint_id, sa.func.count()).where(
        _TABLE.state == _WAITING, _TABLE.endpoint_id.is_not(None)
    )
    counts = {row[0]: row[1] for row in connection.execute(waiting.group_by(_TABLE.endpoint_id))}
    return [
        _Receiver(
            endpoint_id=row.endpoint_id,
            url=row.url,
            base=row.base,
            has_room=counts.get(row.endpoint_id, 0) < MAX_WAITING,
        )
        for row in wants
    ]


def _subscriber(connection: Connection, job: sa.Row[Any], event: EventType) -> list[_Receiver]:
    """The subscriber's URI for an event, unless its receiver has answered that it wants nothing more."""
    given = job.request.get("subscriber")
    subscriber = Subscriber(**given) if given else Subscriber()
    url = uri_for(subscriber, event)
    if url is None:
        return []
    own = _TABLE.endpoint_id.is_(None)
    ended = sa.select(_TABLE.delivery_id).where(
        own, _TABLE.job_id == job.job_id, _TABLE.url == url, _TABLE.state == DeliveryState.GONE.value
    )
    if connection.execute(ended.limit(1)).first() is not None:
        return []
    same = _TABLE.owner.is_not_distinct_from(job.owner)
    waiting = sa.select(_TABLE.delivery_id).where(own, same, _TABLE.state == _WAITING)
    has_room = connection.execute(waiting.offset(MAX_WAITING - 1).limit(1)).first() is None
    return [_Receiver(endpoint_id=None, url=url, base=subscriber.base, has_room=has_room)]


def uri_for(subscriber: Subscriber, event: EventType) -> str | None:
    """The URI that gets an event, if there is one. That a job waits is known to its client.

    >>> uri_for(Subscriber(failed_uri="https://example.org/f"), EventType.DISMISSED)
    'https://example.org/f'
    """
    return None if event.uri_field is None else getattr(subscriber, event.uri_field)


def _is_progress_due(connection: Connection, job_id: str, now: dt.datetime) -> bool:
    """Whether the last report of a job's progress is old enough."""
    last = sa.select(sa.func.max(_EVENTS.at)).where(_EVENTS.job_id == job_id, _EVENTS.event == EventType.PROGRESS.value)
    at: dt.datetime | None = connection.execute(last).scalar_one()
    return at is None or at <= now - dt.timedelta(seconds=PROGRESS_S)
