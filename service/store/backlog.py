"""Events that wait for room at an endpoint: put in line, counted, and removed when no one needs them. In a transaction.

All endpoints share the rows of the events. Each one has a place in them, `sent_until`: every event up to it has its
delivery. Of later events those without a delivery wait. An event may be committed a moment after a later one, so the
place stays behind the present for as long as a transaction may take.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
from collections.abc import Mapping
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.store.outbox import Receiver, add
from service.store.tables import WEBHOOK_ATTEMPTS, WEBHOOK_DELIVERIES, WEBHOOK_EVENTS, WEBHOOKS
from service.webhooks import KEEPS_UP_S, ROOM, UNDER_WAY, DeliveryState, EventType

_DELIVERIES = WEBHOOK_DELIVERIES.c
_EVENTS = WEBHOOK_EVENTS.c
_HOOKS = WEBHOOKS.c
_WAITING = DeliveryState.WAITING.value
_ENDS = [event.value for event in EventType if event.is_end]
_AT_ONCE = 500
"""Rows that one transaction removes."""
_ENDPOINTS_AT_ONCE = 32
"""Endpoints that one transaction puts events in line for."""
_TICK = dt.timedelta(milliseconds=1)
_MOVED_AFTER = 1.5 * UNDER_WAY
"""How far the place of an endpoint that keeps up may be behind, before it is moved."""
_PASSING = dt.timedelta(hours=1)
"""How long an event other than an end waits for an endpoint without room: news of an hour ago is not news."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Refilled:
    """What became of the endpoints that wait for room."""

    added: int = 0
    """Deliveries that are in line now."""
    paused: tuple[str, ...] = ()
    """Ids of endpoints that are paused from now on."""


def behind(connection: Connection, now: dt.datetime, *, with_late: bool) -> list[str]:
    """Ids of the endpoints that have room and events, or replays, that wait for it; or whose place is to be moved.

    Parameters
    ----------
    with_late : bool
        Add those without room whose deliveries are in line for too long: they may have to be paused.
    """
    replays = sa.select(_DELIVERIES.endpoint_id).where(_DELIVERIES.replay_at.is_not(None))
    lacks = sa.or_(_HOOKS.is_behind, _HOOKS.endpoint_id.in_(replays), _HOOKS.sent_until < now - _MOVED_AFTER)
    waiting = _waiting().subquery()
    ready = sa.func.coalesce(waiting.c.number, 0) <= ROOM // 2
    if with_late:
        ready = sa.or_(ready, waiting.c.since <= now - dt.timedelta(seconds=KEEPS_UP_S))
    found = (
        sa.select(_HOOKS.endpoint_id)
        .outerjoin(waiting, waiting.c.endpoint_id == _HOOKS.endpoint_id)
        .where(_HOOKS.is_enabled, _HOOKS.paused_at.is_(None), lacks, ready)
    )
    return list(
        connection.execute(
            found.order_by(_HOOKS.is_behind.desc(), _HOOKS.sent_until).limit(_ENDPOINTS_AT_ONCE)
        ).scalars()
    )


def refill(connection: Connection, endpoint_ids: list[str], now: dt.datetime, *, max_waiting: int) -> Refilled:
    """Put events in line for endpoints with room, in the order of the events; pause those that do not keep up.

    Parameters
    ----------
    endpoint_ids : list of str
        As `behind` returns them.
    max_waiting : int
        Most messages that may wait for an endpoint that does not keep up.
    """
    chosen = sa.select(WEBHOOKS).where(_HOOKS.endpoint_id.in_(endpoint_ids), _HOOKS.is_enabled)
    rows = connection.execute(chosen.where(_HOOKS.paused_at.is_(None)).with_for_update(skip_locked=True)).all()
    counts = {row.endpoint_id: row for row in connection.execute(_waiting())}
    news: list[tuple[sa.RowMapping | Mapping[str, Any], Receiver]] = []
    replays, paused = 0, []
    for row in rows:
        waiting = counts.get(row.endpoint_id)
        number = 0 if waiting is None else waiting.number
        room = max(0, min(ROOM, max_waiting) - number)
        replayed = _replay(connection, row.endpoint_id, room, now)
        found = connection.execute(_missing(row).limit(room - replayed + 1)).mappings().all()
        taken = found[: room - replayed]
        receiver = Receiver(endpoint_id=row.endpoint_id, url=row.url, base=row.base)
        news += [(event, receiver) for event in taken]
        replays += replayed
        is_full = len(found) > len(taken)
        # all events before the first one without a delivery have theirs
        settled = min(found[-1]["at"] - _TICK, now - UNDER_WAY) if is_full else now - UNDER_WAY
        has_more = is_full or (replayed > 0 and replayed == room)
        values: dict[str, Any] = {"is_behind": has_more, "sent_until": max(row.sent_until, settled)}
        is_late = waiting is not None and waiting.since <= now - dt.timedelta(seconds=KEEPS_UP_S)
        if is_late and is_full and _is_more(connection, row, max_waiting - number):
            values["paused_at"] = now
            paused.append(row.endpoint_id)
        connection.execute(sa.update(WEBHOOKS).where(_HOOKS.endpoint_id == row.endpoint_id).values(**values))
    add(connection, news, now)
    return Refilled(added=len(news) + replays, paused=tuple(paused))


def not_sent(connection: Connection, row: sa.Row[Any]) -> int:
    """Number of messages that wait for room at an endpoint or, if it is paused, for a replay."""
    if not row.is_enabled or not (row.is_behind or row.paused_at is not None):
        return 0
    events = connection.execute(sa.select(sa.func.count()).select_from(_missing(row).subquery())).scalar_one()
    own = _DELIVERIES.endpoint_id == row.endpoint_id
    wait: sa.ColumnElement[bool] = _DELIVERIES.replay_at.is_not(None)
    if row.paused_at is not None:
        wait = sa.or_(wait, _DELIVERIES.state == _WAITING)
    rows = sa.select(sa.func.count()).select_from(WEBHOOK_DELIVERIES).where(own, wait)
    return int(events) + int(connection.execute(rows).scalar_one())


def replay_all(connection: Connection, endpoint_id: str, now: dt.datetime) -> None:
    """Let all that was not sent to an endpoint be sent, as it has room; its pause is over, and its hours count anew.

    These are the events that wait, and the ends of jobs in its log that failed or were dropped.
    """
    own = _DELIVERIES.endpoint_id == endpoint_id
    waiting = sa.and_(own, _DELIVERIES.state == _WAITING, _DELIVERIES.lease_until.is_(None))
    connection.execute(sa.update(WEBHOOK_DELIVERIES).where(waiting).values(due_at=now, tried_since=now))
    # the next look at the events corrects it
    values = {"paused_at": None, "is_behind": True, "updated_at": now}
    connection.execute(sa.update(WEBHOOKS).where(_HOOKS.endpoint_id == endpoint_id).values(**values))
    lost = _DELIVERIES.state.in_([DeliveryState.FAILED.value, DeliveryState.GONE.value, DeliveryState.DROPPED.value])
    ends = sa.and_(own, lost, _DELIVERIES.event.in_(_ENDS))
    connection.execute(sa.update(WEBHOOK_DELIVERIES).where(ends).values(replay_at=now))


def forget_replays(connection: Connection, endpoint_id: str) -> None:
    """Leave out the replays that an endpoint still waits for."""
    waiting = sa.and_(_DELIVERIES.endpoint_id == endpoint_id, _DELIVERIES.replay_at.is_not(None))
    connection.execute(sa.update(WEBHOOK_DELIVERIES).where(waiting).values(replay_at=None))


def forget(connection: Connection, now: dt.datetime, days: float, most: int | None) -> int:
    """Remove old deliveries and events that no one needs, a limited number at once; how many.

    Parameters
    ----------
    days : float
        Days after which a finished delivery goes, and the end of a job that a paused endpoint did not get.
    most : int or None
        Most deliveries that arrived or were dropped, and most that failed; the oldest go first. None for any number.
    """
    before = now - dt.timedelta(days=days)
    old = sa.select(_DELIVERIES.delivery_id).where(_DELIVERIES.finished_at < before).limit(_AT_ONCE)
    found = list(connection.execute(old).scalars())
    if not found and most is not None:
        failed = _DELIVERIES.state == DeliveryState.FAILED.value
        for kind in (~failed, failed):
            found += _surplus(connection, kind, most)
    if found:
        connection.execute(sa.delete(WEBHOOK_ATTEMPTS).where(WEBHOOK_ATTEMPTS.c.delivery_id.in_(found)))
        connection.execute(sa.delete(WEBHOOK_DELIVERIES).where(_DELIVERIES.delivery_id.in_(found)))
    return len(found) + _forget_events(connection, now, before)


def _surplus(connection: Connection, kind: sa.ColumnElement[bool], most: int) -> list[str]:
    """The oldest finished deliveries beyond a number, without those that show that an endpoint has its event."""
    finished = sa.and_(_DELIVERIES.finished_at.is_not(None), kind)
    number = sa.select(sa.func.count()).select_from(WEBHOOK_DELIVERIES).where(finished)
    surplus = int(connection.execute(number).scalar_one()) - most
    if surplus <= 0:
        return []
    needed = sa.exists(
        sa.select(_HOOKS.endpoint_id).where(
            _HOOKS.endpoint_id == _DELIVERIES.endpoint_id, _HOOKS.sent_until < _DELIVERIES.created_at
        )
    )
    chosen = sa.select(_DELIVERIES.delivery_id).where(finished, ~needed, _DELIVERIES.replay_at.is_(None))
    return list(connection.execute(chosen.order_by(_DELIVERIES.finished_at).limit(min(surplus, _AT_ONCE))).scalars())


def _forget_events(connection: Connection, now: dt.datetime, before: dt.datetime) -> int:
    """Remove events without deliveries that no endpoint waits for."""
    places = sa.select(sa.func.min(_HOOKS.sent_until)).where(_HOOKS.is_enabled)
    place: dt.datetime | None = connection.execute(places).scalar_one()
    passed = now - UNDER_WAY if place is None else min(place, now - UNDER_WAY)
    is_old = sa.or_(
        _EVENTS.at < before,
        _EVENTS.at < passed,
        sa.and_(_EVENTS.at < now - _PASSING, _EVENTS.event.not_in(_ENDS)),
    )
    used = sa.exists(sa.select(_DELIVERIES.delivery_id).where(_DELIVERIES.event_id == _EVENTS.event_id))
    old = sa.select(_EVENTS.event_id).where(is_old, ~used).order_by(_EVENTS.at).limit(_AT_ONCE)
    found = list(connection.execute(old).scalars())
    if found:
        connection.execute(sa.delete(WEBHOOK_EVENTS).where(_EVENTS.event_id.in_(found)))
    return len(found)


def _waiting() -> sa.Select[Any]:
    """Number of deliveries that wait per endpoint, and the time since which the first of them is in line."""
    return (
        sa.select(
            _DELIVERIES.endpoint_id,
            sa.func.count().label("number"),
            sa.func.min(_DELIVERIES.tried_since).label("since"),
        )
        .where(_DELIVERIES.state == _WAITING, _DELIVERIES.endpoint_id.is_not(None))
        .group_by(_DELIVERIES.endpoint_id)
    )


def _missing(row: sa.Row[Any]) -> sa.Select[Any]:
    """The events that an endpoint wants and has no delivery of, the first one first."""
    wanted = [event for event in row.events if event != EventType.PROGRESS]
    given = sa.exists(
        sa.select(_DELIVERIES.delivery_id).where(
            _DELIVERIES.event_id == _EVENTS.event_id, _DELIVERIES.endpoint_id == row.endpoint_id
        )
    )
    columns = (_EVENTS.event_id, _EVENTS.job_id, _EVENTS.owner, _EVENTS.event, _EVENTS.at)
    missing = sa.select(*columns).where(_EVENTS.at > row.sent_until, _EVENTS.event.in_(wanted), ~given)
    return missing.order_by(_EVENTS.at, _EVENTS.event_id)


def _is_more(connection: Connection, row: sa.Row[Any], number: int) -> bool:
    """Whether more events than a number wait for an endpoint."""
    return connection.execute(_missing(row).offset(max(0, number)).limit(1)).first() is not None


def _replay(connection: Connection, endpoint_id: str, room: int, now: dt.datetime) -> int:
    """Put deliveries that wait for their replay in line; how many."""
    waiting = sa.select(_DELIVERIES.delivery_id).where(
        _DELIVERIES.replay_at.is_not(None), _DELIVERIES.endpoint_id == endpoint_id
    )
    found = list(connection.execute(waiting.order_by(_DELIVERIES.created_at).limit(room)).scalars())
    if found:
        values: dict[str, Any] = {"state": _WAITING, "reason": "replayed", "due_at": now, "finished_at": None}
        values |= {"tried_since": now}
        values |= {"replay_at": None, "lease_owner": None, "lease_until": None}
        # it may have moved since
        values["url"] = sa.select(_HOOKS.url).where(_HOOKS.endpoint_id == endpoint_id).scalar_subquery()
        one = _DELIVERIES.delivery_id.in_(found)
        connection.execute(sa.update(WEBHOOK_DELIVERIES).where(one).values(**values))
    return len(found)
