"""The child processes of this process: one for each thread that is at work, kept from batch to batch."""

from __future__ import annotations

import atexit
import contextlib
import functools
import os
import threading
from collections.abc import Callable, Iterator, Sequence

from pipeline.errors import RunError
from pipeline.runtime.isolation.forked_child import (
    ForkServer,
    can_fork,
    fork_server_here,
    has_one_thread,
    read_by_children,
    spawn_server,
)
from pipeline.runtime.isolation.spawned_child import SpawnedChild
from pipeline.runtime.isolation.supervision import SupervisedChild
from pipeline.runtime.monitoring.logs import LOG
from pipeline.runtime.monitoring.measurement import charge

FRUITLESS_STARTS = 3
"""Children that die in a row before they begin anything: then it is nobody's building that is at fault."""

_LOADS = ("pipeline.runtime.stages.model_batch:load",)
_START_TIMEOUT_S = 900.0
"""With compiled kernels a child takes two seconds; without, it compiles them."""


def start_failure(told: str, stderr: str, work: str = "models buildings") -> str:
    """The message where children that do some work do not last."""
    said = f". It said: {stderr}" if stderr else ""
    return f"the process that {work} does not last, {FRUITLESS_STARTS} times in a row: {told}{said}"


class _Children:
    """The children of this process: those that have nothing to do, and those that are lent out."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._idle: list[SupervisedChild] = []
        self._all: set[SupervisedChild] = set()
        self._server: ForkServer | None = None
        self._retired: list[ForkServer] = []
        self._can_fork = can_fork()
        self._closed = False

    @contextlib.contextmanager
    def lent(
        self, cancelled: Callable[[], bool], *, fresh: bool, loads: Sequence[str] | None
    ) -> Iterator[SupervisedChild]:
        """A ready child, `fresh` where it must not have done anything yet; ended where its work broke off.

        Raises
        ------
        RunCancelledError
            `cancelled` turned true.
        RunError
            No child can be started.
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
        """Kill all children and start no other; those that are lent out die under their users."""
        self._closed = True
        self.kill()

    def preload(self, loads: Sequence[str]) -> None:
        """Start the server that children are forked from, where none is there."""
        with self._lock:
            if not self._closed:
                self._serving(loads)

    def has_idle(self) -> bool:
        """Whether a living child has nothing to do, and would do it with the environment of now."""
        environment = read_by_children(os.environ)
        with self._lock:
            return any(child.alive and child.environment == environment for child in self._idle)

    def kill(self) -> None:
        """Kill all children; the next work starts others."""
        with self._lock:
            idle, lent = self._idle, self._all.difference(self._idle)
            self._idle, self._all = [], set(lent)
            for child in idle:
                child.end()
            for child in lent:
                child.kill()
            self._retire()
            for server in self._retired:
                server.end()
            self._retired.clear()

    def take(self, server: ForkServer) -> None:
        """Have children forked from a server."""
        with self._lock:
            self._retire()
            self._server = server

    def _ready_child(self, cancelled: Callable[[], bool], *, fresh: bool, loads: Sequence[str]) -> SupervisedChild:
        """An idle child or a new one."""
        fault = ""
        for start in range(FRUITLESS_STARTS):
            # where a forked one does not last, it may be for the server's sake
            child = self._idle_or_new(fresh=fresh, loads=loads, forked=start == 0)
            try:
                problem = child.wait_until_ready(_START_TIMEOUT_S, cancelled)
            except BaseException:
                self._end(child)
                raise
            if problem is None:
                return child
            fault = start_failure(problem, child.last_words)
            self._end(child)
        raise RunError(fault)

    def _idle_or_new(self, *, fresh: bool, loads: Sequence[str], forked: bool) -> SupervisedChild:
        with self._lock:
            if self._closed:
                raise RunError("this process is about to end: it models no buildings any more")
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
                return SupervisedChild(lambda stderr: server.forked(loads, stderr))
            except OSError as error:
                LOG.warning("no process can be forked: %s", error)
                self._retire()
        return SupervisedChild(lambda stderr: SpawnedChild(loads, stderr))

    def _serving(self, loads: Sequence[str]) -> ForkServer | None:
        """The server, started where none is there that can serve; None where children have to be executed."""
        if self._server is not None and not self._server.serves:
            if fault := self._server.fault:
                LOG.warning("the server that processes are forked from ended: %s", fault)
                # one that ended by itself will do so again; one that was killed will not
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


_children = _Children()


def borrowed_child(
    cancelled: Callable[[], bool], *, fresh: bool, loads: Sequence[str] | None = None
) -> contextlib.AbstractContextManager[SupervisedChild]:
    """A ready child of this process, for the time of a `with` block.

    Parameters
    ----------
    cancelled : callable
        Asked while the child gets ready.
    fresh : bool
        Whether it must not have done anything yet.
    loads : sequence of str, optional
        What a new child calls before it is ready, as `isolation.child_main` takes it; all methods by default. A
        child that is there already loads what else it needs when it needs it.

    Raises
    ------
    RunCancelledError
        `cancelled` turned true.
    RunError
        No child can be started.
    """
    return _children.lent(cancelled, fresh=fresh, loads=loads)


def preload(loads: Sequence[str]) -> None:
    """Have the server that children are forked from load what they will need, while this process does something else.

    Parameters
    ----------
    loads : sequence of str
        What it loads, as `isolation.child_main` takes it. Without this call the first child's loads are those of the
        server; a server that is there already loads nothing more: what is missing each child loads by itself.
    """
    _children.preload(loads)


def fork_server() -> None:
    """Have this process forked to be the server of its children, with all that it has loaded; it has one thread."""
    _children.take(ForkServer(functools.partial(fork_server_here, ())))


def has_idle_child() -> bool:
    """Whether a child of this process is there and has nothing to do."""
    return _children.has_idle()


def kill_children() -> None:
    """Kill the children of this process and the server that they were forked from; the next work starts others."""
    _children.kill()


def _forget_children() -> None:
    """A forked copy of this process leaves the children to the original."""
    global _children  # noqa: PLW0603 - one pool a process
    _children = _Children()


os.register_at_fork(after_in_child=_forget_children)


@atexit.register
def close_children() -> None:
    """End the children of this process and start no others; a process that ends without `atexit` calls it itself."""
    _children.close()
