"""One supervised child process: its start, its work, its limits and its end."""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import fcntl
import os
import select
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

from pipeline.errors import RunCancelledError
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
from pipeline.runtime.isolation.forked_child import read_by_children
from pipeline.runtime.isolation.spawned_child import ChildProcess
from pipeline.runtime.monitoring.progress import never

_PIECE = 2**20
_TICK_S = 0.05
"""Interval of the checks of the child's memory and time."""
_CANCEL_TICK_S = 0.25
_TRACE_WAIT_S = 2.0
_STDERR_KEPT_BYTES = 8 * 2**20
_PUNCH_HOLE = 1 | 2  # FALLOC_FL_KEEP_SIZE | FALLOC_FL_PUNCH_HOLE
_STDERR_REPORTED_BYTES = 6000
_DATA_MARGIN_BYTES = 2**30
"""Allowance above the limit: a process reserves more address space than it uses."""


class EndCause(StrEnum):
    """Why a child ended."""

    DIED = "died"
    TIME = "time"
    MEMORY = "memory"


@dataclasses.dataclass(frozen=True, kw_only=True)
class ChildEnd:
    """The end of a child that had work."""

    cause: EndCause
    """Why it ended."""
    index: int | None
    """The item that it had announced and not finished; None if there was none."""
    detail: str
    """What happened; the same text each time it happens."""
    seconds: float
    """Time since that item was announced."""
    memory_bytes: int
    """Largest private memory observed during that time."""
    stderr: str
    """The last lines of its standard error, with the traceback if available."""


class SupervisedChild:
    """A process that runs `pipeline.runtime.isolation.child_main`.

    Parameters
    ----------
    start : callable
        Starts it with a descriptor for its standard error: `SpawnedChild`, or `ForkServer.fork`.
    """

    def __init__(self, start: Callable[[int], ChildProcess]) -> None:
        self._stderr = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 - closed in `end`
        # both processes append, also after the file was truncated
        fcntl.fcntl(self._stderr, fcntl.F_SETFL, fcntl.fcntl(self._stderr, fcntl.F_GETFL) | os.O_APPEND)
        self._process = start(self._stderr.fileno())
        self._watched: Any = None
        self._poll = select.poll()
        self._poll.register(self._process.stdout, select.POLLIN)
        self._frames = Frames()
        self._ready = False
        self._nonsense = ""
        self.environment = read_by_children(os.environ)
        """Environment at its start."""
        self.begun = 0
        """Number of items announced so far."""
        self._read_bytes = 0
        self._reported_cpu_s = 0.0
        self._seen_cpu_s = 0.0

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    @property
    def return_code(self) -> int | None:
        """The return code of the process, negative for a signal; None while it runs."""
        return self._process.poll()

    @property
    def memory_bytes(self) -> int:
        """Its resident memory without the pages shared with files; 0 if it is gone."""
        info = self._psutil("memory_info")
        return 0 if info is None else int(info.rss) - int(getattr(info, "shared", 0))

    @property
    def address_space_bytes(self) -> int:
        """What counts against its limit of data: also memory that a library has given up but not returned."""
        info = self._psutil("memory_info")
        return 0 if info is None else int(getattr(info, "data", info.rss))

    def spent_cpu_s(self) -> float:
        """CPU seconds since the last call, including its start; for a dead child up to the last look."""
        self._look_at_cpu()
        spent, self._reported_cpu_s = self._seen_cpu_s - self._reported_cpu_s, self._seen_cpu_s
        return spent

    def _look_at_cpu(self) -> None:
        times = self._psutil("cpu_times")
        if times is not None:
            self._seen_cpu_s = max(self._seen_cpu_s, times.user + times.system)

    def _psutil(self, what: str) -> Any:
        """The result of a method of `psutil.Process`; None if the process is gone."""
        import psutil  # type: ignore[import-untyped]  # slow to load, and a serial run has no child

        if self._watched is None and self._process.pid is None:
            return None
        try:
            self._watched = self._watched or psutil.Process(self._process.pid)
            return getattr(self._watched, what)()
        except psutil.Error:
            return None

    def wait_until_ready(self, timeout_s: float, cancelled: Callable[[], bool]) -> str | None:
        """Wait until the child has loaded what it needs; returns why it will never be ready, None if it is ready."""
        if self._ready:
            return None
        deadline = time.monotonic() + timeout_s
        for message in self._messages(cancelled):
            if isinstance(message, Ready):
                self._ready = True
                return None
            if time.monotonic() > deadline:
                return f"it was not ready after {timeout_s:g} s"
        return self.how_it_ended()

    def work(
        self,
        function: Callable[[Any], Any],
        items: Sequence[tuple[int, Any]],
        *,
        timeout_s: float,
        memory_bytes: int,
        cancelled: Callable[[], bool],
        one: str = "building",
    ) -> Iterator[Finished | ChildEnd]:
        """Process items; yields each result as it comes, and finally a `ChildEnd` if the child died or was ended.

        `one` is the word for an item in messages. An item that reports progress has its whole time again.
        """
        batch = Batch(function=function, items=items, data_limit_bytes=memory_bytes + _DATA_MARGIN_BYTES)
        with contextlib.suppress(BrokenPipeError):  # its end is handled below
            self._write(frame(batch))
        allowed = f"the {memory_bytes / 2**30:g} GiB that a {one} may take"
        kills = system_kills()
        left = len(items)
        at_work: int | None = None
        began = time.monotonic()
        peak_bytes = 0

        def ended(cause: EndCause, detail: str) -> ChildEnd:
            return ChildEnd(
                cause=cause,
                index=at_work,
                detail=detail,
                seconds=time.monotonic() - began,
                memory_bytes=peak_bytes,
                stderr=self.last_output,
            )

        for message in self._messages(cancelled):
            match message:
                case Begun():
                    at_work, began, peak_bytes = message.index, time.monotonic(), 0
                    self.begun += 1
                case Progressed():
                    began = time.monotonic()
                case Finished():
                    at_work = None
                    left -= 1
                    yield message
                    if left == 0:
                        return
                case OutOfMemory():
                    peak_bytes = max(peak_bytes, self.memory_bytes)
                    yield ended(EndCause.MEMORY, f"it asked for more than {allowed}")
                    return
                case Raised():
                    raise message.error
                case _:
                    used = self.memory_bytes
                    peak_bytes = max(peak_bytes, used)
                    if used > memory_bytes:
                        yield ended(EndCause.MEMORY, f"it took more than {allowed}")
                        return
                    if at_work is not None and time.monotonic() - began > timeout_s:
                        self._ask_for_trace()
                        yield ended(
                            EndCause.TIME, f"it took longer than {timeout_s:g} s, the limit that protects a run"
                        )
                        return
        detail = self.how_it_ended()
        if self._process.poll() == -signal.SIGKILL and system_kills() > kills:
            yield ended(EndCause.MEMORY, "the system ran out of memory and ended its process")
        else:
            yield ended(EndCause.DIED, detail)

    def converse(self, function: Callable[[Any], Any], item: object, *, data_limit_bytes: int | None) -> Iterator[Any]:
        """Work on one item that talks while it is worked on.

        Yields the content of each `Said`, the `Finished` or `OutOfMemory` of the item, and None every tick; ends when
        the process is gone. Limits are the caller's, who may `answer`, and end the process.

        Raises the exception of the function, as it was pickled.
        """
        batch = Batch(function=function, items=[(0, item)], data_limit_bytes=data_limit_bytes)
        with contextlib.suppress(BrokenPipeError):  # the caller sees its end
            self._write(frame(batch))
        before = self.begun
        for message in self._messages(never):
            if isinstance(message, Begun):
                self.begun += 1
            elif message is not None and self.begun == before:
                continue  # of a thread of the item before
            elif isinstance(message, Said):
                yield message.content
            elif isinstance(message, Raised):
                raise message.error
            else:
                yield message

    def answer(self, content: object) -> None:
        """Send something to the item that talks; harmless if the process is gone."""
        with contextlib.suppress(BrokenPipeError):
            self._write(frame(Heard(content)))

    def kill(self) -> None:
        """Kill the process and all that it started; harmless if it is gone."""
        self._look_at_cpu()
        self._process.kill()

    def end(self) -> None:
        """Kill the process, wait for its end and release its resources."""
        if self._stderr.closed:
            return
        self.kill()
        self._process.wait()
        self._process.close()
        self._stderr.close()

    def _write(self, content: bytes) -> None:
        """Write a whole message."""
        rest = memoryview(content)
        while rest:
            rest = rest[os.write(self._process.stdin, rest) :]

    def _messages(self, cancelled: Callable[[], bool]) -> Iterator[Any]:
        """Messages of the child as they come, and None every tick; ends when the child is gone."""
        cancel_at = 0.0
        tick_at = time.monotonic() + _TICK_S
        while True:
            if self._poll.poll(max(0.0, tick_at - time.monotonic()) * 1e3):
                received = os.read(self._process.stdout, _PIECE)
                if not received:
                    return
                try:
                    messages = list(self._frames.feed(received))
                except Exception as error:  # noqa: BLE001 - a building that corrupts memory can write anywhere
                    self._nonsense = f"its process sent what cannot be read: {type(error).__name__}"
                    return
                yield from messages
            now = time.monotonic()
            if now < tick_at:
                continue
            tick_at = now + _TICK_S
            self._cut_stderr()
            yield None
            if now >= cancel_at:
                cancel_at = now + _CANCEL_TICK_S
                if cancelled():
                    raise RunCancelledError("the run was cancelled")

    def how_it_ended(self) -> str:
        """Signal or exit code of a process whose pipe is closed."""
        self._look_at_cpu()  # until it is waited for, the system remembers
        if self._nonsense:
            return self._nonsense
        code = self._process.wait(_TRACE_WAIT_S)
        if code is None:
            return "its process closed its pipe"
        if code >= 0:
            return f"its process ended with exit code {code}"
        try:
            name = signal.Signals(-code).name
        except ValueError:
            name = "no name"
        return f"its process was ended by signal {-code} ({name})"

    def show_trace(self) -> None:
        """Let the child write a traceback to its standard error, and go on; harmless if it is gone."""
        if self._process.pid is not None and self.alive:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._process.pid, signal.SIGUSR1)

    def _ask_for_trace(self) -> None:
        """Let the child write a traceback; faulthandler does so even while a building holds the interpreter."""
        before = os.fstat(self._stderr.fileno()).st_size
        deadline = time.monotonic() + _TRACE_WAIT_S
        self.show_trace()
        while time.monotonic() < deadline:
            if os.fstat(self._stderr.fileno()).st_size > before and not self._poll.poll(_TICK_S * 1e3):
                return
            time.sleep(_TICK_S)

    def _cut_stderr(self) -> None:
        """Keep a child from filling the disk: only the end of its standard error stays."""
        found = os.fstat(self._stderr.fileno())
        if found.st_blocks * 512 <= _STDERR_KEPT_BYTES:
            return
        freed = found.st_size - _STDERR_REPORTED_BYTES
        if free_beginning(self._stderr.fileno(), freed):
            self._read_bytes = max(self._read_bytes, freed)
        else:
            tail = self._end_of_stderr()
            os.ftruncate(self._stderr.fileno(), 0)
            os.write(self._stderr.fileno(), tail)

    def _end_of_stderr(self) -> bytes:
        size = os.fstat(self._stderr.fileno()).st_size
        return os.pread(self._stderr.fileno(), _STDERR_REPORTED_BYTES, max(0, size - _STDERR_REPORTED_BYTES))

    def new_output(self) -> str:
        """What it wrote to its standard error since the last call."""
        size = os.fstat(self._stderr.fileno()).st_size
        begin, self._read_bytes = min(self._read_bytes, size), size
        return os.pread(self._stderr.fileno(), size - begin, begin).decode("utf-8", errors="replace")

    @property
    def last_output(self) -> str:
        """The end of its standard error."""
        return self._end_of_stderr().decode("utf-8", errors="replace").strip()


def free_beginning(descriptor: int, size: int) -> bool:
    """Free the disk beneath the first bytes of a file, which then read as zeros; False where that cannot be done.

    The file keeps its size, so what another process appends meanwhile stays.
    """
    fallocate = getattr(ctypes.CDLL(None), "fallocate", None)
    return fallocate is not None and fallocate(descriptor, _PUNCH_HOLE, ctypes.c_int64(0), ctypes.c_int64(size)) == 0


def system_kills() -> int:
    """Number of processes that Linux has ended for lack of memory since it started; 0 if unknown.

    Those of this process's control group; without one, those of the machine.
    """
    for path in (*_events_of_group(), Path("/proc/vmstat")):
        with contextlib.suppress(OSError, ValueError):
            counts = dict(line.split() for line in path.read_text(encoding="ascii").splitlines())
            if "oom_kill" in counts:
                return int(counts["oom_kill"])
    return 0


def _events_of_group() -> list[Path]:
    """The file in which the control group of this process counts what befell its memory, if it has one."""
    try:
        groups = Path("/proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
    # of the unified hierarchy; in a container its path begins at the container's own group
    own = [line.removeprefix("0::/") for line in groups if line.startswith("0::/")]
    return [Path("/sys/fs/cgroup", name, "memory.events") for name in own]
