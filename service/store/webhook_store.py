"""The webhooks of a store: endpoints, secrets, and the log with replay. Every method is one transaction."""

from __future__ import annotations

import builtins
import dataclasses
import datetime as dt
import uuid
from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service import deliveries as deliveries_of_requests
from service.errors import NoSuchDeliveryError, NoSuchWebhookError, NotReplayableError, TooManyWebhooksError
from service.store.database import LOCK_SECRETS, LOCK_SUBMISSIONS, lock
from service.store.delivery_line import REMOVED, DeliveryLine, closed, endpoints_of
from service.store.outbox import drop
from service.store.records import from_row, row_by_id, storable
from service.store.tables import WEBHOOK_ATTEMPTS, WEBHOOK_DELIVERIES, WEBHOOK_EVENTS, WEBHOOKS
from service.store.uploads import creating
from service.store.webhook_secrets import known_secret, own_secret, replace_own_secret
from service.webhooks import Attempt, Delivery, DeliveryState, Endpoint, EventType, new_secret

_TABLE = WEBHOOK_DELIVERIES.c
_EVENTS = WEBHOOK_EVENTS.c
_WAITING = DeliveryState.WAITING.value
_LOST = [state.value for state in (DeliveryState.FAILED, DeliveryState.GONE, DeliveryState.DROPPED)]
_ENDS = [event.value for event in EventType if event.is_end]
_AT_ONCE = 500
"""Rows that one transaction removes."""
_KEPT = dt.timedelta(minutes=1)
"""Time for which an event without deliveries is kept: it says when progress was reported last."""


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


class WebhookStore(DeliveryLine):
    """Endpoints, secrets and deliveries; `JobStore.webhooks`.

    Deliveries are made by the changes of jobs (`outbox`), in the same transaction.
    """

    # --- endpoints

    def create(
        self,
        url: str,
        *,
        events: Sequence[EventType],
        description: str | None = None,
        base: str,
        owner: str | None = None,
        most: int | None = None,
        delivery: deliveries_of_requests.Delivery[tuple[Endpoint, str]] | None = None,
    ) -> tuple[Endpoint, str]:
        """Make an endpoint; it and its secret.

        Parameters
        ----------
        url : str
            Where messages go; already checked.
        events : sequence of EventType
            Only these are sent.
        description : str or None
            The operator's words.
        base : str
            The service's own URL, for links.
        owner : str or None
            The key that makes it; None if keys are not used.
        most : int or None
            Maximum number of endpoints of the key; None for any number.
        delivery : Delivery, optional
            What else is written for the request that makes it.

        Raises
        ------
        TooManyWebhooksError
            The key has so many already.
        """
        with creating(self._database, delivery) as (connection, made):
            # no other process adds one between counting and adding
            lock(connection, LOCK_SUBMISSIONS)
            now, secret, endpoint_id = self._database.now(connection), new_secret(), uuid.uuid4().hex
            own = WEBHOOKS.c.owner.is_not_distinct_from(None if owner is None else storable(owner, 64))
            found = connection.execute(sa.select(sa.func.count()).select_from(WEBHOOKS).where(own)).scalar_one()
            if most is not None and found >= most:
                whose = "webhooks that were made without a key" if owner is None else "webhooks of this key"
                raise TooManyWebhooksError(
                    f"there are {found} {whose}, the limit is {most}: remove one, or raise "
                    "GABLEWORK_MAX_WEBHOOKS_PER_KEY"
                )
            values = {
                "endpoint_id": endpoint_id,
                "url": storable(url),
                "events": [event.value for event in events],
                "description": None if description is None else storable(description),
                "is_enabled": True,
                "base": storable(base),
                "owner": None if owner is None else storable(owner, 64),
                "created_at": now,
                "updated_at": now,
                "secret": secret,
                "changed_at": now,
            }
            connection.execute(sa.insert(WEBHOOKS).values(**values))
            return made((from_row(Endpoint, _endpoint_row(connection, endpoint_id)), secret))

    def get(self, endpoint_id: str) -> Endpoint:
        """One endpoint.

        Raises
        ------
        NoSuchWebhookError
            It does not exist.
        """
        with self._database.read() as connection:
            return from_row(Endpoint, _endpoint_row(connection, endpoint_id))

    def list(self, *, limit: int = 100, offset: int = 0) -> builtins.list[Endpoint]:
        """Endpoints, newest first."""
        chosen = sa.select(WEBHOOKS).order_by(WEBHOOKS.c.created_at.desc(), WEBHOOKS.c.endpoint_id.desc())
        with self._database.read() as connection:
            return [from_row(Endpoint, row) for row in connection.execute(chosen.limit(limit).offset(offset))]

    def replay_all(self, endpoint_id: str) -> Endpoint:
        """Send all that waits for an endpoint, and the ends of jobs that failed or were dropped; enable it.

        Raises
        ------
        NoSuchWebhookError
            It does not exist.
        """
        one = WEBHOOKS.c.endpoint_id == endpoint_id
        own = _TABLE.endpoint_id == endpoint_id
        waiting = sa.and_(_TABLE.state == _WAITING, _TABLE.lease_until.is_(None))
        ends = sa.and_(_TABLE.state.in_(_LOST), _TABLE.event.in_(_ENDS))
        with self._database.write() as connection:
            row = _endpoint_row(connection, endpoint_id, locked=True)
            now = self._database.now(connection)
            enabled = {"is_enabled": True, "disabled_reason": None, "updated_at": now}
            connection.execute(sa.update(WEBHOOKS).where(one).values(**enabled))
            again = sa.update(WEBHOOK_DELIVERIES).where(own, sa.or_(waiting, ends))
            connection.execute(again.values(**_again(now), url=row.url))
            return from_row(Endpoint, _endpoint_row(connection, endpoint_id))

    def remove(self, endpoint_id: str) -> None:
        """Delete an endpoint, and drop what waits; the log stays.

        Raises
        ------
        NoSuchWebhookError
            It does not exist.
        """
        with self._database.write() as connection:
            _endpoint_row(connection, endpoint_id)
            connection.execute(sa.delete(WEBHOOKS).where(WEBHOOKS.c.endpoint_id == endpoint_id))
            drop(connection, _TABLE.endpoint_id == endpoint_id, REMOVED, self._database.now(connection))

    # --- secrets of keys

    def own_secret(self, owner: str | None) -> str:
        """The secret that signs messages to a key's subscribers (None if keys are not used); made if there is none."""
        with self._database.read() as connection:
            found = known_secret(connection, owner)
        if found is not None:
            return found
        with self._database.write() as connection:
            lock(connection, LOCK_SECRETS)
            return own_secret(connection, owner, self._database.now(connection))

    def replace_own_secret(self, owner: str | None) -> str:
        """Give a key a new secret for its subscribers; the one before signs no longer."""
        with self._database.write() as connection:
            lock(connection, LOCK_SECRETS)
            return replace_own_secret(connection, owner, self._database.now(connection))

    # --- the log

    def deliveries(self, criteria: DeliveryFilter) -> builtins.list[Delivery]:
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
        with self._database.read() as connection:
            found = connection.execute(chosen.limit(criteria.limit).offset(criteria.offset))
            return [from_row(Delivery, row) for row in found]

    def delivery(self, delivery_id: str, *, owner: str | None = None) -> Delivery:
        """One delivery with its attempts; with an owner only one to a subscriber of its jobs.

        Raises
        ------
        NoSuchDeliveryError
            It does not exist, or belongs to another key.
        """
        with self._database.read() as connection:
            return _delivery(connection, delivery_id, owner)

    def replay(self, delivery_id: str, *, owner: str | None = None) -> Delivery:
        """Send a delivery again, whatever became of it; its hours count anew.

        Raises
        ------
        NoSuchDeliveryError
            It does not exist, or belongs to another key.
        NotReplayableError
            It is being sent, or its endpoint is gone or disabled.
        """
        with self._database.write() as connection:
            now = self._database.now(connection)
            row = _delivery_row(connection, delivery_id, owner, locked=True)
            if row.state == _WAITING and row.lease_until is not None and row.lease_until > now:
                raise NotReplayableError(f"delivery {delivery_id} is being sent: look at its attempts in a moment")
            url = row.url
            if row.endpoint_id is not None:
                endpoint = endpoints_of(connection, [row.endpoint_id])[row.endpoint_id]
                reason = closed(endpoint)
                if endpoint is None or reason is not None:
                    raise NotReplayableError(f"delivery {delivery_id} cannot be sent: {reason}")
                # the webhook may have moved since
                url = endpoint.url
            again = sa.update(WEBHOOK_DELIVERIES).where(_TABLE.delivery_id == delivery_id)
            connection.execute(again.values(**_again(now), url=url))
            return _delivery(connection, delivery_id, owner)

    def counts(self) -> dict[DeliveryState, int]:
        """Deliveries by state; every state is there."""
        grouped = sa.select(_TABLE.state, sa.func.count()).group_by(_TABLE.state)
        with self._database.read() as connection:
            found: dict[Any, int] = {DeliveryState(state): count for state, count in connection.execute(grouped)}
        return {state: found.get(state, 0) for state in DeliveryState}

    def forget(self, days: float, *, most: int | None = None) -> int:
        """Remove old deliveries and events that no delivery needs, a limited number at once; how many.

        Parameters
        ----------
        days : float
            Days after which a finished delivery goes.
        most : int, optional
            Most finished deliveries that did not fail, and most that did; the oldest go first.
        """
        with self._database.write() as connection:
            now = self._database.now(connection)
            old = sa.select(_TABLE.delivery_id).where(_TABLE.finished_at < now - dt.timedelta(days=days))
            found = list(connection.execute(old.limit(_AT_ONCE)).scalars())
            if not found and most is not None:
                failed = _TABLE.state == DeliveryState.FAILED.value
                for kind in (~failed, failed):
                    finished = sa.select(_TABLE.delivery_id, _TABLE.finished_at).where(_TABLE.finished_at.is_not(None))
                    newest_first = finished.where(kind).order_by(_TABLE.finished_at.desc())
                    surplus = newest_first.offset(most).subquery()
                    oldest_first = sa.select(surplus.c.delivery_id).order_by(surplus.c.finished_at)
                    found += connection.execute(oldest_first.limit(_AT_ONCE)).scalars()
            connection.execute(sa.delete(WEBHOOK_ATTEMPTS).where(WEBHOOK_ATTEMPTS.c.delivery_id.in_(found)))
            connection.execute(sa.delete(WEBHOOK_DELIVERIES).where(_TABLE.delivery_id.in_(found)))
            used = sa.exists(sa.select(_TABLE.delivery_id).where(_TABLE.event_id == _EVENTS.event_id))
            unused = sa.select(_EVENTS.event_id).where(_EVENTS.at < now - _KEPT, ~used).limit(_AT_ONCE)
            events = list(connection.execute(unused).scalars())
            connection.execute(sa.delete(WEBHOOK_EVENTS).where(_EVENTS.event_id.in_(events)))
            return len(found) + len(events)


def _again(now: dt.datetime) -> dict[str, Any]:
    """The columns of a delivery that is sent again from now on."""
    free = {"finished_at": None, "lease_owner": None, "lease_until": None}
    return {"state": _WAITING, "reason": "replayed", "due_at": now, "tried_since": now, **free}


def _endpoint_row(connection: Connection, endpoint_id: str, *, locked: bool = False) -> sa.Row[Any]:
    row = row_by_id(connection, WEBHOOKS, endpoint_id, locked=locked)
    if row is None:
        raise NoSuchWebhookError(f"there is no webhook {endpoint_id[:64]!r}")
    return row


def _delivery_row(connection: Connection, delivery_id: str, owner: str | None, *, locked: bool = False) -> sa.Row[Any]:
    row = row_by_id(connection, WEBHOOK_DELIVERIES, delivery_id, locked=locked)
    if row is None or (owner is not None and (row.owner != owner or row.endpoint_id is not None)):
        raise NoSuchDeliveryError(f"there is no delivery {delivery_id[:64]!r} (any more)")
    return row


def _delivery(connection: Connection, delivery_id: str, owner: str | None) -> Delivery:
    """A delivery with its attempts."""
    found = from_row(Delivery, _delivery_row(connection, delivery_id, owner))
    log = WEBHOOK_ATTEMPTS.c
    chosen = sa.select(log.number, log.at, log.driver, log.duration_ms, log.status, log.error)
    rows = connection.execute(chosen.where(log.delivery_id == delivery_id).order_by(log.number))
    return dataclasses.replace(found, log=tuple(Attempt(**row._asdict()) for row in rows))
