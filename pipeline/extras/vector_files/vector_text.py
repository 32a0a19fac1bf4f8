"""Text of vector files: in the encoding that a file declares, else UTF-8, else Windows-1252 with a warning."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from pipeline.io.library_faults import shortened

BYTES = "ISO-8859-1"
"""An encoding in which every byte is one character: text that a library decodes by it can be decoded again."""
CONTROLS = re.compile("[\x80-\x9f]")
"""Control characters of ISO-8859-1, which text does not have. Files that declare it have Windows-1252 in their place,
as browsers take it."""


class Texts:
    """Decodes text of one layer, and remembers what was not UTF-8."""

    def __init__(self) -> None:
        self._first = ""
        self._count = 0

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence that names the first value that was not UTF-8 and counts the others; empty without one."""
        if not self._count:
            return ()
        others = self._count - 1
        more = f", as are {others} more" if others > 1 else ", as is one more" if others else ""
        return (f"{self._first}{more}",)

    def of_bytes(self, raw: bytes, where: str) -> str:
        """Text out of a file, as it is meant; `where` names it in the warning."""
        try:
            return raw.decode()
        except UnicodeDecodeError:
            # five of its bytes mean nothing
            text = raw.decode("cp1252", errors="replace")
        if not self._count:
            self._first = f"{where} is not UTF-8 and is read as Windows-1252 ({shortened(text)!r})"
        self._count += 1
        return text

    def of_value(self, value: Any, column: str, row: int) -> Any:
        """A value of a column; text, also in lists, that was decoded as `BYTES` is decoded again."""
        if isinstance(value, str):
            if value.isascii():
                return value
            return self.of_bytes(value.encode(BYTES), f"the text in column {shortened(column)!r} of row {row}")
        if isinstance(value, np.ndarray) and value.dtype.kind == "U":
            return [self.of_value(item, column, row) for item in value.tolist()]
        return value


def without_controls(value: Any) -> Any:
    r"""A value of a file whose declared encoding was followed; text of a declared ISO-8859-1 as Windows-1252.

    >>> without_controls("\x8cuvre"), without_controls("Sè vres"), without_controls(1)
    ('Œuvre', 'Sè vres', 1)
    """
    if not isinstance(value, str) or value.isascii() or not CONTROLS.search(value):
        return value
    return CONTROLS.sub(lambda found: found[0].encode(BYTES).decode("cp1252", errors="replace"), value)
