"""Documents in JSON that clients send: measured before anything looks at their content.

While a large document is read nothing else happens in the process, for milliseconds, and its objects take many times
its bytes. Therefore large ones are read one after the other, with pauses, and what no client has reason to send is
refused here, before it is validated: at a cost that does not grow with its faults. A thread would not help: it would
take its milliseconds again and again while the event loop waits for sockets.
"""

from __future__ import annotations

import asyncio
import json
from typing import Any

import anyio
from anyio.lowlevel import RunVar
from pydantic_core import from_json

from service.errors import RequestError

SMALL_BYTES = 8_192
"""Largest document that is read at once."""
MAX_MEMBERS = 1_000
"""Largest number of members of an object. Most have the attributes of a building, and tables have hundreds of columns
at most."""
MAX_DEPTH = 100
"""Deepest nesting. The coordinates of a collection of features lie nine levels deep."""
BYTES_PER_VALUE, BYTES_PER_LIST = 4, 16
"""Bytes of the largest body per value, and per list or object, that a document may have. A pair of coordinates takes
more; an empty list takes three bytes as text and sixty in memory."""

_TOO_DEEP = f"the body is nested more than {MAX_DEPTH} levels deep: no input needs that"
_turns: RunVar[anyio.Lock] = RunVar("_turns")


async def read(text: str, max_bytes: int) -> Any:
    """The document.

    Parameters
    ----------
    text : str
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
    await check(text.encode("utf-8", "replace"), max_bytes)
    return json.loads(text)


async def check(text: bytes, max_bytes: int) -> None:
    """Refuse what `read` refuses. The document is gone when this returns; what is not JSON is left to the caller."""
    if len(text) <= SMALL_BYTES:
        _check(text, max_bytes)
        return
    loop = asyncio.get_running_loop()
    async with _turn():
        began_s = loop.time()
        try:
            _check(text, max_bytes)
        finally:
            # a short request needs several turns: it must not wait for one large document in each
            await asyncio.sleep(loop.time() - began_s)


def _turn() -> anyio.Lock:
    """The lock of one event loop."""
    try:
        return _turns.get()
    except LookupError:
        made = anyio.Lock()
        _turns.set(made)
        return made


def _check(text: bytes, max_bytes: int) -> None:
    # those within texts count, too: no text has that many
    commas, opened = text.count(b","), text.count(b"[") + text.count(b"{")
    bounds = ((commas, "commas", BYTES_PER_VALUE), (opened, "lists and objects", BYTES_PER_LIST))
    for number, what, bytes_each in bounds:
        most = max_bytes // bytes_each
        if number > most:
            fix = "send files to /uploads, or raise GABLEWORK_MAX_BODY_BYTES"
            raise RequestError([f"the body has {number:,} {what}, at most {most:,} are read: {fix}"])
    try:
        document = from_json(text, cache_strings="none")
    except ValueError as fault:
        if "recursion limit" in str(fault):
            raise RequestError([_TOO_DEEP]) from None
        return
    _measure(document)


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
