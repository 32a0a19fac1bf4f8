"""Deliveries for drivers: claimed when they are due, and settled once they were sent."""

from __future__ import annotations

import dataclasses
import datetime as dt
import random
from collections.abc import Callable, Collection, Sequence
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from pipeline.backoff import Backoff
from service.receivers import Avoided, Due
from service.store.database import LOCK_SECRETS, StorePart, lock
from service.store.outbox import drop
from service.store.records import from_row, storable
from service.store.tables import WEBHOOK_ATTEMPTS, WEBHOOK_DELIVERIES, WEBHOOK_EVENTS, WEBHOOKS
from service.store.webhook_secrets import own_secret
from service.webhooks import Delivery, DeliveryState, EventType, Parcel, Result, job_of, verdict

REMOVED = "the webhook was removed"
_TABLE = WEBHOOK_DELIVERIES.c
_LOG = WEBHOOK_ATTEMPTS.c
_RECEIVER = sa.func.coalesce(_TABLE.endpoint_id, _TABLE.url)
_PAYER = sa.func.coalesce(WEBHOOKS.c.owner, _TABLE.owner, "")
_LINE = 512
"""Most deliveries of a line: twice as many as one driver sends at once."""
_WAITING = DeliveryState.WAITING.value


class DeliveryLine(StorePart):
    """The deliveries that are due."""

    def claim_some(
        self,
        driver: str,
        choose: Callable[[Sequence[Due]], Sequence[Due]],
        *,
        lease_s: float,
        avoided: Avoided = Avoided(),  # noqa: B008 - it is frozen
    ) -> list[Parcel]:
        """Claim deliveries that are due; no other driver sends them until the lease ends.

        Parameters
        ----------
        driver : str
            Name of the driver, unique per process.
        choose : callable
            Picks from the line at most one delivery per receiver.
        lease_s : float
            Seconds for which they are held.
        avoided : Avoided
            What is not in the line.
        """
        # the long look takes no lock; what others claimed since then is left out
        with self._database.read() as connection:
            chosen = choose(_line(connection, avoided, self._database.now(connection)))
        if not chosen:
            return []
        with self._database.write() as connection:
            lock(connection, LOCK_SECRETS)
            return _take(connection, chosen, driver, now=self._database.now(connection), lease_s=lease_s)

    def settle_all(self, ended: Sequence[tuple[Parcel, Result]], policy: Backoff) -> list[DeliveryState | None]:
        """Write how attempts ended, in one transaction; the states of the deliveries.

        None if another driver sends a delivery by now, or it was removed.
        """
        with self._database.write() as connection:
            return _settle(connection, ended, self._database.now(connection), policy)


def _line(connection: Connection, avoided: Avoided, now: dt.datetime) -> list[Due]:
    """The deliveries that are due for the longest time, without those to receivers that get something already."""
    busy = avoided.receivers | _busy(connection, now)
    order = (_TABLE.due_at, _TABLE.created_at, _TABLE.delivery_id)
    due = (
        sa.select(
            _TABLE.delivery_id,
            _RECEIVER.label("receiver"),
            _PAYER.label("payer"),
            _TABLE.due_at,
            _TABLE.created_at,
            # a receiver gets one message at a time: its others must not fill the line
            sa.func.row_number().over(partition_by=_RECEIVER, order_by=order).label("place"),
        )
        .outerjoin(WEBHOOKS, WEBHOOKS.c.endpoint_id == _TABLE.endpoint_id)
        .where(_is_due(now), _RECEIVER.not_in(list(busy)), _PAYER.not_in(list(avoided.payers)))
        .subquery()
    )
    first = (
        sa.select(due.c.delivery_id, due.c.receiver, due.c.payer)
        .where(due.c.place == 1)
        .order_by(due.c.due_at, due.c.created_at, due.c.delivery_id)
        .limit(_LINE)
    )
    return [Due(*row) for row in connection.execute(first)]


def _busy(connection: Connection, now: dt.datetime) -> set[str]:
    """The receivers to which a driver sends something."""
    return set(connection.execute(sa.select(_RECEIVER).where(_TABLE.lease_until > now)).scalars())


def _is_due(now: dt.datetime) -> sa.ColumnElement[bool]:
    is_free = sa.or_(_TABLE.lease_until.is_(None), _TABLE.lease_until <= now)
    return sa.and_(_TABLE.state == _WAITING, _TABLE.due_at <= now, is_free)


def _take(
    connection: Connection, chosen: Sequence[Due], driver: str, *, now: dt.datetime, lease_s: float
) -> list[Parcel]:
    """Claim deliveries of a line, with all that sending them needs; those of closed endpoints are dropped."""
    busy = _busy(connection, now)
    payers = {due.delivery_id: due.payer for due in chosen if due.receiver not in busy}
    free = sa.and_(_TABLE.delivery_id.in_(list(payers)), _is_due(now))
    rows = connection.execute(sa.select(WEBHOOK_DELIVERIES).where(free).with_for_update(skip_locked=True)).all()
    endpoints = endpoints_of(connection, [row.endpoint_id for row in rows])
    for endpoint_id, endpoint in endpoints.items():
        if (reason := closed(endpoint)) is not None:
            drop(connection, sa.and_(free, _TABLE.endpoint_id == endpoint_id), reason, now)
    rows = [row for row in rows if row.endpoint_id is None or closed(endpoints[row.endpoint_id]) is None]
    if not rows:
        return []
    name, taken = storable(driver, 255), [row.delivery_id for row in rows]
    lost = sa.and_(_LOG.delivery_id.in_(taken), _LOG.duration_ms.is_(None), _LOG.error.is_(None))
    words = "the driver ended during this attempt"
    connection.execute(sa.update(WEBHOOK_ATTEMPTS).where(lost).values(error=words))
    log = [{"delivery_id": row.delivery_id, "number": row.attempts + 1, "at": now, "driver": name} for row in rows]
    connection.execute(sa.insert(WEBHOOK_ATTEMPTS), log)
    lease = {"lease_owner": name, "lease_until": now + dt.timedelta(seconds=lease_s)}
    held = sa.update(WEBHOOK_DELIVERIES).where(_TABLE.delivery_id.in_(taken))
    connection.execute(held.values(attempts=_TABLE.attempts + 1, **lease))
    own_secrets = {
        owner: own_secret(connection, owner, now)
        for owner in sorted({row.owner for row in rows if row.endpoint_id is None}, key=str)
    }
    happened = sa.select(WEBHOOK_EVENTS.c.event_id, WEBHOOK_EVENTS.c.snapshot).where(
        WEBHOOK_EVENTS.c.event_id.in_({row.event_id for row in rows})
    )
    jobs = {event_id: job_of(snapshot) for event_id, snapshot in connection.execute(happened)}
    parcels = []
    for row in rows:
        endpoint = endpoints.get(row.endpoint_id)
        parcels.append(
            Parcel(
                delivery=dataclasses.replace(from_row(Delivery, row), attempts=row.attempts + 1),
                driver=name,
                job=jobs[row.event_id],
                base=row.base,
                secret=own_secrets[row.owner] if endpoint is None else endpoint.secret,
                sent_at=now,
                payer=payers[row.delivery_id],
            )
        )
    return parcels


def _settle(
    connection: Connection, ended: Sequence[tuple[Parcel, Result]], now: dt.datetime, policy: Backoff
) -> list[DeliveryState | None]:
    by_id = {parcel.delivery.delivery_id: (parcel, result) for parcel, result in ended}
    chosen = sa.select(WEBHOOK_DELIVERIES).where(_TABLE.delivery_id.in_(list(by_id))).order_by(_TABLE.delivery_id)
    rows = [row for row in connection.execute(chosen.with_for_update()) if _is_held(row, by_id[row.delivery_id][0])]
    states: dict[str, DeliveryState] = {}
    attempts, changes, after = [], [], []
    for row in rows:
        parcel, result = by_id[row.delivery_id]
        error = None if result.error is None else storable(result.error)
        key = {"of": row.delivery_id, "attempt": row.attempts}
        attempts.append(key | {"duration_ms": result.duration_ms, "status": result.status, "error": error})
        # chance only spreads retries
        found = verdict(parcel.delivery, result, now, policy, random.random())  # noqa: S311 - no secret
        values: dict[str, Any] = {"state": found.state.value, "due_at": found.due_at}
        values |= {"reason": None if found.reason is None else storable(found.reason)}
        values |= {"finished_at": None if found.state is DeliveryState.WAITING else now}
        if row.state != _WAITING and found.state is not DeliveryState.DELIVERED:
            # it was dropped meanwhile
            values = {name: getattr(row, name) for name in values}
        states[row.delivery_id] = DeliveryState(values["state"])
        changes.append({"of": row.delivery_id, "body": result.body or row.body, **values})
        if found.state is not DeliveryState.DELIVERED:
            after.append((parcel.delivery, found))
    if rows:
        one = sa.and_(_LOG.delivery_id == sa.bindparam("of"), _LOG.number == sa.bindparam("attempt"))
        connection.execute(sa.update(WEBHOOK_ATTEMPTS).where(one), attempts)
        delivery = _TABLE.delivery_id == sa.bindparam("of")
        free = {"lease_owner": None, "lease_until": None}
        connection.execute(sa.update(WEBHOOK_DELIVERIES).where(delivery).values(**free), changes)
    for delivery_, found in after:
        if found.state is DeliveryState.GONE:
            _end(connection, delivery_, found.reason or "", now)
        elif found.state is DeliveryState.WAITING and _is_overtaken(connection, delivery_):
            drop(connection, _TABLE.delivery_id == delivery_.delivery_id, "overtaken by a later report", now)
    return [states.get(parcel.delivery.delivery_id) for parcel, _ in ended]


def _is_held(row: sa.Row[Any], parcel: Parcel) -> bool:
    """Whether a delivery is still held for the attempt of a parcel."""
    return bool(row.lease_owner == parcel.driver and row.attempts == parcel.delivery.attempts)


def give_up_all(connection: Connection, driver: str) -> None:
    """End the leases of a driver that is dead. Within a transaction."""
    held = _TABLE.lease_owner == storable(driver, 255)
    connection.execute(sa.update(WEBHOOK_DELIVERIES).where(held).values(lease_owner=None, lease_until=None))


def endpoints_of(connection: Connection, endpoint_ids: Collection[str | None]) -> dict[str, sa.Row[Any] | None]:
    """Rows of `webhooks` by id; None for one that was removed."""
    wanted = {endpoint_id for endpoint_id in endpoint_ids if endpoint_id is not None}
    rows = connection.execute(sa.select(WEBHOOKS).where(WEBHOOKS.c.endpoint_id.in_(wanted))) if wanted else ()
    found = {row.endpoint_id: row for row in rows}
    return {endpoint_id: found.get(endpoint_id) for endpoint_id in wanted}


def closed(endpoint: sa.Row[Any] | None) -> str | None:
    """Why nothing may be sent to an endpoint; None if it is enabled."""
    if endpoint is None:
        return REMOVED
    return None if endpoint.is_enabled else str(endpoint.disabled_reason)


def _end(connection: Connection, delivery: Delivery, reason: str, now: dt.datetime) -> None:
    """Send nothing more to a receiver that does not want it."""
    if delivery.endpoint_id is None:
        same = sa.and_(_TABLE.endpoint_id.is_(None), _TABLE.job_id == delivery.job_id, _TABLE.url == delivery.url)
    else:
        same = _TABLE.endpoint_id == delivery.endpoint_id
        one = WEBHOOKS.c.endpoint_id == delivery.endpoint_id
        values = {"is_enabled": False, "disabled_reason": storable(reason), "updated_at": now}
        connection.execute(sa.update(WEBHOOKS).where(one).values(**values))
    drop(connection, same, reason, now)


def _is_overtaken(connection: Connection, delivery: Delivery) -> bool:
    """Whether there is newer news than this report of progress."""
    if delivery.event is not EventType.PROGRESS:
        return False
    newer = sa.select(_TABLE.delivery_id).where(
        _TABLE.job_id == delivery.job_id,
        _TABLE.endpoint_id.is_not_distinct_from(delivery.endpoint_id),
        _TABLE.created_at > delivery.created_at,
    )
    return connection.execute(newer.limit(1)).first() is not None
