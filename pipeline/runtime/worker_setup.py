"""What a worker process does before its first task; Dask calls `dask_setup` of the modules that are preloaded.

The stages are imported here, and so while the client still plans, not when the first task waits for them.
"""

from __future__ import annotations

import importlib
import signal

from pipeline.runtime.start_up import start_own_process

STAGES = tuple(f"pipeline.runtime.{name}" for name in ("ingest", "split", "modelling", "publish"))
"""The modules of all tasks."""


def dask_setup(worker: object) -> None:
    """Leave signals to the nanny and import what tasks need.

    A Ctrl-C on a terminal and the stop of a service go to all processes of a group. The worker must outlive them:
    its nanny, or the process that embeds it, ends it once its tasks are settled.
    """
    del worker
    start_own_process()
    for number in (signal.SIGTERM, signal.SIGINT):
        # a function, not SIG_IGN, which programs that a task starts would inherit
        signal.signal(number, _left_to_the_nanny)
    for name in STAGES:
        importlib.import_module(name)


def _left_to_the_nanny(number: int, frame: object) -> None:
    """Do nothing on a signal."""
