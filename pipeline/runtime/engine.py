"""Which engine runs a job: this process alone, its children, or a Dask cluster."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from pipeline.errors import SettingsError
from pipeline.runtime.cluster.priorities import Traffic, priority_of
from pipeline.runtime.cluster.serial_executor import Executor, SerialExecutor
from pipeline.runtime.cluster.tls import TlsFiles
from pipeline.runtime.expected import RATES, Expected
from pipeline.runtime.isolation.child_pool import kill_children, preload
from pipeline.runtime.monitoring.machine import cores, memory_bytes

Engine = Literal["serial", "local", "cluster"]

SMALL_S = 10.0 * RATES.cluster_start_s
"""Jobs that take less wall time on all cores need no cluster: its start would cost them more than a tenth."""
ALONE_S = 0.5
"""Jobs without buildings that take less CPU time need no children: their start would cost more than they save."""


def engine_of(
    *,
    workers: int | None,
    scheduler: str | None,
    expected_cpu_s: float,
    at: int,
    performance_report: bool = False,
    isolates: bool = True,
) -> tuple[Engine, int]:
    """The engine of a job, and how many processes it has; those of a scheduler elsewhere are its own.

    Parameters
    ----------
    workers : int or None
        As asked for; None leaves it to the estimate.
    scheduler : str or None
        As asked for.
    expected_cpu_s : float
        CPU seconds of the job.
    at : int
        Workers that this machine has cores and memory for.
    performance_report : bool
        Whether a page about the time of workers is asked for, which only a cluster has.
    isolates : bool
        Whether buildings are modelled, which children must do.

    Examples
    --------
    >>> engine_of(workers=None, scheduler=None, expected_cpu_s=5.0, at=2)
    ('local', 2)
    >>> engine_of(workers=None, scheduler=None, expected_cpu_s=500.0, at=2)
    ('cluster', 2)
    """
    if scheduler is not None:
        return "cluster", 0
    if workers is not None:
        return ("cluster", workers) if workers else ("serial", 1)
    if performance_report or expected_cpu_s / at > SMALL_S:
        return "cluster", at
    if not isolates and expected_cpu_s < ALONE_S:
        return "serial", 1
    return "local", at


def workers_that_fit(at: int, memory: int, task_bytes: int) -> int:
    """Workers that a machine has cores and memory for, at least one.

    Parameters
    ----------
    at : int
        Its cores.
    memory : int
        Its bytes.
    task_bytes : int
        Of the largest task, above the process's own size.

    Examples
    --------
    >>> workers_that_fit(8, 16 * 2**30, 3 * 2**30), workers_that_fit(8, 2**30, 3 * 2**30)
    (4, 1)
    """
    return max(1, min(at, int(memory // (RATES.process_gib * 2**30 + task_bytes))))


def executor_for(
    *,
    workers: int | None,
    scheduler: str | None,
    local_directory: str,
    work: Expected | None = None,
    priority: int = 0,
    traffic: Traffic = "interactive",
    tls: TlsFiles | None = None,
    performance_report: str | None = None,
    isolates: bool = True,
    loads: Sequence[str] = (),
) -> Executor:
    """The executor that a request asks for.

    Parameters
    ----------
    workers, scheduler
        As `engine_of` has them.
    local_directory, tls
        As `Cluster` has them.
    work : Expected, optional
        What there is to do; without, a job counts as small.
    priority, traffic, performance_report
        As `Cluster.executor` has them.
    isolates
        As `engine_of` has it.
    loads : sequence of str
        What children are to load, as `pipeline.runtime.isolation.preloading` tells it, unless they are started already.

    Raises
    ------
    SettingsError
        A performance report is asked for where there are no workers, or certificates cannot be used.
    """
    engine, processes = engine_of(
        workers=workers,
        scheduler=scheduler,
        expected_cpu_s=0.0 if work is None else sum(work.cpu_s().values()),
        at=workers_that_fit(cores(), memory_bytes(), 0 if work is None else work.task_bytes),
        performance_report=performance_report is not None,
        isolates=isolates,
    )
    if engine == "serial":
        if performance_report is not None:
            raise SettingsError(["a performance report tells the time of workers, and there are none: use --workers 1"])
        return SerialExecutor()
    if engine == "local":
        from pipeline.runtime.cluster.local_executor import LocalExecutor

        if loads:
            preload(loads)
        return LocalExecutor(processes)
    if scheduler is None:
        kill_children()  # the server that was started early, in case the job was small
    from pipeline.runtime.cluster.dask_executor import Cluster, DaskExecutor

    cluster = Cluster(workers=processes, scheduler=scheduler, local_directory=local_directory, tls=tls)
    return DaskExecutor(
        cluster, priority=priority_of(traffic, priority), owned=True, performance_report=performance_report
    )
