"""The spans of the service: requests, jobs over all their attempts, webhooks.

A job's span ends with the job, maybe in another process than the one that began it. Its id is therefore made from that
of the job: every attempt knows it. The trace is that of the request that submitted the job; without one it is made
from the job's id, too.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from pipeline.runtime.monitoring import tracing
from pipeline.runtime.monitoring.tracing import Parent
from service.jobs import Job, JobStatus

if TYPE_CHECKING:
    from fastapi.telemetry import TelemetryConfig

_UNTRACED = frozenset({"/healthz", "/readyz", "/metrics"})
"""Paths that probes ask for again and again."""


def telemetry() -> TelemetryConfig:
    """The framework's own spans of requests; its other telemetry is off."""
    if not tracing.is_on():
        return {"tracing": False, "metrics": False, "logs": False}
    return {
        "tracer_provider": tracing.provider(),
        "metrics": False,
        "logs": False,
        "operation_spans": False,
        "exclude": lambda scope: scope["path"] in _UNTRACED,
    }


def of_job(job: Job) -> Parent | None:
    """The span of a job; None while traces are off."""
    if not tracing.is_on():
        return None
    request = Parent.of(job.traceparent)
    span_id = int(job.job_id[:16], 16) or 1
    if request is not None:
        return Parent(request.trace_id, span_id, request.is_sampled)
    trace_id = int(job.job_id, 16) or 1
    return Parent(trace_id, span_id, tracing.is_sampled(trace_id))


@contextlib.contextmanager
def attempt(job: Job, driver: str) -> Iterator[Any]:
    """The span of an attempt."""
    facts: dict[str, Any] = {
        "job_id": job.job_id,
        "attempt": job.attempt,
        "driver": driver,
        "process": job.request.process_id,
    }
    with tracing.span("attempt", parent=of_job(job), **facts) as made:
        yield made


def job_ended(job: Job, status: JobStatus) -> None:
    """Make the span of a job that is over."""
    own = of_job(job)
    if own is not None:
        error = status.value if status is JobStatus.FAILED else None
        facts = {"job_id": job.job_id, "status": status.value, "attempts": job.attempt, "schedule": job.schedule_id}
        facts["process"] = job.request.process_id
        tracing.own_span("job", own, Parent.of(job.traceparent), job.created_at.timestamp(), error=error, **facts)
