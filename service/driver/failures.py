"""Turns an exception in an attempt into a failure with its kind and a sentence, or into another try."""

from __future__ import annotations

from collections.abc import Callable

from pipeline.errors import ClusterError, InputError, RunError, SettingsError, VersionMismatchError
from service.disk import has_no_space
from service.errors import (
    InputRefusedError,
    LimitError,
    NoSpaceError,
    NoSuchOutputError,
    NoSuchUploadError,
    RequestError,
    StoreError,
    UnexpectedError,
)
from service.jobs import Fault, Job, JobFailure


def is_tried_again(error: BaseException, job: Job, max_attempts: int) -> bool:
    """Whether the job goes back to the queue: the cluster, the database or the disk failed, and not too often yet."""
    if isinstance(error, StoreError):
        return True
    lost = isinstance(error, ClusterError | NoSpaceError) and not isinstance(error, VersionMismatchError)
    return lost and job.lost_attempts + 1 < max_attempts


def failure_of(error: BaseException, *, scrub: Callable[[str], str], reference: str, attempts: int) -> JobFailure:
    """The failure that the client sees.

    Parameters
    ----------
    error : exception
        The exception that ended the attempt.
    scrub : callable
        Removes the paths of this machine from a message.
    reference : str
        The log holds the exception under this reference.
    attempts : int
        Attempts with a lost cluster, including this one.

    Returns
    -------
    JobFailure
        An exception that was not raised on purpose shows only its type, never its message.
    """
    message = scrub(str(error))
    if isinstance(error, SettingsError):
        return JobFailure(fault=Fault.SETTINGS, detail=message)
    if has_no_space(error):
        times = "once" if attempts == 1 else f"{attempts} times"
        detail = (
            f"the service's disk had no room for this job, tried {times} (reference {reference}): remove finished jobs "
            "or uploads, use fewer or smaller tiles, or ask the operator to make room; then submit again"
        )
        return JobFailure(fault=Fault.NO_SPACE, detail=detail)
    if isinstance(error, InputRefusedError | LimitError):
        return JobFailure(fault=Fault.REFUSED, detail=message)
    if isinstance(error, InputError | NoSuchUploadError | RequestError | NoSuchOutputError):
        return JobFailure(fault=Fault.INPUT, detail=message)
    if isinstance(error, VersionMismatchError):
        return JobFailure(fault=Fault.CLUSTER, detail=message)
    if isinstance(error, ClusterError):
        times = "once" if attempts == 1 else f"{attempts} times"
        return JobFailure(
            fault=Fault.CLUSTER, detail=f"the cluster was lost {times} during this job; the last time {message}"
        )
    if isinstance(error, RunError):
        return JobFailure(fault=Fault.INTERNAL, detail=f"{message} (reference {reference})")
    kind = error.kind if isinstance(error, UnexpectedError) else type(error).__name__
    detail = (
        f"an unexpected fault of the service, {kind} (reference {reference}): "
        "its operator finds it in the driver's log under this reference"
    )
    return JobFailure(fault=Fault.INTERNAL, detail=detail)
