"""Places: a folder or file of this machine or behind a URL; what serves URLs is loaded for one alone."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.io.file_facts import Readable
from pipeline.io.locations import is_url
from pipeline.io.storage import LocalStorage, Storage
from pipeline.registry import extra

if TYPE_CHECKING:
    import pyarrow.fs as pafs


def storage_at(place: str | Path) -> Storage:
    """The storage of a folder, a path, or of a URL; raises RunError for a URL where nothing can be stored.

    >>> storage_at("s3://bucket/runs/a/").place
    's3://bucket/runs/a'
    """
    if isinstance(place, str) and is_url(place):
        storage: Storage = extra("ObjectStorage")(url=place)
        return storage
    return LocalStorage(root=Path(place).resolve())


def file_at(location: str | Path) -> Readable:
    """A file of this machine, or behind a URL."""
    if not is_url(location):
        return Path(location)
    file: Readable = extra("RemoteFile")(str(location))
    return file


@contextlib.contextmanager
def on_this_machine(location: str | Path) -> Iterator[Path]:
    """A file as a path of this machine, for libraries that need one; fetched if it is behind a URL.

    A fetched copy lies in a temporary folder while the block runs. Raises UnreadableInputError if it cannot be fetched.
    """
    if not is_url(location):
        yield Path(location)
        return
    from pipeline.io.temporary import temporary_folder

    file = extra("RemoteFile")(str(location))
    with temporary_folder() as folder:
        path = folder / f"file{file.suffix}"
        file.fetch(path)
        yield path


@contextlib.contextmanager
def made_here(place: str) -> Iterator[str]:
    """A folder of this machine for results that go to a place: the folder itself, or one whose files go to the URL.

    Where the block ends without an error its files are put; of a URL only then anything is.
    """
    if not is_url(place):
        yield place
        return
    from pipeline.io.temporary import temporary_folder

    storage = storage_at(place)
    with temporary_folder() as folder:
        yield str(folder)
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            storage.put(path.relative_to(folder).as_posix(), path.read_bytes())


def place_below(place: str | Path, name: str) -> str:
    """The folder or URL of something inside a place.

    >>> place_below("s3://bucket/run", "quarantine")
    's3://bucket/run/quarantine'
    """
    return f"{place}/{name}" if is_url(str(place)) else str(Path(place, name))


def arrow_at(place: str | Path) -> tuple[pafs.FileSystem, str]:
    """The file system of Arrow that reads a folder or URL, and the path in it; RunError if it cannot read the URL."""
    import pyarrow.fs as pafs

    if not is_url(str(place)):
        return pafs.LocalFileSystem(), str(place)
    storage = extra("ObjectStorage")(url=str(place))
    return pafs.PyFileSystem(extra("ObjectHandler")(storage.url)), storage.url.partition("://")[2]
