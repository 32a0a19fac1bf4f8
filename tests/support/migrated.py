"""Databases that have their tables already: making them revision by revision takes longer than most tests.

The revisions themselves are run by the tests of the store that begin with an empty database, by `live_service`, and by
every service that runs as a process.
"""

import functools
import tempfile
from pathlib import Path

from service.store import JobStore


@functools.cache
def _template() -> bytes:
    """A SQLite database with all tables and nothing in them, made once a process."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "service.db")
        with JobStore(f"sqlite:///{path}") as store:
            store.migrate()
        return path.read_bytes()


def with_tables(url: str) -> str:
    """The URL of a SQLite database, which is there with its tables then; one that is there already stays as it is."""
    path = Path(url.removeprefix("sqlite:///"))
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(_template())
    return url
