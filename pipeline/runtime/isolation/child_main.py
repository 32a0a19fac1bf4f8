"""The child process that does the building work: `python -m MODULE PARENT [MODULE:FUNCTION ...]`.

Started by `isolation.spawned_child`, never by hand, or forked by a `isolation.fork_server`. It calls the
functions that it is told to load what it will need, says that it is ready, and then works off batches until its parent
is gone. It knows nothing of buildings.
"""

from __future__ import annotations

import ctypes
import faulthandler
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
from pipeline.runtime.isolation.messages import Batch, Begun, Finished, Frames, OutOfMemory, Raised, Ready, frame
from pipeline.runtime.isolation.start_up import start_own_process

NAME = "gablework-child"
"""Name of the process, as `ps` and `top` show it on Linux, which allows no longer one."""
_PIECE = 2**20
_PR_SET_PDEATHSIG, _PR_SET_NAME = 1, 15
_FIRST_VICTIM = "1000"


def main(arguments: Sequence[str]) -> None:
    """Serve one parent until it is gone.

    Parameters
    ----------
    arguments : sequence of str
        The parent's process id, then what is called before this process is ready: `module:function`,
        `module:function:argument` where it takes a text, or `module` alone to be imported.
    """
    start_own_process()
    serve_parent(int(arguments[0]), arguments[1:])


def serve_parent(parent: int, loads: Sequence[str]) -> None:
    """Work off what comes over standard input until the parent is gone.

    Parameters
    ----------
    parent : int
        Process id of the parent.
    loads : sequence of str
        What is called before this process is ready.
    """
    incoming, outgoing = _private_pipes()
    end_with_parent(parent)
    name_process(NAME)
    _be_the_first_victim()
    faulthandler.enable(all_threads=False)
    faulthandler.register(signal.SIGUSR1, all_threads=True)
    batches: queue.SimpleQueue[Batch] = queue.SimpleQueue()
    threading.Thread(target=_receive, args=(incoming, batches), daemon=True).start()
    for name in loads:
        load(name)
    _send(outgoing, Ready())
    while True:
        _work(batches.get(), outgoing)


def load(name: str) -> None:
    """Call a function, told as `module:function`, or as `module:function:argument`; or import a `module`."""
    module, *function = name.split(":", 2)
    loaded = importlib.import_module(module)
    if function:
        getattr(loaded, function[0])(*function[1:])


def _private_pipes() -> tuple[int, int]:
    """The two pipes under new numbers; standard input is empty and standard output is standard error from here on.

    A library that prints must not write into the pipe.
    """
    incoming, outgoing = os.dup(0), os.dup(1)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    os.dup2(2, 1)
    return incoming, outgoing


def end_with_parent(parent: int) -> None:
    """Have the system kill this process when its parent dies.

    Closed pipes would end it too, but not while a building holds the interpreter's lock.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it died before the line above
        os._exit(0)


def name_process(name: str) -> None:
    """Tell those who look at processes what this one is: a forked one has the command line of its server."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_NAME, name.encode(), 0, 0, 0)


def _be_the_first_victim() -> None:
    """Where the machine's memory runs out, this process is to go, not its worker."""
    if sys.platform == "linux":
        try:
            Path("/proc/self/oom_score_adj").write_text(_FIRST_VICTIM, encoding="ascii")
        except OSError as error:  # some sandboxes forbid it
            print(f"oom_score_adj cannot be set: {error}", file=sys.stderr)  # noqa: T201


def _receive(incoming: int, batches: queue.SimpleQueue[Batch]) -> None:
    """Read batches until the parent closes its end; then the process ends, whatever it does."""
    frames = Frames()
    try:
        while received := os.read(incoming, _PIECE):
            for batch in frames.feed(received):
                batches.put(batch)
    except BaseException:  # noqa: BLE001 - told to the parent by the end of this process
        traceback.print_exc()
        os._exit(1)
    os._exit(0)


def _send(outgoing: int, message: object) -> None:
    """Write a message whole."""
    rest = memoryview(frame(message))
    while rest:
        rest = rest[os.write(outgoing, rest) :]


def _work(batch: Batch, outgoing: int) -> None:
    """Work off a batch, every item announced before it is touched."""
    if sys.platform == "linux":
        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        wanted = resource.RLIM_INFINITY if batch.data_limit_bytes is None else batch.data_limit_bytes
        if hard != resource.RLIM_INFINITY and (wanted == resource.RLIM_INFINITY or wanted > hard):
            wanted = hard
        resource.setrlimit(resource.RLIMIT_DATA, (wanted, hard))
    for index, item in batch.items:
        _send(outgoing, Begun(index))
        try:
            _send(outgoing, Finished(index, batch.function(item)))
        except MemoryError as error:
            _send(outgoing, OutOfMemory(index, str(error)))
            return
        except Exception as error:  # noqa: BLE001 - the parent raises it
            _send(outgoing, Raised(index, _picklable(error)))
            return


def _picklable(error: Exception) -> Exception:
    """The error, or one that says the same where it does not survive the pipe."""
    try:
        copy: Any = pickle.loads(pickle.dumps(error))  # noqa: S301 - just made
    except Exception:  # noqa: BLE001 - whatever its class does when copied
        copy = None
    return error if type(copy) is type(error) else RunError(f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    main(sys.argv[1:])
