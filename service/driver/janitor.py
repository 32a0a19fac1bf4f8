"""Removes files that no job or upload needs any longer, but never files that a live lease may use."""

from __future__ import annotations

import contextlib
import datetime as dt
import logging
import os
import shutil
import time
from pathlib import Path

from service.driver import workplace
from service.errors import NoSuchJobError, UploadInUseError
from service.files import StateFolder, is_id
from service.jobs import JobStatus
from service.resumable import remove_expired
from service.settings import ServiceSettings
from service.store import JobStore
from service.uploads import STALE_S, remove_file, remove_leftovers

LOG = logging.getLogger("gablework.driver")

SO_FAR_S = 60.0
"""Seconds for which the buildings that a job had so far stay readable after they last changed."""
_DOOMED_S = 3600.0
"""Seconds from which a folder counts as left that another process began to remove."""
_DAY_S = 86_400.0


def tidy(store: JobStore, folder: StateFolder, settings: ServiceSettings) -> list[Path]:
    """Remove the files that jobs and uploads left behind, and old answers; set room aside for the database again.

    Several drivers may do so at once.

    Parameters
    ----------
    store : JobStore
        The records of jobs and uploads.
    folder : StateFolder
        Their files.
    settings : ServiceSettings
        How long jobs are kept.

    Returns
    -------
    list of Path
        The removed folders.
    """
    removed = [
        *retire_jobs(store, folder, settings),
        *tidy_jobs(store, folder, settings.stalled_days),
        *tidy_uploads(store, folder),
    ]
    store.forget_answers()
    store.fill_ballast(folder.reserve_bytes)
    return removed


def retire_jobs(store: JobStore, folder: StateFolder, settings: ServiceSettings) -> list[Path]:
    """Remove jobs that are over for `job_days`, then those that ended first until all files are small enough.

    Kept jobs stay. Their files and those of unfinished jobs count, too.
    """
    over = store.finished() if settings.job_days or settings.max_results_bytes else []
    retired = []
    if settings.job_days:
        end = store.now() - dt.timedelta(days=settings.job_days)
        retired = [job_id for job_id, finished_at in over if finished_at <= end]
    if settings.max_results_bytes:
        sizes = {path.name: _size_of(path) for path in _entries(folder.jobs)}
        size = sum(sizes.values()) - sum(sizes.get(job_id, 0) for job_id in retired)
        for job_id, _ in over[len(retired) :]:
            if size <= settings.max_results_bytes:
                break
            size -= sizes.get(job_id, 0)
            retired.append(job_id)
    removed = []
    for job_id in retired:
        # another driver, or its client, may have removed it meanwhile
        with contextlib.suppress(NoSuchJobError):
            store.remove(job_id)
            shutil.rmtree(folder.job(job_id), ignore_errors=True)
            removed.append(folder.job(job_id))
            LOG.info("job %s is removed with its results, as its age or the size of all jobs demands", job_id)
    return removed


def tidy_jobs(store: JobStore, folder: StateFolder, stalled_days: float = 0.0) -> list[Path]:
    """Remove the folders of jobs that are gone or dismissed, and of attempts that are over.

    Inputs that an attempt left which stood still are kept for `stalled_days`.

    Folders are listed before the database is read, and a job is in the database before it has a folder. A folder that
    the database does not know therefore belongs to a job that was removed.
    """
    entries = _entries(folder.jobs)
    # renamed to be removed, by a process that died
    doomed = [path for path in entries if path.name.startswith(".") and _is_old(path, _DOOMED_S)]
    found = sorted(path.name for path in entries if is_id(path.name))
    known = store.attempts(found)
    if found and not known and sum(store.counts().values()) == 0:
        LOG.warning("the database has no jobs, but %s has: they are kept, it may be the wrong database", folder.jobs)
        return []
    removed = doomed
    for job_id in found:
        if job_id not in known or known[job_id][0] is JobStatus.DISMISSED:
            removed.append(folder.job(job_id))
            continue
        status, attempt = known[job_id]
        if status is JobStatus.SUCCESSFUL and _is_old(folder.so_far(job_id, attempt), SO_FAR_S):
            # a reader may have begun before the job was over
            removed.append(folder.so_far(job_id, attempt))
        # a job that waits or failed needs no attempt, one that runs or succeeded only its last
        last = attempt if status in {JobStatus.ACCEPTED, JobStatus.FAILED} else attempt - 1
        for path in _entries(folder.job(job_id)):
            number = workplace.number_of(path)
            if number is None:
                # renamed to be removed, by a process that died
                removed += [path] if path.name.startswith(".") and _is_old(path, _DOOMED_S) else []
                continue
            # results whose end no driver could write yet: the next one does
            is_kept = not status.is_over and (
                workplace.has_end(path) or workplace.is_needed(path, attempt, waits=status is JobStatus.ACCEPTED)
            )
            if status is JobStatus.FAILED and workplace.has_kept_inputs(path):
                is_kept = not _is_old(path, stalled_days * _DAY_S)
            if number <= last and not is_kept:
                removed.append(path)
    for path in removed:
        shutil.rmtree(path, ignore_errors=True)
    return removed


def tidy_uploads(store: JobStore, folder: StateFolder) -> list[Path]:
    """Remove expired uploads, finished or not, and the files of uploads without a record."""
    removed = []
    for upload in store.expired_uploads(store.now()):
        try:
            store.remove_upload(upload.upload_id)
        except UploadInUseError:
            # a job was submitted meanwhile
            continue
        remove_file(upload.upload_id, folder)
        removed.append(folder.upload(upload.upload_id))
    now_s = time.time()
    stale = [p for p in _entries(folder.uploads) if is_id(p.name) and _is_old(p, STALE_S)]
    known = store.upload_ids() if stale else set()
    for path in stale:
        if path.name not in known:
            remove_file(path.name, folder)
            removed.append(path)
    if folder.uploads.is_dir():
        removed += remove_expired(folder, store.now())
        removed += remove_leftovers(folder, now_s=now_s)
    return removed


def _entries(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except FileNotFoundError:
        return []


def _size_of(folder: Path) -> int:
    """Bytes of all files in a folder."""
    size = 0
    for place, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(FileNotFoundError):
                size += os.lstat(os.path.join(place, name)).st_size  # noqa: PTH118 - folders have thousands of files
    return size


def _is_old(path: Path, seconds: float) -> bool:
    """Whether a folder exists and its entries last changed longer ago than that."""
    try:
        return time.time() - path.stat().st_mtime > seconds
    except FileNotFoundError:
        return False
