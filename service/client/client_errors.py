"""The exceptions of the client.

```
RemoteError               of the pipeline: a service elsewhere
├── UnreachableError      no answer: a wrong URL, a certificate that is not trusted, no network
├── ForeignAnswerError    an answer that is not one of gablework
├── DamagedError          bytes that differ from their checksum, again and again
├── JobFailedError        a job that failed, with its reason
├── JobDismissedError     a job that was dismissed
└── RefusedError          a request that the service refuses
    ├── BusyError         for now: too many requests, no room, a busy database; the timeout has passed
    ├── UnauthorizedError no key, or one that is not known
    ├── ForbiddenError    a key without the scope
    └── NotFoundError     no such job, upload or result, or results that are not ready
```

A file on this machine that cannot be read or written raises `InputError` or `RunError` of `pipeline.errors`.
"""

from __future__ import annotations

from pipeline.errors import RemoteError
from service.client.client_answers import Job, Problem


class UnreachableError(RemoteError):
    """The service does not answer."""


class ForeignAnswerError(RemoteError):
    """The answer is not one of gablework: the URL leads elsewhere, or to a proxy that has a fault."""


class DamagedError(RemoteError):
    """Bytes differ from their checksum."""


class RefusedError(RemoteError):
    """The service refuses a request.

    Parameters
    ----------
    problem : Problem
        Its answer.
    hint : str, optional
        A sentence for the client, beside those of the service.
    """

    def __init__(self, problem: Problem, hint: str = "") -> None:
        self.problem = problem
        faults = [fault for fault in problem.errors if fault not in problem.detail]
        said = [problem.detail or problem.title, *faults, hint]
        super().__init__(". ".join(part.strip().rstrip(".") for part in said if part.strip()))

    @property
    def status(self) -> int:
        """The status of the answer."""
        return self.problem.status


class BusyError(RefusedError):
    """The service refuses a request for now."""


class UnauthorizedError(RefusedError):
    """The service needs a key, or does not know this one."""


class ForbiddenError(RefusedError):
    """The key lacks a scope, or the service does not allow this to anyone."""


class NotFoundError(RefusedError):
    """The service does not have it, has it for another key, or does not have it yet."""


class JobFailedError(RemoteError):
    """A job failed.

    Parameters
    ----------
    job : Job
        The job; `job.problem` has the reason.
    """

    def __init__(self, job: Job) -> None:
        self.job = job
        reason = job.message if job.problem is None else job.problem.detail
        super().__init__(f"job {job.id} failed: {reason}")


class JobDismissedError(RemoteError):
    """A job was dismissed.

    Parameters
    ----------
    job : Job
        The job.
    """

    def __init__(self, job: Job) -> None:
        self.job = job
        super().__init__(f"job {job.id} was dismissed")
