"""Preparation of a worker process before its first task; Dask calls `dask_setup` of preloaded modules.

It imports the stages while the client still plans, not when the first task waits for them.
"""

from __future__ import annotations

import importlib
import multiprocessing.util
import os
import signal

from pipeline.runtime.isolation.child_pool import close_children
from pipeline.runtime.isolation.start_up import start_own_process
from pipeline.runtime.monitoring import log_lines, logs

STAGES = (
    "pipeline.runtime.stages.ingest",
    "pipeline.runtime.stages.ground_stage",
    "pipeline.runtime.stages.split",
    "pipeline.runtime.stages.join",
    "pipeline.runtime.stages.reconstruct",
    "pipeline.runtime.stages.child_batch",
    "pipeline.runtime.stages.publish",
    "pipeline.strip_alignment",
    "pipeline.recipe",
)
"""The modules of all tasks."""
NAME = "gablework-work"
"""Name of a forked worker's process in `ps` and `top`."""
LOG = "GABLEWORK_WORKER_LOG"
"""Set by `gablework worker` to plain or json. Embedded workers log nothing unless JSON is requested."""
METRICS_PORT, METRICS_HOST = "GABLEWORK_WORKER_METRICS_PORT", "GABLEWORK_WORKER_METRICS_HOST"
"""Set by `gablework worker`: where the worker shows its metrics; without a port nowhere."""
LEAN_LOOP = {"distributed.worker.profile.enabled": False, "distributed.admin.tick.interval": "500ms"}
"""Dask's settings for a loop that mostly waits. By default every worker inspects its stack a hundred times a second and
its clock fifty times: 2.7 % of a worker's time and 2.9 % of a core in the driver's process, for a profile that is not
used. With these settings .75 and 1.4 % remain (`benchmarks/city_scale.py` measures them by process)."""


def dask_setup(worker: object) -> None:
    """Leave signals to the nanny, import what tasks need, and set up logs and metrics.

    Ctrl-C on a terminal and the stop of a service signal all processes of a group. The worker must survive them: its
    nanny, or the process that embeds it, ends it once its tasks are settled.
    """
    del worker
    start_own_process()
    for number in (signal.SIGTERM, signal.SIGINT):
        # a function, not SIG_IGN, which programs that a task starts would inherit
        signal.signal(number, ignore_signal)
    # a forked worker ends without `atexit`
    multiprocessing.util.Finalize(None, close_children, exitpriority=0)
    for name in STAGES:
        importlib.import_module(name)
    if os.environ.get(LOG):
        as_json = os.environ[LOG] == "json"
        if as_json:
            log_lines.log_everything_as_json()
        log_lines.configure(as_json=as_json, also=("distributed",) if as_json else ())
    elif logs.wants_json():
        log_lines.configure_as_json()
    if os.environ.get(METRICS_PORT):
        from pipeline.runtime.cluster.run_metrics import serve_metrics

        serve_metrics(int(os.environ[METRICS_PORT]), host=os.environ.get(METRICS_HOST, "127.0.0.1"))


def ignore_signal(number: int, frame: object) -> None:
    """Do nothing on a signal."""
