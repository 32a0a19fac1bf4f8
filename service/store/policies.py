"""Decisions about jobs, as pure functions; the time is an argument."""

from __future__ import annotations

import datetime as dt

from service.jobs import EndedAttempt, Fault, Job, JobFailure, JobStatus

MAX_OTHER_ENDS = 20
"""Attempts that were killed from outside, or ended now in this stage, now in that, after which a job fails, too."""


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


def after_end(job: Job, ended: EndedAttempt, max_attempts: int) -> JobStatus:
    """The next status of a job after an attempt whose process ended before it.

    Parameters
    ----------
    job : Job
        As it was before; `own_ends` and `other_ends` do not count this end yet.
    ended : EndedAttempt
        The attempt.
    max_attempts : int
        Number of attempts in a row that may end by themselves in one stage.

    Returns
    -------
    JobStatus
        Dismissed if that was requested, failed after too many ends, otherwise accepted: it waits again.
    """
    if job.dismiss_requested:
        return JobStatus.DISMISSED
    is_last = own_ends(job, ended) >= max_attempts or other_ends(job, ended) >= MAX_OTHER_ENDS
    return JobStatus.FAILED if is_last else JobStatus.ACCEPTED


def own_ends(job: Job, ended: EndedAttempt) -> int:
    """Attempts in a row that ended by themselves in one stage, with this one: another stage means progress."""
    if not ended.is_own:
        return job.own_ends
    return job.own_ends + 1 if job.own_end_stage == ended.stage else 1


def other_ends(job: Job, ended: EndedAttempt) -> int:
    """Attempts that were killed from outside, or ended in another stage than the one before, with this one."""
    is_elsewhere = ended.is_own and job.own_ends > 0 and job.own_end_stage != ended.stage
    return job.other_ends + (is_elsewhere or not ended.is_own)


def standstill(job: Job, ended: EndedAttempt, kept_days: float) -> JobFailure:
    """The failure of a job whose attempts ended too often."""
    stage = f" at stage {ended.stage}" if ended.stage else ""
    others, times = other_ends(job, ended), own_ends(job, ended)
    if others >= MAX_OTHER_ENDS:
        what = f"{others} attempts were killed from outside, or ended now here, now there: the last one {ended.detail}"
    else:
        attempts = "an attempt" if times == 1 else f"{times} attempts in a row"
        what = f"{attempts} ended by themselves{stage}: the last one {ended.detail}"
    return JobFailure(
        fault=Fault.STALLED,
        detail=f"{what}, so the job is not tried again. Its inputs are kept for {kept_days:g} days. Ask the operator "
        "for the driver's log; only an operator's key, with the scope admin, may retry the job",
    )


def duration_ms(job: Job, now: dt.datetime) -> int | None:
    """Milliseconds from the first claim to now; None for a job that was never claimed."""
    return None if job.started_at is None else max(0, round((now - job.started_at).total_seconds() * 1000))
