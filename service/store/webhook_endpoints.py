"""Endpoints and secrets of webhooks. Within a transaction."""

from __future__ import annotations

import dataclasses
import datetime as dt
import uuid
from collections.abc import Mapping, Sequence
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.errors import NoSuchWebhookError, TooManyWebhooksError
from service.files import is_id
from service.store import backlog
from service.store.outbox import drop
from service.store.records import storable
from service.store.tables import WEBHOOK_DELIVERIES, WEBHOOK_SECRETS, WEBHOOKS
from service.webhooks import Endpoint, EventType, new_secret

REMOVED = "the webhook was removed"
_CLOSED: Mapping[str, Any] = {"paused_at": None, "is_behind": False}
"""Columns of an endpoint for which nothing waits any longer."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class NewEndpoint:
    """An endpoint to be made; already checked."""

    url: str
    """Where messages go."""
    events: Sequence[EventType]
    """Only these are sent."""
    description: str | None = None
    """The operator's words."""
    base: str
    """The service's own URL, for links."""
    owner: str | None = None
    """The key that makes it; None if keys are not used."""


def insert(connection: Connection, new: NewEndpoint, *, most: int | None, now: dt.datetime) -> tuple[str, str]:
    """Store a new endpoint; its id and its secret.

    Raises
    ------
    TooManyWebhooksError
        The key has so many already.
    """
    own = WEBHOOKS.c.owner.is_(None) if new.owner is None else WEBHOOKS.c.owner == storable(new.owner, 64)
    found = connection.execute(sa.select(sa.func.count()).select_from(WEBHOOKS).where(own)).scalar_one()
    if most is not None and found >= most:
        whose = "webhooks that were made without a key" if new.owner is None else "webhooks of this key"
        raise TooManyWebhooksError(
            f"there are {found} {whose}, the limit is {most}: remove one, or raise GABLEWORK_MAX_WEBHOOKS_PER_KEY"
        )
    endpoint_id = uuid.uuid4().hex
    secret = new_secret()
    connection.execute(
        sa.insert(WEBHOOKS).values(
            endpoint_id=endpoint_id,
            url=storable(new.url),
            events=[event.value for event in new.events],
            description=None if new.description is None else storable(new.description),
            is_enabled=True,
            base=storable(new.base),
            owner=None if new.owner is None else storable(new.owner, 64),
            sent_until=now,
            created_at=now,
            updated_at=now,
            secret=secret,
            changed_at=now,
        )
    )
    return endpoint_id, secret


def get(connection: Connection, endpoint_id: str) -> Endpoint:
    """One endpoint.

    Raises
    ------
    NoSuchWebhookError
        It does not exist.
    """
    row = _row(connection, endpoint_id)
    return _endpoint(row, backlog.not_sent(connection, row))


def listed(connection: Connection, limit: int, offset: int) -> list[Endpoint]:
    """Endpoints, newest first."""
    chosen = sa.select(WEBHOOKS).order_by(WEBHOOKS.c.created_at.desc(), WEBHOOKS.c.endpoint_id.desc())
    rows = connection.execute(chosen.limit(limit).offset(offset)).all()
    return [_endpoint(row, backlog.not_sent(connection, row)) for row in rows]


def replay(connection: Connection, endpoint_id: str, now: dt.datetime) -> None:
    """Send all that was not sent, end the pause, and enable it.

    Raises
    ------
    NoSuchWebhookError
        It does not exist.
    """
    row = _row(connection, endpoint_id, locked=True)
    if not row.is_enabled:
        values = {"is_enabled": True, "disabled_reason": None, "sent_until": now}
        connection.execute(sa.update(WEBHOOKS).where(WEBHOOKS.c.endpoint_id == endpoint_id).values(**values))
    backlog.replay_all(connection, endpoint_id, now)


def disable(connection: Connection, endpoint_id: str, reason: str, now: dt.datetime) -> None:
    """Send nothing more to an endpoint, and drop what waits; one that is gone is ignored."""
    one = WEBHOOKS.c.endpoint_id == endpoint_id
    values = {"is_enabled": False, "disabled_reason": storable(reason), "updated_at": now, **_CLOSED}
    connection.execute(sa.update(WEBHOOKS).where(one).values(**values))
    drop(connection, WEBHOOK_DELIVERIES.c.endpoint_id == endpoint_id, reason, now)
    backlog.forget_replays(connection, endpoint_id)


def remove(connection: Connection, endpoint_id: str, now: dt.datetime) -> None:
    """Delete an endpoint, and drop what waits; the log stays.

    Raises
    ------
    NoSuchWebhookError
        It does not exist.
    """
    _row(connection, endpoint_id)
    connection.execute(sa.delete(WEBHOOKS).where(WEBHOOKS.c.endpoint_id == endpoint_id))
    drop(connection, WEBHOOK_DELIVERIES.c.endpoint_id == endpoint_id, REMOVED, now)
    backlog.forget_replays(connection, endpoint_id)


def replace_own_secret(connection: Connection, owner: str | None, now: dt.datetime) -> str:
    """Give a key a new secret for its subscribers; the one before signs no longer."""
    own_secret(connection, owner, now)
    secret = new_secret()
    one = WEBHOOK_SECRETS.c.owner == storable(owner or "", 64)
    connection.execute(sa.update(WEBHOOK_SECRETS).where(one).values(secret=secret, changed_at=now))
    return secret


def own_secret(connection: Connection, owner: str | None, now: dt.datetime) -> str:
    """The secret that signs messages to the subscribers of a key; made when it is needed first."""
    found = known_secret(connection, owner)
    if found is None:
        found = new_secret()
        row = {"owner": storable(owner or "", 64), "secret": found, "changed_at": now}
        connection.execute(sa.insert(WEBHOOK_SECRETS).values(**row))
    return found


def known_secret(connection: Connection, owner: str | None) -> str | None:
    """The secret of a key; None if it was not needed yet."""
    chosen = sa.select(WEBHOOK_SECRETS.c.secret).where(WEBHOOK_SECRETS.c.owner == storable(owner or "", 64))
    return connection.execute(chosen).scalar_one_or_none()


def _row(connection: Connection, endpoint_id: str, *, locked: bool = False) -> sa.Row[Any]:
    row = None
    if is_id(endpoint_id):
        one = sa.select(WEBHOOKS).where(WEBHOOKS.c.endpoint_id == endpoint_id)
        row = connection.execute(one.with_for_update() if locked else one).one_or_none()
    if row is None:
        raise NoSuchWebhookError(f"there is no webhook {endpoint_id[:64]!r}")
    return row


def _endpoint(row: sa.Row[Any], not_sent: int) -> Endpoint:
    """A row of `webhooks`."""
    return Endpoint(
        endpoint_id=row.endpoint_id,
        url=row.url,
        events=tuple(EventType(word) for word in row.events),
        description=row.description,
        is_enabled=row.is_enabled,
        disabled_reason=row.disabled_reason,
        base=row.base,
        created_at=row.created_at,
        updated_at=row.updated_at,
        owner=row.owner,
        paused_at=row.paused_at,
        not_sent=not_sent,
    )
