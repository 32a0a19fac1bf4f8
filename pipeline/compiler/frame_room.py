"""Deep recursion without system calls: room for Python's frames, taken once.

CPython keeps frames in chunks of 16 KB and releases a chunk as soon as its first frame returns. numba recurses deeply
and calls small functions by the million; if a chunk ends inside a hot loop, each call maps and unmaps a chunk. That
took a tenth of the time of a compilation. A frame that needs more gets a larger chunk, and its callees use the rest.
"""

from __future__ import annotations

import types
from collections.abc import Callable
from typing import Any, TypeVar

Value = TypeVar("Value")

_SLOTS = 70_000
"""Values on the stack of the large frame: 0.53 MiB, for which CPython takes a chunk of 1 MiB; the rest is free."""


def with_room_for_frames(function: Callable[[], Value]) -> Value:
    """Call a function from a frame with room for the frames of a deep recursion in the same chunk.

    >>> with_room_for_frames(lambda: 7)
    7
    """
    value: Value = _from_large_frame(function)
    return value


def _called(function: Callable[[], Any]) -> Any:
    return function()


_from_large_frame = types.FunctionType(_called.__code__.replace(co_stacksize=_SLOTS), globals())
"""`_called` in a frame with room for far more values than it needs."""
