"""The folder in which an attempt works; it is delivered, handed back for the next attempt, or removed.

An attempt works in the folder of its own number, so two drivers never write into the same one. An attempt that is
handed back in good order leaves its folder as it is, with a file that says so. The next attempt works on there, under
the same paths, and so repeats no stage that is done. When it succeeds, the results move to the folder of its number.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from service.files import StateFolder
from service.jobs import Job

HOLDER = "holder.json"
"""Name of the file that says which attempt works in a folder, or handed it back; only in folders that were."""
END = "end.json"
"""Name of the file with the end of an attempt that no database would take; the next driver writes it."""
INPUTS = "inputs"
"""The files that the attempt fetched."""
_ATTEMPT = re.compile(r"attempt-([0-9]+)")


def number_of(place: Path) -> int | None:
    """The number in the name of an attempt's folder; None for another folder."""
    found = _ATTEMPT.fullmatch(place.name)
    return None if found is None else int(found[1])


def take(folder: StateFolder, job: Job) -> tuple[Path, bool]:
    """The folder in which an attempt works, and whether an earlier attempt handed it back.

    Raises
    ------
    OSError
        It cannot be made.
    """
    for number in range(job.attempt - 1, 0, -1):
        earlier = folder.attempt(job.job_id, number)
        if _holder(earlier)[1]:
            _write_holder(earlier, job.attempt, handed_back=False)
            return earlier, True
    place = folder.attempt(job.job_id, job.attempt)
    # the number of an attempt is unique; files there are from before a backup of the database was restored
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    return place, False


def hand_back(place: Path, job: Job) -> None:
    """Leave a folder for the next attempt; nothing may write there any longer.

    Raises
    ------
    OSError
        It cannot be written.
    """
    _write_holder(place, job.attempt, handed_back=True)


def deliver(place: Path, folder: StateFolder, job: Job) -> None:
    """Move the results of an attempt to the folder of its own number.

    Raises
    ------
    OSError
        A file cannot be moved.
    """
    target = folder.attempt(job.job_id, job.attempt)
    if place == target:
        return
    target.mkdir(exist_ok=True)
    for entry in place.iterdir():
        if entry.name != HOLDER:
            # files there are from before a backup of the database was restored
            shutil.rmtree(target / entry.name, ignore_errors=True)
            entry.rename(target / entry.name)
    shutil.rmtree(place, ignore_errors=True)


def discard(place: Path) -> None:
    """Remove a folder; it is renamed first, so that no late task of a worker fills it again."""
    doomed = place.with_name(f".{place.name}.{os.getpid()}")
    try:
        place.rename(doomed)
    except OSError:
        # gone, or another process removes it; what is left is removed where it is
        doomed = place
    shutil.rmtree(doomed, ignore_errors=True)


def keep_inputs(place: Path) -> None:
    """Remove all but the inputs that an attempt fetched."""
    for entry in list(place.iterdir()) if place.is_dir() else []:
        if entry.name != INPUTS:
            discard(entry)


def has_kept_inputs(place: Path) -> bool:
    """Whether a folder has inputs and nothing else."""
    try:
        return [entry.name for entry in place.iterdir()] == [INPUTS]
    except OSError:
        return False


def is_needed(place: Path, attempt: int, *, waits: bool) -> bool:
    """Whether an unfinished job at this attempt, which waits or runs, may still work in an earlier attempt's folder."""
    holder, is_handed_back = _holder(place)
    return is_handed_back or (not waits and holder == attempt) or holder > attempt


def leave_end(folder: StateFolder, job: Job, message: str, summary: dict[str, Any]) -> None:
    """Write the end of an attempt that succeeded.

    Raises
    ------
    OSError
        The disk is full, or the folder is gone.
    """
    _write(folder.attempt(job.job_id, job.attempt) / END, {"message": message, "summary": summary})


def has_end(attempt: Path) -> bool:
    """Whether an attempt's folder has such a file."""
    return (attempt / END).is_file()


def take_over_end(folder: StateFolder, job: Job) -> tuple[str, dict[str, Any]] | None:
    """The end of an earlier attempt, whose results become those of this one; None if there is none.

    Raises
    ------
    OSError
        The folder cannot be renamed.
    """
    for number in range(job.attempt - 1, 0, -1):
        earlier = folder.attempt(job.job_id, number)
        if has_end(earlier):
            end = json.loads((earlier / END).read_text())
            earlier.rename(folder.attempt(job.job_id, job.attempt))
            (folder.attempt(job.job_id, job.attempt) / END).unlink()
            return str(end["message"]), dict(end["summary"])
    return None


def _holder(place: Path) -> tuple[int, bool]:
    """The last attempt that worked in a folder, and whether it was handed back."""
    try:
        found = json.loads((place / HOLDER).read_text())
        return int(found["attempt"]), bool(found["handed_back"])
    except (OSError, ValueError, KeyError, TypeError):
        # without the file, or with one that was cut off, it is that of the attempt with its number
        return number_of(place) or 0, False


def _write_holder(place: Path, attempt: int, *, handed_back: bool) -> None:
    _write(place / HOLDER, {"attempt": attempt, "handed_back": handed_back})


def _write(path: Path, content: Mapping[str, Any]) -> None:
    """Write a file whole, so that it survives a loss of power."""
    new = path.with_name(f".{path.name}")
    with new.open("w") as stream:
        json.dump(content, stream)
        stream.flush()
        os.fsync(stream.fileno())
    new.rename(path)
