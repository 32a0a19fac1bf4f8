"""The state folder with uploads, attempts and results. Its paths are built only from ids that the service made."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

_ID = re.compile(r"[0-9a-f]{32}")


def is_id(text: str) -> bool:
    """Whether the text can be the id of a job or an upload.

    >>> is_id("0123456789abcdef" * 2), is_id("../" + "a" * 29)
    (True, False)
    """
    return _ID.fullmatch(text) is not None


def _checked(identifier: str) -> str:
    """The identifier, if it can be one of ours; anything else never becomes a path.

    Raises
    ------
    ValueError
        It is not an id.
    """
    if not is_id(identifier):
        raise ValueError(f"{identifier!r} is not an id of this service")
    return identifier


@dataclasses.dataclass(frozen=True)
class StateFolder:
    """Layout of the folder that API, drivers and workers share."""

    root: Path
    """The folder."""

    @property
    def uploads(self) -> Path:
        """One folder per upload."""
        return self.root / "uploads"

    @property
    def jobs(self) -> Path:
        """One folder per job."""
        return self.root / "jobs"

    def upload(self, upload_id: str) -> Path:
        """Folder of one upload; holds one file under its cleaned name."""
        return self.uploads / _checked(upload_id)

    def job(self, job_id: str) -> Path:
        """Folder of a job."""
        return self.jobs / _checked(job_id)

    def attempt(self, job_id: str, attempt: int) -> Path:
        """Folder of one attempt: two drivers never write into the same one."""
        return self.job(job_id) / f"attempt-{attempt}"

    def inputs(self, job_id: str, attempt: int) -> Path:
        """The files that the attempt fetched."""
        return self.attempt(job_id, attempt) / "inputs"

    def run(self, job_id: str, attempt: int) -> Path:
        """The run directory."""
        return self.attempt(job_id, attempt) / "run"

    def comparison(self, job_id: str, attempt: int) -> Path:
        """The folder of a comparison: one run directory per method, and the files made from them."""
        return self.attempt(job_id, attempt) / "comparison"

    def outputs(self, job_id: str, attempt: int) -> Path:
        """The outputs, assembled for download."""
        return self.attempt(job_id, attempt) / "outputs"
