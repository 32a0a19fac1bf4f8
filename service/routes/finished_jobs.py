"""Jobs with results: where the results are, or why there are none; for a comparison also those of one run.

A job that still runs has no results, but its buildings can be read as they are modelled.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
from collections.abc import Collection
from pathlib import Path
from typing import Annotated
from urllib.parse import urlencode

from fastapi import Depends, Query

from pipeline.model import Status
from service.disk import Disk
from service.errors import NoSuchOutputError, RequestError, ResultNotReadyError, StoreError
from service.features.index import NAME as INDEX_NAME
from service.features.index import RowIndex
from service.features.runs import job_index
from service.files import StateFolder
from service.jobs import Job, JobStatus
from service.outputs import Catalogue, read_catalogue, run_outputs
from service.outputs.catalogue import NOTHING_YET
from service.outputs.comparison_files import RUNS
from service.outputs.kinds import SELECTABLE
from service.outputs.selected import Selections, refuse_others
from service.problems import JobFailedError
from service.routes.bound import Folder, Reader, Selecting, Store
from service.routes.jobs import JobId
from service.store import JobStore
from service.wire.queries import Statuses

_WATCHED_AGAIN_S = 10.0
"""Seconds after which it is noted again that a client reads the buildings of a running job."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FinishedJob:
    """A job that was successful, or the buildings of one that still runs."""

    job: Job
    """As stored."""
    out_dir: Path
    """Its outputs."""
    run_dir: Path
    """Its run directory, or the folder of its comparison."""
    catalogue: Catalogue
    """The list of the outputs."""
    label: str | None = None
    """The requested run of a comparison; None for the whole comparison, and for other jobs."""
    statuses: tuple[Status, ...] = ()
    """The statuses of the buildings in the outputs; empty for all."""
    is_complete: bool = True
    """Whether the job is over; if not, there are only the buildings that it has modelled so far."""

    @property
    def has_buildings_yet(self) -> bool:
        """Whether there is an index of buildings."""
        return self.catalogue is not NOTHING_YET

    @property
    def index(self) -> RowIndex:
        """The rows of its tables."""
        path = self.out_dir / INDEX_NAME
        return job_index(path, self.run_dir) if self.is_complete else RowIndex(path)

    def run(self, label: str) -> FinishedJob:
        """One run of a comparison, as if it were a job of its own."""
        if label not in self.catalogue.runs:
            if not self.catalogue.runs:
                raise RequestError([f"query method is {label[:80]!r}: this job ran one method, leave it out"])
            raise RequestError([f"query method is {label[:80]!r}: use one of {', '.join(self.catalogue.runs)}"])
        out_dir = run_outputs(self.out_dir, label)
        return dataclasses.replace(
            self, out_dir=out_dir, run_dir=self.run_dir / RUNS / label, catalogue=read_catalogue(out_dir), label=label
        )

    def address(self, path: str, **query: str) -> str:
        """A path below the job with the query that selects the same run."""
        status = {"status": ",".join(self.statuses)} if self.statuses else {}
        given = {**({} if self.label is None else {"method": self.label}), **status, **query}
        return f"{path}?{urlencode(given)}" if given else path


@dataclasses.dataclass(frozen=True, kw_only=True)
class AskedResults:
    """The results that a request asks for; a selection of buildings is made only for outputs that there are."""

    whole: FinishedJob
    """The job, or one run of a comparison, with all buildings."""
    statuses: tuple[Status, ...]
    """The statuses of the wanted buildings; empty for all."""
    selections: Selections
    """Makes selections of buildings."""
    disk: Disk
    """Where they go."""

    def having(self, names: Collection[str]) -> FinishedJob:
        """The job with outputs that hold the wanted buildings; raises NoSuchOutputError if a named one is missing."""
        for name in names:
            if self.statuses:
                refuse_others(name)
            if name not in self.whole.catalogue.outputs:
                raise self.whole.catalogue.missing(name)
        if not self.statuses:
            return self.whole
        job, whole = self.whole.job, self.whole
        place = self.selections.make(whole.run_dir, whole.out_dir, self.statuses, self.disk, job.request.geoid_height)
        found = dataclasses.replace(whole, out_dir=place, catalogue=read_catalogue(place), statuses=self.statuses)
        for name in names:
            if name not in found.catalogue.outputs:  # such as a tileset without a model
                raise found.catalogue.missing(name)
        return found


def _finished(job_id: JobId, store: Store, folder: Folder, caller: Reader) -> FinishedJob:
    """The job with its results; refused if it is not successful or its files are gone."""
    return results_of(store.get(job_id, owner=caller.owner), folder)


def results_of(job: Job, folder: StateFolder) -> FinishedJob:
    """The job with its results; refused if it is not successful or its files are gone."""
    if job.status is JobStatus.FAILED and job.failure is not None:
        raise JobFailedError(job.failure)
    if job.status is JobStatus.DISMISSED:
        raise ResultNotReadyError(f"job {job.job_id} was dismissed: it has no results")
    if job.status is not JobStatus.SUCCESSFUL:
        raise ResultNotReadyError(
            f"job {job.job_id} is {job.status.value} ({job.progress} %): ask again when it is over"
        )
    out_dir = folder.outputs(job.job_id, job.attempt)
    catalogue = read_catalogue(out_dir)
    place = folder.comparison if catalogue.runs else folder.run
    return FinishedJob(job=job, out_dir=out_dir, run_dir=place(job.job_id, job.attempt), catalogue=catalogue)


_Finished = Annotated[FinishedJob, Depends(_finished)]

_Label = Annotated[
    str | None,
    Query(
        alias="method",
        description="A run of a comparison, by its label: METHOD, or METHOD-PRESET.",
        examples=["fuzzy-sart"],
    ),
]


_Only = Annotated[
    Statuses,
    Query(
        alias="status",
        description=f"Only buildings of these statuses: {', '.join(Status)}; with commas, or the parameter again. For "
        f"{', '.join(SELECTABLE)}. These outputs are made when they are first asked "
        "for; until then the answer is 503 with Retry-After.",
        examples=["ok"],
    ),
]


def _results(
    finished: _Finished,
    selections: Selecting,
    folder: Folder,
    label: _Label = None,
    statuses: _Only = None,
) -> AskedResults:
    """The job's results, or those of one run, or of the buildings of some statuses."""
    return AskedResults(
        whole=finished if label is None else finished.run(label),
        statuses=tuple(status for status in Status if status in (statuses or ())),
        selections=selections,
        disk=folder.disk,
    )


def _so_far(job: Job, store: JobStore, folder: StateFolder) -> FinishedJob:
    """The buildings of a job that runs; its driver shows them while clients read."""
    watched_at, now = job.watched_at, dt.datetime.now(dt.UTC)
    if watched_at is None or abs((now - watched_at).total_seconds()) > _WATCHED_AGAIN_S:
        # a database that cannot be written now must not prevent reading
        with contextlib.suppress(StoreError):
            store.watch(job.job_id)
    place = folder.so_far(job.job_id, job.attempt)
    try:
        catalogue = read_catalogue(place)
    except NoSuchOutputError:
        catalogue = NOTHING_YET
    return FinishedJob(job=job, out_dir=place, run_dir=place, catalogue=catalogue, is_complete=False)


def _buildings(job_id: JobId, store: Store, folder: Folder, caller: Reader, label: _Label = None) -> FinishedJob:
    """The run of the buildings: by default the first one of a comparison."""
    job = store.get(job_id, owner=caller.owner)
    if job.status is JobStatus.RUNNING and job.request.process_id == "reconstruct":
        return _run_of(_so_far(job, store, folder), label)
    return _run_of(results_of(job, folder), label)


def _run(finished: _Finished, label: _Label = None) -> FinishedJob:
    """The same of a job that is over."""
    return _run_of(finished, label)


def _run_of(finished: FinishedJob, label: str | None) -> FinishedJob:
    if not finished.job.request.has_buildings:
        process_id = finished.job.request.process_id
        raise NoSuchOutputError(f"a job of the process {process_id} has no buildings: see /jobs/{{jobID}}/results")
    if label is None and finished.catalogue.runs:
        return finished.run(finished.catalogue.runs[0])
    return finished if label is None else finished.run(label)


Asked = Annotated[AskedResults, Depends(_results)]
"""The results of the job of the path; of a comparison those of one run, if it is named."""

FinishedRun = Annotated[FinishedJob, Depends(_run)]
"""The job of the path with the results of one run."""

ReadableRun = Annotated[FinishedJob, Depends(_buildings)]
"""The job of the path with the buildings of one run, also of a job that has not modelled all of them yet."""
