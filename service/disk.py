"""The disk of a folder: its free space, and the reserve that only the database may use."""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import os
import shutil
from pathlib import Path

from pipeline.errors import causes
from service.errors import NoSpaceError

FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
"""Codes of a disk that is full."""
FULL_BYTES = 1 << 20
"""Free bytes below which any failure is put down to the full disk."""
BALLAST_BYTES = 16 << 20
"""Size of the ballast: four times the size at which SQLite moves its log into the database."""
BALLAST = ".ballast"
"""Name of the ballast, beside the database."""


MAKE_ROOM = "Remove finished jobs or uploads, or wait until the operator makes room"
"""What a client can do about a disk that is full."""


def has_no_space(error: BaseException) -> bool:
    """Whether a full disk is the error, or its cause."""
    return any(
        isinstance(cause, NoSpaceError) or (isinstance(cause, OSError) and cause.errno in FULL)
        for cause in causes(error)
    )


@dataclasses.dataclass(frozen=True)
class Disk:
    """The file system of a folder."""

    folder: Path
    """The folder; it need not exist yet, its parent is asked then."""
    reserve_bytes: int = 0
    """Bytes that must stay free."""

    @property
    def free_bytes(self) -> int:
        """Bytes that this user may still write."""
        place = self.folder
        while not place.exists() and place != place.parent:
            place = place.parent
        return shutil.disk_usage(place).free

    @property
    def is_short(self) -> bool:
        """Whether less is free than the reserve."""
        return self.free_bytes < self.reserve_bytes

    def require(self, more_bytes: int, purpose: str) -> None:
        """Refuse to write so many bytes if that would use the reserve.

        Raises
        ------
        NoSpaceError
            It would.
        """
        free_bytes = self.free_bytes
        if free_bytes - more_bytes < self.reserve_bytes:
            raise NoSpaceError(
                f"there is no room on the disk for {purpose}: {free_bytes} bytes are free, {self.reserve_bytes} are "
                f"reserved for the database. {MAKE_ROOM}"
            )


@dataclasses.dataclass(frozen=True)
class Ballast:
    """A file that holds space for the database; it is removed when the disk is full, and made again later."""

    folder: Path
    """The folder of the database."""
    size_bytes: int = BALLAST_BYTES

    @property
    def path(self) -> Path:
        """The file."""
        return self.folder / BALLAST

    def release(self) -> bool:
        """Free the space; False if there was none."""
        found = list(self.folder.glob(f"{BALLAST}*"))
        for path in found:
            path.unlink(missing_ok=True)
        return bool(found)

    def fill(self, reserve_bytes: int = 0) -> None:
        """Take the space, if the reserve stays free without it; otherwise do nothing."""
        if self.path.exists() or Disk(self.folder).free_bytes < reserve_bytes + self.size_bytes:
            return
        # a name of its own for each process: the file has its whole size when it gets its name
        new = self.path.with_name(f"{BALLAST}-{os.getpid()}")
        try:
            with os.fdopen(os.open(new, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "wb") as stream:
                # not zeros: some file systems store none
                stream.write(os.urandom(self.size_bytes))
                stream.flush()
                os.fsync(stream.fileno())
            new.rename(self.path)
        except OSError as error:
            with contextlib.suppress(FileNotFoundError):
                new.unlink()
            if error.errno not in FULL:
                raise
