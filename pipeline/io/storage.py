"""Local storage: what is there is complete, because a thing gets its name only after its last byte is on the disk."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from pipeline.errors import RunError

BLOCK_BYTES = 1 << 20
TEMPORARY_SUFFIX = ".part"
"""Ends the names of what is being written; `keys` does not tell them."""


def sha256_of(path: str | Path) -> str:
    """Hexadecimal sha256 of a file's content, read in blocks."""
    digest = hashlib.sha256()
    with Path(path).open("rb") as stream:
        while block := stream.read(BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()


@dataclasses.dataclass(frozen=True, kw_only=True)
class LocalStorage:
    """Things by key in a folder. A key is a relative path with forward slashes, such as `state/x85_y447.json`."""

    root: Path
    """The folder; made when the first thing is put."""

    def path(self, key: str) -> Path:
        """Where a thing is or would be.

        Raises
        ------
        RunError
            If the key is empty, absolute or leads out of the folder.
        """
        parts = PurePosixPath(key)
        if not parts.parts or parts.is_absolute() or ".." in parts.parts or "\\" in key:
            raise RunError(f"{key!r} is no key: use a relative path with forward slashes and without ..")
        return self.root.joinpath(*parts.parts)

    @contextlib.contextmanager
    def putting(self, key: str) -> Iterator[Path]:
        """A temporary path beside the final one, to be written by whoever writes best; renamed when the block ends.

        When the block raises, the temporary file is removed and what stood under the key stays.

        Raises
        ------
        RunError
            If the folder cannot be made, or the block wrote nothing to the path.
        """
        final = self.path(key)
        try:
            final.parent.mkdir(parents=True, exist_ok=True)
        except OSError as fault:
            raise RunError(f"{final.parent}: the folder cannot be made ({fault.strerror or fault})") from fault
        temporary = final.with_name(f".{final.name}.{uuid.uuid4().hex}{TEMPORARY_SUFFIX}")
        try:
            yield temporary
            if not temporary.is_file():
                raise RunError(f"{key!r} was not written")
            with temporary.open("rb+") as stream:
                os.fsync(stream.fileno())
            temporary.replace(final)
        finally:
            temporary.unlink(missing_ok=True)
        _sync_folder(final.parent)

    def put(self, key: str, content: bytes) -> None:
        """Put bytes under a key, in place of what stood there."""
        with self.putting(key) as temporary:
            temporary.write_bytes(content)

    def get(self, key: str) -> bytes:
        """The bytes under a key.

        Raises
        ------
        RunError
            If there is nothing.
        """
        try:
            return self.path(key).read_bytes()
        except FileNotFoundError:
            raise RunError(f"{key!r} is not in {self.root}") from None

    def remove(self, key: str) -> None:
        """Remove what stands under a key; nothing where there is nothing."""
        self.path(key).unlink(missing_ok=True)

    def has(self, key: str) -> bool:
        """Whether something complete stands under the key."""
        return self.path(key).is_file()

    def keys(self, folder: str = "") -> list[str]:
        """The keys of all complete things in a folder and below, sorted; none where the folder is not there."""
        top = self.path(folder) if folder else self.root
        return sorted(
            path.relative_to(self.root).as_posix()
            for path in top.rglob("*")
            if path.is_file() and path.suffix != TEMPORARY_SUFFIX
        )


def _sync_folder(folder: Path) -> None:
    """Bring the rename itself to the disk, where the system can."""
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
