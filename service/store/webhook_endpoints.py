"""Endpoints and secrets of webhooks. Within a transaction."""

from __future__ import annotations

import dataclasses
import datetime as dt
import uuid
from collections.abc import Mapping, Sequence
from typing import Any

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.errors import NoSuchWebhookError, NotReplayableError, TooManyWebhooksError
from service.files import is_id
from service.store import backlog
from service.store.outbox import drop
from service.store.records import storable
from service.store.tables import WEBHOOK_DELIVERIES, WEBHOOK_SECRETS, WEBHOOKS
from service.webhooks import Endpoint, EventType, SigningSecret, new_secret

REMOVED = "the webhook was removed"
DISABLED = "the webhook was disabled"
_CLOSED: Mapping[str, Any] = {"paused_at": None, "is_behind": False}
"""Columns of an endpoint for which nothing waits any longer."""
_WRITABLE = ("url", "description", "disabled_reason")


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


def insert(connection: Connection, new: NewEndpoint, *, most: int | None, now: dt.datetime) -> str:
    """Store a new endpoint with a secret; its id.

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
    secret = SigningSecret(secret=new_secret(), changed_at=now)
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
    row = _row(connection, endpoint_id)
    return _endpoint(row, backlog.not_sent(connection, row))


def listed(connection: Connection, limit: int, offset: int) -> list[Endpoint]:
    """Endpoints, newest first."""
    chosen = sa.select(WEBHOOKS).order_by(WEBHOOKS.c.created_at.desc(), WEBHOOKS.c.endpoint_id.desc())
    rows = connection.execute(chosen.limit(limit).offset(offset)).all()
    return [_endpoint(row, backlog.not_sent(connection, row)) for row in rows]


def change(connection: Connection, endpoint_id: str, changes: Mapping[str, Any], now: dt.datetime) -> None:
    """Change what is given: `url`, `events`, `description`, `is_enabled`.

    Deliveries that wait go to the new URL. If it is disabled, they are dropped, and so are events that wait. If it is
    enabled and was paused, it goes on where it stopped.

    Raises
    ------
    NoSuchWebhookError
        It does not exist.
    """
    row = _row(connection, endpoint_id, locked=True)
    values = dict(changes)
    if "events" in values:
        values["events"] = [event.value for event in values["events"]]
    if "is_enabled" in values:
        values["disabled_reason"] = None if values["is_enabled"] else DISABLED
    values |= {name: storable(values[name]) for name in _WRITABLE if values.get(name) is not None}
    one = WEBHOOKS.c.endpoint_id == endpoint_id
    theirs = WEBHOOK_DELIVERIES.c.endpoint_id == endpoint_id
    if "url" in values:
        waiting = sa.and_(theirs, WEBHOOK_DELIVERIES.c.state == "waiting")
        connection.execute(sa.update(WEBHOOK_DELIVERIES).where(waiting).values(url=values["url"]))
    if values.get("is_enabled") is False:
        drop(connection, theirs, DISABLED, now)
        backlog.forget_replays(connection, endpoint_id)
        values |= _CLOSED
    elif values.get("is_enabled") and not row.is_enabled:
        values["sent_until"] = now
    connection.execute(sa.update(WEBHOOKS).where(one).values(**values, updated_at=now))
    if values.get("is_enabled") and row.paused_at is not None:
        backlog.resume(connection, endpoint_id, now)


def replay(connection: Connection, endpoint_id: str, now: dt.datetime) -> None:
    """Send all that was not sent, and end the pause.

    Raises
    ------
    NoSuchWebhookError
        It does not exist.
    NotReplayableError
        It is disabled.
    """
    row = _row(connection, endpoint_id, locked=True)
    if not row.is_enabled:
        raise NotReplayableError(f"nothing is sent to webhook {endpoint_id}: {row.disabled_reason}; enable it first")
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


def endpoint_secret(connection: Connection, endpoint_id: str) -> SigningSecret:
    """The secret of an endpoint.

    Raises
    ------
    NoSuchWebhookError
        It does not exist.
    """
    return secret_of(_row(connection, endpoint_id))


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
    return None if row is None else secret_of(row)


def rotate_own_secret(connection: Connection, owner: str | None, now: dt.datetime) -> SigningSecret:
    """Give a key a new secret for its subscribers."""
    secret = own_secret(connection, owner, now).rotated(now)
    one = WEBHOOK_SECRETS.c.owner == storable(owner or "", 64)
    connection.execute(sa.update(WEBHOOK_SECRETS).where(one).values(**_columns(secret)))
    return secret


def _row(connection: Connection, endpoint_id: str, *, locked: bool = False) -> sa.Row[Any]:
    row = None
    if is_id(endpoint_id):
        one = sa.select(WEBHOOKS).where(WEBHOOKS.c.endpoint_id == endpoint_id)
        row = connection.execute(one.with_for_update() if locked else one).one_or_none()
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


def secret_of(row: sa.Row[Any]) -> SigningSecret:
    """The secret in a row of `webhooks` or `webhook_secrets`."""
    return SigningSecret(
        secret=row.secret, old_secret=row.old_secret, old_until=row.old_until, changed_at=row.changed_at
    )


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
        old_secret_until=row.old_until,
        owner=row.owner,
        paused_at=row.paused_at,
        not_sent=not_sent,
    )
