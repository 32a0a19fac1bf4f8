"""Which point files a list of paths and URLs means."""

from __future__ import annotations

import glob
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.errors import InputError, UnreadableInputError, all_at_fault
from pipeline.io.formats import first_bytes, is_index
from pipeline.io.locations import is_url, shown
from pipeline.registry import extra

if TYPE_CHECKING:
    from pipeline.extras.vector_files.tile_index import TileIndex

Cut = Callable[["TileIndex"], Sequence[str]]
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
        files: list[str] = extra("files_at")(str(entry), cut)
        return files
    path = Path(entry)
    if path.is_dir():
        from pipeline.io.point_folders import files_in

        return [str(file) for file in files_in(path)]
    if not path.exists() and glob.has_magic(str(entry)):
        met = glob.glob(str(entry), recursive=True)  # noqa: PTH207 - pathlib knows no absolute patterns
        files = [name for name in met if Path(name).is_file()]
        if not files:
            raise UnreadableInputError(str(entry), "the pattern matches no file", "Check the pattern and the folder")
        return files
    first_bytes(path)
    if not is_index(path):
        return [str(path)]
    return list(cut(extra("read_tile_index")(str(path))))
