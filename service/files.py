"""The state folder with uploads, attempts and results. Its paths are built only from ids that the service made."""

from __future__ import annotations

import dataclasses
import logging
import os
import re
import stat
from pathlib import Path

from service.disk import Disk
from service.errors import StartUpError

SO_FAR = "so-far"
"""Name of the folder of an attempt with the buildings that it has modelled so far."""
_ID = re.compile(r"[0-9a-f]{32}")
_log = logging.getLogger("gablework.service")


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
    reserve_bytes: int = 0
    """Free bytes of its disk that uploads, fetched inputs and runs may not use."""

    @property
    def disk(self) -> Disk:
        """Its disk."""
        return Disk(self.root, self.reserve_bytes)

    @property
    def uploads(self) -> Path:
        """One folder per upload."""
        return self.root / "uploads"

    @property
    def jobs(self) -> Path:
        """One folder per job."""
        return self.root / "jobs"

    def make(self) -> None:
        """Make the folders; other users of the machine must not read tiles, results and digests of keys."""
        for path in (self.root, self.uploads, self.jobs):
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
            keep_private(path)

    def prepare(self) -> None:
        """Make the folders when a process starts.

        Raises
        ------
        StartUpError
            They cannot be made or written.
        """
        fix = "name a folder with --state, or GABLEWORK_STATE"
        for path in (self.root, self.uploads, self.jobs):
            fault = folder_fault(path)
            if fault is not None:
                raise StartUpError(f"the state folder {self.root} cannot be used: {fault}. Change that, or {fix}")
        try:
            self.make()
        except OSError as error:
            what = f"{error.filename}: {error.strerror}"
            raise StartUpError(f"the state folder {self.root} cannot be made ({what}): {fix}") from error

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

    def so_far(self, job_id: str, attempt: int) -> Path:
        """The buildings that the attempt has modelled so far, for readers, while it runs."""
        return self.attempt(job_id, attempt) / SO_FAR

    def outputs(self, job_id: str, attempt: int) -> Path:
        """The outputs, assembled for download."""
        return self.attempt(job_id, attempt) / "outputs"


def folder_fault(path: Path) -> str | None:
    """Why a path cannot be a folder that this account writes, in a few words; None if it can, as far as is known.

    >>> folder_fault(Path("/dev/null/state"))
    '/dev/null is not a folder'
    """
    place = path.absolute()
    while not os.path.lexists(place) and place != place.parent:
        place = place.parent
    if not place.is_dir():
        return f"{place} leads nowhere" if place.is_symlink() and not place.exists() else f"{place} is not a folder"
    if not os.access(place, os.W_OK | os.X_OK):
        return f"this account (user {os.geteuid()}) may not write into {place}"
    return None


def keep_private(path: Path) -> None:
    """Take the rights of other users from a file or folder.

    The group keeps its rights if the folder, or that of the file, has the set-group-id bit: this is how an operator
    shares it among the accounts of API and drivers. A folder of another account is left as it is, with a warning.
    """
    mode = stat.S_IMODE(path.stat().st_mode)
    folder_mode = mode if path.is_dir() else path.parent.stat().st_mode
    is_shared = bool(folder_mode & stat.S_ISGID)
    wanted = mode & ~(stat.S_IRWXO if is_shared else stat.S_IRWXO | stat.S_IRWXG)
    if wanted == mode:
        return
    try:
        path.chmod(wanted)
    except PermissionError:
        _log.warning("%s can be read by other users and belongs to another account: run chmod o= on it", path)


def make_private_file(path: Path) -> None:
    """Make an empty file if there is none; only this account may read it."""
    os.close(os.open(path, os.O_CREAT | os.O_WRONLY, 0o600))
    keep_private(path)
