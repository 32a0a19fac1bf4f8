"""The exceptions of the service. They know no HTTP: `service.problems` maps them to problem documents.

```
ServiceError
├── NoSuchJobError, NoSuchProcessError, NoSuchUploadError, NoSuchBuildingError, NoSuchOutputError, NoSuchScheduleError
├── NoSuchWebhookError, NoSuchDeliveryError, NoSuchCollectionError, NoSuchFeatureError
├── ResultNotReadyError      the job is not over yet, or was dismissed
├── SelectionBusyError       the outputs of some statuses are being made
├── RequestError             inputs that do not fit the process: lists the faults together
├── OutsideAreaError         tiles far outside the area of use of their CRS: lists them together
├── InputRefusedError        an input that is not allowed: a path outside the roots, a host that is not listed
├── TargetRefusedError       a URL to which webhooks are not sent
├── LimitError               more than this service takes
│   ├── TooLargeError        an upload or a body with too many bytes or points
│   ├── NoSpaceError         the disk of the state folder is full, or only its reserve is free
│   ├── QuotaError           the uploads of a key have too many bytes
│   ├── QueueFullError       too many jobs wait
│   ├── TooManySchedulesError a key has reached its limit of schedules
│   ├── TooManyWebhooksError a key has reached its limit of webhooks
│   ├── TooManyUploadsError  a key has reached its limit of uploads, or of unfinished ones
│   └── TooManyRequestsError too many requests of one client
├── UnauthorizedError        no key, or one that is not known
├── ForbiddenError           a key without the scope
├── UploadInUseError         an upload that unfinished jobs need
├── UploadBusyError          an unfinished upload that another request sends
├── OffsetError              bytes that do not continue an unfinished upload
├── ChecksumError            bytes that differ from their checksum
├── ScheduleBusyError        a job of the schedule is under way, so it cannot be run now
├── KeyInUseError            a request with the same Idempotency-Key is under way
├── KeyReusedError           the Idempotency-Key was used for another request
├── RemovedSinceError        the Idempotency-Key was used for something that was removed since
├── NotReplayableError       a delivery that is being sent, or whose webhook is gone
├── ChangedMeanwhileError    the record has changed since the client read it
├── LeaseLostError           a driver's claim on a job has passed to another
├── AttemptEndedError        the process of an attempt ended before the attempt
├── NoProcessError           the process of an attempt cannot be started now
├── UnexpectedError          an exception that was not raised on purpose, of another process
├── StoreError               the database does not answer, or is not migrated
│   ├── StoreBusyError       others hold its locks for too long
│   ├── StoreNewerError      a newer version has migrated it
│   └── StoreFullError       its disk is full
└── StartUpError             settings with which the service must not start
```
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Self

MOST_FAULTS = 20
"""Faults that an answer names; further ones are counted."""


class Further(str):
    """The last entry of a list of faults: how many there are beyond those that are named.

    >>> Further(79_980)
    'and 79,980 more'
    """

    __slots__ = ("number",)
    number: int

    def __new__(cls, number: int) -> Self:
        """The entry for a number of faults."""
        found = super().__new__(cls, f"and {number:,} more")
        found.number = number
        return found


def few(faults: Iterable[str]) -> tuple[str, ...]:
    """The first faults, and the number of the others.

    >>> few(["a"] * 22)[19:]
    ('a', 'and 2 more')
    """
    named: list[str] = []
    number = 0
    for fault in faults:
        if isinstance(fault, Further):
            number += fault.number
        elif len(named) < MOST_FAULTS:
            named.append(fault)
        else:
            number += 1
    return (*named, Further(number)) if number else tuple(named)


def within(place: str, faults: Iterable[str]) -> list[str]:
    """Faults of a part of a request, with its name before each."""
    return [fault if isinstance(fault, Further) else f"{place}: {fault}" for fault in faults]


class ServiceError(Exception):
    """Base of the service's own errors."""

    def __reduce__(self) -> tuple[object, ...]:
        """Survive pickling between the processes of a driver, whatever a class takes."""
        return _again, (type(self), self.args, self.__dict__)


def _again(kind: type[ServiceError], arguments: tuple[object, ...], members: dict[str, object]) -> ServiceError:
    """An error as it was pickled, without the call of its class."""
    error = kind.__new__(kind, *arguments)
    error.args = arguments
    error.__dict__.update(members)
    return error


class NoSuchJobError(ServiceError):
    """The job does not exist, or belongs to another key."""


class NoSuchProcessError(ServiceError):
    """The process does not exist."""


class NoSuchCollectionError(ServiceError):
    """The collection does not exist, belongs to another key, or has no place on the globe."""


class NoSuchFeatureError(ServiceError):
    """The collection has no such feature."""


class NoSuchUploadError(ServiceError):
    """The upload does not exist, has expired, or belongs to another key."""


class NoSuchBuildingError(ServiceError):
    """The job's results hold no such building."""


class NoSuchOutputError(ServiceError):
    """The process has no such output, or the request left it out."""


class NoSuchScheduleError(ServiceError):
    """The schedule does not exist, or belongs to another key."""


class NoSuchWebhookError(ServiceError):
    """The webhook does not exist."""


class NoSuchDeliveryError(ServiceError):
    """The delivery does not exist, was removed from the log, or belongs to another key."""


class NotReplayableError(ServiceError):
    """A delivery that cannot be sent again now: it is being sent, or its webhook is gone or disabled."""


class ResultNotReadyError(ServiceError):
    """The job has no results (yet)."""


class SelectionBusyError(ServiceError):
    """The outputs with the buildings of some statuses are being made."""

    retry_after_s = 2.0
    """Seconds after which a client may ask again."""


class RequestError(ServiceError):
    """Inputs that do not fit the process; the message lists the first faults and counts the others.

    Parameters
    ----------
    faults : sequence of str
        One sentence per fault with the input, its value and what is allowed.
    """

    def __init__(self, faults: Sequence[str]) -> None:
        self.faults = few(faults)
        super().__init__("; ".join(self.faults))


class OutsideAreaError(ServiceError):
    """Tiles that would lie far outside the area of use of their CRS; the message lists the first and counts the others.

    Parameters
    ----------
    faults : sequence of str
        One sentence per tile with the CRS, its area and the place.
    """

    def __init__(self, faults: Sequence[str]) -> None:
        self.faults = few(faults)
        super().__init__("; ".join(self.faults))


class InputRefusedError(ServiceError):
    """An input that this service is not allowed to read."""


class TargetRefusedError(ServiceError):
    """A URL to which this service sends no webhooks."""


class LimitError(ServiceError):
    """More than this service takes; the message names the value and the limit."""


class TooLargeError(LimitError):
    """An upload, a body or an input with too many bytes or points."""


class NoSpaceError(LimitError):
    """The disk of the state folder is full, or only its reserve is free."""


class QuotaError(LimitError):
    """The uploads of a key have too many bytes.

    Parameters
    ----------
    stored_bytes, more_bytes, most_bytes : int
        Bytes of the stored uploads, of the new ones, and the limit.
    """

    def __init__(self, stored_bytes: int, more_bytes: int, most_bytes: int) -> None:
        super().__init__(
            f"the uploads of this key have {stored_bytes} bytes, with the new ones {stored_bytes + more_bytes} or "
            f"more; the limit is {most_bytes}: remove uploads, or raise GABLEWORK_MAX_UPLOAD_BYTES_PER_KEY"
        )


class QueueFullError(LimitError):
    """Too many jobs wait already."""


class TooManySchedulesError(LimitError):
    """A key has reached its limit of schedules."""


class TooManyWebhooksError(LimitError):
    """A key has reached its limit of webhooks."""


class TooManyUploadsError(LimitError):
    """A key has reached its limit of uploads, or of unfinished ones."""

    @classmethod
    def stored(cls, most: int) -> Self:
        """The refusal of one more upload than `most`."""
        return cls(
            f"this key has {most:,} uploads, which is the limit: remove some, wait until old ones are removed, or "
            "raise GABLEWORK_MAX_UPLOADS_PER_KEY"
        )


class TooManyRequestsError(LimitError):
    """Too many requests of one client."""

    def __init__(self, message: str, retry_after_s: float) -> None:
        self.retry_after_s = retry_after_s
        super().__init__(message)


class UnauthorizedError(ServiceError):
    """No key was sent, or one that is not known."""


class ForbiddenError(ServiceError):
    """The key lacks the scope."""


class UploadInUseError(ServiceError):
    """An upload that unfinished jobs need; the message names how many."""


class JobNotOverError(ServiceError):
    """The job still waits or runs."""


class UploadBusyError(ServiceError):
    """An unfinished upload that another request sends."""

    retry_after_s = 1.0
    """Seconds after which the other request may be over."""


class OffsetError(ServiceError):
    """Bytes that do not continue an unfinished upload; the message names both offsets."""


class ChecksumError(ServiceError):
    """Bytes that differ from their checksum; they were not kept."""


class ScheduleBusyError(ServiceError):
    """A job of the schedule is under way, so it cannot be run now."""

    def __init__(self, message: str, job_id: str) -> None:
        self.job_id = job_id
        self.members = {"jobID": job_id}
        super().__init__(message)


class KeyInUseError(ServiceError):
    """A request with the same Idempotency-Key is under way."""

    retry_after_s = 2.0
    """Seconds after which the first request may be over."""


class KeyReusedError(ServiceError):
    """The Idempotency-Key was used for another request."""


class RemovedSinceError(ServiceError):
    """The request with this Idempotency-Key made something that was removed since."""


class ChangedMeanwhileError(ServiceError):
    """The record has changed since the client read it; the message names both versions."""


class StoreError(ServiceError):
    """The database does not answer, or its tables are not those of this version; may pass."""


class StoreNewerError(StoreError):
    """The database is of a newer version, which may have migrated it while this process ran."""


class StoreBusyError(StoreError):
    """Others hold the locks of the database for too long; nothing was written."""

    retry_after_s = 5.0
    """Seconds after which a client may try again: a lock that lasted for seconds may last for some more."""


class StoreFullError(StoreError):
    """The disk of the database is full; nothing was written."""

    retry_after_s = 5.0
    """Seconds after which a client may try again: by then the room that is set aside for the database is free."""


class LeaseLostError(ServiceError):
    """A driver's claim on a job has passed to another driver, or the job is over."""


class AttemptEndedError(ServiceError):
    """The process of an attempt ended, or was ended, before the attempt.

    Parameters
    ----------
    detail : str
        What happened, in words that follow the name of the attempt.
    is_own : bool
        Whether the attempt itself is the cause: it stood still, took too much memory, or met a signal of its own. One
        that was killed from outside is not.
    """

    def __init__(self, detail: str, *, is_own: bool) -> None:
        self.is_own = is_own
        super().__init__(detail)


class NoProcessError(ServiceError):
    """The driver's machine has no room for the process of an attempt now, for which the job is not to blame."""


class UnexpectedError(ServiceError):
    """An exception that was not raised on purpose, of another process, which has logged it.

    Parameters
    ----------
    kind : str
        Name of its class.
    """

    def __init__(self, kind: str) -> None:
        self.kind = kind
        super().__init__(kind)


class StartUpError(ServiceError):
    """Settings with which the service must not start; the message names the fix."""
