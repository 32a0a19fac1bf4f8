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
            expires_at=key.expires_at,
        )
    )


def by_digest(connection: Connection, digest: str) -> Key | None:
    """The key with this digest, or with this one before its rotation, also if it is refused; None if there is none."""
    held = sa.or_(KEYS.c.digest == storable(digest), KEYS.c.old_digest == storable(digest))
    row = connection.execute(sa.select(KEYS).where(held)).one_or_none()
    return None if row is None else key_of(row)


def every(connection: Connection) -> list[Key]:
    """All keys, also revoked ones, oldest first."""
    return [key_of(row) for row in connection.execute(sa.select(KEYS).order_by(KEYS.c.created_at, KEYS.c.key_id))]


def revoke(connection: Connection, key_id: str, now: dt.datetime) -> None:
    """Revoke a key; one that is revoked already keeps its time; one that does not exist is ignored."""
    one = sa.and_(KEYS.c.key_id == storable(key_id), KEYS.c.revoked_at.is_(None))
    connection.execute(sa.update(KEYS).where(one).values(revoked_at=now))


def rotate(connection: Connection, key: Key) -> None:
    """Store the new secret of a key."""
    values = {name: getattr(key, name) for name in ("digest", "old_digest", "old_until", "expires_at")}
    connection.execute(sa.update(KEYS).where(KEYS.c.key_id == key.key_id).values(**values))


def any_valid(connection: Connection, now: dt.datetime) -> bool:
    """Whether there is a key that is neither revoked nor expired."""
    lasting = sa.or_(KEYS.c.expires_at.is_(None), KEYS.c.expires_at > now)
    valid = sa.select(KEYS.c.key_id).where(KEYS.c.revoked_at.is_(None), lasting)
    return connection.execute(valid.limit(1)).first() is not None
