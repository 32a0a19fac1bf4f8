"""What Dask's workers are born with: the server that they are forked from imports this, and nobody else does.

It loads all that tasks need. Every worker, while it still has one thread, forks the server of its own children from
itself (`pipeline.runtime.isolation.fork_server`), so that they begin with the same.
"""

from __future__ import annotations

import gc
import os
import signal

from pipeline.runtime.cluster.compiled_kernels import kernels_are_compiled
from pipeline.runtime.cluster.worker_setup import NAME, STAGES
from pipeline.runtime.isolation import child_main, child_pool, fork_server

_METHOD = "arrangement"
"""The default method; others are loaded by those who model by them."""


def _prepare() -> None:
    """Load, and be born again in every worker."""
    child_main.name_process(fork_server.NAME)
    # the stop of a service goes to all its processes: workers, which finish their tasks, must not lose this one
    signal.signal(signal.SIGTERM, _left_to_the_nanny)
    loads = list(STAGES)
    if kernels_are_compiled():  # or else each compiles what it needs, when the run tells that it does
        loads.append(f"pipeline.runtime.stages.model_batch:load_once:{_METHOD}")
    fork_server.load_all(loads)
    gc.freeze()  # a collection would write to all objects, and so copy the memory that is shared
    server = os.getpid()

    def born() -> None:
        if os.getppid() == server:
            child_main.name_process(NAME)
            child_pool.fork_server()

    os.register_at_fork(after_in_child=born)


def _left_to_the_nanny(number: int, frame: object) -> None:
    """Do nothing on a signal."""


_prepare()
