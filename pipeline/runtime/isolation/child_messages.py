"""Messages between a supervisor and its child process: pickles behind their length, over two pipes.

```
supervisor                          child
    Batch(function, items) ──────▶
                           ◀──────  Ready                    once, after loading
                           ◀──────  Begun(index)             before an item begins: the one to blame if the child dies
                           ◀──────  Said(content)            what a long item reports meanwhile
    Heard(content)         ──────▶                           an answer to it, or a request to end
                           ◀──────  Progressed(index)        now and then, from items that say that they go on
                           ◀──────  Finished(index, result)  at once, so no finished item is lost
                           ◀──────  OutOfMemory(index)       the item raised MemoryError; the child is not used again
                           ◀──────  Raised(index, error)     the function raised: a fault of the run, not of the item
```
"""

from __future__ import annotations

import dataclasses
import pickle
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

NUMBER = struct.Struct("<q")
"""Format of process ids and return codes from a fork server."""
_LENGTH = struct.Struct("<Q")
_LONGEST = 2**40


@dataclasses.dataclass(frozen=True)
class Order:
    """Order of a child from a fork server."""

    environment: Mapping[str, str]
    """Environment of the child."""
    folder: str
    """Its working directory."""
    loads: tuple[str, ...]
    """Its loads, as in `isolation.child_main`."""


@dataclasses.dataclass(frozen=True)
class Batch:
    """Work for the child."""

    function: Callable[[Any], Any]
    """Called with each item; must be picklable."""
    items: Sequence[tuple[int, Any]]
    """Indices and items."""
    data_limit_bytes: int | None
    """Limit of the private memory that the child may reserve; None for no limit."""


@dataclasses.dataclass(frozen=True)
class Ready:
    """The child has loaded everything."""


@dataclasses.dataclass(frozen=True)
class Begun:
    """An item begins."""

    index: int


@dataclasses.dataclass(frozen=True)
class Progressed:
    """The item goes on: its time limit begins anew."""

    index: int


@dataclasses.dataclass(frozen=True)
class Finished:
    """An item is done."""

    index: int
    result: Any


@dataclasses.dataclass(frozen=True)
class Said:
    """Something that an item says while it is worked on (`child_main.say`)."""

    content: Any


@dataclasses.dataclass(frozen=True)
class Heard:
    """Something for the item that is worked on (`child_main.HEARD`)."""

    content: Any


@dataclasses.dataclass(frozen=True)
class OutOfMemory:
    """An item raised MemoryError."""

    index: int
    detail: str


@dataclasses.dataclass(frozen=True)
class Raised:
    """The function raised another error."""

    index: int
    error: Exception


def frame(message: object) -> bytes:
    """The bytes of a message on the pipe."""
    body = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
    return _LENGTH.pack(len(body)) + body


class Frames:
    """Splits the bytes of a pipe into messages.

    Examples
    --------
    >>> frames, sent = Frames(), frame(Begun(3)) + frame(Ready())
    >>> [list(frames.feed(piece)) for piece in (sent[:5], sent[5:-2], sent[-2:])]
    [[], [Begun(index=3)], [Ready()]]
    """

    def __init__(self) -> None:
        self._held = bytearray()

    def feed(self, received: bytes) -> Iterator[Any]:
        """Add bytes; yields the messages that are now complete.

        Raises ValueError if the bytes are not messages: something else wrote into the pipe.
        """
        self._held += received
        while len(self._held) >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(self._held)
            if length > _LONGEST:
                raise ValueError(f"a message of {length} bytes: something else wrote into the pipe")
            end = _LENGTH.size + length
            if len(self._held) < end:
                return
            body = bytes(memoryview(self._held)[_LENGTH.size : end])
            del self._held[:end]
            yield pickle.loads(body)  # noqa: S301 - from the process at the other end, which runs our code
