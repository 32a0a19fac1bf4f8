"""The server that child processes are forked from: `python -m MODULE OWNER SOCKET [LOAD ...]`.

Started by `isolation.forked_child`, never by hand. It loads what children will need, once, and forks one whenever its
owner asks: a child then begins with all of that, in memory that it shares with its siblings. It does nothing else, has
one thread, and never sees an item of work.

```
owner                               server
    over the socket:
    control, stdin, stdout, stderr ▶         four descriptors of a child to be
    over the child's control:
    Order(environment, ...) ──────▶
                           ◀──────  its process id           once it is forked
                           ◀──────  its return code          once it ended, however; it stays a zombie until then
    (closes) ─────────────────────▶          it is killed if it lives, and waited for
```

Linux ends it when its owner dies, and its children when it dies (`PR_SET_PDEATHSIG`). Where the owner closes the socket
it forks no more, and ends after its last child.
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
from pipeline.runtime.isolation.messages import NUMBER, Frames, Order
from pipeline.runtime.isolation.start_up import start_own_process

NAME = "gablework-fork"
"""Name of the process, as `ps` and `top` show it."""
THREADED = 75
"""Exit code of a server that has more than one thread: a forked child would wait for locks that nobody lets go."""
_PIECE = 2**16
_DESCRIPTORS = 4
_STANDARD = 3


def main(arguments: Sequence[str]) -> None:
    """Load, then serve one owner until it is gone.

    Parameters
    ----------
    arguments : sequence of str
        The owner's process id, the descriptor of the socket to it, then what is loaded, as `isolation.child_main`
        takes it. What cannot be loaded is left to the children, who tell why.
    """
    start_own_process()
    child_main.end_with_parent(int(arguments[0]))
    load_all(arguments[2:])
    serve(socket.socket(fileno=int(arguments[1])))


def _close_all_but(orders: int) -> None:
    """Close all descriptors but the standard ones, one more, and files that are read.

    A library that was loaded before the fork, such as PROJ with its data base, goes on to read them by their numbers.
    """
    for number in sorted(int(name) for name in os.listdir("/proc/self/fd")):  # noqa: PTH208 - numbers, no paths
        if number < _STANDARD or number == orders:
            continue
        with contextlib.suppress(OSError):  # the listing's own is closed by now
            read_only = fcntl.fcntl(number, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY
            if not (read_only and stat.S_ISREG(os.fstat(number).st_mode)):
                os.close(number)


def load_all(loads: Sequence[str]) -> None:
    """Load what children will need; what cannot be loaded is left to them, who tell why."""
    for name in loads:
        try:
            child_main.load(name)
        except Exception:  # noqa: BLE001 - told by the child that needs it
            traceback.print_exc()


def serve_forked(owner: int, orders: socket.socket, stderr: int, loads: Sequence[str] = ()) -> NoReturn:
    """Be the server of the process that this one was just forked from, and of which it keeps nothing but the memory.

    Parameters
    ----------
    owner : int
        Process id of the other.
    orders : socket
        To it.
    stderr : int
        Descriptor that gets what this process has to say.
    loads : sequence of str
        What is loaded besides, as `pipeline.runtime.isolation.child_main` takes it.
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
    """Fork children for an owner; for a process with one thread, which ends here."""
    child_main.name_process(NAME)
    # the stop of a service goes to all its processes: this one ends with its owner, not before
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    gc.freeze()  # a collection in a child would write to all objects, and so copy the memory that is shared
    _Server(owner).serve()
    os._exit(0)


class _Child:
    """A child as the server knows it."""

    def __init__(self, pid: int, control: socket.socket) -> None:
        self.pid = pid
        self.control = control
        self.lives = os.pidfd_open(pid)
        self.ended = False


class _Server:
    """The loop: orders, ends of children, and children that nobody wants any more."""

    def __init__(self, owner: socket.socket) -> None:
        self._owner: socket.socket | None = owner
        self._poll = select.poll()
        self._poll.register(owner, select.POLLIN)
        self._children: dict[int, _Child] = {}  # by both descriptors

    def serve(self) -> None:
        """Serve until the owner closed the socket and the last child is gone."""
        while self._owner is not None or self._children:
            for descriptor, _ in self._poll.poll():
                if self._owner is not None and descriptor == self._owner.fileno():
                    self._take_order(self._owner)
                elif descriptor in self._children:
                    known = self._children[descriptor]
                    if descriptor == known.lives:
                        self._tell_end(known)
                    else:
                        self._let_go(known)

    def _take_order(self, owner: socket.socket) -> None:
        """Fork a child; hear that there will be no more orders."""
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
            except OSError:  # no room for one more process: its owner hears that it is gone, the others go on
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
        self._children |= {control.fileno(): known, known.lives: known}
        self._poll.register(known.lives, select.POLLIN)
        self._poll.register(control, select.POLLIN)
        _tell(control, pid)

    def _be_child(self, server: int, order: Order, control: socket.socket, standard: Sequence[int]) -> NoReturn:
        """The forked process: as one that was started by `exec`, but all is loaded."""
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
            with contextlib.suppress(OSError):  # a folder that is gone cannot be entered, and nobody needs it
                os.chdir(order.folder)
            child_main.serve_parent(server, order.loads)
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else 1
        except BaseException:  # noqa: BLE001 - as an interpreter ends
            traceback.print_exc()
        finally:
            os._exit(code)

    def _tell_end(self, known: _Child) -> None:
        """Tell the return code, and leave the process's number taken as long as somebody may signal it."""
        self._poll.unregister(known.lives)
        known.ended = True
        found = os.waitid(os.P_PID, known.pid, os.WEXITED | os.WNOWAIT)
        assert found is not None
        _tell(known.control, found.si_status if found.si_code == os.CLD_EXITED else -found.si_status)

    def _let_go(self, known: _Child) -> None:
        """The owner closed the child's control: nobody waits for it any more."""
        self._poll.unregister(known.control)
        if not known.ended:
            self._poll.unregister(known.lives)
            kill_with_group(known.pid)
        os.waitpid(known.pid, 0)
        del self._children[known.control.fileno()], self._children[known.lives]
        known.control.close()
        os.close(known.lives)


def kill_with_group(pid: int) -> None:
    """Kill a process that was not waited for yet and all that it started, also one that has no group of its own yet."""
    for kill in (os.killpg, os.kill):
        with contextlib.suppress(ProcessLookupError):
            kill(pid, signal.SIGKILL)


def _order(control: socket.socket) -> Order | None:
    """The order for a child; None where the owner is gone meanwhile."""
    frames = Frames()
    while received := control.recv(_PIECE):
        for order in frames.feed(received):
            assert isinstance(order, Order)
            return order
    return None


def _tell(control: socket.socket, number: int) -> None:
    with contextlib.suppress(BrokenPipeError):  # it was closed: the loop comes to that
        control.sendall(NUMBER.pack(number))


if __name__ == "__main__":
    main(sys.argv[1:])
