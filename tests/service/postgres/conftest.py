"""A PostgreSQL server for the tests of this folder."""

from processes import postgres_server, postgres_url

__all__ = ["postgres_server", "postgres_url"]
