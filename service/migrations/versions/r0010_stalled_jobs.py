"""Attempts that ended by themselves, the time by which a job must get somewhere, and how long its inputs are kept.

Revision ID: 0010
Revises: 0009
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the columns; no attempt of before ended by itself."""
    op.add_column("jobs", sa.Column("own_ends", sa.Integer, nullable=False, server_default="0"))
    op.add_column("jobs", sa.Column("own_end_stage", sa.String(64), nullable=False, server_default=""))
    op.add_column("jobs", sa.Column("other_ends", sa.Integer, nullable=False, server_default="0"))
    op.add_column("jobs", sa.Column("progress_due_at", sa.DateTime(timezone=True), nullable=True))
    op.add_column("jobs", sa.Column("inputs_until", sa.DateTime(timezone=True), nullable=True))
