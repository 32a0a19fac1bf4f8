"""Deliveries: listed and replayed by clients; claimed, sent and settled by drivers. Within a transaction."""

from __future__ import annotations

import dataclasses
import datetime as dt
from collections.abc import Callable, Collection, Sequence
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from pipeline.backoff import Backoff
from service.errors import NoSuchDeliveryError, NotReplayableError
from service.files import is_id
from service.jobs import Job
from service.receivers import Avoided, Due
from service.store import webhook_endpoints as webhooks
from service.store.outbox import drop
from service.store.records import storable
from service.store.tables import WEBHOOK_ATTEMPTS, WEBHOOK_DELIVERIES, WEBHOOK_EVENTS, WEBHOOKS
from service.webhooks import ROOM, Attempt, Delivery, DeliveryState, EventType, Parcel, Result, job_of, verdict

_TABLE = WEBHOOK_DELIVERIES.c
_LOG = WEBHOOK_ATTEMPTS.c
_RECEIVER = sa.func.coalesce(_TABLE.endpoint_id, _TABLE.url)
_PAYER = sa.func.coalesce(WEBHOOKS.c.owner, _TABLE.owner, "")
_LINE = 512
"""Most deliveries of a line: twice as many as one driver sends at once."""
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
    found = _delivery(row, log=tuple(_attempt(one) for one in log))
    return dataclasses.replace(found, body=_body(row, _events(connection, [row])[0]) if row.attempts else None)


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
        It is being sent, or its endpoint is gone, disabled or paused.
    """
    row = _row(connection, delivery_id, owner, locked=True)
    if row.state == _WAITING and row.lease_until is not None and row.lease_until > now:
        raise NotReplayableError(f"delivery {delivery_id} is being sent: look at its attempts in a moment")
    values: dict[str, Any] = {"state": _WAITING, "reason": "replayed", "due_at": now, "finished_at": None}
    # it may have waited for its replay already
    values["replay_at"] = None
    if row.endpoint_id is not None:
        endpoint = _endpoints(connection, [row.endpoint_id])[row.endpoint_id]
        reason = _closed(endpoint)
        if endpoint is not None and endpoint.paused_at is not None:
            reason = "its webhook is paused: replay the webhook, which sends all that it did not get"
        if reason is not None:
            raise NotReplayableError(f"delivery {delivery_id} cannot be sent: {reason}")
        assert endpoint is not None
        # the webhook may have moved since
        values["url"] = endpoint.url
        full = sa.select(_TABLE.delivery_id).where(_TABLE.state == _WAITING, _TABLE.endpoint_id == row.endpoint_id)
        if row.state != _WAITING and connection.execute(full.offset(ROOM - 1).limit(1)).first() is not None:
            values = {"reason": "is sent again when other messages to its webhook are sent", "replay_at": now}
    connection.execute(
        sa.update(WEBHOOK_DELIVERIES)
        .where(_TABLE.delivery_id == delivery_id)
        .values(**values, tried_since=now, lease_owner=None, lease_until=None)
    )


def counts(connection: Connection) -> dict[DeliveryState, int]:
    """Deliveries by state; every state is there."""
    grouped = sa.select(_TABLE.state, sa.func.count()).group_by(_TABLE.state)
    found: dict[Any, int] = {DeliveryState(state): count for state, count in connection.execute(grouped)}
    return {state: found.get(state, 0) for state in DeliveryState}


# --- for drivers


def line(connection: Connection, avoided: Avoided, now: dt.datetime) -> list[Due]:
    """The deliveries that are due for the longest time, without those to receivers that get something already."""
    is_busy = sa.select(_RECEIVER).where(_TABLE.lease_until > now)
    busy = avoided.receivers | set(connection.execute(is_busy).scalars())
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
        .where(
            _is_due(now),
            WEBHOOKS.c.paused_at.is_(None),
            _RECEIVER.not_in(list(busy)),
            _PAYER.not_in(list(avoided.payers)),
        )
        .subquery()
    )
    first = (
        sa.select(due.c.delivery_id, due.c.receiver, due.c.payer)
        .where(due.c.place == 1)
        .order_by(due.c.due_at, due.c.created_at, due.c.delivery_id)
        .limit(_LINE)
    )
    return [Due(*row) for row in connection.execute(first)]


def take(
    connection: Connection, chosen: Sequence[Due], driver: str, *, now: dt.datetime, lease_s: float
) -> list[Parcel]:
    """Claim deliveries of a line, with all that sending them needs; those of closed endpoints are dropped."""
    busy = set(connection.execute(sa.select(_RECEIVER).where(_TABLE.lease_until > now)).scalars())
    payers = {due.delivery_id: due.payer for due in chosen if due.receiver not in busy}
    free = sa.and_(_TABLE.delivery_id.in_(list(payers)), _is_due(now))
    rows = connection.execute(sa.select(WEBHOOK_DELIVERIES).where(free).with_for_update(skip_locked=True)).all()
    endpoints = _endpoints(connection, [row.endpoint_id for row in rows])
    for endpoint_id, endpoint in endpoints.items():
        reason = _closed(endpoint)
        if reason is not None:
            drop(connection, sa.and_(free, _TABLE.endpoint_id == endpoint_id), reason, now)
    rows = [row for row in rows if row.endpoint_id is None or _closed(endpoints[row.endpoint_id]) is None]
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
        owner: webhooks.own_secret(connection, owner, now)
        for owner in sorted({row.owner for row in rows if row.endpoint_id is None}, key=str)
    }
    jobs: dict[str, Job] = {}
    parcels = []
    for row, event in zip(rows, _events(connection, rows), strict=True):
        if event is not None and event.event_id not in jobs:
            jobs[event.event_id] = job_of(event.snapshot)
        endpoint = endpoints.get(row.endpoint_id)
        secret = own_secrets[row.owner] if endpoint is None else endpoint.secret
        parcels.append(
            Parcel(
                delivery=dataclasses.replace(_delivery(row), attempts=row.attempts + 1, body=_body(row, event)),
                driver=name,
                job=job_of(row.snapshot) if event is None else jobs[event.event_id],
                base=row.base,
                secret=secret,
                sent_at=now,
                event_id=row.event_id,
                payer=payers[row.delivery_id],
            )
        )
    return parcels


def settle(
    connection: Connection,
    ended: Sequence[tuple[Parcel, Result]],
    *,
    now: dt.datetime,
    policy: Backoff,
    chance: Callable[[], float],
) -> list[DeliveryState | None]:
    """Write how attempts ended, and what becomes of the deliveries: their states.

    None if another driver sends a delivery by now, or it was removed.
    """
    by_id = {parcel.delivery.delivery_id: (parcel, result) for parcel, result in ended}
    chosen = sa.select(WEBHOOK_DELIVERIES).where(_TABLE.delivery_id.in_(list(by_id))).order_by(_TABLE.delivery_id)
    rows = [row for row in connection.execute(chosen.with_for_update()) if _is_held(row, by_id[row.delivery_id][0])]
    bodies = _Bodies(connection, rows)
    states: dict[str, DeliveryState] = {}
    attempts, changes, after = [], [], []
    for row in rows:
        parcel, result = by_id[row.delivery_id]
        error = None if result.error is None else storable(result.error)
        key = {"of": row.delivery_id, "attempt": row.attempts}
        attempts.append(key | {"duration_ms": result.duration_ms, "status": result.status, "error": error})
        found = verdict(parcel.delivery, result, now, policy, chance())
        values: dict[str, Any] = {"state": found.state.value, "due_at": found.due_at}
        values |= {"reason": None if found.reason is None else storable(found.reason)}
        values |= {"finished_at": None if found.state is DeliveryState.WAITING else now}
        values |= {"replay_at": None if found.state is DeliveryState.DELIVERED else row.replay_at}
        if row.state != _WAITING and found.state is not DeliveryState.DELIVERED:
            # it was dropped meanwhile
            values = {name: getattr(row, name) for name in values}
        states[row.delivery_id] = DeliveryState(values["state"])
        changes.append({"of": row.delivery_id, "body": bodies.own(row, result.body), **values})
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


class _Bodies:
    """Where bodies are stored: one that all endpoints get is stored once, with its event."""

    def __init__(self, connection: Connection, rows: Sequence[sa.Row[Any]]) -> None:
        self._connection = connection
        found = _events(connection, [row for row in rows if row.endpoint_id is not None])
        self._stored = {event.event_id: (event.base, event.body) for event in found if event is not None}

    def own(self, row: sa.Row[Any], body: str | None) -> str | None:
        """The body that a delivery stores itself; None if its event has it."""
        if body is None or row.event_id not in self._stored:
            return body
        if self._stored[row.event_id][1] is None:
            values = {"base": row.base, "body": body}
            one = sa.and_(WEBHOOK_EVENTS.c.event_id == row.event_id, WEBHOOK_EVENTS.c.body.is_(None))
            if self._connection.execute(sa.update(WEBHOOK_EVENTS).where(one).values(**values)).rowcount:
                self._stored[row.event_id] = (row.base, body)
        return None if self._stored[row.event_id] == (row.base, body) else body


def _events(connection: Connection, rows: Sequence[sa.Row[Any]]) -> list[sa.Row[Any] | None]:
    """The event of each delivery; None for one of an earlier version."""
    wanted = {row.event_id for row in rows if row.event_id is not None}
    found: dict[str, sa.Row[Any]] = {}
    if wanted:
        chosen = sa.select(WEBHOOK_EVENTS).where(WEBHOOK_EVENTS.c.event_id.in_(wanted))
        found = {row.event_id: row for row in connection.execute(chosen)}
    return [found.get(row.event_id) for row in rows]


def _body(row: sa.Row[Any], event: sa.Row[Any] | None) -> str | None:
    """The body as it was sent, or as others with the same links got it; None if nothing was sent yet."""
    if row.body is not None or event is None or row.endpoint_id is None or event.base != row.base:
        own: str | None = row.body
        return own
    shared: str | None = event.body
    return shared


def give_up_all(connection: Connection, driver: str) -> None:
    """End the leases of a driver that is dead."""
    held = _TABLE.lease_owner == storable(driver, 255)
    connection.execute(sa.update(WEBHOOK_DELIVERIES).where(held).values(lease_owner=None, lease_until=None))


def _is_due(now: dt.datetime) -> sa.ColumnElement[bool]:
    is_free = sa.or_(_TABLE.lease_until.is_(None), _TABLE.lease_until <= now)
    return sa.and_(_TABLE.state == _WAITING, _TABLE.due_at <= now, is_free)


def _endpoints(connection: Connection, endpoint_ids: Collection[str | None]) -> dict[str, sa.Row[Any] | None]:
    """Rows of `webhooks` by id; None for one that was removed."""
    wanted = {endpoint_id for endpoint_id in endpoint_ids if endpoint_id is not None}
    rows = connection.execute(sa.select(WEBHOOKS).where(WEBHOOKS.c.endpoint_id.in_(wanted))) if wanted else ()
    found = {row.endpoint_id: row for row in rows}
    return {endpoint_id: found.get(endpoint_id) for endpoint_id in wanted}


def _closed(endpoint: sa.Row[Any] | None) -> str | None:
    """Why nothing may be sent to an endpoint; None if it is enabled."""
    if endpoint is None:
        return webhooks.REMOVED
    return None if endpoint.is_enabled else str(endpoint.disabled_reason)


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
