"""Names of the columns of ASCII points: what they mean, and which line of a header holds them.

A header counts only as a whole. One that names some coordinates and leaves another unknown is refused: read in the
usual order, such a file could have x and y swapped.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from pipeline.errors import UnreadableInputError

COLUMN_NAMES = {
    "x": (
        *("x", "easting", "east", "eastings", "x1", "e", "rechtswert", "utm_e", "utm_x", "x_utm"),
        *("rechts", "ost", "oost", "est", "este"),
    ),
    "y": (
        *("y", "northing", "north", "northings", "y1", "n", "hochwert", "utm_n", "utm_y", "y_utm"),
        *("hoch", "nord", "noord", "norte"),
    ),
    "z": (
        *("z", "elevation", "z1", "height", "altitude", "elev", "alt", "h", "hoehe", "höhe"),
        *("hoogte", "hauteur", "altura", "cota", "quota"),
    ),
    "x2": ("x2",),
    "y2": ("y2",),
    "z2": ("z2",),
    "return_number": ("return_number", "returnnumber", "rn"),
    "return_count": ("return_count", "number_of_returns", "numberofreturns", "nr"),
    "classification": ("classification", "class", "c"),
    "gps_time": ("gps_time", "gpstime", "t"),
    "source_id": ("source_id", "point_source_id", "pointsourceid"),
}
"""What a column can be called, the surest name first; any other name, such as intensity or `-`, is read over."""
FIX = "Name the columns x, y and z (or easting, northing, height; any order), or remove the line if it names none"

COMMENT = re.compile(rb"\s*(#|//|%)")
SEPARATORS = bytes.maketrans(b",;", b"  ")
_UNIT = re.compile(r"\(.*?\)|\[.*?\]|_(?:m|ft|us_?ft)$")
"""A unit in a name, which the file's CRS states anyway."""
_MARKS = " \t\r\n#/%\"'"
_WORDS = re.compile(r"[\s_-]*coord(?:inate)?s?$")
_AXES = ("x", "y", "z")
_PROSE = frozenset({"above", "and", "are", "by", "for", "from", "is", "of", "the", "to", "with"})
"""Words of sentences: a comment with one of them, or a number, names no columns, unless it names two coordinates."""


def columns_of(names: Sequence[str]) -> dict[str, int]:
    """Column by field, of those names that are known; of several names of one field the surest."""
    found = {}
    for field, aliases in COLUMN_NAMES.items():
        at = next((names.index(alias) for alias in aliases if alias in names), None)
        if at is not None:
            found[field] = at
    return found


def is_complete(columns: dict[str, int]) -> bool:
    """Whether a point, and a second one where one is begun, has all coordinates."""
    second = [name in columns for name in ("x2", "y2", "z2")]
    return all(name in columns for name in _AXES) and all(second) == any(second)


def names_in(line: bytes, separator: str | None) -> list[str]:
    """The words of a line of a header, as names of columns: small, without units, quotes and marks of comments.

    >>> names_in(b'# "X [m]"; Y-coordinate ;Height_m', ";"), names_in(b"// Columns: X Y Z", None)
    (['x', 'y', 'height'], ['x', 'y', 'z'])
    """
    text = COMMENT.sub(b"", line).decode(errors="replace").lower()
    text = text.rpartition(":")[2]
    words = text.split(separator) if separator is not None and separator in text else re.split(r"[\s,;]+", text)
    bare = [_WORDS.sub("", _UNIT.sub("", word.strip(_MARKS))).strip(_MARKS) for word in words]
    names = [name.replace(" ", "_") for name in bare]
    while names and not names[-1]:  # a separator at the end of the line
        names.pop()
    return names if separator is not None else [name for name in names if name]


def header_columns(path: str, header: Sequence[bytes], separator: str | None, width: int) -> dict[str, int] | None:
    """Column by field, by the lines above the first row of numbers; None where they name no columns.

    Parameters
    ----------
    path : str
        The file, for messages.
    header : sequence of bytes
        The lines, blank ones left out.
    separator : str, optional
        What parts the columns of the rows; None for white space.
    width : int
        Number of columns.

    Raises
    ------
    UnreadableInputError
        If a line names columns, and which of them are x, y and z is not clear.
    """
    for number, line in enumerate(reversed(header)):
        names = names_in(line, separator)
        columns = columns_of(names)
        if len(names) == width and is_complete(columns):
            return columns
        places = [columns[name] for name in _AXES if name in columns]
        if len(places) >= _least_axes(names, line, separator, width, is_last=number == 0):
            if len(names) != width and COMMENT.match(line) and places == sorted(places):
                continue  # words about the columns, which the usual order does not contradict
            raise UnreadableInputError(path, _problem(names, columns, width), FIX)
    return None


def _least_axes(names: Sequence[str], line: bytes, separator: str | None, width: int, *, is_last: bool) -> int:
    """How many coordinates a line must name to be one of names, rather than one of any words."""
    if len(names) != width or not is_last:
        return 2
    if COMMENT.match(line):
        is_prose = not _PROSE.isdisjoint(names) or any(map(_is_number, names))
        return 2 if separator is None and is_prose else 1
    return 1 if any(map(_is_number, names)) else 0


def _problem(names: Sequence[str], columns: dict[str, int], width: int) -> str:
    """What is not understood of a header."""
    listed = ", ".join(map(repr, names[:12]))
    if len(names) != width:
        return f"its header names {len(names)} columns ({listed}), its rows have {width}"
    unknown = [name for name in _AXES if name not in columns] or ["the whole second echo"]
    return f"its header names the columns {listed}, and which of them is {' or '.join(unknown)} is not known"


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
