"""Jobs, events, uploads, schedules and keys in SQL: SQLite by default, the same code on PostgreSQL."""

from service.store.deadline import RequestDeadline
from service.store.job_store import JobStore
from service.store.queries import JobFilter
from service.store.schedule_store import ScheduleFilter
from service.store.webhook_store import DeliveryFilter

__all__ = ["DeliveryFilter", "JobFilter", "JobStore", "RequestDeadline", "ScheduleFilter"]
