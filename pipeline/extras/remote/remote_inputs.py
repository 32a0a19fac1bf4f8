"""Which point files a URL means."""

from __future__ import annotations

import glob
from collections.abc import Callable, Sequence
from typing import Any

from pipeline.errors import RunError, UnreadableInputError
from pipeline.extras.remote.remote_file import RemoteFile
from pipeline.extras.remote.retries import GaveUpError, persistently
from pipeline.extras.remote.urls import filesystem_of, scheme_of
from pipeline.extras.vector_files.tile_index import TileIndex, read_tile_index
from pipeline.io.formats import is_index
from pipeline.io.locations import shown
from pipeline.io.point_folders import point_files


def files_at(url: str, cut: Callable[[TileIndex], Sequence[str]]) -> list[str]:
    """The files of one URL."""
    try:
        lists = scheme_of(url).stores
    except RunError as error:
        raise UnreadableInputError(shown(url), "its scheme is not understood", str(error)) from None
    pattern = lists and glob.has_magic(url) and not filesystem_of(url).isfile(url)
    if pattern or url.endswith("/"):
        if not lists:
            raise UnreadableInputError(
                shown(url), "a web server does not list its files", "Name the files, or a tile index that names them"
            )
        return _listed(url, pattern=pattern)
    file = RemoteFile(url)
    if is_index(file):
        return list(cut(read_tile_index(url)))
    file.stat()  # fails now, not when its turn comes
    return [url]


def _listed(url: str, *, pattern: bool) -> list[str]:
    """The point files of a folder, or of a pattern, of an object store."""
    filesystem = filesystem_of(url)
    scheme, _, path = url.partition("://")

    def ask() -> Any:
        if pattern:
            return filesystem.glob(path, detail=True)
        # the exact answer of the store, whatever was listed before
        return {info["name"]: info for info in filesystem.ls(path.rstrip("/"), detail=True, refresh=True)}

    try:
        found = persistently(ask)
    except GaveUpError as error:
        raise UnreadableInputError(shown(url), f"cannot be listed: {error.problem}", error.cause.fix) from None
    files = [f"{scheme}://{name}" for name, info in sorted(found.items()) if info["type"] == "file" and info["size"]]
    if pattern:
        if not files:
            raise UnreadableInputError(shown(url), "the pattern matches no file", "Check the pattern and the bucket")
        return files
    return [file.url for file in point_files(shown(url), [RemoteFile(file) for file in files])]
