"""Uploads and keys in the database. Within a transaction."""

from __future__ import annotations

import datetime as dt
from collections.abc import Sequence

import sqlalchemy as sa
from sqlalchemy.engine import Connection

from service.errors import NoSuchUploadError, QuotaError, TooManyUploadsError, UploadInUseError
from service.files import is_id
from service.jobs import JobStatus, Upload
from service.store.records import storable, upload_of
from service.store.tables import JOB_UPLOADS, JOBS, SCHEDULE_UPLOADS, UPLOADS

_NOT_OVER = [status.value for status in JobStatus if not status.is_over]


def add(connection: Connection, upload: Upload) -> None:
    """Store the record of an upload."""
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


def stored_bytes(connection: Connection, owner: str | None) -> int:
    """Bytes of all uploads of a key, or of all that belong to none."""
    own = sa.select(sa.func.coalesce(sa.func.sum(UPLOADS.c.size_bytes), 0)).where(
        UPLOADS.c.owner.is_not_distinct_from(owner)
    )
    return int(connection.execute(own).scalar_one())


def check_quota(connection: Connection, added: Sequence[Upload], most_bytes: int, most: int) -> None:
    """Refuse uploads of one owner that exceed its quota; 0 stands for no limit.

    Raises
    ------
    QuotaError
        They have too many bytes.
    TooManyUploadsError
        They are too many.
    """
    owner = added[0].owner
    stored, more = stored_bytes(connection, owner), sum(upload.size_bytes for upload in added)
    if most_bytes and stored + more > most_bytes:
        raise QuotaError(stored, more, most_bytes)
    own = sa.select(sa.func.count()).select_from(UPLOADS).where(UPLOADS.c.owner.is_not_distinct_from(owner))
    if most and connection.execute(own).scalar_one() + len(added) > most:
        raise TooManyUploadsError.stored(most)


def get(connection: Connection, upload_id: str, owner: str | None) -> Upload:
    """One upload.

    Raises
    ------
    NoSuchUploadError
        It does not exist, or belongs to another key.
    """
    one = sa.select(UPLOADS).where(UPLOADS.c.upload_id == upload_id)
    row = connection.execute(one).one_or_none() if is_id(upload_id) else None
    if row is None or (owner is not None and row.owner != owner):
        raise NoSuchUploadError(f"there is no upload {upload_id[:64]!r} (any more)")
    return upload_of(row)


def listed(connection: Connection, owner: str | None, limit: int, offset: int) -> list[Upload]:
    """Uploads, newest first; with an owner only its own."""
    chosen = sa.select(UPLOADS).order_by(UPLOADS.c.created_at.desc(), UPLOADS.c.upload_id.desc())
    if owner is not None:
        chosen = chosen.where(UPLOADS.c.owner == owner)
    return [upload_of(row) for row in connection.execute(chosen.limit(limit).offset(offset))]


def remove(connection: Connection, upload_id: str) -> None:
    """Delete an upload; one that does not exist is ignored.

    Raises
    ------
    UploadInUseError
        Jobs that wait or run, or schedules, need it.
    """
    if not is_id(upload_id):
        return
    connection.execute(sa.select(UPLOADS).where(UPLOADS.c.upload_id == upload_id).with_for_update())
    # a statement of its own: only now it sees the jobs that were submitted while we waited
    jobs = connection.execute(sa.select(sa.func.count()).select_from(_needed(upload_id).subquery())).scalar_one()
    if jobs:
        raise UploadInUseError(f"{jobs} jobs that are not over need the upload {upload_id}: dismiss them first")
    planned = sa.select(sa.func.count()).where(SCHEDULE_UPLOADS.c.upload_id == upload_id)
    schedules = connection.execute(planned).scalar_one()
    if schedules:
        raise UploadInUseError(f"{schedules} schedules need the upload {upload_id}: remove or change them first")
    connection.execute(sa.delete(UPLOADS).where(UPLOADS.c.upload_id == upload_id))


def expired(connection: Connection, now: dt.datetime) -> list[Upload]:
    """Uploads whose time is over and that no waiting or running job and no schedule needs, nor one that stood still."""
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
    return [upload_of(row) for row in connection.execute(old)]


def known(connection: Connection) -> set[str]:
    """Ids of all uploads."""
    return set(connection.execute(sa.select(UPLOADS.c.upload_id)).scalars())


def _needed(upload_id: str) -> sa.Select[tuple[str]]:
    return (
        sa.select(JOBS.c.job_id)
        .join(JOB_UPLOADS, JOB_UPLOADS.c.job_id == JOBS.c.job_id)
        .where(JOB_UPLOADS.c.upload_id == upload_id, JOBS.c.status.in_(_NOT_OVER))
    )
