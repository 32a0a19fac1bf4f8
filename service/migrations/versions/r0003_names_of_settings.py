"""Renames settings in the stored requests of jobs and schedules: bounds are called `min_` and `max_`.

Revision ID: 0003
Revises: 0002
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import sqlalchemy as sa
from alembic import op

from pipeline.renamed_settings import RENAMED

revision = "0003"
down_revision = "0002"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Write the new names."""
    connection = op.get_bind()
    for table, key in (("jobs", "job_id"), ("schedules", "schedule_id")):
        rows = sa.table(table, sa.column(key), sa.column("request", sa.JSON))
        for identity, request in connection.execute(sa.select(rows.c[key], rows.c.request)).all():
            settings = request.get("settings", {})
            renamed = {section: _renamed(values) for section, values in settings.items()}
            if renamed != settings:
                changed = request | {"settings": renamed}
                connection.execute(sa.update(rows).where(rows.c[key] == identity).values(request=changed))


def _renamed(values: Any) -> Any:
    """A table of settings with the new names; a general setting as it is."""
    if not isinstance(values, Mapping):
        return values
    return {RENAMED.get(name, name): value for name, value in values.items()}
