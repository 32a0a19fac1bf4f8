"""The programs that tests start."""

from processes import postgres_server, postgres_url, programs

__all__ = ["postgres_server", "postgres_url", "programs"]
