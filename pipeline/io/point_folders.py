"""The point files of a folder."""

from __future__ import annotations

from pathlib import Path

from pipeline.errors import UnreadableInputError
from pipeline.io.formats import ASCII_SUFFIXES, POINT_SUFFIXES, VALID, first_bytes, looks_like_points
from pipeline.io.records import Readable


def files_in(folder: Path) -> list[Path]:
    """The point files of a folder; raises UnreadableInputError if it cannot be read, or holds none."""
    try:
        entries = [path for path in folder.iterdir() if path.is_file()]
    except OSError as fault:
        raise UnreadableInputError(
            str(folder), f"the folder cannot be read ({fault.strerror or fault})", "Check its permissions"
        ) from fault
    files = [path for path in entries if _is_point_file(path)]
    if not files:
        what = f"none of the {len(entries)} files in the folder is a point file" if entries else "the folder is empty"
        raise UnreadableInputError(str(folder), what, VALID)
    return files


def _is_point_file(path: Readable) -> bool:
    """Whether a file found in a folder is meant, by its suffix, and text by its content."""
    suffix = path.suffix.lower()
    if path.name.startswith(".") or suffix not in POINT_SUFFIXES:
        return False
    return suffix not in ASCII_SUFFIXES or (path.stat().st_size > 0 and looks_like_points(first_bytes(path)))
