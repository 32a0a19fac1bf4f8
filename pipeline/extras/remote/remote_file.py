"""A file behind a URL: read by ranges, as far as its header and some parts go, or fetched whole.

LAZ is decoded from its first byte to its last, and a fetched file can be read again at no cost, so a run fetches each
input into its scratch when its turn comes, and removes it when its points are there. The plan reads by ranges: headers
and a few chunks are a small part of a tile. So is a window of COPC, whose nodes are read by ranges, too.
docs/how_to/object_storage.md has the measurement behind this.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import io
import shutil
import weakref
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any, Literal

from pipeline.backoff import Backoff
from pipeline.errors import UnreadableInputError
from pipeline.extras.remote import urls
from pipeline.extras.remote.retries import POLICY, GaveUpError, ShortReadError, persistently
from pipeline.extras.remote.urls import filesystem_of, range_options
from pipeline.io.locations import name_in, shown
from pipeline.io.reading import moved
from pipeline.io.temporary import temporary_folder

BLOCK_BYTES = 1 << 18
"""Read at least, and kept together."""
BLOCKS_KEPT = 64
"""Blocks kept per file, 16 MiB."""
MAX_AHEAD = 32
"""Blocks that are read at once where a file is read on and on: 8 MiB."""
PIECE_BYTES = 1 << 24
"""Fetched by one request: the most that a broken connection costs."""
_FETCHES = 2
"""A file that changes while it is fetched is fetched once more."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RemoteStatus:
    """A server's facts about a file."""

    st_size: int
    """Bytes."""
    st_mtime_ns: int
    """When it was last written, nanoseconds since 1970; 0 if unknown."""
    etag: str
    """Changes with the content; empty if unknown."""


class RemoteFile:
    """A file behind a URL; the readers of point files take it for a path.

    Parameters
    ----------
    url : str
        `s3://`, `https://` or `http://`, with its query.
    policy : Backoff
        How often and how long requests are repeated.
    """

    def __init__(self, url: str, policy: Backoff = POLICY) -> None:
        self.url = url
        self._policy = policy
        self._filesystem = filesystem_of(url)
        self._status: RemoteStatus | None = None
        self._handle: Any = None
        self._blocks: OrderedDict[int, bytes] = OrderedDict()
        self._next_block, self._ahead = -1, 1
        self._whole: Path | None = None

    def __str__(self) -> str:
        """The URL without what may be secret."""
        return shown(self.url)

    @property
    def name(self) -> str:
        """The last part of its path."""
        return name_in(self.url)

    @property
    def suffix(self) -> str:
        """The ending of the name, with its dot."""
        return PurePosixPath(self.name).suffix

    def stat(self) -> RemoteStatus:
        """Size and time, requested once; raises UnreadableInputError if the server does not report them."""
        if self._status is None:
            self._status = self._asked()
        return self._status

    def _asked(self) -> RemoteStatus:
        info = self._tried(lambda: self._filesystem.info(self.url, timeout=urls.REQUEST_S))
        if info.get("type", "file") != "file":
            raise UnreadableInputError(str(self), "a folder, not a file", "End its name with / to take what is in it")
        sent = info.get("size")
        # a server that makes a file as it sends it gives no size
        size = Path(self._held()).stat().st_size if sent is None else int(sent)
        return RemoteStatus(st_size=size, st_mtime_ns=_time_ns(info), etag=str(info.get("ETag") or ""))

    def open(self, mode: Literal["rb"] = "rb", /) -> io.BufferedReader:
        """Its bytes; sequential reading uses larger pieces. Raises UnreadableInputError if it cannot be reached."""
        del mode
        self.stat()
        if self._whole is not None:
            return Path(self._held()).open("rb")
        return io.BufferedReader(_Ranges(self))

    def read_at(self, begin: int, length: int) -> bytes:
        """Some bytes, fewer where the file ends; raises UnreadableInputError if they cannot be read."""
        end = min(begin + length, self.stat().st_size)
        parts = []
        while begin < end:
            block, at = divmod(begin, BLOCK_BYTES)
            part = self._block(block)[at : at + end - begin]
            parts.append(part)
            begin += len(part)
        return b"".join(parts)

    def read_once(self, begin: int, length: int) -> bytes:
        """The same, for what is read once and alone: one request for no more than is wanted, and nothing is kept."""
        end = min(begin + length, self.stat().st_size)
        parts = []
        while begin < end and begin // BLOCK_BYTES in self._blocks:
            block, at = divmod(begin, BLOCK_BYTES)
            parts.append(self._blocks[block][at : at + end - begin])
            begin += len(parts[-1])
        return b"".join([*parts, self._range(begin, end)] if begin < end else parts)

    def _block(self, number: int) -> bytes:
        """One block, from memory or, with those that will be wanted next, from the server."""
        if number not in self._blocks:
            self._ahead = min(2 * self._ahead, MAX_AHEAD) if number == self._next_block else 1
            ahead = next((k for k in range(1, self._ahead) if number + k in self._blocks), self._ahead)
            begin = number * BLOCK_BYTES
            content = self._range(begin, min(begin + ahead * BLOCK_BYTES, self.stat().st_size))
            for k in range(0, len(content), BLOCK_BYTES):
                self._blocks[number + k // BLOCK_BYTES] = content[k : k + BLOCK_BYTES]
            self._next_block = number + -(-len(content) // BLOCK_BYTES)
            while len(self._blocks) > BLOCKS_KEPT:
                self._blocks.popitem(last=False)
        self._blocks.move_to_end(number)
        return self._blocks[number]

    def _range(self, begin: int, end: int) -> bytes:
        """The bytes from begin to before end, all of them."""
        content: bytes = self._tried(lambda: self._requested(begin, end))
        return content

    def _requested(self, begin: int, end: int) -> bytes:
        """One request for a range."""
        if self._whole is None:
            try:
                if self._handle is None:
                    size = self.stat().st_size
                    options = {"block_size": BLOCK_BYTES, "cache_type": "none", "size": size}
                    self._handle = self._filesystem.open(self.url, "rb", **options, **range_options(self.url))
                self._handle.seek(begin)
                content: bytes = self._handle.read(end - begin)
            except ValueError:  # what fsspec says of servers that send the whole file, whatever they are asked for
                self._held()
            except Exception:
                self._handle = None
                raise
            else:
                if len(content) != end - begin:
                    self._handle = None
                    raise ShortReadError(f"{len(content)} of {end - begin} bytes came")
                return content
        with self._held().open("rb") as stream:
            stream.seek(begin)
            return stream.read(end - begin)

    @property
    def is_held(self) -> bool:
        """Whether the server does not send parts, so that a whole copy had to be fetched."""
        return self._whole is not None

    def _held(self) -> Path:
        """A whole copy in a temporary file, removed with this object; for servers without range requests."""
        if self._whole is None:
            with contextlib.ExitStack() as stack:
                copy = stack.enter_context(temporary_folder()) / "whole"
                self._download(copy)
                weakref.finalize(self, stack.pop_all().close)
            self._whole = copy
        return self._whole

    def _download(self, target: Path) -> None:
        """The whole file by one request."""
        from fsspec.callbacks import Callback  # loaded with its file systems

        class Moved(Callback):  # type: ignore[misc]
            def call(self, *_: Any, **__: Any) -> None:
                moved()

        self._tried(lambda: self._filesystem.get_file(self.url, str(target), timeout=urls.WHOLE_S, callback=Moved()))

    def fetch(self, target: Path, check: Callable[[], None] = lambda: None) -> None:
        """Write the whole file to a path of this machine, in an existing folder, piece by piece.

        `check` is called before each piece; what it raises ends the fetching.

        Raises
        ------
        UnreadableInputError
            It cannot be read, or changes again and again.
        OSError
            This machine's disk does not take it.
        """
        for _ in range(_FETCHES):
            before = self.stat()
            with target.open("wb") as stream:
                for begin in range(0, before.st_size, PIECE_BYTES):
                    check()
                    if self._whole is not None:
                        break
                    stream.write(self._range(begin, min(begin + PIECE_BYTES, before.st_size)))
            if self._whole is not None:
                shutil.copyfile(self._held(), target)
                return
            self._status, self._handle = None, None
            if self.stat() == before:
                return
        raise UnreadableInputError(
            str(self), "it changes while it is read", "Try again when it is no longer being written"
        )

    def _tried(self, work: Callable[[], Any]) -> Any:
        """The result of a request, repeated if that may help."""
        try:
            return persistently(work, self._policy)
        except GaveUpError as error:
            raise UnreadableInputError(str(self), f"cannot be fetched: {error.problem}", error.cause.fix) from None


class _Ranges(io.RawIOBase):
    """A remote file as a raw stream."""

    def __init__(self, file: RemoteFile) -> None:
        self._file = file
        self._at = 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._file.stat().st_size}[whence]
        if start + offset < 0:
            raise OSError(22, f"byte {start + offset} of {self._file} is before its first")
        self._at = start + offset
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: Any, /) -> int:
        view = memoryview(buffer).cast("B")
        content = self._file.read_at(self._at, len(view))
        view[: len(content)] = content
        self._at += len(content)
        return len(content)


def _time_ns(info: dict[str, Any]) -> int:
    """When a file was written, from the fields of S3 or HTTP."""
    written = info.get("LastModified") or info.get("Last-Modified")
    if isinstance(written, str):
        from email.utils import parsedate_to_datetime  # most runs read no file of a server

        try:
            written = parsedate_to_datetime(written)
        except ValueError:
            return 0
    return int(written.timestamp()) * 1_000_000_000 if isinstance(written, dt.datetime) else 0
