"""Schedules, the history of their slots, and the uploads that they need; the schedule that made a job.

Revision ID: 0002
Revises: 0001
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

_TIME = sa.DateTime(timezone=True)


def upgrade() -> None:
    """Make the tables, and the column of jobs."""
    op.create_table(
        "schedules",
        sa.Column("schedule_id", sa.String(32), primary_key=True),
        sa.Column("owner", sa.String(64), nullable=True),
        sa.Column("title", sa.Text, nullable=True),
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
        sa.Column("created_at", _TIME, nullable=False),
        sa.Column("updated_at", _TIME, nullable=False),
        sa.Column("decided_until", _TIME, nullable=False),
        sa.Column("next_at", _TIME, nullable=True),
        sa.Column("waiting_slot", _TIME, nullable=True),
        sa.Column("last_number", sa.Integer, nullable=False),
        sa.Column("submitted", sa.BigInteger, nullable=False),
        sa.Column("skipped", sa.BigInteger, nullable=False),
        sa.Column("missed_slots", sa.BigInteger, nullable=False),
        sa.Column("failed", sa.BigInteger, nullable=False),
        sa.CheckConstraint("is_paused = (next_at IS NULL)", name="only_paused_is_never_due"),
        sa.CheckConstraint("NOT (is_paused AND waiting_slot IS NOT NULL)", name="nothing_waits_while_paused"),
    )
    op.create_index("schedules_by_next", "schedules", ["next_at"])
    op.create_index("schedules_by_age", "schedules", ["created_at", "schedule_id"])
    op.create_index("schedules_by_owner", "schedules", ["owner", "created_at"])
    op.create_table(
        "schedule_runs",
        sa.Column(
            "schedule_id", sa.String(32), sa.ForeignKey("schedules.schedule_id", ondelete="CASCADE"), primary_key=True
        ),
        sa.Column("number", sa.Integer, primary_key=True),
        sa.Column("trigger", sa.String(16), nullable=False),
        sa.Column("outcome", sa.String(16), nullable=False),
        sa.Column("slot", _TIME, nullable=True),
        sa.Column("first_slot", _TIME, nullable=True),
        sa.Column("slots", sa.Integer, nullable=False),
        sa.Column("is_counted", sa.Boolean, nullable=False),
        sa.Column("job_id", sa.String(32), nullable=True),
        sa.Column("at", _TIME, nullable=False),
        sa.Column("message", sa.Text, nullable=False),
        sa.CheckConstraint(
            "outcome IN ('submitted', 'waiting', 'skipped', 'missed', 'failed')", name="outcome_is_known"
        ),
        sa.CheckConstraint("outcome <> 'submitted' OR job_id IS NOT NULL", name="submitted_has_job"),
        sa.CheckConstraint("slot IS NOT NULL OR trigger = 'hand'", name="clock_has_slot"),
        sa.UniqueConstraint("schedule_id", "slot", name="one_fate_a_slot"),
    )
    op.create_table(
        "schedule_uploads",
        sa.Column(
            "schedule_id", sa.String(32), sa.ForeignKey("schedules.schedule_id", ondelete="CASCADE"), primary_key=True
        ),
        sa.Column("upload_id", sa.String(32), primary_key=True),
    )
    op.create_index("schedule_uploads_by_upload", "schedule_uploads", ["upload_id"])
    op.add_column("jobs", sa.Column("schedule_id", sa.String(32), nullable=True))
    op.create_index("jobs_by_schedule", "jobs", ["schedule_id", "status"])
