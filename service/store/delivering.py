"""Writes what comes with a thing that a request makes: its uploads, and the answer under its key."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

from sqlalchemy.engine import Connection

from service.deliveries import Delivery, Made
from service.store import idempotency, uploads
from service.store.database import LOCK_SUBMISSIONS, Database


@contextlib.contextmanager
def creating(
    database: Database, delivery: Delivery[Made] | None
) -> Iterator[tuple[Connection, Callable[[Made], Made]]]:
    """A transaction in which a thing is made.

    Its second value is called with what was made, at the end of the transaction, and returns it.

    Raises
    ------
    QuotaError
        The owner of the uploads has too many bytes.
    TooManyUploadsError
        The owner of the uploads has too many of them.
    KeyInUseError
        The key of the request has passed to another one.
    """
    with database.write() as connection:
        if delivery is not None and delivery.uploads:
            if delivery.max_upload_bytes or delivery.max_uploads:
                # no other process adds one between counting and adding
                database.lock(connection, LOCK_SUBMISSIONS)
                uploads.check_quota(connection, delivery.uploads, delivery.max_upload_bytes, delivery.max_uploads)
            for upload in delivery.uploads:
                uploads.add(connection, upload)

        def made(thing: Made) -> Made:
            if delivery is not None and delivery.claim is not None and delivery.answer is not None:
                answer, now = delivery.answer(thing), database.now(connection)
                idempotency.keep(connection, delivery.claim, answer, now=now, kept_s=delivery.kept_s)
            return thing

        yield connection, made
