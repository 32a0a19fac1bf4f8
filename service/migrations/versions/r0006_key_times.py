"""Keys that expire, and keys whose secret was rotated.

Revision ID: 0006
Revises: 0005
"""

from __future__ import annotations

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

_COLUMNS = (
    ("expires_at", sa.DateTime(timezone=True)),
    ("old_digest", sa.String(64)),
    ("old_until", sa.DateTime(timezone=True)),
)


def upgrade() -> None:
    """Add the columns; keys of before never expire."""
    for name, kind in _COLUMNS:
        op.add_column("keys", sa.Column(name, kind, nullable=True))
    op.create_index("keys_by_old_digest", "keys", ["old_digest"], unique=True)
