"""Child processes in new interpreters, which import everything; slower than forked ones."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import ParamSpec, Protocol, TypeVar

Arguments = ParamSpec("Arguments")
Value = TypeVar("Value")


class ChildProcess(Protocol):
    """A forked or spawned child process, and the pipes to its standard input and output."""

    stdin: int
    stdout: int

    @property
    def pid(self) -> int | None:
        """Its process id; None until it exists."""

    def poll(self) -> int | None:
        """Its return code as in `subprocess`; None until its end."""

    def wait(self, timeout_s: float | None = None) -> int | None:
        """Wait for its end; returns its return code, or None after the time-out."""

    def kill(self) -> None:
        """Kill it and all that it started; harmless if it is gone."""

    def close(self) -> None:
        """Release an ended process."""


class SpawnedChild:
    """A process that runs `isolation.child_main` in a new interpreter; see `ChildProcess`."""

    def __init__(self, loads: Sequence[str], stderr: int) -> None:
        self._process = run_in_starter_thread(
            subprocess.Popen,
            [sys.executable, "-P", "-m", "pipeline.runtime.isolation.child_main", str(os.getpid()), *loads],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            bufsize=0,
            start_new_session=True,
            env=environment_with_this_package(),
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self.stdin, self.stdout = self._process.stdin.fileno(), self._process.stdout.fileno()

    @property
    def pid(self) -> int | None:
        """Its process id."""
        return self._process.pid

    def poll(self) -> int | None:
        """Its return code; None as long as it lives."""
        return self._process.poll()

    def wait(self, timeout_s: float | None = None) -> int | None:
        """Wait for its end; returns its return code, or None after the time-out."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            return self._process.wait(timeout_s)
        return None

    def kill(self) -> None:
        """Kill it and all that it started; harmless if it is gone."""
        if self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)

    def close(self) -> None:
        """Release an ended process."""
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()


def environment_with_this_package() -> dict[str, str]:
    """The environment of this process, with this package first on Python's path."""
    root = str(Path(__file__).resolve().parents[3])
    paths = [root, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def run_in_starter_thread(
    start: Callable[Arguments, Value], *arguments: Arguments.args, **options: Arguments.kwargs
) -> Value:
    """Call a function in the one thread that lives as long as this process.

    Linux ends a child with the *thread* that started it, and threads of a worker's pool may end at any time.
    """
    return _starter.submit(start, *arguments, **options).result()


def _new_starter() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=1, thread_name_prefix="child-starter")


_starter = _new_starter()


def _after_fork() -> None:
    """Make a new starter thread: threads do not survive a fork."""
    global _starter  # noqa: PLW0603 - one per process
    _starter = _new_starter()


os.register_at_fork(after_in_child=_after_fork)
