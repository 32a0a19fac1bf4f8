"""What Alembic runs to reach the database: the connection is handed in by `service.migrations.upgrade`."""

from __future__ import annotations

from alembic import context


def _run() -> None:
    context.configure(connection=context.config.attributes["connection"])
    with context.begin_transaction():
        context.run_migrations()


_run()
