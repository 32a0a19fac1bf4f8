"""Storage in an object store, through fsspec.

A put is one request, or a multipart upload that is completed by one: readers see the old object or the new one, never
a part. Nothing is renamed, since stores cannot, and nothing that must be right relies on a listing. A request that
fails is made again where that may help (`retries`); one that timed out and arrived all the same does no harm, since
the next puts the same bytes.
"""

from __future__ import annotations

import contextlib
import dataclasses
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_EXCEPTION, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any, TypeVar

from pipeline.backoff import Backoff
from pipeline.errors import RunError
from pipeline.extras.remote.retries import GONE, POLICY, GaveUpError, persistently
from pipeline.extras.remote.urls import filesystem_of, scheme_of
from pipeline.io.locations import shown
from pipeline.io.storage import Puts, parts_of_key
from pipeline.io.temporary import temporary_folder

Result = TypeVar("Result")

AT_ONCE = 8
"""Requests of one task that are under way together: a store answers after tens of milliseconds, most of it waiting."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ObjectStorage:
    """Things by key below a prefix of a bucket."""

    url: str
    """Such as `s3://bucket/prefix`; the bucket is there."""
    policy: Backoff = POLICY
    """How often and how long requests are made again."""

    def __post_init__(self) -> None:
        """Refuse what cannot be stored to."""
        if not scheme_of(self.url).stores:
            raise RunError(f"{shown(self.url)}: nothing can be stored there. Use a folder, or s3://bucket/prefix")
        scheme, _, path = self.url.partition("://")
        parts = [part for part in path.split("/") if part]
        if not parts or ".." in parts:
            raise RunError(f"{self.url!r} names no bucket: use s3://bucket/prefix")
        object.__setattr__(self, "url", f"{scheme.lower()}://{'/'.join(parts)}")

    @property
    def place(self) -> str:
        """The URL."""
        return self.url

    def make(self) -> None:
        """Do nothing: an object store has no folders."""

    @contextlib.contextmanager
    def putting(self, key: str) -> Iterator[Path]:
        """A temporary path on this machine, uploaded when the block ends; when it raises nothing is."""
        path = self._path(key)
        with temporary_folder() as folder:
            temporary = folder / "object"
            yield temporary
            if not temporary.is_file():
                raise RunError(f"{key!r} was not written")
            self._tried("written", key, lambda fs: fs.put_file(str(temporary), path))

    def put(self, key: str, content: bytes) -> None:
        """Put bytes under a key and replace what was there."""
        self._put(key, content, lambda: None)

    def _put(self, key: str, content: bytes, check: Callable[[], None]) -> None:
        path = self._path(key)
        self._tried("written", key, lambda fs: fs.pipe_file(path, content), check)

    @contextlib.contextmanager
    def several(self, check: Callable[[], None]) -> Iterator[Puts]:
        """Puts of which some are under way at once; no more wait in memory than that."""
        with ThreadPoolExecutor(AT_ONCE, thread_name_prefix="gablework-put") as threads:
            puts = _Window(self, check, threads)
            try:
                yield puts
                puts.wait()
            finally:
                puts.drop()

    def get(self, key: str) -> bytes:
        """The bytes under a key."""
        path = self._path(key)
        content: bytes = self._tried("read", key, lambda fs: fs.cat_file(path))
        return content

    def has(self, key: str) -> bool:
        """Whether there is an object under the key; asks for it by name, never by a listing."""
        return self._info(key) is not None

    def size(self, key: str) -> int:
        """Bytes of an object."""
        info = self._info(key)
        if info is None:
            raise RunError(f"{key!r} is not in {self.url}")
        return int(info["size"])

    def names(self) -> list[str]:
        """The first parts of all keys, sorted."""
        root = self._root
        found = self._listed("", lambda fs: fs.ls(root, detail=False, refresh=True))
        return sorted({path.rstrip("/").rpartition("/")[2] for path in found if path.rstrip("/") != root})

    def keys(self, folder: str = "") -> list[str]:
        """The keys in a folder and below, sorted."""
        top = self._path(folder) if folder else self._root
        found = self._listed(folder, lambda fs: fs.find(top))
        return sorted(path.removeprefix(f"{self._root}/") for path in found if path != top)

    def delete(self, key: str) -> None:
        """Remove an object, if it is there."""
        path = self._path(key)
        with contextlib.suppress(_NotThereError):
            self._tried("removed", key, lambda fs: fs.rm_file(path))

    def clear(self, names: Iterable[str]) -> None:
        """Remove objects, and all below these names."""
        with ThreadPoolExecutor(AT_ONCE, thread_name_prefix="gablework-delete") as threads:
            for name in names:
                for _ in threads.map(self.delete, [name, *self.keys(name)]):
                    pass

    @property
    def _root(self) -> str:
        return self.url.partition("://")[2]

    def _path(self, key: str) -> str:
        return "/".join((self._root, *parts_of_key(key)))

    def _info(self, key: str) -> dict[str, Any] | None:
        """The store's facts about an object; None if there is none."""
        path = self._path(key)
        try:
            info: dict[str, Any] = self._tried("looked for", key, lambda fs: fs.info(path))
        except _NotThereError:
            return None
        return info if info["type"] == "file" else None

    def _listed(self, folder: str, work: Callable[[Any], list[str]]) -> list[str]:
        try:
            return self._tried("listed", folder, work)
        except _NotThereError:
            return []

    def _tried(
        self, done: str, key: str, work: Callable[[Any], Result], check: Callable[[], None] = lambda: None
    ) -> Result:
        """What a request gives, tried again where that may help."""
        filesystem = filesystem_of(self.url)
        try:
            return persistently(lambda: work(filesystem), self.policy, check=check)
        except GaveUpError as error:
            label = f"{self.url}/{key}" if key else self.url
            kind = _NotThereError if error.cause is GONE else RunError
            raise kind(f"{label} cannot be {done}: {error.problem}. {error.cause.fix}") from None


class _NotThereError(RunError):
    """There is no such object. A missing bucket is a different error."""


class _Window:
    """Puts by some threads, with room for as many as there are threads."""

    def __init__(self, storage: ObjectStorage, check: Callable[[], None], threads: ThreadPoolExecutor) -> None:
        self._storage = storage
        self._check = check
        self._threads = threads
        self._room = threading.BoundedSemaphore(AT_ONCE)
        self._going: set[Future[None]] = set()
        self._dropped = False

    def put(self, key: str, content: bytes) -> None:
        """Put as soon as a thread is free."""
        self._check()
        self._room.acquire()
        self._tell()
        going = self._threads.submit(self._storage._put, key, content, self._checked)  # noqa: SLF001 - a part of it
        self._going.add(going)
        # only when it is over: the next put takes this room, looks for faults first, and must see this one
        going.add_done_callback(lambda _: self._room.release())

    def _checked(self) -> None:
        self._check()
        if self._dropped:
            raise RunError("another put of the same block failed")

    def _tell(self) -> None:
        """Raise what became of the puts that are over."""
        over = {future for future in self._going if future.done()}
        self._going -= over
        for future in over:
            future.result()

    def wait(self) -> None:
        """Return when all are there; at the first fault at once."""
        wait(self._going, return_when=FIRST_EXCEPTION)
        self._tell()

    def drop(self) -> None:
        """Begin no further attempt."""
        self._dropped = True
        for future in self._going:
            future.cancel()
