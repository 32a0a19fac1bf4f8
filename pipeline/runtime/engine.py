"""The engine of a job: this process alone, its child processes, or a Dask cluster."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from pipeline.errors import SettingsError
from pipeline.runtime.cluster.priorities import priority_of
from pipeline.runtime.cluster.serial_executor import Executor, SerialExecutor
from pipeline.runtime.expected import RATES, Expected
from pipeline.runtime.isolation.child_pool import kill_children, preload
from pipeline.runtime.monitoring.measurement import cores, memory_bytes
from pipeline.runtime.resources import Resources

Engine = Literal["serial", "local", "cluster"]

SMALL_S = 10.0 * RATES.cluster_start_s
"""Jobs that take less wall time on all cores run without a cluster, whose start would cost more than a tenth of it."""
ALONE_S = 0.5
"""Jobs without buildings that take less CPU time run without child processes, whose start costs more than it saves."""


def engine_of(resources: Resources, *, expected_cpu_s: float, at: int, models: bool = True) -> tuple[Engine, int]:
    """The engine of a job, and its number of processes; 0 where they belong to a scheduler elsewhere.

    `at` is the number of workers for which this machine has cores and memory. Only child processes model buildings, if
    the job `models` any.

    Examples
    --------
    >>> engine_of(Resources(), expected_cpu_s=5.0, at=2)
    ('local', 2)
    >>> engine_of(Resources(), expected_cpu_s=500.0, at=2)
    ('cluster', 2)
    """
    if resources.scheduler is not None:
        return "cluster", 0
    if resources.workers is not None:
        return ("cluster", resources.workers) if resources.workers else ("serial", 1)
    if resources.performance_report is not None or expected_cpu_s / at > SMALL_S:
        return "cluster", at
    if not models and expected_cpu_s < ALONE_S:
        return "serial", 1
    return "local", at


def workers_that_fit(at: int, memory: int, task_bytes: int) -> int:
    """Workers for which a machine has cores and memory, at least one.

    `task_bytes` is the memory of the largest task, above the process's own size.

    Examples
    --------
    >>> workers_that_fit(8, 16 * 2**30, 3 * 2**30), workers_that_fit(8, 2**30, 3 * 2**30)
    (4, 1)
    """
    return max(1, min(at, int(memory // (RATES.process_gib * 2**30 + task_bytes))))


def executor_for(
    resources: Resources, *, local_directory: str, work: Expected | None = None, loads: Sequence[str] = ()
) -> Executor:
    """The executor that a request asks for.

    Raises SettingsError if a performance report is requested without workers, or certificates cannot be used.

    Parameters
    ----------
    local_directory : str
        Where embedded workers spill.
    work : Expected, optional
        What there is to do; a job is small by default.
    loads : sequence of str
        What child processes load, from `loads_of`, unless they have started already.
    """
    engine, processes = engine_of(
        resources,
        expected_cpu_s=0.0 if work is None else sum(work.cpu_s().values()),
        at=workers_that_fit(cores(), memory_bytes(), 0 if work is None else work.task_bytes),
        models=work is None or work.models,
    )
    if engine == "serial":
        if resources.performance_report is not None:
            raise SettingsError(["a performance report needs workers; this run has none: use --workers 1"])
        return SerialExecutor()
    if engine == "local":
        from pipeline.runtime.cluster.local_executor import LocalExecutor

        if loads:
            preload(loads)
        return LocalExecutor(processes)
    if resources.scheduler is None:
        kill_children()  # the server that was started early, in case the job was small
    from pipeline.runtime.cluster.dask_executor import Cluster, DaskExecutor

    cluster = Cluster(
        workers=processes, scheduler=resources.scheduler, local_directory=local_directory, tls=resources.tls
    )
    return DaskExecutor(
        cluster,
        priority=priority_of(resources.traffic),
        owned=True,
        performance_report=resources.performance_report,
    )
