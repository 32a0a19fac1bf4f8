"""Deliveries: listed and replayed by clients; claimed, sent and settled by drivers. Within a transaction."""

from __future__ import annotations

import dataclasses
import datetime as dt
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.errors import LeaseLostError, NoSuchDeliveryError, NotReplayableError
from service.files import is_id
from service.store import webhook_endpoints as webhooks
from service.store.outbox import drop
from service.store.records import storable
from service.store.tables import WEBHOOK_ATTEMPTS, WEBHOOK_DELIVERIES, WEBHOOKS
from service.webhooks import (
    Attempt,
    Delivery,
    DeliveryState,
    EventType,
    Parcel,
    Result,
    RetryPolicy,
    job_of,
    verdict,
)

_TABLE = WEBHOOK_DELIVERIES.c
_LOG = WEBHOOK_ATTEMPTS.c
_FORGOTTEN_AT_ONCE = 1000
_WAITING = DeliveryState.WAITING.value


@dataclasses.dataclass(frozen=True, kw_only=True)
class DeliveryFilter:
    """Which deliveries to list."""

    owner: str | None = None
    """Only those to subscribers of this key's jobs; None for all."""
    job_id: str | None = None
    """Only news of this job."""
    endpoint_id: str | None = None
    """Only those to this endpoint."""
    state: DeliveryState | None = None
    """Only those in this state."""
    limit: int = 100
    """Maximum number of deliveries to list."""
    offset: int = 0
    """Number of deliveries to skip."""


# --- for clients


def get(connection: Connection, delivery_id: str, owner: str | None) -> Delivery:
    """One delivery with its attempts.

    Raises
    ------
    NoSuchDeliveryError
        It does not exist, or belongs to another key.
    """
    row = _row(connection, delivery_id, owner, locked=False)
    log = connection.execute(sa.select(WEBHOOK_ATTEMPTS).where(_LOG.delivery_id == delivery_id).order_by(_LOG.number))
    return _delivery(row, log=tuple(_attempt(one) for one in log))


def listed(connection: Connection, criteria: DeliveryFilter) -> list[Delivery]:
    """The deliveries that fit, newest first, without their attempts."""
    chosen = sa.select(WEBHOOK_DELIVERIES).order_by(_TABLE.created_at.desc(), _TABLE.delivery_id.desc())
    if criteria.owner is not None:
        chosen = chosen.where(_TABLE.owner == criteria.owner, _TABLE.endpoint_id.is_(None))
    if criteria.job_id is not None:
        chosen = chosen.where(_TABLE.job_id == storable(criteria.job_id))
    if criteria.endpoint_id is not None:
        chosen = chosen.where(_TABLE.endpoint_id == storable(criteria.endpoint_id))
    if criteria.state is not None:
        chosen = chosen.where(_TABLE.state == criteria.state.value)
    return [_delivery(row) for row in connection.execute(chosen.limit(criteria.limit).offset(criteria.offset))]


def replay(connection: Connection, delivery_id: str, owner: str | None, now: dt.datetime) -> None:
    """Let a delivery be sent again now, whatever became of it; its hours count anew.

    Raises
    ------
    NoSuchDeliveryError
        It does not exist, or belongs to another key.
    NotReplayableError
        It is being sent, or its endpoint is gone or disabled.
    """
    row = _row(connection, delivery_id, owner, locked=True)
    if row.state == _WAITING and row.lease_until is not None and row.lease_until > now:
        raise NotReplayableError(f"delivery {delivery_id} is being sent: look at its attempts in a moment")
    if row.endpoint_id is not None:
        reason = _closed(connection, row.endpoint_id)
        if reason is not None:
            raise NotReplayableError(f"delivery {delivery_id} cannot be sent: {reason}")
    values = {"state": _WAITING, "reason": "replayed", "due_at": now, "tried_since": now, "finished_at": None}
    connection.execute(
        sa.update(WEBHOOK_DELIVERIES)
        .where(_TABLE.delivery_id == delivery_id)
        .values(**values, lease_owner=None, lease_until=None)
    )


def counts(connection: Connection) -> dict[DeliveryState, int]:
    """Deliveries by state; every state is there."""
    grouped = sa.select(_TABLE.state, sa.func.count()).group_by(_TABLE.state)
    found: dict[Any, int] = {DeliveryState(state): count for state, count in connection.execute(grouped)}
    return {state: found.get(state, 0) for state in DeliveryState}


# --- for drivers


def something_is_due(connection: Connection, now: dt.datetime) -> bool:
    """Whether a claim may find something."""
    return connection.execute(sa.select(_TABLE.delivery_id).where(_is_due(now)).limit(1)).first() is not None


def take_first(connection: Connection, driver: str, *, now: dt.datetime, lease_s: float) -> Parcel | None:
    """Claim the delivery that is due for the longest time, of receivers to which nothing is being sent.

    A receiver that hangs therefore holds up one sender, not all.
    """
    other = WEBHOOK_DELIVERIES.alias()
    is_busy = sa.exists(sa.select(other.c.delivery_id).where(other.c.lease_until > now, other.c.url == _TABLE.url))
    line = sa.select(WEBHOOK_DELIVERIES).where(_is_due(now), ~is_busy).order_by(_TABLE.due_at, _TABLE.delivery_id)
    row = connection.execute(line.limit(1).with_for_update(skip_locked=True)).one_or_none()
    if row is None:
        return None
    one = _TABLE.delivery_id == row.delivery_id
    if row.endpoint_id is not None:
        reason = _closed(connection, row.endpoint_id)
        if reason is not None:
            drop(connection, one, reason, now)
            return None
    lost = sa.and_(_LOG.delivery_id == row.delivery_id, _LOG.duration_ms.is_(None), _LOG.error.is_(None))
    words = "the driver ended during this attempt"
    connection.execute(sa.update(WEBHOOK_ATTEMPTS).where(lost).values(error=words))
    number, name = row.attempts + 1, storable(driver, 255)
    connection.execute(
        sa.insert(WEBHOOK_ATTEMPTS).values(delivery_id=row.delivery_id, number=number, at=now, driver=name)
    )
    lease = {"lease_owner": name, "lease_until": now + dt.timedelta(seconds=lease_s)}
    connection.execute(sa.update(WEBHOOK_DELIVERIES).where(one).values(attempts=number, **lease))
    if row.endpoint_id is None:
        secret = webhooks.own_secret(connection, row.owner, now)
    else:
        secret = webhooks.endpoint_secret(connection, row.endpoint_id)
    return Parcel(
        delivery=dataclasses.replace(_delivery(row), attempts=number),
        driver=name,
        job=job_of(row.snapshot),
        base=row.base,
        secrets=secret.valid(now),
        sent_at=now,
    )


def settle(
    connection: Connection, parcel: Parcel, result: Result, *, now: dt.datetime, policy: RetryPolicy, chance: float
) -> DeliveryState:
    """Write how an attempt ended, and what becomes of the delivery.

    Raises
    ------
    LeaseLostError
        Another driver sends it by now, or it was removed.
    """
    delivery = parcel.delivery
    chosen = sa.select(WEBHOOK_DELIVERIES).where(_TABLE.delivery_id == delivery.delivery_id)
    row = connection.execute(chosen.with_for_update()).one_or_none()
    if row is None or row.lease_owner != parcel.driver or row.attempts != delivery.attempts:
        raise LeaseLostError(f"delivery {delivery.delivery_id}: attempt {delivery.attempts} is no longer held")
    error = None if result.error is None else storable(result.error)
    connection.execute(
        sa.update(WEBHOOK_ATTEMPTS)
        .where(_LOG.delivery_id == delivery.delivery_id, _LOG.number == delivery.attempts)
        .values(duration_ms=result.duration_ms, status=result.status, error=error)
    )
    found = verdict(delivery, result, now, policy, chance)
    values: dict[str, Any] = {"lease_owner": None, "lease_until": None, "body": result.body}
    was_dropped = row.state != _WAITING and found.state is not DeliveryState.DELIVERED
    if not was_dropped:
        ended = None if found.state is DeliveryState.WAITING else now
        reason = None if found.reason is None else storable(found.reason)
        values |= {"state": found.state.value, "due_at": found.due_at, "reason": reason, "finished_at": ended}
    connection.execute(sa.update(WEBHOOK_DELIVERIES).where(_TABLE.delivery_id == delivery.delivery_id).values(**values))
    if found.state is DeliveryState.GONE:
        _end(connection, delivery, found.reason or "", now)
    elif found.state is DeliveryState.WAITING and _is_overtaken(connection, delivery):
        drop(connection, _TABLE.delivery_id == delivery.delivery_id, "overtaken by a later report", now)
    return DeliveryState(row.state) if was_dropped else found.state


def give_up_all(connection: Connection, driver: str) -> None:
    """End the leases of a driver that is dead."""
    held = _TABLE.lease_owner == storable(driver, 255)
    connection.execute(sa.update(WEBHOOK_DELIVERIES).where(held).values(lease_owner=None, lease_until=None))


def forget(connection: Connection, before: dt.datetime) -> int:
    """Remove finished deliveries that ended before some time, a limited number at once; how many."""
    old = sa.select(_TABLE.delivery_id).where(_TABLE.finished_at < before).limit(_FORGOTTEN_AT_ONCE)
    found = list(connection.execute(old).scalars())
    if found:
        connection.execute(sa.delete(WEBHOOK_ATTEMPTS).where(_LOG.delivery_id.in_(found)))
        connection.execute(sa.delete(WEBHOOK_DELIVERIES).where(_TABLE.delivery_id.in_(found)))
    return len(found)


def _is_due(now: dt.datetime) -> sa.ColumnElement[bool]:
    is_free = sa.or_(_TABLE.lease_until.is_(None), _TABLE.lease_until <= now)
    return sa.and_(_TABLE.state == _WAITING, _TABLE.due_at <= now, is_free)


def _closed(connection: Connection, endpoint_id: str) -> str | None:
    """Why nothing may be sent to an endpoint; None if it is enabled."""
    chosen = sa.select(WEBHOOKS.c.is_enabled, WEBHOOKS.c.disabled_reason).where(WEBHOOKS.c.endpoint_id == endpoint_id)
    row = connection.execute(chosen).one_or_none()
    if row is None:
        return webhooks.REMOVED
    return None if row.is_enabled else str(row.disabled_reason)


def _end(connection: Connection, delivery: Delivery, reason: str, now: dt.datetime) -> None:
    """Send nothing more to a receiver that does not want it."""
    if delivery.endpoint_id is not None:
        webhooks.disable(connection, delivery.endpoint_id, reason, now)
    else:
        same = sa.and_(_TABLE.endpoint_id.is_(None), _TABLE.job_id == delivery.job_id, _TABLE.url == delivery.url)
        drop(connection, same, reason, now)


def _is_overtaken(connection: Connection, delivery: Delivery) -> bool:
    """Whether there is newer news than this report of progress."""
    if delivery.event is not EventType.PROGRESS:
        return False
    endpoint = _TABLE.endpoint_id
    same = endpoint.is_(None) if delivery.endpoint_id is None else endpoint == delivery.endpoint_id
    newer = sa.select(_TABLE.delivery_id).where(
        _TABLE.job_id == delivery.job_id, same, _TABLE.created_at > delivery.created_at
    )
    return connection.execute(newer.limit(1)).first() is not None


def _row(connection: Connection, delivery_id: str, owner: str | None, *, locked: bool) -> sa.Row[Any]:
    row = None
    if is_id(delivery_id):
        one = sa.select(WEBHOOK_DELIVERIES).where(_TABLE.delivery_id == delivery_id)
        row = connection.execute(one.with_for_update() if locked else one).one_or_none()
    if row is None or (owner is not None and (row.owner != owner or row.endpoint_id is not None)):
        raise NoSuchDeliveryError(f"there is no delivery {delivery_id[:64]!r} (any more)")
    return row


def _delivery(row: sa.Row[Any], log: tuple[Attempt, ...] = ()) -> Delivery:
    """A row of `webhook_deliveries`."""
    return Delivery(
        delivery_id=row.delivery_id,
        endpoint_id=row.endpoint_id,
        job_id=row.job_id,
        owner=row.owner,
        url=row.url,
        event=EventType(row.event),
        state=DeliveryState(row.state),
        reason=row.reason,
        attempts=row.attempts,
        created_at=row.created_at,
        tried_since=row.tried_since,
        due_at=row.due_at,
        finished_at=row.finished_at,
        body=row.body,
        log=log,
    )


def _attempt(row: sa.Row[Any]) -> Attempt:
    """A row of `webhook_attempts`."""
    return Attempt(**{name: value for name, value in row._asdict().items() if name != "delivery_id"})
