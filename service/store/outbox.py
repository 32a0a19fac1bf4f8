"""The outbox: news of a job for its receivers, written in the transaction that changes the job."""

from __future__ import annotations

import dataclasses
import datetime as dt
import uuid
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.jobs import Subscriber
from service.store.records import job_of, storable
from service.store.tables import JOBS, WEBHOOK_DELIVERIES, WEBHOOKS
from service.webhooks import PROGRESS_S, DeliveryState, EventType, snapshot_of

_TABLE = WEBHOOK_DELIVERIES.c


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Receiver:
    """Where a message goes."""

    endpoint_id: str | None
    url: str
    base: str

    @property
    def rows(self) -> sa.ColumnElement[bool]:
        """Deliveries to it; of a subscriber those of one job must be chosen, too."""
        if self.endpoint_id is not None:
            return _TABLE.endpoint_id == self.endpoint_id
        return sa.and_(_TABLE.endpoint_id.is_(None), _TABLE.url == self.url)


def announce(connection: Connection, job: sa.Row[Any], event: EventType, now: dt.datetime) -> None:
    """Write a delivery per receiver that wants the event of a job, which is changed already.

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
    of_job = _TABLE.job_id == job.job_id
    receivers = [*_endpoints(connection, event), *_subscriber(connection, job, event)]
    if event is EventType.PROGRESS and receivers:
        receivers = [one for one in receivers if _may_hear_of_progress(connection, of_job, one, now)]
    if event.is_end or (event is EventType.PROGRESS and receivers):
        old = of_job if event.is_end else sa.and_(of_job, sa.or_(*(one.rows for one in receivers)))
        drop(connection, sa.and_(old, _TABLE.event == EventType.PROGRESS.value), f"overtaken by {event}", now)
    if not receivers:
        return
    changed = connection.execute(sa.select(JOBS).where(JOBS.c.job_id == job.job_id)).one()
    snapshot = snapshot_of(job_of(changed))
    rows = [
        {
            "delivery_id": uuid.uuid4().hex,
            "endpoint_id": one.endpoint_id,
            "job_id": job.job_id,
            "owner": job.owner,
            "url": one.url,
            "base": one.base,
            "event": event.value,
            "snapshot": snapshot,
            "state": DeliveryState.WAITING.value,
            "attempts": 0,
            "created_at": now,
            "tried_since": now,
            "due_at": now,
        }
        for one in receivers
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


def _endpoints(connection: Connection, event: EventType) -> list[_Receiver]:
    """The endpoints that want an event."""
    enabled = sa.select(WEBHOOKS.c.endpoint_id, WEBHOOKS.c.url, WEBHOOKS.c.base, WEBHOOKS.c.events)
    rows = connection.execute(enabled.where(WEBHOOKS.c.is_enabled))
    return [
        _Receiver(endpoint_id=row.endpoint_id, url=row.url, base=row.base) for row in rows if event.value in row.events
    ]


def _subscriber(connection: Connection, job: sa.Row[Any], event: EventType) -> list[_Receiver]:
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
    return [_Receiver(endpoint_id=None, url=url, base=subscriber.base)]


def uri_for(subscriber: Subscriber, event: EventType) -> str | None:
    """The URI that gets an event, if there is one. That a job waits is known to its client.

    >>> uri_for(Subscriber(failed_uri="https://example.org/f"), EventType.DISMISSED)
    'https://example.org/f'
    """
    return {
        EventType.RUNNING: subscriber.in_progress_uri,
        EventType.PROGRESS: subscriber.in_progress_uri,
        EventType.SUCCESSFUL: subscriber.success_uri,
        EventType.FAILED: subscriber.failed_uri,
        EventType.DISMISSED: subscriber.failed_uri,
    }.get(event)


def _may_hear_of_progress(
    connection: Connection, of_job: sa.ColumnElement[bool], one: _Receiver, now: dt.datetime
) -> bool:
    """Whether the last report of progress to a receiver is old enough."""
    last = sa.select(sa.func.max(_TABLE.created_at)).where(of_job, one.rows, _TABLE.event == EventType.PROGRESS.value)
    at: dt.datetime | None = connection.execute(last).scalar_one()
    return at is None or at <= now - dt.timedelta(seconds=PROGRESS_S)
