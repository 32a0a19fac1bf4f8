"""Webhooks that do not keep up: events are stored once, and each webhook has its place in them.

Revision ID: 0011
Revises: 0010
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"
branch_labels = None
depends_on = None

_TIME = sa.DateTime(timezone=True)
_INDEXES = (
    ("by_room", ["state", "endpoint_id"], False),
    ("by_event", ["event_id", "endpoint_id"], True),
    ("by_replay", ["replay_at", "endpoint_id"], False),
)


def upgrade() -> None:
    """Make the table and the columns; deliveries of before keep the job as it was in their own row."""
    op.create_table(
        "webhook_events",
        sa.Column("event_id", sa.String(32), primary_key=True),
        sa.Column("job_id", sa.String(32), nullable=False),
        sa.Column("owner", sa.String(64), nullable=True),
        sa.Column("event", sa.String(32), nullable=False),
        sa.Column("at", _TIME, nullable=False),
        sa.Column("snapshot", sa.JSON, nullable=False),
        sa.Column("base", sa.Text, nullable=True),
        sa.Column("body", sa.Text, nullable=True),
    )
    op.create_index("webhook_events_by_age", "webhook_events", ["at", "event_id"])
    op.create_index("webhook_events_by_job", "webhook_events", ["job_id", "event", "at"])
    op.add_column("webhook_deliveries", sa.Column("event_id", sa.String(32), nullable=True))
    op.add_column("webhook_deliveries", sa.Column("replay_at", _TIME, nullable=True))
    for name, columns, is_unique in _INDEXES:
        op.create_index(f"webhook_deliveries_{name}", "webhook_deliveries", columns, unique=is_unique)
    op.add_column("webhooks", sa.Column("owner", sa.String(64), nullable=True))
    op.add_column("webhooks", sa.Column("sent_until", _TIME, nullable=True))
    op.add_column("webhooks", sa.Column("is_behind", sa.Boolean, nullable=False, server_default=sa.false()))
    op.add_column("webhooks", sa.Column("paused_at", _TIME, nullable=True))
    # there are no events yet, so any time that has passed is right
    op.execute("UPDATE webhooks SET sent_until = updated_at")
