"""Keys in the database."""

from __future__ import annotations

import sqlalchemy as sa

from service.keys import Key
from service.store.database import StorePart
from service.store.records import from_row, storable
from service.store.tables import KEYS


class KeyTable(StorePart):
    """The keys of a service; the keys themselves are not stored."""

    def add_key(self, key: Key) -> None:
        """Store a key."""
        values = {
            "key_id": key.key_id,
            "name": storable(key.name),
            "digest": key.digest,
            "scopes": sorted(key.scopes),
            "created_at": key.created_at,
            "revoked_at": key.revoked_at,
            "expires_at": key.expires_at,
        }
        with self._database.write() as connection:
            connection.execute(sa.insert(KEYS).values(**values))

    def key_by_digest(self, digest: str) -> Key | None:
        """The key with this digest, new or old, even if it is refused; None if there is none."""
        held = sa.or_(KEYS.c.digest == storable(digest), KEYS.c.old_digest == storable(digest))
        with self._database.read() as connection:
            row = connection.execute(sa.select(KEYS).where(held)).one_or_none()
        return None if row is None else from_row(Key, row)

    def keys(self) -> list[Key]:
        """All keys, also revoked ones, oldest first."""
        with self._database.read() as connection:
            rows = connection.execute(sa.select(KEYS).order_by(KEYS.c.created_at, KEYS.c.key_id))
            return [from_row(Key, row) for row in rows]

    def rotate_key(self, key: Key) -> None:
        """Store the new secret of a key."""
        values = {name: getattr(key, name) for name in ("digest", "old_digest", "old_until", "expires_at")}
        with self._database.write() as connection:
            connection.execute(sa.update(KEYS).where(KEYS.c.key_id == key.key_id).values(**values))

    def revoke_key(self, key_id: str) -> None:
        """Revoke a key; one that is revoked already keeps its time; one that does not exist is ignored."""
        one = sa.and_(KEYS.c.key_id == storable(key_id), KEYS.c.revoked_at.is_(None))
        with self._database.write() as connection:
            connection.execute(sa.update(KEYS).where(one).values(revoked_at=self._database.now(connection)))

    def has_keys(self) -> bool:
        """Whether there is a key that is neither revoked nor expired."""
        with self._database.read() as connection:
            lasting = sa.or_(KEYS.c.expires_at.is_(None), KEYS.c.expires_at > self._database.now(connection))
            valid = sa.select(KEYS.c.key_id).where(KEYS.c.revoked_at.is_(None), lasting)
            return connection.execute(valid.limit(1)).first() is not None
