"""Places: a folder of this machine or a URL, as storage and as a file system of Arrow."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.io.object_storage import ObjectStorage
from pipeline.io.storage import LocalStorage, Storage
from pipeline.io.temporary import temporary_folder
from pipeline.io.urls import is_url

if TYPE_CHECKING:
    import pyarrow.fs as pafs


def storage_at(place: str | Path) -> Storage:
    """The storage of a folder, a path, or of a URL; raises RunError for a URL where nothing can be stored.

    >>> storage_at("s3://bucket/runs/a/").place
    's3://bucket/runs/a'
    """
    if isinstance(place, str) and is_url(place):
        return ObjectStorage(url=place)
    return LocalStorage(root=Path(place).resolve())


@contextlib.contextmanager
def made_here(place: str) -> Iterator[str]:
    """A folder of this machine for results that go to a place: the folder itself, or one whose files go to the URL.

    Where the block ends without an error its files are put; of a URL only then anything is.
    """
    if not is_url(place):
        yield place
        return
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
    from pipeline.io.arrow_objects import ObjectHandler

    storage = ObjectStorage(url=str(place))
    return pafs.PyFileSystem(ObjectHandler(storage.url)), storage.url.partition("://")[2]
