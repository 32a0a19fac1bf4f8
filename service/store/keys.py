"""Keys in the database. Within a transaction."""

from __future__ import annotations

import datetime as dt

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.keys import Key
from service.store.records import key_of, storable
from service.store.tables import KEYS


def add(connection: Connection, key: Key) -> None:
    """Store a key."""
    connection.execute(
        sa.insert(KEYS).values(
            key_id=key.key_id,
            name=storable(key.name),
            digest=key.digest,
            scopes=sorted(key.scopes),
            created_at=key.created_at,
            revoked_at=key.revoked_at,
        )
    )


def by_digest(connection: Connection, digest: str) -> Key | None:
    """The key with this digest, also if it is revoked; None if there is none."""
    row = connection.execute(sa.select(KEYS).where(KEYS.c.digest == storable(digest))).one_or_none()
    return None if row is None else key_of(row)


def every(connection: Connection) -> list[Key]:
    """All keys, also revoked ones, oldest first."""
    return [key_of(row) for row in connection.execute(sa.select(KEYS).order_by(KEYS.c.created_at, KEYS.c.key_id))]


def revoke(connection: Connection, key_id: str, now: dt.datetime) -> None:
    """Revoke a key; one that is revoked already keeps its time; one that does not exist is ignored."""
    one = sa.and_(KEYS.c.key_id == storable(key_id), KEYS.c.revoked_at.is_(None))
    connection.execute(sa.update(KEYS).where(one).values(revoked_at=now))


def any_valid(connection: Connection) -> bool:
    """Whether there is a key that is not revoked."""
    return connection.execute(sa.select(KEYS.c.key_id).where(KEYS.c.revoked_at.is_(None)).limit(1)).first() is not None
