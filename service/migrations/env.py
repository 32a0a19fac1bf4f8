"""Alembic's script to reach the database; `service.migrations.upgrade` passes the connection in."""

from __future__ import annotations

from alembic import context


def _run() -> None:
    context.configure(connection=context.config.attributes["connection"])
    with context.begin_transaction():
        context.run_migrations()


_run()
