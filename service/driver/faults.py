"""What comes of an exception in an attempt: a failure with its kind and its sentence, or another try."""

from __future__ import annotations

import errno
from collections.abc import Callable

from pipeline.errors import ClusterError, InputError, RunError, SettingsError, VersionMismatchError
from service.errors import (
    InputRefusedError,
    LimitError,
    NoSpaceError,
    NoSuchOutputError,
    NoSuchUploadError,
    RequestError,
    StoreError,
)
from service.jobs import Fault, Job, JobFailure

_FIRST_PAUSE_S = 2.0
_LONGEST_PAUSE_S = 60.0
_NO_SPACE = (errno.ENOSPC, errno.EDQUOT)


def pause_s(losses: int) -> float:
    """Seconds until a job whose cluster was lost is tried again: doubles with every loss.

    >>> [pause_s(losses) for losses in (0, 1, 2, 9)]
    [2.0, 4.0, 8.0, 60.0]
    """
    return min(_LONGEST_PAUSE_S, _FIRST_PAUSE_S * 2.0 ** min(losses, 30))


def tried_again(error: BaseException, job: Job, max_attempts: int) -> bool:
    """Whether the job goes back to the line: its cluster or the database was lost, and not too often yet."""
    if isinstance(error, StoreError):
        return True
    lost = isinstance(error, ClusterError) and not isinstance(error, VersionMismatchError)
    return lost and job.lost_attempts + 1 < max_attempts


def failure_of(error: BaseException, *, scrub: Callable[[str], str], reference: str, attempts: int) -> JobFailure:
    """The failure that the client reads.

    Parameters
    ----------
    error : exception
        What ended the attempt.
    scrub : callable
        Takes the paths of this machine out of a message.
    reference : str
        Under what the log holds the exception.
    attempts : int
        Attempts with a lost cluster, this one included.

    Returns
    -------
    JobFailure
        An exception that was not raised on purpose shows its type alone, never its message.
    """
    told = scrub(str(error))
    if isinstance(error, SettingsError):
        return JobFailure(fault=Fault.SETTINGS, detail=told)
    if isinstance(error, NoSpaceError) or (isinstance(error, OSError) and error.errno in _NO_SPACE):
        detail = f"the service's disk is full (reference {reference}): its operator must make room, then submit again"
        return JobFailure(fault=Fault.INTERNAL, detail=detail)
    if isinstance(error, InputRefusedError | LimitError):
        return JobFailure(fault=Fault.REFUSED, detail=told)
    if isinstance(error, InputError | NoSuchUploadError | RequestError | NoSuchOutputError):
        return JobFailure(fault=Fault.INPUT, detail=told)
    if isinstance(error, VersionMismatchError):
        return JobFailure(fault=Fault.CLUSTER, detail=told)
    if isinstance(error, ClusterError):
        times = "once" if attempts == 1 else f"{attempts} times"
        return JobFailure(
            fault=Fault.CLUSTER, detail=f"the cluster was lost {times} over this job; the last time {told}"
        )
    if isinstance(error, RunError):
        return JobFailure(fault=Fault.INTERNAL, detail=f"{told} (reference {reference})")
    detail = (
        f"an unexpected fault of the service, {type(error).__name__} (reference {reference}): "
        "its operator finds it in the driver's log under this reference"
    )
    return JobFailure(fault=Fault.INTERNAL, detail=detail)
