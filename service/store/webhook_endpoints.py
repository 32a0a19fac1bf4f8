"""Endpoints and secrets of webhooks. Within a transaction."""

from __future__ import annotations

import datetime as dt
import uuid
from collections.abc import Mapping
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.errors import NoSuchWebhookError
from service.files import is_id
from service.store.outbox import drop
from service.store.records import storable
from service.store.tables import WEBHOOK_DELIVERIES, WEBHOOK_SECRETS, WEBHOOKS
from service.webhooks import Endpoint, EventType, SigningSecret, new_secret

REMOVED = "the webhook was removed"
DISABLED = "the webhook was disabled"
_WRITABLE = ("url", "description", "disabled_reason")


def insert(
    connection: Connection, *, url: str, events: list[EventType], description: str | None, base: str, now: dt.datetime
) -> str:
    """Store a new endpoint with a secret; its id."""
    endpoint_id = uuid.uuid4().hex
    secret = SigningSecret(secret=new_secret(), changed_at=now)
    connection.execute(
        sa.insert(WEBHOOKS).values(
            endpoint_id=endpoint_id,
            url=storable(url),
            events=[event.value for event in events],
            description=None if description is None else storable(description),
            is_enabled=True,
            base=storable(base),
            created_at=now,
            updated_at=now,
            **_columns(secret),
        )
    )
    return endpoint_id


def get(connection: Connection, endpoint_id: str) -> Endpoint:
    """One endpoint.

    Raises
    ------
    NoSuchWebhookError
        It does not exist.
    """
    return _endpoint(_row(connection, endpoint_id))


def listed(connection: Connection, limit: int, offset: int) -> list[Endpoint]:
    """Endpoints, newest first."""
    chosen = sa.select(WEBHOOKS).order_by(WEBHOOKS.c.created_at.desc(), WEBHOOKS.c.endpoint_id.desc())
    return [_endpoint(row) for row in connection.execute(chosen.limit(limit).offset(offset))]


def change(connection: Connection, endpoint_id: str, changes: Mapping[str, Any], now: dt.datetime) -> None:
    """Change what is given: `url`, `events`, `description`, `is_enabled`.

    Deliveries that wait go to the new URL. If it is disabled, they are dropped.

    Raises
    ------
    NoSuchWebhookError
        It does not exist.
    """
    _row(connection, endpoint_id)
    values = dict(changes)
    if "events" in values:
        values["events"] = [event.value for event in values["events"]]
    if "is_enabled" in values:
        values["disabled_reason"] = None if values["is_enabled"] else DISABLED
    values |= {name: storable(values[name]) for name in _WRITABLE if values.get(name) is not None}
    one = WEBHOOKS.c.endpoint_id == endpoint_id
    connection.execute(sa.update(WEBHOOKS).where(one).values(**values, updated_at=now))
    theirs = WEBHOOK_DELIVERIES.c.endpoint_id == endpoint_id
    if "url" in values:
        waiting = sa.and_(theirs, WEBHOOK_DELIVERIES.c.state == "waiting")
        connection.execute(sa.update(WEBHOOK_DELIVERIES).where(waiting).values(url=values["url"]))
    if values.get("is_enabled") is False:
        drop(connection, theirs, DISABLED, now)


def disable(connection: Connection, endpoint_id: str, reason: str, now: dt.datetime) -> None:
    """Send nothing more to an endpoint, and drop what waits; one that is gone is ignored."""
    one = WEBHOOKS.c.endpoint_id == endpoint_id
    values = {"is_enabled": False, "disabled_reason": storable(reason), "updated_at": now}
    connection.execute(sa.update(WEBHOOKS).where(one).values(**values))
    drop(connection, WEBHOOK_DELIVERIES.c.endpoint_id == endpoint_id, reason, now)


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


def endpoint_secret(connection: Connection, endpoint_id: str) -> SigningSecret:
    """The secret of an endpoint.

    Raises
    ------
    NoSuchWebhookError
        It does not exist.
    """
    return _secret(_row(connection, endpoint_id))


def rotate_endpoint_secret(connection: Connection, endpoint_id: str, now: dt.datetime) -> SigningSecret:
    """Give an endpoint a new secret.

    Raises
    ------
    NoSuchWebhookError
        It does not exist.
    """
    secret = endpoint_secret(connection, endpoint_id).rotated(now)
    one = WEBHOOKS.c.endpoint_id == endpoint_id
    connection.execute(sa.update(WEBHOOKS).where(one).values(**_columns(secret), updated_at=now))
    return secret


def own_secret(connection: Connection, owner: str | None, now: dt.datetime) -> SigningSecret:
    """The secret that signs messages to the subscribers of a key; made when it is needed first."""
    found = known_secret(connection, owner)
    if found is not None:
        return found
    secret = SigningSecret(secret=new_secret(), changed_at=now)
    connection.execute(sa.insert(WEBHOOK_SECRETS).values(owner=storable(owner or "", 64), **_columns(secret)))
    return secret


def known_secret(connection: Connection, owner: str | None) -> SigningSecret | None:
    """The secret of a key; None if it was not needed yet."""
    chosen = sa.select(WEBHOOK_SECRETS).where(WEBHOOK_SECRETS.c.owner == storable(owner or "", 64))
    row = connection.execute(chosen).one_or_none()
    return None if row is None else _secret(row)


def rotate_own_secret(connection: Connection, owner: str | None, now: dt.datetime) -> SigningSecret:
    """Give a key a new secret for its subscribers."""
    secret = own_secret(connection, owner, now).rotated(now)
    one = WEBHOOK_SECRETS.c.owner == storable(owner or "", 64)
    connection.execute(sa.update(WEBHOOK_SECRETS).where(one).values(**_columns(secret)))
    return secret


def _row(connection: Connection, endpoint_id: str) -> sa.Row[Any]:
    row = None
    if is_id(endpoint_id):
        row = connection.execute(sa.select(WEBHOOKS).where(WEBHOOKS.c.endpoint_id == endpoint_id)).one_or_none()
    if row is None:
        raise NoSuchWebhookError(f"there is no webhook {endpoint_id[:64]!r}")
    return row


def _columns(secret: SigningSecret) -> dict[str, Any]:
    return {
        "secret": secret.secret,
        "old_secret": secret.old_secret,
        "old_until": secret.old_until,
        "changed_at": secret.changed_at,
    }


def _secret(row: sa.Row[Any]) -> SigningSecret:
    return SigningSecret(
        secret=row.secret, old_secret=row.old_secret, old_until=row.old_until, changed_at=row.changed_at
    )


def _endpoint(row: sa.Row[Any]) -> Endpoint:
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
        old_secret_until=row.old_until,
    )
