"""The tables, as made by `service.migrations`; a test compares the two."""

from __future__ import annotations

import datetime as dt

import sqlalchemy as sa
from sqlalchemy.engine import Dialect

METADATA = sa.MetaData()


class UtcTime(sa.types.TypeDecorator[dt.datetime]):
    """A time with a time zone. SQLite stores it as UTC and returns UTC."""

    impl = sa.DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: dt.datetime | None, dialect: Dialect) -> dt.datetime | None:
        """To UTC.

        Raises
        ------
        ValueError
            The time has no time zone.
        """
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError(f"{value} has no time zone")
        utc = value.astimezone(dt.UTC)
        return utc.replace(tzinfo=None) if dialect.name == "sqlite" else utc

    def process_result_value(self, value: dt.datetime | None, dialect: Dialect) -> dt.datetime | None:
        """From what is stored, in UTC."""
        del dialect
        if value is None:
            return None
        return value.replace(tzinfo=dt.UTC) if value.tzinfo is None else value.astimezone(dt.UTC)


JOBS = sa.Table(
    "jobs",
    METADATA,
    sa.Column("job_id", sa.String(32), primary_key=True),
    sa.Column("owner", sa.String(64)),
    sa.Column("process_id", sa.String(64), nullable=False),
    sa.Column("request", sa.JSON, nullable=False),
    sa.Column("status", sa.String(16), nullable=False),
    sa.Column("priority", sa.Integer, nullable=False),
    sa.Column("message", sa.Text, nullable=False),
    sa.Column("progress", sa.Integer, nullable=False),
    sa.Column("stage", sa.String(64), nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("started_at", UtcTime),
    sa.Column("finished_at", UtcTime),
    sa.Column("updated_at", UtcTime, nullable=False),
    sa.Column("duration_ms", sa.BigInteger),
    sa.Column("not_before", UtcTime),
    sa.Column("dismiss_requested", sa.Boolean, nullable=False),
    sa.Column("attempt", sa.Integer, nullable=False),
    sa.Column("lost_attempts", sa.Integer, nullable=False),
    sa.Column("lease_owner", sa.String(255)),
    sa.Column("lease_until", UtcTime),
    sa.Column("fault", sa.String(16)),
    sa.Column("fault_detail", sa.Text),
    sa.Column("summary", sa.JSON(none_as_null=True)),
    sa.Column("last_event", sa.Integer, nullable=False),
    sa.Column("schedule_id", sa.String(32)),
    sa.Column("keep", sa.Boolean, nullable=False, server_default=sa.false()),
    sa.Column("watched_at", UtcTime),
    sa.Column("last_log_line", sa.Integer, nullable=False, server_default="0"),
    sa.Column("traceparent", sa.String(55)),
    sa.Column("own_ends", sa.Integer, nullable=False, server_default="0"),
    sa.Column("own_end_stage", sa.String(64), nullable=False, server_default=""),
    sa.Column("other_ends", sa.Integer, nullable=False, server_default="0"),
    sa.Column("progress_due_at", UtcTime),
    sa.Column("inputs_until", UtcTime),
)
"""One row per job. `duration_ms` is set when a job that was started is over; `last_event` counts its events,
`last_log_line` the lines of its log. A running job counts as stalled after `progress_due_at`; the inputs of a failed
one are kept until `inputs_until`.

`schedule_id` is not a foreign key: a job stays when its schedule is removed, and still names it.
"""

sa.Index("jobs_in_line", JOBS.c.status, JOBS.c.priority.desc(), JOBS.c.created_at, JOBS.c.job_id)
sa.Index("jobs_by_lease", JOBS.c.status, JOBS.c.lease_until)
sa.Index("jobs_by_age", JOBS.c.created_at, JOBS.c.job_id)
sa.Index("jobs_by_owner", JOBS.c.owner, JOBS.c.created_at)
sa.Index("jobs_by_schedule", JOBS.c.schedule_id, JOBS.c.status)

EVENTS = sa.Table(
    "job_events",
    METADATA,
    sa.Column("job_id", sa.String(32), sa.ForeignKey("jobs.job_id", ondelete="CASCADE"), primary_key=True),
    sa.Column("sequence", sa.Integer, primary_key=True),
    sa.Column("at", UtcTime, nullable=False),
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("status", sa.String(16)),
    sa.Column("stage", sa.String(64), nullable=False),
    sa.Column("done", sa.BigInteger, nullable=False),
    sa.Column("total", sa.BigInteger, nullable=False),
    sa.Column("progress", sa.Integer, nullable=False),
    sa.Column("message", sa.Text, nullable=False),
)
"""One row per event of a job."""

LOG_LINES = sa.Table(
    "job_log",
    METADATA,
    sa.Column("job_id", sa.String(32), sa.ForeignKey("jobs.job_id", ondelete="CASCADE"), primary_key=True),
    sa.Column("number", sa.Integer, primary_key=True),
    sa.Column("at", UtcTime, nullable=False),
    sa.Column("level", sa.String(16), nullable=False),
    sa.Column("attempt", sa.Integer, nullable=False),
    sa.Column("stage", sa.String(64), nullable=False),
    sa.Column("message", sa.Text, nullable=False),
    sa.Column("facts", sa.JSON(none_as_null=True)),
)
"""One row per line of a job's log."""

UPLOADS = sa.Table(
    "uploads",
    METADATA,
    sa.Column("upload_id", sa.String(32), primary_key=True),
    sa.Column("owner", sa.String(64)),
    sa.Column("filename", sa.String(255), nullable=False),
    sa.Column("size_bytes", sa.BigInteger, nullable=False),
    sa.Column("sha256", sa.String(64), nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("expires_at", UtcTime, nullable=False),
    sa.Column("preflight", sa.JSON, nullable=False),
)
"""One row per file that a client sent."""

sa.Index("uploads_by_expiry", UPLOADS.c.expires_at)

JOB_UPLOADS = sa.Table(
    "job_uploads",
    METADATA,
    sa.Column("job_id", sa.String(32), sa.ForeignKey("jobs.job_id", ondelete="CASCADE"), primary_key=True),
    sa.Column("upload_id", sa.String(32), primary_key=True),
)
"""One row per job and upload that it reads; not a foreign key, since an upload may be removed after the job."""

sa.Index("job_uploads_by_upload", JOB_UPLOADS.c.upload_id)

KEYS = sa.Table(
    "keys",
    METADATA,
    sa.Column("key_id", sa.String(32), primary_key=True),
    sa.Column("name", sa.Text, nullable=False),
    sa.Column("digest", sa.String(64), nullable=False, unique=True),
    sa.Column("scopes", sa.JSON, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("revoked_at", UtcTime),
    sa.Column("expires_at", UtcTime),
    sa.Column("old_digest", sa.String(64)),
    sa.Column("old_until", UtcTime),
    sa.Index("keys_by_old_digest", "old_digest", unique=True),
)
"""One row per key; the key itself is not stored."""

IDEMPOTENCY_KEYS = sa.Table(
    "idempotency_keys",
    METADATA,
    sa.Column("owner", sa.String(64), primary_key=True),
    sa.Column("key", sa.String(255), primary_key=True),
    sa.Column("token", sa.String(32), nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("until", UtcTime, nullable=False),
    sa.Column("fingerprint", sa.String(64)),
    sa.Column("size_bytes", sa.BigInteger),
    sa.Column("status", sa.Integer),
    sa.Column("headers", sa.JSON(none_as_null=True)),
    sa.Column("body", sa.Text),
)
"""One row per key of a request, by API key. Without a status the request is under way: its claim ends at `until`.

With a status, `until` is the time at which the kept answer is deleted.
"""

sa.Index("idempotency_keys_by_end", IDEMPOTENCY_KEYS.c.until)

SCHEDULES = sa.Table(
    "schedules",
    METADATA,
    sa.Column("schedule_id", sa.String(32), primary_key=True),
    sa.Column("owner", sa.String(64)),
    sa.Column("title", sa.Text),
    sa.Column("cron", sa.String(200), nullable=False),
    sa.Column("time_zone", sa.String(128), nullable=False),
    sa.Column("process_id", sa.String(64), nullable=False),
    sa.Column("request", sa.JSON, nullable=False),
    sa.Column("priority", sa.Integer, nullable=False),
    sa.Column("missed", sa.String(16), nullable=False),
    sa.Column("grace_s", sa.Float, nullable=False),
    sa.Column("overlap", sa.String(16), nullable=False),
    sa.Column("is_paused", sa.Boolean, nullable=False),
    sa.Column("version", sa.Integer, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
    sa.Column("decided_until", UtcTime, nullable=False),
    sa.Column("next_at", UtcTime),
    sa.Column("waiting_slot", UtcTime),
    sa.Column("last_number", sa.Integer, nullable=False),
    sa.Column("submitted", sa.BigInteger, nullable=False),
    sa.Column("skipped", sa.BigInteger, nullable=False),
    sa.Column("missed_slots", sa.BigInteger, nullable=False),
    sa.Column("failed", sa.BigInteger, nullable=False),
)
"""One row per schedule. `last_number` counts its entries; the four last columns count its slots by outcome."""

sa.Index("schedules_by_next", SCHEDULES.c.next_at)
sa.Index("schedules_by_age", SCHEDULES.c.created_at, SCHEDULES.c.schedule_id)
sa.Index("schedules_by_owner", SCHEDULES.c.owner, SCHEDULES.c.created_at)

SCHEDULE_RUNS = sa.Table(
    "schedule_runs",
    METADATA,
    sa.Column(
        "schedule_id", sa.String(32), sa.ForeignKey("schedules.schedule_id", ondelete="CASCADE"), primary_key=True
    ),
    sa.Column("number", sa.Integer, primary_key=True),
    sa.Column("trigger", sa.String(16), nullable=False),
    sa.Column("outcome", sa.String(16), nullable=False),
    sa.Column("slot", UtcTime),
    sa.Column("first_slot", UtcTime),
    sa.Column("slots", sa.Integer, nullable=False),
    sa.Column("is_counted", sa.Boolean, nullable=False),
    sa.Column("job_id", sa.String(32)),
    sa.Column("at", UtcTime, nullable=False),
    sa.Column("message", sa.Text, nullable=False),
    sa.UniqueConstraint("schedule_id", "slot", name="one_fate_a_slot"),
)
"""The history of schedules. A run by hand has no slot. No slot can be decided twice."""

SCHEDULE_UPLOADS = sa.Table(
    "schedule_uploads",
    METADATA,
    sa.Column(
        "schedule_id", sa.String(32), sa.ForeignKey("schedules.schedule_id", ondelete="CASCADE"), primary_key=True
    ),
    sa.Column("upload_id", sa.String(32), primary_key=True),
)
"""One row per schedule and upload that it needs."""

sa.Index("schedule_uploads_by_upload", SCHEDULE_UPLOADS.c.upload_id)

WEBHOOKS = sa.Table(
    "webhooks",
    METADATA,
    sa.Column("endpoint_id", sa.String(32), primary_key=True),
    sa.Column("url", sa.Text, nullable=False),
    sa.Column("events", sa.JSON, nullable=False),
    sa.Column("description", sa.Text),
    sa.Column("is_enabled", sa.Boolean, nullable=False),
    sa.Column("disabled_reason", sa.Text),
    sa.Column("base", sa.Text, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("updated_at", UtcTime, nullable=False),
    sa.Column("secret", sa.String(64), nullable=False),
    sa.Column("changed_at", UtcTime, nullable=False),
    sa.Column("owner", sa.String(64)),
)
"""One row per endpoint that gets the events of all jobs. Secrets are stored, since they sign."""

WEBHOOK_SECRETS = sa.Table(
    "webhook_secrets",
    METADATA,
    sa.Column("owner", sa.String(64), primary_key=True),
    sa.Column("secret", sa.String(64), nullable=False),
    sa.Column("changed_at", UtcTime, nullable=False),
)
"""One row per key whose subscribers get signed messages; the owner is empty if keys are not used."""

WEBHOOK_DELIVERIES = sa.Table(
    "webhook_deliveries",
    METADATA,
    sa.Column("delivery_id", sa.String(32), primary_key=True),
    sa.Column("endpoint_id", sa.String(32)),
    sa.Column("job_id", sa.String(32), nullable=False),
    sa.Column("owner", sa.String(64)),
    sa.Column("url", sa.Text, nullable=False),
    sa.Column("base", sa.Text, nullable=False),
    sa.Column("event", sa.String(32), nullable=False),
    sa.Column("body", sa.Text),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("reason", sa.Text),
    sa.Column("attempts", sa.Integer, nullable=False),
    sa.Column("created_at", UtcTime, nullable=False),
    sa.Column("tried_since", UtcTime, nullable=False),
    sa.Column("due_at", UtcTime),
    sa.Column("finished_at", UtcTime),
    sa.Column("lease_owner", sa.String(255)),
    sa.Column("lease_until", UtcTime),
    sa.Column("event_id", sa.String(32)),
)
"""One row per message and receiver: the outbox, and later the log. Not tied to jobs, which may be removed before."""

sa.Index("webhook_deliveries_in_line", WEBHOOK_DELIVERIES.c.state, WEBHOOK_DELIVERIES.c.due_at)
sa.Index("webhook_deliveries_by_lease", WEBHOOK_DELIVERIES.c.lease_until)
sa.Index("webhook_deliveries_by_job", WEBHOOK_DELIVERIES.c.job_id)
sa.Index("webhook_deliveries_by_endpoint", WEBHOOK_DELIVERIES.c.endpoint_id, WEBHOOK_DELIVERIES.c.state)
sa.Index("webhook_deliveries_by_age", WEBHOOK_DELIVERIES.c.created_at, WEBHOOK_DELIVERIES.c.delivery_id)
sa.Index("webhook_deliveries_by_owner", WEBHOOK_DELIVERIES.c.owner, WEBHOOK_DELIVERIES.c.created_at)
sa.Index("webhook_deliveries_by_end", WEBHOOK_DELIVERIES.c.finished_at)
sa.Index("webhook_deliveries_by_room", WEBHOOK_DELIVERIES.c.state, WEBHOOK_DELIVERIES.c.endpoint_id)
sa.Index("webhook_deliveries_by_event", WEBHOOK_DELIVERIES.c.event_id, WEBHOOK_DELIVERIES.c.endpoint_id, unique=True)

WEBHOOK_EVENTS = sa.Table(
    "webhook_events",
    METADATA,
    sa.Column("event_id", sa.String(32), primary_key=True),
    sa.Column("job_id", sa.String(32), nullable=False),
    sa.Column("owner", sa.String(64)),
    sa.Column("event", sa.String(32), nullable=False),
    sa.Column("at", UtcTime, nullable=False),
    sa.Column("snapshot", sa.JSON, nullable=False),
)
"""One row per event of a job that a receiver wants, however many they are; it has the job as it was."""

sa.Index("webhook_events_by_age", WEBHOOK_EVENTS.c.at, WEBHOOK_EVENTS.c.event_id)
sa.Index("webhook_events_by_job", WEBHOOK_EVENTS.c.job_id, WEBHOOK_EVENTS.c.event, WEBHOOK_EVENTS.c.at)

WEBHOOK_ATTEMPTS = sa.Table(
    "webhook_attempts",
    METADATA,
    sa.Column(
        "delivery_id",
        sa.String(32),
        sa.ForeignKey("webhook_deliveries.delivery_id", ondelete="CASCADE"),
        primary_key=True,
    ),
    sa.Column("number", sa.Integer, primary_key=True),
    sa.Column("at", UtcTime, nullable=False),
    sa.Column("driver", sa.String(255), nullable=False),
    sa.Column("duration_ms", sa.BigInteger),
    sa.Column("status", sa.Integer),
    sa.Column("error", sa.Text),
)
"""One row per attempt, written before it begins."""
