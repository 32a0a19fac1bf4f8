"""What a supervisor and its child process say to one another: pickles behind their length, over two pipes.

```
supervisor                          child
    Batch(function, items) ──────▶
                           ◀──────  Ready                    once, when all that it needs is loaded
                           ◀──────  Begun(index)             before an item is touched: who is at work when it dies
                           ◀──────  Finished(index, result)  as soon as it is done, so nothing finished is lost
                           ◀──────  OutOfMemory(index)       the item raised MemoryError; the child is not used again
                           ◀──────  Raised(index, error)     the function raised: not the item's fault but the run's
```
"""

from __future__ import annotations

import dataclasses
import pickle
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

NUMBER = struct.Struct("<q")
"""How a process server tells a process id and a return code."""
_LENGTH = struct.Struct("<Q")
_LONGEST = 2**40


@dataclasses.dataclass(frozen=True)
class Order:
    """What a process server is to fork."""

    environment: Mapping[str, str]
    """Environment of the child."""
    folder: str
    """Its working directory."""
    loads: tuple[str, ...]
    """What it calls before it is ready, as `pipeline.runtime.isolation.child_main` takes it."""


@dataclasses.dataclass(frozen=True)
class Batch:
    """Work for the child."""

    function: Callable[[Any], Any]
    """Called with one item after the other; must be picklable."""
    items: Sequence[tuple[int, Any]]
    """Indices and items."""
    data_limit_bytes: int | None
    """Private memory that the child may ask its system for; None does not limit it."""


@dataclasses.dataclass(frozen=True)
class Ready:
    """The child has loaded what it needs."""


@dataclasses.dataclass(frozen=True)
class Begun:
    """An item is about to be touched."""

    index: int


@dataclasses.dataclass(frozen=True)
class Finished:
    """An item is done."""

    index: int
    result: Any


@dataclasses.dataclass(frozen=True)
class OutOfMemory:
    """An item raised MemoryError."""

    index: int
    detail: str


@dataclasses.dataclass(frozen=True)
class Raised:
    """The function raised what it should not."""

    index: int
    error: Exception


def frame(message: object) -> bytes:
    """A message as it goes over the pipe."""
    body = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
    return _LENGTH.pack(len(body)) + body


class Frames:
    """Takes the pipe's bytes as they come and gives whole messages.

    Examples
    --------
    >>> frames, sent = Frames(), frame(Begun(3)) + frame(Ready())
    >>> [list(frames.feed(piece)) for piece in (sent[:5], sent[5:-2], sent[-2:])]
    [[], [Begun(index=3)], [Ready()]]
    """

    def __init__(self) -> None:
        self._held = bytearray()

    def feed(self, received: bytes) -> Iterator[Any]:
        """The messages that are whole now.

        Raises
        ------
        ValueError
            The bytes are no messages: something else wrote into the pipe.
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
