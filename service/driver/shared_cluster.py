"""The cluster of a driver: started on first use, restarted after a failure; an external scheduler is waited for."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable
from urllib.parse import urlsplit

from pipeline.errors import ClusterError, RunCancelledError
from pipeline.runtime.cluster.dask_executor import Cluster
from pipeline.runtime.engine import workers_that_fit
from pipeline.runtime.monitoring.measurement import cores, memory_bytes
from pipeline.runtime.monitoring.progress import Event
from pipeline.runtime.run_plan import LARGEST_TASK_BYTES
from service.driver.leased_job import LOG, LeasedJob
from service.settings import ServiceSettings

_CONNECT_S = 2.0
_AGAIN_S = 1.0
"""Seconds between two tries of a scheduler that does not answer."""
_REPORT_S = 30.0
"""Seconds between two reports that the job waits."""


def _as_many_as_fit() -> int:
    """A worker per core if each has memory for the largest task of a plan; at least two."""
    return min(cores(), max(2, workers_that_fit(cores(), memory_bytes(), LARGEST_TASK_BYTES)))


class SharedCluster:
    """The workers that all jobs of a driver use; safe to share between threads.

    Parameters
    ----------
    settings : ServiceSettings
        The number of embedded workers, or the address of a scheduler.
    make : callable, optional
        Makes a cluster that is not started yet.

    Raises
    ------
    SettingsError
        Certificates cannot be used.
    """

    def __init__(self, settings: ServiceSettings, make: Callable[[], Cluster] | None = None) -> None:
        resources = settings.resources
        self._scheduler = resources.scheduler
        workers = resources.workers or _as_many_as_fit()
        self._make = make or (lambda: Cluster(workers=workers, scheduler=self._scheduler, tls=resources.tls))
        self._lock = threading.Lock()
        self._engine: Cluster | None = None
        self._closed = False

    def engine(self) -> Cluster:
        """The workers; started if there are none.

        Raises
        ------
        ClusterError
            They do not start, or the driver ends.
        """
        with self._lock:
            if self._closed:
                raise ClusterError("the driver is ending and starts no more workers")
            if self._engine is None:
                self._engine = self._make().__enter__()
            return self._engine

    def replace(self, broken: Cluster) -> None:
        """Stop workers that broke; the next run starts new ones. A scheduler elsewhere is left alone.

        If another job has already replaced them, the new workers are left alone, too.
        """
        if self._scheduler is not None:
            return
        with self._lock:
            if self._engine is not broken:
                return
            self._engine = None
        broken.__exit__(None, None, None)

    def close(self) -> None:
        """Stop the workers for good."""
        with self._lock:
            self._closed = True
            engine, self._engine = self._engine, None
        if engine is not None:
            engine.__exit__(None, None, None)

    def wait_until_there(self, held: LeasedJob) -> None:
        """Wait for a scheduler that is elsewhere, and record that the job waits.

        Raises
        ------
        RunCancelledError
            The job was cancelled while it waited.
        """
        if self._scheduler is None or answers(self._scheduler):
            return
        since_s = time.monotonic()
        reported_s: float | None = None
        while not answers(self._scheduler):
            waited_s = time.monotonic() - since_s
            if reported_s is None or waited_s - reported_s >= _REPORT_S:
                reported_s = waited_s
                message = (
                    f"waiting: the cluster's scheduler has not answered for {waited_s:.0f} s; "
                    "the job continues as soon as it does"
                )
                LOG.warning("the scheduler %s does not answer", self._scheduler, extra=held.facts)
                held.record(Event(kind="waiting", message=message))
            if held.wait(_AGAIN_S) or held.cancelled():
                raise RunCancelledError("the job was cancelled")


def answers(address: str) -> bool:
    """Whether a scheduler listens at an address; one without a host and a port is not tried and counts as yes."""
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
