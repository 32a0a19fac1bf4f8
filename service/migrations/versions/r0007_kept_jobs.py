"""Jobs that are kept, whatever their age and size.

Revision ID: 0007
Revises: 0006
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0007"
down_revision = "0006"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Add the column; no job of before is kept."""
    op.add_column("jobs", sa.Column("keep", sa.Boolean, nullable=False, server_default=sa.false()))
