"""The database's tables, revision by revision (Alembic), run from code: no ini file is needed anywhere.

Revisions only go forward: an earlier version works with a backup that was made before the update.
"""

from __future__ import annotations

import functools
from pathlib import Path

from alembic import command
from alembic.config import Config
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Connection


def _config() -> Config:
    config = Config()
    # a percent sign in the path would be read as the start of an interpolation
    config.set_main_option("script_location", str(Path(__file__).parent).replace("%", "%%"))
    return config


@functools.cache
def head() -> str:
    """The revision that this version of the program works with."""
    revision = ScriptDirectory.from_config(_config()).get_current_head()
    assert revision is not None
    return revision


@functools.cache
def known() -> frozenset[str]:
    """All revisions that this version of the program knows."""
    return frozenset(script.revision for script in ScriptDirectory.from_config(_config()).walk_revisions())


def current(connection: Connection) -> str | None:
    """The revision of the database; None if it has none of our tables."""
    return MigrationContext.configure(connection).get_current_revision()


def upgrade(connection: Connection) -> None:
    """Bring the tables to `head`, within the connection's own transaction.

    Parameters
    ----------
    connection : sqlalchemy.Connection
        In a transaction that excludes all other migrations; the caller commits.
    """
    config = _config()
    config.attributes["connection"] = connection
    command.upgrade(config, "head")
