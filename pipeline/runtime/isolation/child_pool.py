"""The child processes of this process: one per working thread, reused from batch to batch."""

from __future__ import annotations

import atexit
import contextlib
import functools
import os
import threading
from collections.abc import Callable, Iterator, Sequence

from pipeline.errors import RunError
from pipeline.io.apart import has_one_thread
from pipeline.runtime.isolation.forked_child import (
    ForkServer,
    can_fork,
    fork_server_here,
    read_by_children,
    spawn_server,
)
from pipeline.runtime.isolation.spawned_child import SpawnedChild
from pipeline.runtime.isolation.supervision import SupervisedChild
from pipeline.runtime.monitoring.logs import LOG
from pipeline.runtime.monitoring.measurement import charge

FRUITLESS_STARTS = 3
"""Children that die in a row before they begin an item; then no building is to blame."""

_LOADS = ("pipeline.runtime.stages.rehearsal:load",)
_START_TIMEOUT_S = 900.0
"""A child takes two seconds with compiled kernels; without them it compiles them first."""


def start_failure(detail: str, stderr: str, work: str = "models buildings") -> str:
    """The message if children die before they begin an item."""
    output = f". Its output: {stderr}" if stderr else ""
    return f"the process that {work} died {FRUITLESS_STARTS} times in a row before it began: {detail}{output}"


class ChildPool:
    """The children of this process, idle or borrowed.

    Parameters
    ----------
    stderr : int, optional
        A descriptor that is the standard error of all children; by default each child has a file of its own.
    """

    def __init__(self, stderr: int | None = None) -> None:
        self._stderr = stderr
        self._lock = threading.Lock()
        self._idle: list[SupervisedChild] = []
        self._all: set[SupervisedChild] = set()
        self._server: ForkServer | None = None
        self._retired: list[ForkServer] = []
        self._can_fork = can_fork()
        self._closed = False

    @contextlib.contextmanager
    def borrowed(
        self, cancelled: Callable[[], bool], *, fresh: bool, loads: Sequence[str] | None
    ) -> Iterator[SupervisedChild]:
        """A ready child, with `fresh` one that has not begun any item; ended if its work breaks off.

        Raises the errors of `borrowed_child`.
        """
        child = self._ready_child(cancelled, fresh=fresh, loads=_LOADS if loads is None else loads)
        try:
            yield child
        except BaseException:
            self._end(child)
            raise
        finally:
            charge(child.spent_cpu_s())
        with self._lock:
            kept = child.alive and not self._closed
            if kept:
                self._idle.append(child)
        if not kept:
            self._end(child)

    def close(self) -> None:
        """Kill all children, also borrowed ones, and start no others."""
        self._closed = True
        self.kill()

    def preload(self, loads: Sequence[str]) -> None:
        """Start the server that children are forked from, unless there is one."""
        with self._lock:
            if not self._closed:
                self._serving(loads)

    def has_idle(self) -> bool:
        """Whether a living child with the present environment is idle."""
        environment = read_by_children(os.environ)
        with self._lock:
            return any(child.alive and child.environment == environment for child in self._idle)

    def kill(self) -> None:
        """Kill all children; later work starts others."""
        with self._lock:
            idle, busy = self._idle, self._all.difference(self._idle)
            self._idle, self._all = [], set(busy)
            for child in idle:
                child.end()
            for child in busy:
                child.kill()
            self._retire()
            for server in self._retired:
                server.end()
            self._retired.clear()

    def use_server(self, server: ForkServer) -> None:
        """Fork children from a server."""
        with self._lock:
            self._retire()
            self._server = server

    def _ready_child(self, cancelled: Callable[[], bool], *, fresh: bool, loads: Sequence[str]) -> SupervisedChild:
        """An idle child or a new one."""
        fault = ""
        for start in range(FRUITLESS_STARTS):
            # if a forked child dies at once, its server may be the cause
            child = self._idle_or_new(fresh=fresh, loads=loads, forked=start == 0)
            try:
                problem = child.wait_until_ready(_START_TIMEOUT_S, cancelled)
            except BaseException:
                self._end(child)
                raise
            if problem is None:
                return child
            fault = start_failure(problem, child.last_output)
            self._end(child)
        raise RunError(fault)

    def _idle_or_new(self, *, fresh: bool, loads: Sequence[str], forked: bool) -> SupervisedChild:
        with self._lock:
            if self._closed:
                raise RunError("this process is about to end and starts no more children")
            environment = read_by_children(os.environ)
            for child in tuple(self._idle):
                if not child.alive or child.environment != environment:
                    self._idle.remove(child)
                    self._all.discard(child)
                    child.end()
                elif not (fresh and child.begun):
                    self._idle.remove(child)
                    return child
            child = self._new(loads, forked=forked)
            self._all.add(child)
        return child

    def _new(self, loads: Sequence[str], *, forked: bool) -> SupervisedChild:
        server = self._serving(loads) if forked else None
        if server is not None:
            try:
                return SupervisedChild(lambda own: server.fork(loads, self._stderr_or(own)))
            except OSError as error:
                LOG.warning("no process can be forked: %s", error)
                self._retire()
        return SupervisedChild(lambda own: SpawnedChild(loads, self._stderr_or(own)))

    def _stderr_or(self, own: int) -> int:
        return own if self._stderr is None else self._stderr

    def _serving(self, loads: Sequence[str]) -> ForkServer | None:
        """The server, started if necessary; None if children have to be spawned."""
        if self._server is not None and not self._server.serves:
            if fault := self._server.fault:
                LOG.warning("the server that processes are forked from ended: %s", fault)
                # a server that ended by itself would do so again, one that was killed would not
                self._can_fork = self._server.was_killed
            self._retire()
        self._retired = [server for server in self._retired if server.alive]
        if self._server is None and self._can_fork:
            start = fork_server_here if has_one_thread() else spawn_server
            self._server = ForkServer(functools.partial(start, loads))
        return self._server

    def _retire(self) -> None:
        if self._server is not None:
            self._server.retire()
            self._retired.append(self._server)
            self._server = None

    def _end(self, child: SupervisedChild) -> None:
        child.end()
        with self._lock:
            self._all.discard(child)


_pool = ChildPool()


def borrowed_child(
    cancelled: Callable[[], bool], *, fresh: bool, loads: Sequence[str] | None = None
) -> contextlib.AbstractContextManager[SupervisedChild]:
    """A ready child of this process for a `with` block.

    Raises RunCancelledError if `cancelled` turned true, RunError if no child can be started.

    Parameters
    ----------
    cancelled : callable
        Polled while the child gets ready.
    fresh : bool
        Whether it must not have begun any item.
    loads : sequence of str, optional
        Loads of a new child, as in `isolation.child_main`; all methods by default. An existing child loads what else it
        needs when it needs it.
    """
    return _pool.borrowed(cancelled, fresh=fresh, loads=loads)


def preload(loads: Sequence[str]) -> None:
    """Start the server that children are forked from, and let it load what they need in the meantime.

    Loads are as in `isolation.child_main`. Without this call the server has the first child's loads. An existing server
    loads nothing else; each child then loads what is missing.
    """
    _pool.preload(loads)


def fork_own_server() -> None:
    """Fork this process, which has one thread, as the server of its children, with everything that it has loaded."""
    _pool.use_server(ForkServer(functools.partial(fork_server_here, ())))


def has_idle_child() -> bool:
    """Whether a child of this process is idle."""
    return _pool.has_idle()


def kill_children() -> None:
    """Kill the children of this process and their server; later work starts others."""
    _pool.kill()


def _forget_children() -> None:
    """Leave the children to the original process after a fork."""
    global _pool  # noqa: PLW0603 - one pool per process
    _pool = ChildPool()


os.register_at_fork(after_in_child=_forget_children)


@atexit.register
def close_children() -> None:
    """End the children of this process and start no others; processes that end without `atexit` call it."""
    _pool.close()
