"""Decisions about jobs, as pure functions; the time is an argument."""

from __future__ import annotations

import datetime as dt

from service.jobs import Fault, Job, JobFailure, JobStatus


def lease_expired(job: Job, now: dt.datetime) -> bool:
    """Whether the driver that holds a job was silent for too long: from the very end of the lease on.

    Examples
    --------
    A job without a holder has no lease that could expire.
    """
    return job.status is JobStatus.RUNNING and job.lease_until is not None and job.lease_until <= now


def after_loss(job: Job, max_attempts: int) -> JobStatus:
    """The next status of a job whose driver was lost.

    Parameters
    ----------
    job : Job
        As it was when the driver was lost; `lost_attempts` does not count this loss yet.
    max_attempts : int
        Number of losses after which a job fails.

    Returns
    -------
    JobStatus
        Dismissed if that was requested, failed if it was lost too often, otherwise accepted: it waits again.
    """
    if job.dismiss_requested:
        return JobStatus.DISMISSED
    return JobStatus.FAILED if job.lost_attempts + 1 >= max_attempts else JobStatus.ACCEPTED


def loss(job: Job) -> JobFailure:
    """The failure of a job that was lost too often."""
    times = job.lost_attempts + 1
    drivers = "a driver was" if times == 1 else f"{times} drivers were"
    stage = f" (the last one at stage {job.stage})" if job.stage else ""
    return JobFailure(
        fault=Fault.LOST,
        detail=f"{drivers} lost during this job{stage}, so it is not tried again. It may need more memory than the "
        "driver's machine has: submit it with fewer or smaller tiles, or ask the operator for the driver's log",
    )


def duration_ms(job: Job, now: dt.datetime) -> int | None:
    """Milliseconds from the first claim to now; None for a job that was never claimed."""
    return None if job.started_at is None else max(0, round((now - job.started_at).total_seconds() * 1000))
