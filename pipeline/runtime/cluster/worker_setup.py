"""What a worker process does before its first task; Dask calls `dask_setup` of the modules that are preloaded.

The stages are imported here, and so while the client still plans, not when the first task waits for them.
"""

from __future__ import annotations

import importlib
import multiprocessing.util
import os
import signal

from pipeline.runtime.isolation.child_pool import close_children
from pipeline.runtime.isolation.start_up import start_own_process
from pipeline.runtime.monitoring import logs

STAGES = (
    *(f"pipeline.runtime.stages.{name}" for name in ("ingest", "split", "reconstruct", "publish")),
    "pipeline.reconstruct",
)
"""The modules of all tasks."""
NAME = "gablework-work"
"""Name of a worker's process that was forked, as `ps` and `top` show it."""
LOG = "GABLEWORK_WORKER_LOG"
"""How `gablework worker` tells its worker to log: plain or json. Embedded workers log nothing unless asked for JSON."""
METRICS_PORT, METRICS_HOST = "GABLEWORK_WORKER_METRICS_PORT", "GABLEWORK_WORKER_METRICS_HOST"
"""Where `gablework worker` tells its worker to show its figures; no port shows none."""
LEAN_LOOP = {"distributed.worker.profile.enabled": False, "distributed.admin.tick.interval": "500ms"}
"""Dask's settings for a loop that mostly waits. By default every worker looks at its own stack a hundred times a second
and at its clock fifty times: 2.7 % of a worker's time and 2.9 % of a core in the driver's process, beside tasks that
nobody profiles that way; with these .75 and 1.4 % are left (`benchmarks/city_scale.py` tells them by process)."""


def dask_setup(worker: object) -> None:
    """Leave signals to the nanny, import what tasks need, speak and show figures as the nanny was asked to.

    A Ctrl-C on a terminal and the stop of a service go to all processes of a group. The worker must outlive them:
    its nanny, or the process that embeds it, ends it once its tasks are settled.

    Raises
    ------
    SettingsError
        The port of the figures is taken.
    """
    del worker
    start_own_process()
    for number in (signal.SIGTERM, signal.SIGINT):
        # a function, not SIG_IGN, which programs that a task starts would inherit
        signal.signal(number, _left_to_the_nanny)
    # a forked worker ends without `atexit`
    multiprocessing.util.Finalize(None, close_children, exitpriority=0)
    for name in STAGES:
        importlib.import_module(name)
    if os.environ.get(LOG):
        as_json = os.environ[LOG] == "json"
        if as_json:
            logs.log_everything_as_json()
        logs.configure(as_json=as_json, also=("distributed",) if as_json else ())
    else:
        logs.configure_once()
    if os.environ.get(METRICS_PORT):
        from pipeline.runtime.cluster.run_metrics import serve_metrics

        serve_metrics(int(os.environ[METRICS_PORT]), host=os.environ.get(METRICS_HOST, "127.0.0.1"))


def _left_to_the_nanny(number: int, frame: object) -> None:
    """Do nothing on a signal."""
