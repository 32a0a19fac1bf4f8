"""Errors of the libraries that read vector files, in our words.

Messages of GDAL, Arrow, GEOS, SQLite and Python's decoders name functions and limits of their own. A user gets what is
wrong with the file; the library's words go to the log, and its error remains the cause of ours.
"""

from __future__ import annotations

import contextlib
import json
import logging
import re
import warnings
from collections.abc import Iterator
from pathlib import Path

from pipeline.errors import GableworkError, UnreadableInputError

DAMAGED = "its content is damaged, or in another format than its name or its first bytes say"
"""The words for an error that is in no table."""
TOO_LARGE = "a part of it claims more memory than there is for reading it"

_log = logging.getLogger("gablework.io")

_LOGGED = 10
"""Warnings of libraries that are logged."""
_SHOWN = 24
"""Characters of a value that are shown."""
_BY_TEXT = tuple(
    (re.compile(pattern, re.IGNORECASE), words)
    for pattern, words in (
        (r"\b[mc]?(?:re)?alloc|out of memory|bad_alloc|cannot allocate|too large to allocate", TOO_LARGE),
        (r"unrecognized number:? *(\S+)", "{0} is not a number that can be held"),
        (r"unable to open .*\.(shx|dbf)\b", "its .{0} file is missing or cannot be opened"),
        (r"\bdbf file|\.dbf\b", "its .dbf file is damaged or cut off"),
        (r"\.shx file|(?:offset|length) for entity", "its .shx file is damaged or cut off"),
        (r"^missing [,\[\]]", "its coordinate reference system is damaged"),
        (r"at line (\d+), character (\d+)", "its JSON is damaged at line {0}, character {1}"),
        (r"no such (table|column): *(\S+)", "its database has no {0} {1}"),
        (r"database disk image|not a database|malformed|sqlite3?_", "its database is damaged"),
        (r"\binterrupted\b", "its database takes too much work to read"),
        (r"string or blob too big", "a value in its database is larger than is allowed"),
        (r"nest|recursion|too deep", "it is nested too deep"),
        (
            r"\b(month|day|hour|minute|second|year)\b.*(?:must be|out of range)",
            "it has a date with the {0} wrong",
        ),
        (r"magic bytes|thrift|footer", "its footer is damaged or cut off"),
        (r"\beof\b|unexpected end|end of (?:file|stream)|truncated", "it is cut off"),
    )
)
"""What a library's message means, by the first pattern that it matches."""


@contextlib.contextmanager
def in_our_words(path: str | Path, what: str, fix: str, passing: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """Raise what a library raises in the block as UnreadableInputError; its warnings go to the log.

    Only calls of libraries belong into the block. Any error counts: readers raise whatever a damaged file leads to.

    Parameters
    ----------
    path : str or Path
        The file.
    what : str
        What it cannot be read as.
    fix : str
        What the user can do.
    passing : tuple of types
        Errors that are raised on purpose and pass as they are, beside those of `pipeline.errors`.
    """
    try:
        with warnings.catch_warnings(record=True) as noted:
            warnings.simplefilter("default", RuntimeWarning)
            yield
        for warning in noted[:_LOGGED]:
            _log.info("%s: %s", path, warning.message)
    except Exception as error:
        if isinstance(error, (GableworkError, *passing)):
            raise
        _log.info("%s cannot be read as %s: %s: %s", path, what, type(error).__name__, error)
        raise UnreadableInputError(str(path), f"cannot be read as {what}: {words_of(error)}", fix) from error


def words_of(error: Exception) -> str:
    """What a library's error says of the file.

    >>> words_of(MemoryError("realloc of size 800000000 failed")) == TOO_LARGE
    True
    >>> words_of(RuntimeError("At line 1, character 43: Unrecognized number: " + "1" * 4000))
    '111111111111111111111111… (4000 characters) is not a number that can be held'
    >>> words_of(RuntimeError("a text that is in no table")) == DAMAGED
    True
    """
    if isinstance(error, MemoryError):
        return TOO_LARGE
    if isinstance(error, UnicodeDecodeError):
        return f"a text in it is not UTF-8: it has the byte 0x{error.object[error.start]:02x}"
    if isinstance(error, json.JSONDecodeError):
        return f"its JSON is damaged at line {error.lineno}, character {error.colno}"
    if isinstance(error, OSError) and error.errno and error.strerror:
        return error.strerror
    for pattern, words in _BY_TEXT:
        found = pattern.search(str(error))
        if found is not None:
            return words.format(*map(shortened, found.groups()))
    return DAMAGED


def shortened(text: str) -> str:
    """A value out of a file, for a message."""
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}… ({len(text)} characters)"
