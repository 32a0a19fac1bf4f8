"""The end of an attempt that could not be written to the database: a file beside its results, for the next driver."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from service.files import StateFolder
from service.jobs import Job

END = "end.json"
"""Name of the file in the folder of the attempt."""


def leave(folder: StateFolder, job: Job, message: str, summary: dict[str, Any]) -> None:
    """Write the end of an attempt that succeeded.

    Raises
    ------
    OSError
        The disk is full, or the folder is gone.
    """
    place = folder.attempt(job.job_id, job.attempt)
    new = place / f".{END}"
    with new.open("w") as stream:
        json.dump({"message": message, "summary": summary}, stream)
        stream.flush()
        os.fsync(stream.fileno())
    new.rename(place / END)


def is_left(attempt: Path) -> bool:
    """Whether an attempt's folder has such a file."""
    return (attempt / END).is_file()


def take_over(folder: StateFolder, job: Job) -> tuple[str, dict[str, Any]] | None:
    """The end of an earlier attempt, whose results become those of this one; None if there is none.

    Raises
    ------
    OSError
        The folder cannot be renamed.
    """
    for number in range(job.attempt - 1, 0, -1):
        earlier = folder.attempt(job.job_id, number)
        if is_left(earlier):
            end = json.loads((earlier / END).read_text())
            earlier.rename(folder.attempt(job.job_id, job.attempt))
            (folder.attempt(job.job_id, job.attempt) / END).unlink()
            return str(end["message"]), dict(end["summary"])
    return None
