"""What a client remembers of the files that it has sent, so that the same call continues: a small file for each.

The files lie in the user's cache folder. They hold no key: its digest is a part of their names.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import time
import uuid
from pathlib import Path
from typing import Self

from pipeline.errors import UnreadableInputError

REMEMBERED_S = 30.0 * 86_400.0
"""Seconds after which an entry is removed; services keep uploads for days."""
READ_BYTES = 1 << 20


@dataclasses.dataclass(frozen=True, kw_only=True)
class LocalFile:
    """A file on this machine, and what shows that it has changed."""

    path: Path
    """Absolute."""
    size_bytes: int
    modified_ns: int

    @classmethod
    def at(cls, path: str | Path) -> Self:
        """The file of a path.

        Raises
        ------
        UnreadableInputError
            It cannot be sent.
        """
        place = Path(path)
        if place.is_dir():
            raise UnreadableInputError(str(path), "is a folder", "Name its files, such as tiles/*.laz")
        try:
            with place.open("rb") as stream:
                facts = os.fstat(stream.fileno())
        except OSError as error:
            raise UnreadableInputError(str(path), f"cannot be read ({error.strerror})", "Check the path") from None
        if facts.st_size == 0:
            raise UnreadableInputError(str(path), "is empty", "Check the file")
        return cls(path=place.resolve(), size_bytes=facts.st_size, modified_ns=facts.st_mtime_ns)

    def sha256(self) -> str:
        """SHA-256 of the content, hexadecimal. Raises OSError."""
        digest = hashlib.sha256()
        with self.path.open("rb") as stream:
            while piece := stream.read(READ_BYTES):
                digest.update(piece)
        return digest.hexdigest()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Remembered:
    """A file that was sent, whole or in part."""

    upload_id: str
    """The id of the upload, before and after its end."""
    sha256: str
    """Of the file, hexadecimal."""


class UploadMemory:
    """The entries in a folder.

    Parameters
    ----------
    folder : Path
        Is made when something is remembered.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    @classmethod
    def of_user(cls) -> Self:
        """That in the user's cache folder."""
        import platformdirs

        return cls(Path(platformdirs.user_cache_dir("gablework", appauthor=False)) / "uploads")

    def find(self, url: str, key: str | None, file: LocalFile) -> Remembered | None:
        """What is remembered of a file at a service; None if nothing is, or if the entry is damaged."""
        try:
            found = json.loads(self._entry(url, key, file).read_text(encoding="utf-8"))
            return Remembered(upload_id=str(found["upload"]), sha256=str(found["sha256"]))
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def keep(self, url: str, key: str | None, file: LocalFile, known: Remembered) -> None:
        """Remember a file; old entries are removed. Raises OSError."""
        self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        entry = self._entry(url, key, file)
        content = {"service": url, "path": str(file.path), "upload": known.upload_id, "sha256": known.sha256}
        written = entry.with_name(f".{uuid.uuid4().hex}.tmp")
        written.write_text(json.dumps(content), encoding="utf-8")
        written.replace(entry)
        oldest_s = time.time() - REMEMBERED_S
        for other in self._folder.iterdir():
            if other.stat().st_mtime < oldest_s:
                other.unlink(missing_ok=True)

    def forget(self, url: str, key: str | None, file: LocalFile) -> None:
        """Remove the entry of a file. Raises OSError."""
        self._entry(url, key, file).unlink(missing_ok=True)

    def _entry(self, url: str, key: str | None, file: LocalFile) -> Path:
        of = json.dumps([url, key, str(file.path), file.size_bytes, file.modified_ns])
        return self._folder / f"{hashlib.sha256(of.encode()).hexdigest()[:32]}.json"
