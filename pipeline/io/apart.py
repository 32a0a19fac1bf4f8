"""Decoding in a forked process, so that a file on which a decoder crashes ends that process and not this one.

lazrs calls itself once more for each change between sequences of GPS times, in all point formats that have them. A
damaged chunk may change without end; then the stack overflows, which ends the process without an exception.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn, TypeVar, cast

from pipeline.errors import UnreadableInputError
from pipeline.io.reading import heard_by, moved, seen_by

Result = TypeVar("Result")
_MOVED = b"."
"""What the process sends before its result, again and again, as it reads on; no pickle begins so."""


def has_one_thread() -> bool:
    """Whether this process has no second thread, not even one of a library, that could hold a lock during a fork."""
    return sum(1 for _ in Path("/proc/self/task").iterdir()) == 1


def apart(work: Callable[[], Result], path: str) -> Result:
    """The result of work on an input, done in a process forked for it where this one has one thread.

    A process with threads does the work itself: those are workers and services, whose readers others watch.

    Raises
    ------
    UnreadableInputError
        The process ended before the work did.
    Exception
        Whatever the work raised.
    """
    if sys.platform != "linux" or not has_one_thread():
        return work()
    ours, theirs = os.pipe()
    pid = os.fork()
    if not pid:
        os.close(ours)
        _work_and_end(work, theirs)
    os.close(theirs)
    ended = False
    try:
        sent = _received(ours)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        ended = True
    finally:
        os.close(ours)
        if not ended:  # an alarm or Ctrl-C came meanwhile
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
    if code:
        how = f"signal {-code} ({signal.strsignal(-code)})" if code < 0 else f"exit code {code}"
        raise UnreadableInputError(
            path,
            f"it cannot be read: the process that decoded some of its points was ended by {how}",
            "Get the file again, or write it again",
        )
    is_error, found = pickle.loads(sent.lstrip(_MOVED))  # noqa: S301 - from a copy of this process
    if is_error:
        raise found
    return cast("Result", found)


def _received(pipe: int) -> bytes:
    """All that the process sends; each piece shows that it goes on."""
    pieces = []
    while piece := os.read(pipe, 2**20):
        moved()
        pieces.append(piece)
    return b"".join(pieces)


def _work_and_end(work: Callable[[], object], into: int) -> NoReturn:
    """In the forked process: send what came of the work, and end without what this process does at its end."""
    code = 1
    try:
        try:
            with heard_by(lambda: os.write(into, _MOVED)), seen_by(lambda: None):
                sent = pickle.dumps((False, work()), pickle.HIGHEST_PROTOCOL)
        except Exception as error:  # noqa: BLE001 - raised by the process that waits
            sent = pickle.dumps((True, error), pickle.HIGHEST_PROTOCOL)
        with open(into, "wb") as stream:
            stream.write(sent)
        code = 0
    finally:
        os._exit(code)
