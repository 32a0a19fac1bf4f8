"""The point files of a folder, on this machine or in a bucket."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from pipeline.errors import UnreadableInputError
from pipeline.io.file_facts import Readable
from pipeline.io.formats import ASCII, POINT_SUFFIXES, VALID, first_bytes, looks_like_points

File = TypeVar("File", bound=Readable)


def files_in(folder: Path) -> list[Path]:
    """The point files of a folder; raises UnreadableInputError if it cannot be read, or holds none."""
    try:
        entries = [path for path in folder.iterdir() if path.is_file()]
    except OSError as fault:
        raise UnreadableInputError(
            str(folder), f"the folder cannot be read ({fault.strerror or fault})", "Check its permissions"
        ) from fault
    return point_files(str(folder), entries)


def point_files(folder: str, files: Sequence[File]) -> list[File]:
    """Those of a folder's files that are meant: by their endings, and text by its content.

    Raises UnreadableInputError without any.
    """
    found = [file for file in files if _is_point_file(file)]
    if not found:
        what = f"none of the {len(files)} files in the folder is a point file" if files else "the folder is empty"
        raise UnreadableInputError(folder, what, VALID)
    return found


def _is_point_file(file: Readable) -> bool:
    """Whether a file found in a folder is meant."""
    suffix = file.suffix.lower()
    if file.name.startswith(".") or suffix not in POINT_SUFFIXES:
        return False
    return suffix not in ASCII.suffixes or (file.stat().st_size > 0 and looks_like_points(first_bytes(file)))
