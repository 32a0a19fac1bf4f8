"""The child process that does the building work: `python -m MODULE PARENT [MODULE:FUNCTION ...]`.

Started by `isolation.spawned_child` or forked by `isolation.fork_server`, never by hand. It first calls the functions
that load libraries and kernels, reports that it is ready, and then processes batches until its parent is gone. It knows
nothing about buildings.
"""

from __future__ import annotations

import ctypes
import faulthandler
import functools
import importlib
import os
import pickle
import queue
import resource
import signal
import sys
import threading
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.errors import RunError
from pipeline.runtime.isolation.child_messages import (
    Batch,
    Begun,
    Finished,
    Frames,
    Heard,
    OutOfMemory,
    Progressed,
    Raised,
    Ready,
    Said,
    frame,
)
from pipeline.runtime.isolation.progress_reports import item_begins
from pipeline.runtime.isolation.start_up import start_own_process

NAME = "gablework-child"
"""Name of the process in `ps` and `top`, as long as Linux allows."""
_PIECE = 2**20
_PR_SET_PDEATHSIG, _PR_SET_NAME = 1, 15
_FIRST_VICTIM = "1000"

HEARD: queue.SimpleQueue[Any] = queue.SimpleQueue()
"""What the parent sends to the item that is worked on, in order."""
_sending = threading.Lock()
_to_parent: list[int] = []
"""The descriptor of the pipe to the parent, once it is known."""


def say(content: object) -> None:
    """Send something to the parent from the item that is worked on, from any thread; it must be picklable."""
    _send(_to_parent[0], Said(content))


def main(arguments: Sequence[str]) -> None:
    """Serve one parent until it is gone.

    The arguments are the parent's process id, then the loads, which run before this process is ready:
    `module:function`, `module:function:argument` with a text, or a `module` to import.
    """
    start_own_process()
    serve_parent(int(arguments[0]), arguments[1:])


def serve_parent(parent: int, loads: Sequence[str]) -> None:
    """Process batches from standard input until the parent is gone."""
    incoming, outgoing = _private_pipes()
    _to_parent[:] = [outgoing]
    end_with_parent(parent)
    name_process(NAME)
    _be_killed_first()
    faulthandler.enable(all_threads=False)
    faulthandler.register(signal.SIGUSR1, all_threads=True)
    batches: queue.SimpleQueue[Batch] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(incoming, batches), daemon=True).start()
    for name in loads:
        load(name)
    _send(outgoing, Ready())
    while True:
        _process(batches.get(), outgoing)


def load(name: str) -> None:
    """Call `module:function` or `module:function:argument`, or import `module`."""
    module, *function = name.split(":", 2)
    loaded = importlib.import_module(module)
    if function:
        getattr(loaded, function[0])(*function[1:])


def _private_pipes() -> tuple[int, int]:
    """Move the two pipes to new numbers: standard input is then empty, and standard output is standard error.

    A library that prints must not write into the pipe.
    """
    incoming, outgoing = os.dup(0), os.dup(1)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    os.dup2(2, 1)
    return incoming, outgoing


def end_with_parent(parent: int) -> None:
    """Let the system kill this process when its parent dies.

    Closed pipes would end it too, except while a building holds the interpreter's lock.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it died before the line above
        os._exit(0)


def name_process(name: str) -> None:
    """Set the process name: a forked process has the command line of its server."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_NAME, name.encode(), 0, 0, 0)


def _be_killed_first() -> None:
    """If the machine runs out of memory, this process is killed, not its worker."""
    if sys.platform == "linux":
        try:
            Path("/proc/self/oom_score_adj").write_text(_FIRST_VICTIM, encoding="ascii")
        except OSError as error:  # some sandboxes forbid it
            print(f"oom_score_adj cannot be set: {error}", file=sys.stderr)  # noqa: T201


def _receive(incoming: int, batches: queue.SimpleQueue[Batch]) -> None:
    """Read batches until the parent closes its end, then end the process."""
    frames = Frames()
    try:
        while received := os.read(incoming, _PIECE):
            for message in frames.feed(received):
                if isinstance(message, Heard):
                    HEARD.put(message.content)
                else:
                    batches.put(message)
    except BaseException:  # noqa: BLE001 - the parent sees that this process ends
        traceback.print_exc()
        os._exit(1)
    os._exit(0)


def _send(outgoing: int, message: object) -> None:
    """Write a whole message."""
    rest = memoryview(frame(message))
    with _sending:
        while rest:
            rest = rest[os.write(outgoing, rest) :]


def _process(batch: Batch, outgoing: int) -> None:
    """Process a batch, announcing each item before it begins."""
    if sys.platform == "linux":
        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        wanted = resource.RLIM_INFINITY if batch.data_limit_bytes is None else batch.data_limit_bytes
        if hard != resource.RLIM_INFINITY and (wanted == resource.RLIM_INFINITY or wanted > hard):
            wanted = hard
        resource.setrlimit(resource.RLIMIT_DATA, (wanted, hard))
    for index, item in batch.items:
        _send(outgoing, Begun(index))
        item_begins(functools.partial(_send, outgoing, Progressed(index)))
        try:
            _send(outgoing, Finished(index, batch.function(item)))
        except MemoryError as error:
            _send(outgoing, OutOfMemory(index, str(error)))
            return
        except Exception as error:  # noqa: BLE001 - the parent raises it
            _send(outgoing, Raised(index, _picklable(error)))
            return


def _picklable(error: Exception) -> Exception:
    """The error, or one with the same text if it cannot be pickled."""
    try:
        copy: Any = pickle.loads(pickle.dumps(error))  # noqa: S301 - just made
    except Exception:  # noqa: BLE001 - whatever its class does when copied
        copy = None
    return error if type(copy) is type(error) else RunError(f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    # items import this module by its name, and find the pipe to the parent only there
    importlib.import_module("pipeline.runtime.isolation.child_main").main(sys.argv[1:])
