"""Logs of jobs, and jobs whose buildings are read while they run.

Revision ID: 0008
Revises: 0007
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column and the table; jobs of before have no log."""
    op.add_column("jobs", sa.Column("watched_at", sa.DateTime(timezone=True), nullable=True))
    op.add_column("jobs", sa.Column("last_log_line", sa.Integer, nullable=False, server_default="0"))
    op.create_table(
        "job_log",
        sa.Column("job_id", sa.String(32), sa.ForeignKey("jobs.job_id", ondelete="CASCADE"), primary_key=True),
        sa.Column("number", sa.Integer, primary_key=True),
        sa.Column("at", sa.DateTime(timezone=True), nullable=False),
        sa.Column("level", sa.String(16), nullable=False),
        sa.Column("attempt", sa.Integer, nullable=False),
        sa.Column("stage", sa.String(64), nullable=False),
        sa.Column("message", sa.Text, nullable=False),
        sa.Column("facts", sa.JSON(none_as_null=True), nullable=True),
    )
