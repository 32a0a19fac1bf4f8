"""Modules loaded for Dask's workers before they are forked; only their fork server imports this module.

Each new worker, while it still has one thread, forks itself as the server of its own children
(`pipeline.runtime.isolation.fork_server`), which then begin with the same modules.
"""

from __future__ import annotations

import gc
import os
import signal

from pipeline.runtime.cluster.compiled_kernels import kernels_are_compiled
from pipeline.runtime.cluster.worker_setup import NAME, STAGES, ignore_signal
from pipeline.runtime.isolation import child_main, child_pool, fork_server

_METHOD = "arrangement"
"""The default method; children load other methods themselves."""


def _prepare() -> None:
    """Load everything, and prepare each forked worker."""
    child_main.name_process(fork_server.NAME)
    # stopping a service signals all its processes; workers still finish their tasks and need this one
    signal.signal(signal.SIGTERM, ignore_signal)
    loads = list(STAGES)
    if kernels_are_compiled():  # otherwise each worker compiles what it needs, and the run says so
        loads.append(f"pipeline.runtime.stages.rehearsal:load_once:{_METHOD}")
    fork_server.load_all(loads)
    gc.freeze()  # a collection would write to all objects and thus copy the shared memory
    server = os.getpid()

    def prepare_worker() -> None:
        if os.getppid() == server:
            child_main.name_process(NAME)
            child_pool.fork_own_server()

    os.register_at_fork(after_in_child=prepare_worker)


_prepare()
