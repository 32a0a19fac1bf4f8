"""The one cluster of a driver: started when it is needed, again when it broke, and waited for when it is elsewhere."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Protocol, Self
from urllib.parse import urlsplit

from pipeline.errors import ClusterError, RunCancelledError
from pipeline.runtime.events import Event
from pipeline.runtime.executors import Cluster, Executor
from service.driver.held import LOG, HeldJob
from service.settings import ServiceSettings

_CONNECT_S = 2.0
_AGAIN_S = 1.0
"""A scheduler that does not answer is tried again after so long."""
_TELL_S = 30.0
"""That the job waits is told again after so long."""


class Engine(Protocol):
    """`pipeline.runtime.executors.Cluster`."""

    def executor(self, priority: int = 0) -> Executor:
        """An executor for one run."""

    def __enter__(self) -> Self:
        """Start."""

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop."""


class SharedCluster:
    """Safe to share between the threads of a driver.

    Parameters
    ----------
    settings : ServiceSettings
        How many workers are embedded, or where the scheduler is.
    make : callable, optional
        Makes a cluster that is not started yet.
    """

    def __init__(self, settings: ServiceSettings, make: Callable[[], Engine] | None = None) -> None:
        self._scheduler = settings.scheduler
        self._make = make or (lambda: Cluster(workers=settings.workers, scheduler=settings.scheduler))
        self._lock = threading.Lock()
        self._engine: Engine | None = None
        self._closed = False

    def start(self) -> None:
        """Start the workers, unless they are there.

        Raises
        ------
        ClusterError
            They do not start, or the driver ends.
        """
        with self._lock:
            if self._closed:
                raise ClusterError("the driver ends and starts no workers any more")
            if self._engine is None:
                self._engine = self._make().__enter__()

    def executor(self, priority: int) -> Executor:
        """An executor for one run; starts the workers unless they are there.

        Raises
        ------
        ClusterError
            They do not start.
        """
        self.start()
        with self._lock:
            if self._engine is None:
                raise ClusterError("the driver's workers have been stopped")
            return self._engine.executor(priority)

    def replace(self) -> None:
        """Stop the workers, so that the next run starts new ones; a scheduler elsewhere is left alone."""
        if self._scheduler is None:
            self._stop_engine()

    def close(self) -> None:
        """Stop the workers for good."""
        with self._lock:
            self._closed = True
        self._stop_engine()

    def _stop_engine(self) -> None:
        with self._lock:
            engine, self._engine = self._engine, None
        if engine is not None:
            engine.__exit__(None, None, None)

    def wait_until_there(self, held: HeldJob) -> None:
        """Wait for a scheduler that is elsewhere, and tell the job that it waits.

        Raises
        ------
        RunCancelledError
            The job was called off while it waited.
        """
        if self._scheduler is None or answers(self._scheduler):
            return
        since_s = time.monotonic()
        told_s: float | None = None
        while not answers(self._scheduler):
            waited_s = time.monotonic() - since_s
            if told_s is None or waited_s - told_s >= _TELL_S:
                told_s = waited_s
                message = (
                    f"waiting: the cluster's scheduler does not answer, for {waited_s:.0f} s now; "
                    "the job goes on as soon as it does"
                )
                LOG.warning("the scheduler %s does not answer", self._scheduler, extra=held.facts)
                held.tell(Event(kind="waiting", message=message))
            if held.wait(_AGAIN_S) or held.cancelled():
                raise RunCancelledError("the job was called off")


def answers(address: str) -> bool:
    """Whether somebody listens at the address of a scheduler; an address that is no host and port is not asked."""
    parts = urlsplit(address if "://" in address else f"tcp://{address}")
    try:
        host, port = parts.hostname, parts.port
    except ValueError:
        return True
    if host is None or port is None:
        return True
    with contextlib.suppress(OSError), socket.create_connection((host, port), timeout=_CONNECT_S):
        return True
    return False
