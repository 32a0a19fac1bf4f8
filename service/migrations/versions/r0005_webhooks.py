"""Webhooks: endpoints, secrets, the outbox with its log.

Revision ID: 0005
Revises: 0004
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"
branch_labels = None
depends_on = None

_TIME = sa.DateTime(timezone=True)


def upgrade() -> None:
    """Make the tables."""
    op.create_table(
        "webhooks",
        sa.Column("endpoint_id", sa.String(32), primary_key=True),
        sa.Column("url", sa.Text, nullable=False),
        sa.Column("events", sa.JSON, nullable=False),
        sa.Column("description", sa.Text, nullable=True),
        sa.Column("is_enabled", sa.Boolean, nullable=False),
        sa.Column("disabled_reason", sa.Text, nullable=True),
        sa.Column("base", sa.Text, nullable=False),
        sa.Column("created_at", _TIME, nullable=False),
        sa.Column("updated_at", _TIME, nullable=False),
        *_secret(),
        sa.CheckConstraint("is_enabled = (disabled_reason IS NULL)", name="disabled_has_reason"),
    )
    op.create_table("webhook_secrets", sa.Column("owner", sa.String(64), primary_key=True), *_secret())
    op.create_table(
        "webhook_deliveries",
        sa.Column("delivery_id", sa.String(32), primary_key=True),
        sa.Column("endpoint_id", sa.String(32), nullable=True),
        sa.Column("job_id", sa.String(32), nullable=False),
        sa.Column("owner", sa.String(64), nullable=True),
        sa.Column("url", sa.Text, nullable=False),
        sa.Column("base", sa.Text, nullable=False),
        sa.Column("event", sa.String(32), nullable=False),
        sa.Column("snapshot", sa.JSON, nullable=False),
        sa.Column("body", sa.Text, nullable=True),
        sa.Column("state", sa.String(16), nullable=False),
        sa.Column("reason", sa.Text, nullable=True),
        sa.Column("attempts", sa.Integer, nullable=False),
        sa.Column("created_at", _TIME, nullable=False),
        sa.Column("tried_since", _TIME, nullable=False),
        sa.Column("due_at", _TIME, nullable=True),
        sa.Column("finished_at", _TIME, nullable=True),
        sa.Column("lease_owner", sa.String(255), nullable=True),
        sa.Column("lease_until", _TIME, nullable=True),
        sa.CheckConstraint("state IN ('waiting', 'delivered', 'failed', 'gone', 'dropped')", name="state_is_known"),
        sa.CheckConstraint("(state = 'waiting') = (due_at IS NOT NULL)", name="waiting_is_due"),
        sa.CheckConstraint("(state = 'waiting') = (finished_at IS NULL)", name="finished_has_time"),
        sa.CheckConstraint("(lease_owner IS NULL) = (lease_until IS NULL)", name="lease_of_delivery_is_whole"),
    )
    for name, columns in (
        ("in_line", ["state", "due_at"]),
        ("by_lease", ["lease_until"]),
        ("by_job", ["job_id"]),
        ("by_endpoint", ["endpoint_id", "state"]),
        ("by_age", ["created_at", "delivery_id"]),
        ("by_owner", ["owner", "created_at"]),
        ("by_end", ["finished_at"]),
    ):
        op.create_index(f"webhook_deliveries_{name}", "webhook_deliveries", columns)
    op.create_table(
        "webhook_attempts",
        sa.Column(
            "delivery_id",
            sa.String(32),
            sa.ForeignKey("webhook_deliveries.delivery_id", ondelete="CASCADE"),
            primary_key=True,
        ),
        sa.Column("number", sa.Integer, primary_key=True),
        sa.Column("at", _TIME, nullable=False),
        sa.Column("driver", sa.String(255), nullable=False),
        sa.Column("duration_ms", sa.BigInteger, nullable=True),
        sa.Column("status", sa.Integer, nullable=True),
        sa.Column("error", sa.Text, nullable=True),
    )


def _secret() -> list[sa.Column[object]]:
    """The columns of a secret and of the one that it replaced."""
    return [
        sa.Column("secret", sa.String(64), nullable=False),
        sa.Column("old_secret", sa.String(64), nullable=True),
        sa.Column("old_until", _TIME, nullable=True),
        sa.Column("changed_at", _TIME, nullable=False),
    ]
