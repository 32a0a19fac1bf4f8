"""Storage of complete things only: in a folder, a file gets its name after its last byte is on the disk.

`Storage` holds a run directory, in a folder (`LocalStorage`) or in an object store
(`pipeline.extras.remote.object_storage`). `pipeline.io.storage_at` gives the one that a path or URL means.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import os
import shutil
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path, PurePosixPath
from typing import Protocol

from pipeline.errors import RunError
from pipeline.io.reading import moved

BLOCK_BYTES = 1 << 20
_SYNCED_AT_ONCE = 8
TEMPORARY_SUFFIX = ".part"
"""Ending of unfinished files; `keys` does not list them."""


def sha256_of(path: str | Path) -> str:
    """Hexadecimal sha256 of a file's content, read in blocks."""
    digest = hashlib.sha256()
    with Path(path).open("rb") as stream:
        while block := stream.read(BLOCK_BYTES):
            moved()
            digest.update(block)
    return digest.hexdigest()


def parts_of_key(key: str) -> tuple[str, ...]:
    """The parts of a key: a relative path with forward slashes, such as `state/x85_y447.json`.

    Raises RunError if the key is empty, absolute or leads out of its storage.
    """
    parts = PurePosixPath(key)
    if not parts.parts or parts.is_absolute() or ".." in parts.parts or "\\" in key:
        raise RunError(f"{key!r} is not a key: use a relative path with forward slashes and without ..")
    return parts.parts


class Puts(Protocol):
    """Several things on their way into a storage."""

    def put(self, key: str, content: bytes) -> None:
        """Put bytes under a key now or soon; raises the errors of earlier ones."""

    def wait(self) -> None:
        """Return when everything put so far is there; raises its errors."""


class Storage(Protocol):
    """Things by key, each whole or not there. All methods may be called twice, from several threads and processes.

    They raise RunError, naming the key and the cause; local ones also OSError, from the disk.
    """

    @property
    def place(self) -> str:
        """The folder or URL, for messages and for `storage_at`."""

    def make(self) -> None:
        """Make the folder, where the storage has such."""

    def putting(self, key: str) -> AbstractContextManager[Path]:
        """A temporary path for the caller to write; put under the key when the block ends."""

    def put(self, key: str, content: bytes) -> None:
        """Put bytes under a key and replace what was there."""

    def several(self, check: Callable[[], None]) -> AbstractContextManager[Puts]:
        """Many puts, as fast as the storage takes them; all are there when the block ends.

        `check` is called before each; what it raises ends the block.
        """

    def get(self, key: str) -> bytes:
        """The bytes under a key."""

    def has(self, key: str) -> bool:
        """Whether something complete is stored under the key."""

    def size(self, key: str) -> int:
        """Bytes stored under the key."""

    def names(self) -> list[str]:
        """The first parts of all keys, sorted; for people, since a listing may lag behind what was put."""

    def keys(self, folder: str = "") -> list[str]:
        """The keys in a folder and below, sorted; none where the folder is not there. It may lag, too."""

    def delete(self, key: str) -> None:
        """Remove what is stored under a key, if anything is."""

    def clear(self, names: Iterable[str]) -> None:
        """Remove some things, and all in folders of these names."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LocalStorage:
    """Things by key in a folder. A key is a relative path with forward slashes, such as `state/x85_y447.json`."""

    root: Path
    """The folder; made when the first thing is put."""

    def path(self, key: str) -> Path:
        """Where a thing is or would be."""
        return self.root.joinpath(*parts_of_key(key))

    def paths(self, key: str) -> tuple[Path, Path]:
        """Where a thing is or would be, and a temporary path beside it in a folder that is there.

        Raises RunError if the folder cannot be made.
        """
        final = self.path(key)
        try:
            final.parent.mkdir(parents=True, exist_ok=True)
        except OSError as fault:
            raise RunError(f"{final.parent}: the folder cannot be made ({fault.strerror or fault})") from fault
        return final, final.with_name(f".{final.name}.{uuid.uuid4().hex}{TEMPORARY_SUFFIX}")

    @property
    def place(self) -> str:
        """The folder."""
        return str(self.root)

    def make(self) -> None:
        """Make the folder; OSError if that fails."""
        self.root.mkdir(parents=True, exist_ok=True)

    @contextlib.contextmanager
    def putting(self, key: str) -> Iterator[Path]:
        """A temporary path beside the final one, for the caller to write; renamed when the block ends.

        When the block raises, the temporary file is removed and what was under the key stays. Raises RunError if the
        folder cannot be made, or the block wrote nothing to the path.
        """
        final, temporary = self.paths(key)
        try:
            yield temporary
            if not temporary.is_file():
                raise RunError(f"{key!r} was not written")
            _sync(temporary)
            temporary.replace(final)
        finally:
            temporary.unlink(missing_ok=True)
        _sync_folder(final.parent)

    def put(self, key: str, content: bytes) -> None:
        """Put bytes under a key and replace what was there."""
        with self.putting(key) as temporary:
            temporary.write_bytes(content)

    @contextlib.contextmanager
    def several(self, check: Callable[[], None]) -> Iterator[Puts]:
        """Puts that reach the disk together; none has its name before."""
        with ThreadPoolExecutor(_SYNCED_AT_ONCE, thread_name_prefix="gablework-sync") as threads:
            puts = _Together(self, check, threads)
            try:
                yield puts
                puts.wait()
            finally:
                puts.drop()

    def get(self, key: str) -> bytes:
        """The bytes under a key; raises RunError if there is nothing."""
        try:
            return self.path(key).read_bytes()
        except FileNotFoundError:
            raise RunError(f"{key!r} is not in {self.root}") from None

    def size(self, key: str) -> int:
        """Bytes stored under the key; raises RunError if there is nothing."""
        try:
            return self.path(key).stat().st_size
        except FileNotFoundError:
            raise RunError(f"{key!r} is not in {self.root}") from None

    def has(self, key: str) -> bool:
        """Whether something complete is stored under the key."""
        return self.path(key).is_file()

    def keys(self, folder: str = "") -> list[str]:
        """The keys of all complete things in a folder and below, sorted; none where the folder is not there."""
        top = self.path(folder) if folder else self.root
        return sorted(
            path.relative_to(self.root).as_posix()
            for path in top.rglob("*")
            if path.is_file() and path.suffix != TEMPORARY_SUFFIX
        )

    def names(self) -> list[str]:
        """What lies in the folder itself, hidden things too, sorted; nothing where it is not there."""
        return sorted(path.name for path in self.root.iterdir()) if self.root.is_dir() else []

    def delete(self, key: str) -> None:
        """Remove what is stored under a key, if anything is."""
        self.path(key).unlink(missing_ok=True)

    def clear(self, names: Iterable[str]) -> None:
        """Remove files and whole folders; raises RunError if something cannot be removed."""
        for name in names:
            path = self.path(name)
            try:
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path)
                else:
                    path.unlink(missing_ok=True)
            except OSError as error:
                raise RunError(f"{path} cannot be removed: {error.strerror or error}") from error


@dataclasses.dataclass(frozen=True)
class _Together:
    """Puts that reach the disk together, from the next wait on: most of each is waiting for the disk.

    To sync a folder takes far longer than to sync a small file in it.
    """

    storage: LocalStorage
    check: Callable[[], None]
    threads: ThreadPoolExecutor
    written: dict[Path, Path] = dataclasses.field(default_factory=dict)
    """The final path of each temporary file since the last wait."""

    def put(self, key: str, content: bytes) -> None:
        """Write a file, without its name."""
        self.check()
        final, temporary = self.storage.paths(key)
        self.written[temporary] = final
        temporary.write_bytes(content)

    def wait(self) -> None:
        """Bring all files to the disk, then give them their names and bring these to the disk."""
        deque(self.threads.map(_sync, self.written), maxlen=0)
        folders = {final.parent for final in self.written.values()}
        for temporary, final in self.written.items():
            temporary.replace(final)
        self.written.clear()
        for folder in folders:
            _sync_folder(folder)

    def drop(self) -> None:
        """Remove what has no name yet."""
        for temporary in self.written:
            temporary.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    """Bring a file's content to the disk."""
    with path.open("rb+") as stream:
        os.fsync(stream.fileno())


def _sync_folder(folder: Path) -> None:
    """Bring the rename itself to the disk, where the system can."""
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
