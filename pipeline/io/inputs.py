"""Which point files a list of paths and URLs means."""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import InputError, RunError, UnreadableInputError, all_at_fault
from pipeline.io.formats import (
    ASCII_SUFFIXES,
    POINT_SUFFIXES,
    VALID,
    files_in,
    first_bytes,
    looks_like_points,
)
from pipeline.io.remote_file import RemoteFile
from pipeline.io.retries import GaveUpError, persistently
from pipeline.io.tile_index import TileIndex, is_index, read_tile_index
from pipeline.io.urls import filesystem_of, is_url, name_in, scheme_of, shown

Cut = Callable[[TileIndex], Sequence[str]]
"""From an index to those of its files that are wanted."""


def find_inputs(
    entries: Iterable[str | Path], *, only_files: bool = False, cut: Cut = lambda index: index.locations
) -> list[str]:
    """The point files that paths, folders, patterns, URLs and tile indexes mean, each once, sorted by name.

    Files are absolute paths without links, and URLs with their queries. Of a folder (not of the folders in it) its LAS,
    LAZ and PLY files are taken, and of its text files those that look like points. A file that is named is taken
    whatever its name, unless it is a tile index.

    Parameters
    ----------
    entries : iterable of str or Path
        `s3://bucket/folder/` (with the slash) and `s3://bucket/*.laz` are listed, `https://host/a.laz` is one file.
    only_files : bool
        Take every entry for the path of one point file of this machine: what strangers name must lead nowhere else.
    cut : callable
        Which files of a tile index are wanted; by default all.

    Raises
    ------
    UnreadableInputError
        If a path is not there or may not be read, a folder holds no point files, a pattern meets none, or a server
        does not answer.
    """
    found: dict[str, None] = {}
    faults: list[InputError] = []
    for entry in entries:
        try:
            locations = [_file(entry)] if only_files else _files_of(entry, cut)
        except InputError as fault:
            # a server that does not answer this time is not asked for each of a thousand files
            if not only_files and is_url(entry):
                raise
            faults.append(fault)
            continue
        for location in locations:
            # workers elsewhere do not share this process's folder
            whole = location if is_url(location) else os.path.realpath(location)
            found[whole] = None
    if faults:
        raise all_at_fault(faults)
    if not found:
        raise UnreadableInputError(
            "inputs", "no input files are given", "Name files, folders or patterns such as tiles/*.laz"
        )
    return sorted(found, key=shown)


def _file(entry: str | Path) -> str:
    """A path that must be that of a file."""
    first_bytes(Path(entry))
    return str(entry)


def _files_of(entry: str | Path, cut: Cut) -> list[str]:
    """The files of one path, folder, pattern, URL or index."""
    if is_url(entry):
        return _files_at(str(entry), cut)
    path = Path(entry)
    if path.is_dir():
        return [str(file) for file in files_in(path)]
    if not path.exists() and glob.has_magic(str(entry)):
        met = glob.glob(str(entry), recursive=True)  # noqa: PTH207 - pathlib knows no absolute patterns
        files = [name for name in met if Path(name).is_file()]
        if not files:
            raise UnreadableInputError(str(entry), "the pattern matches no file", "Check the pattern and the folder")
        return files
    first_bytes(path)
    return list(cut(read_tile_index(str(path)))) if is_index(path) else [str(path)]


def _files_at(url: str, cut: Cut) -> list[str]:
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
    points = [file for file in files if _is_point_file(file)]
    if not points:
        what = f"none of the {len(files)} files in the folder is a point file" if files else "the folder is empty"
        raise UnreadableInputError(shown(url), what, VALID)
    return points


def _is_point_file(url: str) -> bool:
    """Whether a file that was listed is meant, by its suffix, and text by its content."""
    name = name_in(url).lower()
    if name.startswith(".") or not name.endswith(POINT_SUFFIXES):
        return False
    if not name.endswith(ASCII_SUFFIXES):
        return True
    return looks_like_points(first_bytes(RemoteFile(url)))
