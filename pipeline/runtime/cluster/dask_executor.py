"""Tasks on Dask: an embedded cluster, or one elsewhere."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from types import TracebackType
from typing import Any, Self

from pipeline.errors import ClusterError, VersionMismatchError
from pipeline.runtime.cluster import worker_setup
from pipeline.runtime.cluster.dispatch import SETTLE_INTERRUPTED_S, SETTLE_S, ClusterMonitor, Dispatch
from pipeline.runtime.cluster.memory_needs import RESOURCE
from pipeline.runtime.cluster.packed_tasks import differences, mismatch_message
from pipeline.runtime.cluster.performance_report import PerformanceReport
from pipeline.runtime.cluster.priorities import Traffic, priority_of
from pipeline.runtime.cluster.tls import TlsFiles, check_address, explain_failure, given_tls
from pipeline.runtime.cluster.worker_fork_server import forked_workers
from pipeline.runtime.isolation.spawned_child import environment_with_this_package
from pipeline.runtime.monitoring.measurement import Measured, Result, Task
from pipeline.runtime.monitoring.progress import TICK_S, Watch
from pipeline.runtime.monitoring.versions import ENGINE, TALKING, WORKING

CONNECT_S = 20.0
"""Time-out of the connection to a scheduler."""
_ANSWER_S = 30.0
_MEND_S = 5.0
_CLOSE_S = 30.0
_NEVER = "365 days"
"""Delay after a worker's death until Dask ends the nanny if no worker of that name is there. Dask does so even if the
worker came back long ago, died again just now, and is being restarted, which would be blamed on its task.
`Cluster.mend` recognises nannies that gave up by their status."""


class _CancelledErrors(logging.Filter):
    """Drops the lines of Dask's client when its search for a lost scheduler ends; `ClusterError` reports the loss."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether a line is logged."""
        return record.exc_info is None or not isinstance(record.exc_info[1], asyncio.CancelledError)


_CANCELLED_ERRORS = _CancelledErrors()


def load_dask() -> None:
    """Load what connects to a cluster, before a process is forked."""
    import dask
    import distributed
    import tornado.platform.asyncio  # what a client's loop loads

    del dask, distributed, tornado


class Cluster:
    """Workers for any number of runs, also concurrent ones in several threads; a context manager.

    An embedded cluster has its scheduler in this process; each worker is a separate process, restarted when it dies.
    With the address of a scheduler nothing is started here. Each executor makes its own connection, so a scheduler that
    comes back serves the next run.

    Parameters
    ----------
    workers : int
        Processes of the embedded cluster, one thread each; unused with `scheduler`.
    scheduler : str or None
        Address of an existing scheduler.
    local_directory : str or None
        Folder for spilled data of embedded workers; a temporary folder by default.
    tls : TlsFiles or None
        Certificates for all connections, also with embedded workers; by default those of the environment
        (`GABLEWORK_TLS_…`), otherwise those of Dask's own configuration.

    Raises
    ------
    SettingsError
        The certificates of the environment cannot be used.
    """

    _starting = threading.Lock()

    def __init__(
        self,
        *,
        workers: int = 2,
        scheduler: str | None = None,
        local_directory: str | None = None,
        tls: TlsFiles | None = None,
    ) -> None:
        self._workers = workers
        self._scheduler = scheduler
        self._local_directory = local_directory
        self._embedded: Any = None
        self._mended_s = 0.0
        self._while_running = contextlib.ExitStack()
        self.tls = tls or given_tls()

    @property
    def embedded(self) -> bool:
        """Whether scheduler and workers belong to this process."""
        return self._scheduler is None

    @property
    def address(self) -> str:
        """The scheduler's address."""
        if self._scheduler is not None:
            return self._scheduler
        if self._embedded is None:
            raise ClusterError("the embedded cluster is not running: use it as a context manager")
        return str(self._embedded.scheduler_address)

    @property
    def advice(self) -> str:
        """What to do if no worker is there."""
        if self.embedded:
            return "Workers that die are restarted automatically; if they die again and again they lack memory"
        return f"Start one with gablework worker --scheduler {self.address}"

    @property
    def security(self) -> Any:
        """Dask's TLS settings; None for Dask's own configuration."""
        from distributed import Security

        return None if self.tls is None else Security(**self.tls.security)

    def mend(self, workers: int) -> None:
        """Restart embedded workers that their nanny gave up because they died during their start."""
        if self._embedded is None or workers >= self._workers or time.monotonic() - self._mended_s < _MEND_S:
            return
        from distributed import Status

        embedded = self._embedded

        def forget() -> None:
            for name, nanny in list(embedded.workers.items()):
                if nanny.status in (Status.closed, Status.failed):
                    del embedded.workers[name]

        self._mended_s = time.monotonic()
        # both in the cluster's own thread, one after the other
        embedded.loop.add_callback(forget)
        embedded.scale(self._workers)

    def executor(
        self, priority: int = 0, *, traffic: Traffic = "interactive", performance_report: str | None = None
    ) -> DaskExecutor:
        """An executor for one run.

        Parameters
        ----------
        priority : int
            Among runs of one kind, those with a higher priority go first if workers are scarce.
        traffic : {'interactive', 'batch'}
            Tasks of interactive runs always go before those of batch runs.
        performance_report : str, optional
            Path of a page about the workers' time, written when the run is over.
        """
        return DaskExecutor(self, priority=priority_of(traffic, priority), performance_report=performance_report)

    def __enter__(self) -> Self:
        """Start the embedded workers without connecting to them."""
        if self._scheduler is not None:
            return self
        import dask
        from distributed import LocalCluster

        each_bytes = _share_bytes(self._workers)
        settings = {
            "distributed.admin.log-format": "%(message)s",
            "distributed.logging.distributed": "critical",
            # a suspect is tried alone before it is blamed, so it does not have to kill many workers
            "distributed.scheduler.allowed-failures": 1,
            **worker_setup.LEAN_LOOP,
        }
        starting = contextlib.ExitStack()
        try:
            # the configuration belongs to the process, not to the thread, and workers copy it as they start
            with self._starting, dask.config.set(settings), starting:
                # also for workers that are restarted later
                starting.enter_context(dask.config.set(starting.enter_context(forked_workers())))
                self._embedded = LocalCluster(
                    n_workers=self._workers,
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address="127.0.0.1:0",
                    local_directory=self._local_directory,
                    silence_logs="CRITICAL",
                    preload=[worker_setup.__name__],
                    security=self.security,
                    resources={RESOURCE: each_bytes},
                    # those that come later, in the place of one whose nanny gave up, too
                    config=worker_setup.LEAN_LOOP,
                    # their fork server may have started with another environment
                    env=environment_with_this_package(),
                )
                self._while_running = starting.pop_all()
        except (OSError, RuntimeError, TimeoutError) as error:
            raise ClusterError(f"the {self._workers} workers of this machine do not start: {error}") from error
        self._while_running.enter_context(dask.config.set({"distributed.deploy.lost-worker-timeout": _NEVER}))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End the embedded workers."""
        if self._embedded is not None:
            embedded, self._embedded = self._embedded, None
            self._while_running.close()
            # workers that do not end in time end with this process
            with contextlib.suppress(TimeoutError):
                embedded.close(timeout=_CLOSE_S)


class DaskExecutor:
    """One run's connection to a cluster.

    Parameters
    ----------
    cluster : Cluster
        Runs the tasks.
    priority : int
        Dask's priority of the tasks, from `priority_of`.
    owned : bool
        Whether the cluster starts and ends with this executor.
    performance_report : str, optional
        Path of a page about the workers' time, also written if the run breaks off: docs/how_to/watch_a_run.md.
    """

    def __init__(
        self, cluster: Cluster, *, priority: int = 0, owned: bool = False, performance_report: str | None = None
    ) -> None:
        self._cluster = cluster
        self._priority = priority
        self._owned = owned
        self._stack = contextlib.ExitStack()
        self._client: Any = None
        self._monitor: ClusterMonitor | None = None
        self._report = None if performance_report is None else PerformanceReport(performance_report)

    def __enter__(self) -> Self:
        """Connect, and start the cluster if it is owned.

        Raises ClusterError if the scheduler does not answer, or certificates and address do not match.
        """
        import dask
        from distributed import Client

        logging.getLogger("distributed.client").addFilter(_CANCELLED_ERRORS)
        # a fault leaves what was entered before it
        with contextlib.ExitStack() as stack:
            if self._owned:
                stack.enter_context(self._cluster)
            address, tls = self._cluster.address, self._cluster.tls
            configured = bool(dask.config.get("distributed.comm.tls.ca-file", None))
            check_address(address, tls, configured=configured)
            security = self._cluster.security
            given = {} if security is None else {"security": security}
            try:
                client = Client(address, timeout=CONNECT_S, set_as_default=False, **given)
            except (OSError, TimeoutError, ValueError, TypeError, RuntimeError) as error:
                reason = explain_failure(address, tls)
                if not reason and isinstance(error, TypeError | RuntimeError):
                    raise
                raise ClusterError(
                    f"the scheduler {address} cannot be used: {reason}"
                    if reason
                    else f"the scheduler {address} does not answer: {error}. Check the address, or use --workers"
                ) from error
            self._client = stack.enter_context(client)
            if self._report is not None:
                stack.enter_context(self._report)
            self._monitor = ClusterMonitor(client, address, self._cluster.mend, self._cluster.advice)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Disconnect, and end the cluster if it is owned."""
        self._stack.__exit__(kind, error, trace)

    @property
    def memory_limit_bytes(self) -> int | None:
        """The smallest worker's limit; None without limits or workers."""
        found = self._ask(self._client.scheduler.identity, n_workers=-1)
        limits = [worker["memory_limit"] for worker in found["workers"].values()]
        return min((limit for limit in limits if limit), default=None)

    @property
    def worker_count(self) -> int:
        """Number of workers that are there now."""
        return len(self._ask(self._client.scheduler.identity, n_workers=-1)["workers"])

    def prepare(self, stage: str, watch: Watch) -> None:
        """Wait for a worker, reporting the wait, and compare the versions of all processes.

        Raises
        ------
        ClusterError
            The scheduler is lost.
        VersionMismatchError
            A process runs other versions than this one.
        """
        monitor = self._started()
        while not monitor.threads:
            watch.check_cancelled()
            monitor.look(stage, watch)
            if not monitor.threads:
                time.sleep(TICK_S)
        if not self._cluster.embedded:
            self._check_versions()

    def map(
        self, stage: str, function: Callable[[Task], Result], tasks: Sequence[Task], watch: Watch
    ) -> Generator[Measured[Result], None, None]:
        """Results as they come; `Dispatch` handles tasks whose workers die, and raises what cannot be handled."""
        dispatch = Dispatch(
            client=self._client,
            monitor=self._started(),
            stage=stage,
            function=function,
            tasks=tasks,
            watch=watch,
            priority=self._priority,
            # workers that end with the run need no long wait
            settle_s=SETTLE_INTERRUPTED_S if self._owned and self._cluster.embedded else SETTLE_S,
        )
        if self._report is None:
            yield from dispatch.results()
            return
        for measured in dispatch.results():
            self._report.add(stage, measured)
            yield measured

    def _started(self) -> ClusterMonitor:
        if self._monitor is None:
            raise ClusterError("the executor is not connected: use it as a context manager")
        return self._monitor

    def _ask(self, what: Callable[..., Any], **options: Any) -> Any:
        """An answer of the scheduler."""
        try:
            return self._client.sync(what, callback_timeout=_ANSWER_S, **options)
        except (OSError, TimeoutError) as error:
            raise self._started().lost(f"it did not answer ({type(error).__name__}: {error})") from error

    def _check_versions(self) -> None:
        """Compare this process with the scheduler and all workers."""
        from distributed.versions import get_versions

        packages = [ENGINE, *WORKING]
        ours = _plain(get_versions(packages))
        talking = {name: ours[name] for name in ("python", ENGINE, *TALKING) if name in ours}
        message = {"op": "versions", "packages": packages}
        scheduler = self._ask(self._client.scheduler.versions, packages=[ENGINE])
        workers = self._ask(self._client.scheduler.broadcast, msg=message, on_error="ignore")
        found = {f"scheduler {self._cluster.address}": differences(talking, _plain(scheduler))}
        for address, theirs in sorted(workers.items()):
            found[f"worker {address}"] = differences(ours, _plain(theirs))
        faults = [f"{process}: {', '.join(what)}" for process, what in found.items() if what]
        if faults:
            raise VersionMismatchError(mismatch_message(faults))


def memory_of_workers(*, workers: int, scheduler: str | None, tls: TlsFiles | None = None) -> tuple[int, int | None]:
    """The number of workers that a run would have now, and the memory limit of the smallest; starts nothing.

    Raises ClusterError if the scheduler does not answer.
    """
    if scheduler is None:
        if workers == 0:
            return 1, None
        return workers, _share_bytes(workers)
    with DaskExecutor(Cluster(scheduler=scheduler, tls=tls)) as executor:
        return executor.worker_count, executor.memory_limit_bytes


def _plain(found: Mapping[str, Any]) -> dict[str, str]:
    """Versions of a Dask process by name, without missing packages."""
    versions = {name: str(version) for name, version in found["packages"].items() if version is not None}
    major_minor = versions["python"].split(".")[:2]
    wanted = (ENGINE, *TALKING, *WORKING)
    return {"python": ".".join(major_minor), **{name: versions[name] for name in wanted if name in versions}}


def _share_bytes(workers: int) -> int:
    """Memory of one of several workers that share this machine, as Dask computes it."""
    from distributed.system import MEMORY_LIMIT

    return int(MEMORY_LIMIT / max(1, workers))
