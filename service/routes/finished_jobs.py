"""Jobs whose results are there: where they lie, or why there are none."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

from fastapi import Depends

from service.errors import ResultNotReadyError
from service.jobs import Job, JobStatus
from service.outputs import Catalogue, read_catalogue
from service.problems import JobFailedError
from service.routes.bound import Folder, Reader, Store
from service.routes.jobs import JobId


@dataclasses.dataclass(frozen=True, kw_only=True)
class FinishedJob:
    """A job that was successful."""

    job: Job
    """As stored."""
    out_dir: Path
    """Its outputs."""
    run_dir: Path
    """Its run directory."""
    catalogue: Catalogue
    """What the outputs are."""


def _finished(job_id: JobId, store: Store, folder: Folder, caller: Reader) -> FinishedJob:
    """The job with its results.

    Raises
    ------
    NoSuchJobError
        There is none, or it belongs to another key.
    ResultNotReadyError
        It is not over, or was dismissed.
    JobFailedError
        It failed.
    NoSuchOutputError
        Its files are gone.
    """
    job = store.get(job_id, owner=caller.owner)
    if job.status is JobStatus.FAILED and job.failure is not None:
        raise JobFailedError(job.failure)
    if job.status is JobStatus.DISMISSED:
        raise ResultNotReadyError(f"job {job.job_id} was dismissed: it has no results")
    if job.status is not JobStatus.SUCCESSFUL:
        raise ResultNotReadyError(
            f"job {job.job_id} is {job.status.value} ({job.progress} %): ask again when it is over"
        )
    out_dir = folder.outputs(job.job_id, job.attempt)
    return FinishedJob(
        job=job, out_dir=out_dir, run_dir=folder.run(job.job_id, job.attempt), catalogue=read_catalogue(out_dir)
    )


Finished = Annotated[FinishedJob, Depends(_finished)]
"""The job of the path, with its results."""
