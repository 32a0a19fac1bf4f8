"""Child processes that are started the long way: an interpreter of their own, which imports everything."""

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


class Started(Protocol):
    """A child process, however it was started, and the pipes to its standard input and output."""

    stdin: int
    stdout: int

    @property
    def pid(self) -> int | None:
        """Its number; None as long as it is not there."""

    def poll(self) -> int | None:
        """Its return code, as `subprocess` tells it; None as long as it lives, or is to come."""

    def wait(self, timeout_s: float | None = None) -> int | None:
        """Wait for its end; its return code, or None after the time."""

    def kill(self) -> None:
        """Kill it and all that it started; harmless where it is gone."""

    def close(self) -> None:
        """Let go of one that ended."""


class SpawnedChild:
    """A process that runs `pipeline.runtime.isolation.child_main` in an interpreter of its own; see `Started`."""

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
        """Its number."""
        return self._process.pid

    def poll(self) -> int | None:
        """Its return code; None as long as it lives."""
        return self._process.poll()

    def wait(self, timeout_s: float | None = None) -> int | None:
        """Wait for its end; its return code, or None after the time."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            return self._process.wait(timeout_s)
        return None

    def kill(self) -> None:
        """Kill it and all that it started; harmless where it is gone."""
        if self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)

    def close(self) -> None:
        """Let go of one that ended."""
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()


def environment_with_this_package() -> dict[str, str]:
    """The environment of this process, with the package that runs here before all others that may have its name."""
    root = str(Path(__file__).resolve().parents[3])
    paths = [root, *filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def run_in_starter_thread(
    start: Callable[Arguments, Value], *arguments: Arguments.args, **options: Arguments.kwargs
) -> Value:
    """What a function gives in the one thread that lives as long as this process.

    Linux ends a child with the *thread* that started it, and threads of a worker's pool may end any time.
    """
    return _starter.submit(start, *arguments, **options).result()


def _new_starter() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=1, thread_name_prefix="child-starter")


_starter = _new_starter()


def _after_fork() -> None:
    """A forked copy of this process has no starter thread."""
    global _starter  # noqa: PLW0603 - threads do not survive a fork
    _starter = _new_starter()


os.register_at_fork(after_in_child=_after_fork)
