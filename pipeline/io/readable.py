"""What the readers of point files ask of a file: a path of this machine answers it, and so does a file behind a URL."""

from __future__ import annotations

import io
from typing import Literal, Protocol, runtime_checkable


class FileStatus(Protocol):
    """Size and time of a file."""

    @property
    def st_size(self) -> int:
        """Bytes."""

    @property
    def st_mtime_ns(self) -> int:
        """When it was last written, nanoseconds since 1970; 0 if unknown."""


class Readable(Protocol):
    """A file that can be opened at any place; as text it is what messages call it."""

    @property
    def name(self) -> str:
        """The last part of its path."""

    @property
    def suffix(self) -> str:
        """The ending of the name, with its dot."""

    def stat(self) -> FileStatus:
        """Size and time; raises OSError if there is no such file."""

    def open(self, mode: Literal["rb"], /) -> io.BufferedReader:
        """Its bytes."""


@runtime_checkable
class ReadsOnce(Protocol):
    """A file behind a URL."""

    def read_once(self, begin: int, length: int) -> bytes:
        """Some bytes that no one reads again; no others are fetched."""


def bytes_of(file: Readable, stream: io.BufferedReader, begin: int, length: int) -> bytes:
    """Some bytes of an open file, which are read once; of a remote one no others are fetched."""
    if isinstance(file, ReadsOnce):
        return file.read_once(begin, length)
    stream.seek(begin)
    return stream.read(length)
