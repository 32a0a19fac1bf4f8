"""A look at the headers of all inputs: here for few of them, in tasks for many.

A look decodes some chunks of a file, 5 to 10 ms of processor time. The driver alone would look for minutes at the
files of a country, while all workers wait.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Sequence

from pipeline.errors import InputError, all_at_fault
from pipeline.io import ReadOptions, SourceInfo, is_url
from pipeline.io.reading import set_input_timeout
from pipeline.runtime.cluster.serial_executor import Executor
from pipeline.runtime.monitoring.progress import Watch
from pipeline.runtime.resources import Resources
from pipeline.runtime.run_plan import MANY_FILES, looked_at, usable

_FILES_PER_TASK = 32


@dataclasses.dataclass(frozen=True, kw_only=True)
class LookTask:
    """Some inputs for one task."""

    number: int
    """Its place among the tasks."""
    paths: tuple[str, ...]
    """The inputs."""
    options: ReadOptions
    """How they are read."""
    timeout_s: float
    """Seconds within which some more of each must be read."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Looked:
    """What a task saw."""

    number: int
    """The task's place."""
    sources: tuple[SourceInfo, ...]
    """The inputs that can be used, in their order."""
    faults: tuple[InputError, ...]
    """What is wrong with the others."""


def look_at_all(
    paths: Sequence[str],
    options: ReadOptions,
    resources: Resources,
    watch: Watch | None = None,
    executor: Executor | None = None,
) -> tuple[SourceInfo, ...]:
    """The headers of all inputs in their order; the executor of the run looks at many, if there is one already.

    Raises
    ------
    InputError
        Some inputs cannot be used: all that is wrong with any of them.
    RunCancelledError
        The watch says so.
    ClusterError
        The scheduler does not answer.
    """
    # remote inputs are mostly waited for
    local = len(paths) < MANY_FILES or any(is_url(path) for path in paths)
    looking = None if local else executor or _executor(resources)
    if looking is None:
        return looked_at(paths, options)
    groups = [tuple(paths[k : k + _FILES_PER_TASK]) for k in range(0, len(paths), _FILES_PER_TASK)]
    tasks = [
        LookTask(number=k, paths=group, options=options, timeout_s=resources.input_timeout_s)
        for k, group in enumerate(groups)
    ]
    watch = watch or Watch()
    with looking:
        looking.prepare("plan", watch)
        with contextlib.closing(looking.map("plan", look, tasks, watch)) as running:
            found = sorted((measured.result for measured in running), key=lambda one: one.number)
    faults = [fault for one in found for fault in one.faults]
    if faults:
        raise all_at_fault(faults)
    return tuple(info for one in found for info in one.sources)


def _executor(resources: Resources) -> Executor | None:
    """What looks at many inputs; None for this process, where the run has no other."""
    if resources.scheduler is not None:
        from pipeline.runtime.cluster.dask_executor import Cluster

        return Cluster(scheduler=resources.scheduler, tls=resources.tls).executor(traffic=resources.traffic)
    if resources.workers == 0:
        return None
    from pipeline.runtime.cluster.local_executor import LocalExecutor

    return LocalExecutor(resources.workers)


def look(task: LookTask) -> Looked:
    """Look at some inputs, whatever is wrong with one of them."""
    set_input_timeout(task.timeout_s)
    sources, faults = usable(task.paths, task.options)
    return Looked(number=task.number, sources=tuple(sources), faults=tuple(faults))
