"""One supervised child process: started, given work, watched, ended."""

from __future__ import annotations

import contextlib
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
from pipeline.runtime.isolation.forked_child import read_by_children
from pipeline.runtime.isolation.messages import Batch, Begun, Finished, Frames, OutOfMemory, Raised, Ready, frame
from pipeline.runtime.isolation.spawned_child import Started

_PIECE = 2**20
_TICK_S = 0.05
"""Memory and time of the child are looked at this often."""
_CANCEL_TICK_S = 0.25
_TRACE_WAIT_S = 2.0
_STDERR_KEPT_BYTES = 8 * 2**20
_STDERR_TOLD_BYTES = 6000
_DATA_MARGIN_BYTES = 2**30
"""What a child may ask for beyond its limit: address space is more than what is used of it."""


class Cause(StrEnum):
    """What ended a child."""

    DIED = "died"
    TIME = "time"
    MEMORY = "memory"


@dataclasses.dataclass(frozen=True, kw_only=True)
class End:
    """How a child came to its end while it had work."""

    cause: Cause
    """What ended it."""
    index: int | None
    """The item that it had announced and not finished; None where there was none."""
    told: str
    """What happened, in the same words whenever it happens again."""
    seconds: float
    """Since that item was announced."""
    memory_bytes: int
    """Largest private memory seen meanwhile."""
    stderr: str
    """The last lines of its standard error: the place where Python was, if it could still be told."""


class SupervisedChild:
    """A process that runs `pipeline.runtime.isolation.child_main`.

    Parameters
    ----------
    start : callable
        Starts it, with its standard error at a descriptor: `SpawnedChild`, or `ForkServer.forked`.
    """

    def __init__(self, start: Callable[[int], Started]) -> None:
        self._stderr = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 - closed in `end`
        # both processes write behind the end, also after it was cut
        fcntl.fcntl(self._stderr, fcntl.F_SETFL, fcntl.fcntl(self._stderr, fcntl.F_GETFL) | os.O_APPEND)
        self._process = start(self._stderr.fileno())
        self._watched: Any = None
        self._poll = select.poll()
        self._poll.register(self._process.stdout, select.POLLIN)
        self._frames = Frames()
        self._ready = False
        self._nonsense = ""
        self.environment = read_by_children(os.environ)
        """What it was started with."""
        self.begun = 0
        """Items that it announced so far."""
        self._heard = 0
        self._told_cpu_s = 0.0
        self._seen_cpu_s = 0.0

    @property
    def alive(self) -> bool:
        """Whether the process is there."""
        return self._process.poll() is None

    @property
    def memory_bytes(self) -> int:
        """Its private memory: resident, without what it shares with files; 0 where it is not there."""
        info = self._seen("memory_info")
        return 0 if info is None else int(info.rss) - int(getattr(info, "shared", 0))

    def spent_cpu_s(self) -> float:
        """CPU seconds that it spent since this was last asked, its start included; of one that is gone as last seen."""
        self._look_at_cpu()
        spent, self._told_cpu_s = self._seen_cpu_s - self._told_cpu_s, self._seen_cpu_s
        return spent

    def _look_at_cpu(self) -> None:
        times = self._seen("cpu_times")
        if times is not None:
            self._seen_cpu_s = max(self._seen_cpu_s, times.user + times.system)

    def _seen(self, what: str) -> Any:
        """What psutil tells of the process; None where it is not there."""
        import psutil  # type: ignore[import-untyped]  # slow to load, and a serial run has no child

        if self._watched is None and self._process.pid is None:
            return None
        try:
            self._watched = self._watched or psutil.Process(self._process.pid)
            return getattr(self._watched, what)()
        except psutil.Error:
            return None

    def wait_until_ready(self, timeout_s: float, cancelled: Callable[[], bool]) -> str | None:
        """Wait for the child to have loaded what it needs.

        Returns
        -------
        str or None
            Why it is not ready and never will be; None where it is.

        Raises
        ------
        RunCancelledError
            `cancelled` turned true.
        """
        if self._ready:
            return None
        deadline = time.monotonic() + timeout_s
        for message in self._messages(cancelled):
            if isinstance(message, Ready):
                self._ready = True
                return None
            if time.monotonic() > deadline:
                return f"it was not ready after {timeout_s:g} s"
        return self._how_it_ended()

    def work(
        self,
        function: Callable[[Any], Any],
        items: Sequence[tuple[int, Any]],
        *,
        timeout_s: float,
        memory_bytes: int,
        cancelled: Callable[[], bool],
        one: str = "building",
    ) -> Iterator[Finished | End]:
        """Work off items; every result as it comes, and an `End` as the last one where the child did not last.

        `one` is what an item is called where it took too much.

        Raises
        ------
        RunCancelledError
            `cancelled` turned true.
        Exception
            What `function` raised.
        """
        batch = Batch(function=function, items=items, data_limit_bytes=memory_bytes + _DATA_MARGIN_BYTES)
        with contextlib.suppress(BrokenPipeError):  # its end is told below
            self._write(frame(batch))
        allowed = f"the {memory_bytes / 2**30:g} GiB that a {one} may take"
        kills = _system_kills()
        left = len(items)
        at_work: int | None = None
        began = time.monotonic()
        peak_bytes = 0

        def ended(cause: Cause, told: str) -> End:
            return End(
                cause=cause,
                index=at_work,
                told=told,
                seconds=time.monotonic() - began,
                memory_bytes=peak_bytes,
                stderr=self.last_words,
            )

        for message in self._messages(cancelled):
            match message:
                case Begun():
                    at_work, began, peak_bytes = message.index, time.monotonic(), 0
                    self.begun += 1
                case Finished():
                    at_work = None
                    left -= 1
                    yield message
                    if left == 0:
                        return
                case OutOfMemory():
                    peak_bytes = max(peak_bytes, self.memory_bytes)
                    yield ended(Cause.MEMORY, f"it asked for more than {allowed}")
                    return
                case Raised():
                    raise message.error
                case _:
                    used = self.memory_bytes
                    peak_bytes = max(peak_bytes, used)
                    if used > memory_bytes:
                        yield ended(Cause.MEMORY, f"it took more than {allowed}")
                        return
                    if at_work is not None and time.monotonic() - began > timeout_s:
                        self._ask_for_trace()
                        yield ended(Cause.TIME, f"it took longer than {timeout_s:g} s, the limit that protects a run")
                        return
        told = self._how_it_ended()
        if self._process.poll() == -signal.SIGKILL and _system_kills() > kills:
            yield ended(Cause.MEMORY, "the system ran out of memory and ended its process")
        else:
            yield ended(Cause.DIED, told)

    def kill(self) -> None:
        """Kill the process and all that it started; harmless where it is gone."""
        self._look_at_cpu()
        self._process.kill()

    def end(self) -> None:
        """Kill the process, wait for its end and let go of all that belongs to it."""
        if self._stderr.closed:
            return
        self.kill()
        self._process.wait()
        self._process.close()
        self._stderr.close()

    def _write(self, content: bytes) -> None:
        """Write a message whole."""
        rest = memoryview(content)
        while rest:
            rest = rest[os.write(self._process.stdin, rest) :]

    def _messages(self, cancelled: Callable[[], bool]) -> Iterator[Any]:
        """What the child says as it comes, and None every tick; ends when the child is gone."""
        cancel_at = 0.0
        tick_at = time.monotonic() + _TICK_S
        while True:
            if self._poll.poll(max(0.0, tick_at - time.monotonic()) * 1e3):
                received = os.read(self._process.stdout, _PIECE)
                if not received:
                    return
                try:
                    messages = list(self._frames.feed(received))
                except Exception as error:  # noqa: BLE001 - a wild building can write anywhere
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
                    raise RunCancelledError("the run was called off")

    def _how_it_ended(self) -> str:
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

    def _ask_for_trace(self) -> None:
        """Have the child write where it is; faulthandler does that also while a building holds the interpreter."""
        before = os.fstat(self._stderr.fileno()).st_size
        deadline = time.monotonic() + _TRACE_WAIT_S
        assert self._process.pid is not None
        os.kill(self._process.pid, signal.SIGUSR1)
        while time.monotonic() < deadline:
            if os.fstat(self._stderr.fileno()).st_size > before and not self._poll.poll(_TICK_S * 1e3):
                return
            time.sleep(_TICK_S)

    def _cut_stderr(self) -> None:
        """Keep a talkative child from filling the disk, but not from being heard: the end of what it said stays."""
        if os.fstat(self._stderr.fileno()).st_size > _STDERR_KEPT_BYTES:
            tail = self._end_of_stderr()
            os.ftruncate(self._stderr.fileno(), 0)
            os.write(self._stderr.fileno(), tail)

    def _end_of_stderr(self) -> bytes:
        size = os.fstat(self._stderr.fileno()).st_size
        return os.pread(self._stderr.fileno(), _STDERR_TOLD_BYTES, max(0, size - _STDERR_TOLD_BYTES))

    def new_words(self) -> str:
        """What it wrote to its standard error since this was last asked."""
        size = os.fstat(self._stderr.fileno()).st_size
        begin, self._heard = min(self._heard, size), size
        return os.pread(self._stderr.fileno(), size - begin, begin).decode("utf-8", errors="replace")

    @property
    def last_words(self) -> str:
        """The end of its standard error."""
        return self._end_of_stderr().decode("utf-8", errors="replace").strip()


def _system_kills() -> int:
    """How many processes Linux has ended for lack of memory since it started; 0 where that is not told."""
    try:
        counts = dict(line.split() for line in Path("/proc/vmstat").read_text(encoding="ascii").splitlines())
    except OSError:
        return 0
    return int(counts.get("oom_kill", 0))
