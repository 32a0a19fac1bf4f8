"""The trace in which a job was submitted.

Revision ID: 0009
Revises: 0008
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column; jobs of before belong to no trace."""
    op.add_column("jobs", sa.Column("traceparent", sa.String(55), nullable=True))
