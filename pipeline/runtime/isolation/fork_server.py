"""The server that child processes are forked from: `python -m MODULE OWNER SOCKET [LOAD ...]`.

Started by `isolation.forked_child`, never by hand. It loads what children need, once, and forks a child whenever its
owner orders one: the child begins with everything loaded, in memory shared with its siblings. The server does nothing
else, has one thread, and never sees an item of work.

```
owner                               server
    over the socket:
    control, stdin, stdout, stderr ▶         four descriptors of the new child
    over the child's control:
    Order(environment, ...) ──────▶
                           ◀──────  its process id           after the fork
                           ◀──────  its return code          after its end; it remains a zombie until then
    (closes) ─────────────────────▶          the child is killed if it lives, and reaped
```

Linux ends the server when its owner dies, and its children when it dies (`PR_SET_PDEATHSIG`). After the owner closes
the socket, the server forks no more and ends after its last child.
"""

from __future__ import annotations

import contextlib
import fcntl
import gc
import os
import select
import signal
import socket
import stat
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from pipeline.runtime.isolation import child_main
from pipeline.runtime.isolation.child_messages import NUMBER, Frames, Order
from pipeline.runtime.isolation.start_up import start_own_process

NAME = "gablework-fork"
"""Name of the process in `ps` and `top`."""
THREADED = 75
"""Exit code of a server with more than one thread: a forked child could wait forever for a lock."""
_PIECE = 2**16
_DESCRIPTORS = 4
_STANDARD = 3


def main(arguments: Sequence[str]) -> None:
    """Load, then serve one owner until it is gone.

    The arguments are the owner's process id, the descriptor of the socket to it, then the loads, as in
    `isolation.child_main`.
    """
    start_own_process()
    child_main.end_with_parent(int(arguments[0]))
    load_all(arguments[2:])
    serve(socket.socket(fileno=int(arguments[1])))


def _close_all_but(orders: int) -> None:
    """Close all descriptors except the standard ones, `orders`, and files open for reading.

    Libraries loaded before the fork, such as PROJ with its database, continue to read these files by number.
    """
    for number in sorted(int(name) for name in os.listdir("/proc/self/fd")):  # noqa: PTH208 - numbers, no paths
        if number < _STANDARD or number == orders:
            continue
        with contextlib.suppress(OSError):  # the listing's own is closed by now
            read_only = fcntl.fcntl(number, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY
            if not (read_only and stat.S_ISREG(os.fstat(number).st_mode)):
                os.close(number)


def load_all(loads: Sequence[str]) -> None:
    """Load what children need; a load that fails is repeated by each child, which reports the fault."""
    for name in loads:
        try:
            child_main.load(name)
        except Exception:  # noqa: BLE001 - the child that needs it reports it
            traceback.print_exc()


def serve_forked(owner: int, orders: socket.socket, stderr: int, loads: Sequence[str] = ()) -> NoReturn:
    """Become the server of the process that this one was just forked from, keeping only its memory.

    `stderr` is the descriptor for the standard error of this process; the loads are additional ones.
    """
    try:
        start_own_process()
        os.setsid()
        child_main.end_with_parent(owner)
        nothing = os.open(os.devnull, os.O_RDWR)
        for number, descriptor in enumerate((nothing, nothing, stderr)):
            os.dup2(descriptor, number)
        _close_all_but(orders.fileno())
        signal.set_wakeup_fd(-1)
        for name in (signal.SIGCHLD, signal.SIGINT):
            signal.signal(name, signal.SIG_DFL)
        load_all(loads)
        serve(orders)
    except BaseException:  # noqa: BLE001 - as an interpreter ends
        traceback.print_exc()
    finally:
        os._exit(1)


def serve(owner: socket.socket) -> NoReturn:
    """Fork children for an owner, then end this process, which has one thread."""
    child_main.name_process(NAME)
    # stopping a service signals all its processes; this one ends with its owner, not before
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    gc.freeze()  # a collection in a child would write to all objects and thus copy the shared memory
    _Server(owner).serve()
    os._exit(0)


class _Child:
    """A child, seen from the server."""

    def __init__(self, pid: int, control: socket.socket) -> None:
        self.pid = pid
        self.control = control
        self.pidfd = os.pidfd_open(pid)
        self.ended = False


class _Server:
    """The loop: orders, ends of children, and children that the owner drops."""

    def __init__(self, owner: socket.socket) -> None:
        self._owner: socket.socket | None = owner
        self._poll = select.poll()
        self._poll.register(owner, select.POLLIN)
        self._children: dict[int, _Child] = {}  # by both descriptors

    def serve(self) -> None:
        """Serve until the owner has closed the socket and the last child is gone."""
        while self._owner is not None or self._children:
            for descriptor, _ in self._poll.poll():
                if self._owner is not None and descriptor == self._owner.fileno():
                    self._take_order(self._owner)
                elif descriptor in self._children:
                    known = self._children[descriptor]
                    if descriptor == known.pidfd:
                        self._report_end(known)
                    else:
                        self._drop(known)

    def _take_order(self, owner: socket.socket) -> None:
        """Fork a child, or note that there will be no more orders."""
        word, descriptors, _, _ = socket.recv_fds(owner, 1, _DESCRIPTORS)
        if not word:
            self._poll.unregister(owner)
            owner.close()
            self._owner = None
            return
        control = socket.socket(fileno=descriptors[0])
        order = _order(control)
        if order is None:
            control.close()
        else:
            try:
                self._fork(order, control, descriptors[1:])
            except OSError:  # no room for another process: its owner sees that it is gone, the others continue
                traceback.print_exc()
                control.close()
        for descriptor in descriptors[1:]:
            os.close(descriptor)

    def _fork(self, order: Order, control: socket.socket, standard: Sequence[int]) -> None:
        if sum(1 for _ in Path("/proc/self/task").iterdir()) > 1:
            os._exit(THREADED)
        server = os.getpid()
        pid = os.fork()
        if not pid:
            self._be_child(server, order, control, standard)
        try:
            known = _Child(pid, control)
        except OSError:
            kill_with_group(pid)
            os.waitpid(pid, 0)
            raise
        self._children |= {control.fileno(): known, known.pidfd: known}
        self._poll.register(known.pidfd, select.POLLIN)
        self._poll.register(control, select.POLLIN)
        _send(control, pid)

    def _be_child(self, server: int, order: Order, control: socket.socket, standard: Sequence[int]) -> NoReturn:
        """Run the forked process like a spawned one, with everything loaded."""
        code = 1
        try:
            os.setsid()
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            for number, descriptor in enumerate(standard):
                os.dup2(descriptor, number)
                os.close(descriptor)
            control.close()
            if self._owner is not None:
                self._owner.close()
            for descriptor in self._children:
                os.close(descriptor)
            os.environ.clear()
            os.environ.update(order.environment)
            with contextlib.suppress(OSError):  # a folder that is gone cannot be entered, and no child needs it
                os.chdir(order.folder)
            child_main.serve_parent(server, order.loads)
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else 1
        except BaseException:  # noqa: BLE001 - as an interpreter ends
            traceback.print_exc()
        finally:
            os._exit(code)

    def _report_end(self, known: _Child) -> None:
        """Send the return code; the process id stays taken as long as the owner may signal it."""
        self._poll.unregister(known.pidfd)
        known.ended = True
        found = os.waitid(os.P_PID, known.pid, os.WEXITED | os.WNOWAIT)
        assert found is not None
        _send(known.control, found.si_status if found.si_code == os.CLD_EXITED else -found.si_status)

    def _drop(self, known: _Child) -> None:
        """End a child whose control the owner has closed."""
        self._poll.unregister(known.control)
        if not known.ended:
            self._poll.unregister(known.pidfd)
            kill_with_group(known.pid)
        os.waitpid(known.pid, 0)
        del self._children[known.control.fileno()], self._children[known.pidfd]
        known.control.close()
        os.close(known.pidfd)


def kill_with_group(pid: int) -> None:
    """Kill a process that was not reaped yet and all that it started, also if it has no group of its own yet."""
    for kill in (os.killpg, os.kill):
        with contextlib.suppress(ProcessLookupError):
            kill(pid, signal.SIGKILL)


def _order(control: socket.socket) -> Order | None:
    """The order for a child; None if the owner is gone."""
    frames = Frames()
    while received := control.recv(_PIECE):
        for order in frames.feed(received):
            assert isinstance(order, Order)
            return order
    return None


def _send(control: socket.socket, number: int) -> None:
    with contextlib.suppress(BrokenPipeError):  # it was closed: the loop handles that
        control.sendall(NUMBER.pack(number))


if __name__ == "__main__":
    main(sys.argv[1:])
