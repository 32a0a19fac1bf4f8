"""Uploads in the database, and what else a request writes with the thing that it makes."""

from __future__ import annotations

import contextlib
import datetime as dt
from collections.abc import Callable, Iterator, Sequence

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.deliveries import Delivery, Made
from service.errors import NoSuchUploadError, QuotaError, TooManyUploadsError, UploadInUseError
from service.files import is_id
from service.jobs import JobStatus, Upload
from service.store import idempotency
from service.store.database import LOCK_SUBMISSIONS, Database, StorePart, lock
from service.store.records import from_row, row_by_id, storable
from service.store.tables import JOB_UPLOADS, JOBS, SCHEDULE_UPLOADS, UPLOADS

_NOT_OVER = [status.value for status in JobStatus if not status.is_over]


class UploadTable(StorePart):
    """The records of uploads; their files are the caller's."""

    def add_upload(self, upload: Upload) -> None:
        """Store the record of an upload; its file is already in place."""
        self.add_uploads(Delivery(uploads=(upload,)))

    def add_uploads(self, delivery: Delivery[None]) -> None:
        """Store the records of uploads, and the answer under the request's key.

        Raises
        ------
        QuotaError
            They are too large.
        KeyInUseError
            The key of the request has passed to another one.
        """
        with creating(self._database, delivery) as (_, made):
            made(None)

    def stored_bytes(self, owner: str | None) -> int:
        """Bytes of all uploads of a key, or of all that belong to none."""
        with self._database.read() as connection:
            return _stored_bytes(connection, owner)

    def upload(self, upload_id: str, *, owner: str | None = None) -> Upload:
        """One upload; with an owner only its own.

        Raises
        ------
        NoSuchUploadError
            It does not exist, or belongs to another key.
        """
        with self._database.read() as connection:
            row = row_by_id(connection, UPLOADS, upload_id)
        if row is None or (owner is not None and row.owner != owner):
            raise NoSuchUploadError(f"there is no upload {upload_id[:64]!r} (any more)")
        return from_row(Upload, row)

    def list_uploads(self, *, owner: str | None = None, limit: int, offset: int = 0) -> list[Upload]:
        """Uploads, newest first; with an owner only its own."""
        chosen = sa.select(UPLOADS).order_by(UPLOADS.c.created_at.desc(), UPLOADS.c.upload_id.desc())
        if owner is not None:
            chosen = chosen.where(UPLOADS.c.owner == owner)
        with self._database.read() as connection:
            return [from_row(Upload, row) for row in connection.execute(chosen.limit(limit).offset(offset))]

    def remove_upload(self, upload_id: str) -> None:
        """Delete an upload; the caller removes its file afterwards. One that does not exist is ignored.

        Raises
        ------
        UploadInUseError
            Jobs that wait or run, or schedules, need it.
        """
        if not is_id(upload_id):
            return
        one = UPLOADS.c.upload_id == upload_id
        of_jobs = (
            sa.select(sa.func.count(sa.distinct(JOBS.c.job_id)))
            .join(JOB_UPLOADS, JOB_UPLOADS.c.job_id == JOBS.c.job_id)
            .where(JOB_UPLOADS.c.upload_id == upload_id, JOBS.c.status.in_(_NOT_OVER))
        )
        of_schedules = sa.select(sa.func.count()).where(SCHEDULE_UPLOADS.c.upload_id == upload_id)
        with self._database.write() as connection:
            connection.execute(sa.select(UPLOADS).where(one).with_for_update())
            # a statement of its own: only now it sees the jobs that were submitted while we waited
            jobs = connection.execute(of_jobs).scalar_one()
            if jobs:
                raise UploadInUseError(f"{jobs} jobs that are not over need the upload {upload_id}: dismiss them first")
            schedules = connection.execute(of_schedules).scalar_one()
            if schedules:
                raise UploadInUseError(
                    f"{schedules} schedules need the upload {upload_id}: remove or change them first"
                )
            connection.execute(sa.delete(UPLOADS).where(one))

    def expired_uploads(self, now: dt.datetime) -> list[Upload]:
        """Uploads whose time is over and that no waiting or running job, no schedule and no stalled job needs."""
        planned = sa.exists(
            sa.select(SCHEDULE_UPLOADS.c.schedule_id).where(SCHEDULE_UPLOADS.c.upload_id == UPLOADS.c.upload_id)
        )
        needed = sa.exists(
            sa.select(JOBS.c.job_id)
            .join(JOB_UPLOADS, JOB_UPLOADS.c.job_id == JOBS.c.job_id)
            .where(
                JOB_UPLOADS.c.upload_id == UPLOADS.c.upload_id,
                sa.or_(JOBS.c.status.in_(_NOT_OVER), JOBS.c.inputs_until > now),
            )
        )
        old = sa.select(UPLOADS).where(UPLOADS.c.expires_at <= now, ~needed, ~planned).order_by(UPLOADS.c.expires_at)
        with self._database.read() as connection:
            return [from_row(Upload, row) for row in connection.execute(old)]

    def upload_ids(self) -> set[str]:
        """Ids of all uploads."""
        with self._database.read() as connection:
            return set(connection.execute(sa.select(UPLOADS.c.upload_id)).scalars())


@contextlib.contextmanager
def creating(
    database: Database, delivery: Delivery[Made] | None
) -> Iterator[tuple[Connection, Callable[[Made], Made]]]:
    """A transaction in which a thing is made, with its uploads and the answer under its key.

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
                lock(connection, LOCK_SUBMISSIONS)
                _check_quota(connection, delivery.uploads, delivery.max_upload_bytes, delivery.max_uploads)
            for upload in delivery.uploads:
                _add(connection, upload)

        def made(thing: Made) -> Made:
            if delivery is not None and delivery.claim is not None and delivery.answer is not None:
                answer, now = delivery.answer(thing), database.now(connection)
                idempotency.keep(connection, delivery.claim, answer, now=now, kept_s=delivery.kept_s)
            return thing

        yield connection, made


def _add(connection: Connection, upload: Upload) -> None:
    connection.execute(
        sa.insert(UPLOADS).values(
            upload_id=upload.upload_id,
            owner=upload.owner,
            filename=storable(upload.filename, 255),
            size_bytes=upload.size_bytes,
            sha256=upload.sha256,
            created_at=upload.created_at,
            expires_at=upload.expires_at,
            preflight=dict(upload.preflight),
        )
    )


def _stored_bytes(connection: Connection, owner: str | None) -> int:
    own = sa.select(sa.func.coalesce(sa.func.sum(UPLOADS.c.size_bytes), 0))
    return int(connection.execute(own.where(UPLOADS.c.owner.is_not_distinct_from(owner))).scalar_one())


def _check_quota(connection: Connection, added: Sequence[Upload], most_bytes: int, most: int) -> None:
    """Refuse uploads of one owner that exceed its quota; 0 stands for no limit."""
    owner = added[0].owner
    stored, more = _stored_bytes(connection, owner), sum(upload.size_bytes for upload in added)
    if most_bytes and stored + more > most_bytes:
        raise QuotaError(stored, more, most_bytes)
    own = sa.select(sa.func.count()).select_from(UPLOADS).where(UPLOADS.c.owner.is_not_distinct_from(owner))
    if most and connection.execute(own).scalar_one() + len(added) > most:
        raise TooManyUploadsError.stored(most)
