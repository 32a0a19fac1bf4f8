"""The owner's side of a fork server: starting it, and the children that it forks."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO

from pipeline.runtime.isolation.child_messages import NUMBER, Order, frame
from pipeline.runtime.isolation.fork_server import THREADED, kill_with_group, serve_forked
from pipeline.runtime.isolation.spawned_child import environment_with_this_package, run_in_starter_thread
from pipeline.runtime.isolation.start_up import WITHOUT_THREADS

_READ_AT_START = (
    *("PYTHON", "LD_", "LC_", "LANG", "TZ"),
    *("NUMBA_", "GABLEWORK_", "ARROW_", "GDAL_", "PROJ_"),
)
"""Prefixes of variables that the interpreter or a library reads once: if they change, a new server is needed."""
_READ_LATER = (
    *("GABLEWORK_WORKER_", "PYTHONSAFEPATH", "PYTHONHASHSEED"),
    *("GDAL_CURL_CA_BUNDLE", "PROJ_CURL_CA_BUNDLE"),
)
"""Prefixes of variables that look like those and matter to no child: Dask sets one, and pyogrio the last two when it is
loaded."""


_OUTPUT_BYTES = 2000
_END_S = 1.0


def can_fork() -> bool:
    """Whether a server can run here: Linux, without a sandbox that forbids its system calls."""
    if sys.platform != "linux" or not hasattr(os, "pidfd_open"):
        return False
    try:
        os.close(os.pidfd_open(os.getpid()))
    except OSError:
        return False
    return True


class ForkedChild:
    """A process that a server forks for this one after loading; see `isolation.spawned_child.ChildProcess`."""

    def __init__(self, control: socket.socket, stdin: int, stdout: int) -> None:
        self.stdin, self.stdout = stdin, stdout
        self._control = control
        self._lock = threading.Lock()
        self._received = bytearray()
        self._pid: int | None = None
        self._code: int | None = None

    @property
    def pid(self) -> int | None:
        """Its process id; None until it exists."""
        if self._pid is None and self._code is None:
            self._receive(0.0)
        return self._pid

    def poll(self) -> int | None:
        """Its return code; None until its end."""
        if self._code is None:
            self._receive(0.0)
        return self._code

    def wait(self, timeout_s: float | None = None) -> int | None:
        """Wait for its end; returns its return code, or None after the time-out."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while self.poll() is None:
            left_s = None if deadline is None else deadline - time.monotonic()
            if left_s is not None and left_s <= 0.0:
                break
            self._receive(left_s)
        return self._code

    def kill(self) -> None:
        """Kill it and all that it started; harmless if it is gone."""
        if self.poll() is not None:
            return
        if self._pid is not None:
            kill_with_group(self._pid)
            return
        with contextlib.suppress(OSError):
            self._control.shutdown(socket.SHUT_RDWR)
        self._code = -signal.SIGKILL

    def close(self) -> None:
        """Release an ended process."""
        self._control.close()
        os.close(self.stdin)
        os.close(self.stdout)

    def _receive(self, timeout_s: float | None) -> None:
        """Take what the server sends about it within some time."""
        poll = select.poll()
        poll.register(self._control, select.POLLIN)
        if not poll.poll(None if timeout_s is None else 1e3 * timeout_s):
            return
        with self._lock:
            try:
                received = self._control.recv(2 * NUMBER.size, socket.MSG_DONTWAIT)
            except BlockingIOError:  # another thread took it
                return
            except ConnectionResetError:
                received = b""
            if not received:
                # the server is gone, and its children with it
                self._code = -signal.SIGKILL if self._code is None else self._code
                return
            self._received += received
            numbers = [number for (number,) in NUMBER.iter_unpack(self._received[: len(self._received) // 8 * 8])]
            self._pid = numbers[0] if numbers else None
            if len(numbers) > 1:
                self._code = numbers[1]


class ForkedServer:
    """A server forked from this process, with the methods of `subprocess.Popen`."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._code: int | None = None

    def poll(self) -> int | None:
        """Its return code; None as long as it lives."""
        return self._waited(os.WNOHANG)

    def wait(self, timeout: float | None = None) -> int | None:
        """Wait for its end and return its return code; raises TimeoutError if it still lives."""
        if timeout is not None and self._code is None:
            pidfd = os.pidfd_open(self._pid)
            try:
                if not select.select([pidfd], [], [], timeout)[0]:
                    raise TimeoutError
            finally:
                os.close(pidfd)
        return self._waited(0)

    def kill(self) -> None:
        """Kill it."""
        if self.poll() is None:
            os.kill(self._pid, signal.SIGKILL)

    def _waited(self, options: int) -> int | None:
        if self._code is None:
            pid, status = os.waitpid(self._pid, options)
            if pid:
                self._code = os.waitstatus_to_exitcode(status)
        return self._code


def spawn_server(loads: Sequence[str], orders: socket.socket, stderr: IO[bytes]) -> subprocess.Popen[bytes]:
    """Start a server in a new interpreter, with loads as in `isolation.child_main`."""
    command = [sys.executable, "-P", "-m", "pipeline.runtime.isolation.fork_server", str(os.getpid())]
    return run_in_starter_thread(
        subprocess.Popen,
        [*command, str(orders.fileno()), *loads],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=stderr,
        pass_fds=[orders.fileno()],
        start_new_session=True,
        env=environment_with_this_package() | WITHOUT_THREADS,
    )


def fork_server_here(loads: Sequence[str], orders: socket.socket, stderr: IO[bytes]) -> ForkedServer:
    """Fork a server from this process, which has one thread, with everything loaded here and further loads."""
    owner = os.getpid()
    pid = os.fork()
    if not pid:
        os.environ.update(WITHOUT_THREADS)
        serve_forked(owner, orders, stderr.fileno(), loads)
    return ForkedServer(pid)


class ForkServer:
    """A server, seen from its owner.

    Parameters
    ----------
    start : callable
        Starts it, with a socket for orders and a file for its standard error: `spawn_server`, `fork_server_here`.
    """

    def __init__(self, start: Callable[[socket.socket, IO[bytes]], subprocess.Popen[bytes] | ForkedServer]) -> None:
        self._environment = read_at_start(os.environ)
        self._stderr = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115 - lives as long as this object
        self._socket, there = socket.socketpair()
        with there:
            self._process = start(there, self._stderr)
        self._used = False

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return self._process.poll() is None

    @property
    def fault(self) -> str:
        """Why it is gone; empty while it runs."""
        code = self._process.poll()
        if code is None:
            return ""
        if code == THREADED:
            return "a module that it loaded has started threads"
        size = os.fstat(self._stderr.fileno()).st_size
        output = os.pread(self._stderr.fileno(), _OUTPUT_BYTES, max(0, size - _OUTPUT_BYTES))
        return f"return code {code}. Its output: {output.decode(errors='replace').strip()}"

    @property
    def was_killed(self) -> bool:
        """Whether it was killed, for example by the system for lack of memory."""
        return self._process.poll() == -signal.SIGKILL

    @property
    def serves(self) -> bool:
        """Whether it runs, and was started with the present environment."""
        return self.alive and self._environment == read_at_start(os.environ)

    def fork(self, loads: Sequence[str], stderr: int) -> ForkedChild:
        """Order a process that runs `isolation.child_main`, forked once the server has loaded; OSError if that died."""
        self._used = True
        order = Order(environment=environment_with_this_package(), folder=_folder(), loads=tuple(loads))
        theirs: list[int] = []
        control, there = socket.socketpair()
        try:
            stdin, ours = os.pipe()
            theirs.append(stdin)
            result, stdout = os.pipe()
            theirs.append(stdout)
            process = ForkedChild(control, ours, result)
            try:
                socket.send_fds(self._socket, [b"."], [there.fileno(), stdin, stdout, stderr])
                control.sendall(frame(order))
            except OSError:
                process.close()
                raise
        finally:
            there.close()
            for descriptor in theirs:
                os.close(descriptor)
        return process

    def retire(self) -> None:
        """Order nothing more; it ends after its last child."""
        self._socket.close()

    def end(self) -> None:
        """End it: by itself if its children are gone, which counts their processor time, otherwise with them."""
        self.retire()
        if self._used:
            with contextlib.suppress(TimeoutError, subprocess.TimeoutExpired):
                self._process.wait(_END_S)
        self._process.kill()
        self._process.wait()


def _folder() -> str:
    """The working directory; empty if it is gone."""
    try:
        return str(Path.cwd())
    except FileNotFoundError:
        return ""


def read_by_children(environment: Mapping[str, str]) -> dict[str, str]:
    """The variables that may matter to a child, such as the keys of an object store, which it reads at work."""
    return {name: value for name, value in environment.items() if not name.startswith(_READ_LATER)}


def read_at_start(environment: Mapping[str, str]) -> dict[str, str]:
    """The variables that are read only once, when a process starts."""
    return {
        name: value
        for name, value in environment.items()
        if name.startswith(_READ_AT_START) and not name.startswith(_READ_LATER)
    }
