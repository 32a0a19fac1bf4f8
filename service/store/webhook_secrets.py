"""The secrets that sign messages to subscribers, one per key. Within a transaction."""

from __future__ import annotations

import datetime as dt

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.store.records import storable
from service.store.tables import WEBHOOK_SECRETS
from service.webhooks import new_secret


def own_secret(connection: Connection, owner: str | None, now: dt.datetime) -> str:
    """The secret of a key; made when it is needed first."""
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


def replace_own_secret(connection: Connection, owner: str | None, now: dt.datetime) -> str:
    """Give a key a new secret; the one before signs no longer."""
    own_secret(connection, owner, now)
    secret = new_secret()
    one = WEBHOOK_SECRETS.c.owner == storable(owner or "", 64)
    connection.execute(sa.update(WEBHOOK_SECRETS).where(one).values(secret=secret, changed_at=now))
    return secret
