"""Keys of requests and the answers that are kept under them."""

from __future__ import annotations

import datetime as dt
from typing import Any

import sqlalchemy as sa
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import Connection

from service.deliveries import CLAIM_S, Claim, StoredAnswer
from service.errors import KeyInUseError
from service.store.database import StorePart
from service.store.tables import IDEMPOTENCY_KEYS as KEYS


class AnswerTable(StorePart):
    """The answers to requests with a key of their own."""

    def answer_to(self, owner: str, key: str) -> StoredAnswer | None:
        """The answer that is kept under a client's key; None if there is none."""
        with self._database.read() as connection:
            row = connection.execute(sa.select(KEYS).where(KEYS.c.owner == owner, KEYS.c.key == key)).one_or_none()
            return None if row is None or row.until <= self._database.now(connection) else _answer(row)

    def claim_key(self, claim: Claim) -> StoredAnswer | None:
        """Claim a client's key for a request; the answer if one is kept under it, otherwise None.

        Raises
        ------
        KeyInUseError
            Another request holds the key.
        """
        one = sa.and_(KEYS.c.owner == claim.owner, KEYS.c.key == claim.key)
        with self._database.write() as connection:
            now = self._database.now(connection)
            mine = {"token": claim.token, "created_at": now, "until": now + dt.timedelta(seconds=CLAIM_S)}
            insert = sqlite.insert if connection.dialect.name == "sqlite" else postgresql.insert
            added = insert(KEYS).values(owner=claim.owner, key=claim.key, **mine).on_conflict_do_nothing()
            connection.execute(added)
            row = connection.execute(sa.select(KEYS).where(one).with_for_update()).one()
            if row.token == claim.token:
                return None
            if row.until > now:
                if row.status is None:
                    raise KeyInUseError(
                        f"a request with the Idempotency-Key {claim.key[:80]!r} is under way: wait for its end"
                    )
                return _answer(row)
            free = {"fingerprint": None, "size_bytes": None, "status": None, "headers": sa.null(), "body": None}
            connection.execute(sa.update(KEYS).where(one).values(**mine, **free))
            return None

    def renew_claim(self, claim: Claim) -> None:
        """Hold a claim for some more time; one that has passed to another request is left alone."""
        with self._database.write() as connection:
            until = self._database.now(connection) + dt.timedelta(seconds=CLAIM_S)
            connection.execute(sa.update(KEYS).where(_held(claim)).values(until=until))

    def drop_claim(self, claim: Claim) -> None:
        """Free the key of a request that made nothing."""
        with self._database.write() as connection:
            connection.execute(sa.delete(KEYS).where(_held(claim)))

    def forget_answers(self) -> int:
        """Delete the kept answers whose time is over; their number."""
        with self._database.write() as connection:
            return connection.execute(sa.delete(KEYS).where(KEYS.c.until <= self._database.now(connection))).rowcount


def keep(connection: Connection, claim: Claim, answer: StoredAnswer, *, now: dt.datetime, kept_s: float) -> None:
    """Keep the answer to the request that holds a key. Within a transaction.

    Raises
    ------
    KeyInUseError
        The claim has passed to another request.
    """
    values = {
        "fingerprint": answer.fingerprint,
        "size_bytes": answer.size_bytes,
        "status": answer.status,
        "headers": dict(answer.headers),
        "body": answer.body,
        "until": now + dt.timedelta(seconds=kept_s),
    }
    if connection.execute(sa.update(KEYS).where(_held(claim)).values(**values)).rowcount != 1:
        raise KeyInUseError(f"the Idempotency-Key {claim.key[:80]!r} has passed to another request: send it again")


def _held(claim: Claim) -> sa.ColumnElement[bool]:
    same = sa.and_(KEYS.c.owner == claim.owner, KEYS.c.key == claim.key, KEYS.c.token == claim.token)
    return sa.and_(same, KEYS.c.status.is_(None))


def _answer(row: sa.Row[Any]) -> StoredAnswer | None:
    if row.status is None:
        return None
    return StoredAnswer(
        fingerprint=row.fingerprint, size_bytes=row.size_bytes, status=row.status, headers=row.headers, body=row.body
    )
