"""Documents in JSON that clients send: measured before anything looks at their content.

While a large document is read no other Python code runs, for milliseconds, and its objects take many times its bytes.
Therefore large ones are read in one thread, one after the other, and what no client has reason to send is refused
here, before it is validated: at a cost that does not grow with the number of its faults.
"""

from __future__ import annotations

import asyncio
import json
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from service.errors import RequestError

SMALL_BYTES = 8_192
"""Largest document that is read in the event loop: a thread would take longer."""
MAX_MEMBERS = 1_000
"""Largest number of members of an object. Most have the attributes of a building, and tables have hundreds of columns
at most."""
MAX_DEPTH = 100
"""Deepest nesting. The coordinates of a collection of features lie nine levels deep."""
BYTES_PER_VALUE, BYTES_PER_LIST = 4, 16
"""Bytes of the largest body per value, and per list or object, that a document may have. A pair of coordinates takes
more; an empty list takes three bytes as text and sixty in memory."""

_reading = ThreadPoolExecutor(max_workers=1, thread_name_prefix="bodies")


async def read(text: bytes | str, max_bytes: int) -> Any:
    """The document.

    Parameters
    ----------
    text : bytes or str
        The JSON.
    max_bytes : int
        Bytes of the largest body that the service takes.

    Raises
    ------
    RequestError
        It has more members or values than clients have reason to send, or is nested deeper.
    ValueError
        It is not JSON.
    """
    return await _apart(_read, text, max_bytes)


async def check(text: bytes, max_bytes: int) -> None:
    """Refuse what `read` refuses. The document is gone when this returns; what is not JSON is left to the framework."""
    await _apart(_check, text, max_bytes)


async def _apart(function: Any, text: bytes | str, max_bytes: int) -> Any:
    if len(text) <= SMALL_BYTES:
        return function(text, max_bytes)
    return await asyncio.get_running_loop().run_in_executor(_reading, function, text, max_bytes)


def _check(text: bytes, max_bytes: int) -> None:
    try:
        _read(text, max_bytes)
    except ValueError as fault:
        if not isinstance(fault, json.JSONDecodeError | UnicodeDecodeError):
            # the limit of Python's own, whose message names a function of Python
            raise RequestError(["the body has a number of thousands of digits: no input needs that"]) from None


def _read(text: bytes | str, max_bytes: int) -> Any:
    raw = text.encode("utf-8", "replace") if isinstance(text, str) else text
    # those within texts count, too: no text has that many
    commas, opened = raw.count(b","), raw.count(b"[") + raw.count(b"{")
    for number, what, bytes_each in ((commas, "commas", BYTES_PER_VALUE), (opened, "lists and objects", BYTES_PER_LIST)):
        if number > max_bytes // bytes_each:
            raise RequestError(
                [
                    f"the body has {number:,} {what}, at most {max_bytes // bytes_each:,} are read: send files to "
                    "/uploads, or raise GABLEWORK_MAX_BODY_BYTES"
                ]
            )
    try:
        document = json.loads(text)
    except RecursionError:
        raise RequestError([_TOO_DEEP]) from None
    _measure(document)
    return document


_TOO_DEEP = f"the body is nested more than {MAX_DEPTH} levels deep: no input needs that"


def _measure(document: Any) -> None:
    """Refuse an object with too many members, and a document that is too deep; level by level."""
    level: list[tuple[str, Any]] = [("the body", document)]
    for _ in range(MAX_DEPTH):
        below: list[tuple[str, Any]] = []
        for name, value in level:
            if isinstance(value, dict):
                if len(value) > MAX_MEMBERS:
                    raise RequestError([f"{name[:80]} has {len(value):,} members: use at most {MAX_MEMBERS:,}"])
                below += [entry for entry in value.items() if isinstance(entry[1], dict | list)]
            elif isinstance(value, list):
                below += [(name, item) for item in value if isinstance(item, dict | list)]
        if not below:
            return
        level = below
    raise RequestError([_TOO_DEEP])
