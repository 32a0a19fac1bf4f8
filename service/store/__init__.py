"""Jobs, events, uploads and keys in SQL: SQLite by default, the same code on PostgreSQL."""

from service.store.job_store import JobStore
from service.store.queries import JobFilter

__all__ = ["JobFilter", "JobStore"]
