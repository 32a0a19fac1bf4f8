"""The worker of a cluster."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from pipeline.cli.command_options import takes_options
from pipeline.console import Console

MetricsPort = Annotated[
    int | None,
    typer.Option(metavar="N", min=1, max=65535, help="Show metrics for Prometheus on this port, at /metrics."),
]
MetricsHost = Annotated[
    str, typer.Option(metavar="ADDRESS", help="Address of these metrics: anyone who reaches it can read them.")
]
LogJson = Annotated[bool, typer.Option("--log-json", help="Log one JSON object per line, like GABLEWORK_LOG_JSON=1.")]


@takes_options("worker")
def worker(
    scheduler: Annotated[
        str, typer.Option(metavar="ADDRESS", help="The Dask scheduler, as tcp://host:8786 or tls://host:8786.")
    ],
    threads: Annotated[int, typer.Option(min=1, help="Tasks at once.")] = 1,
    memory_limit: Annotated[
        str, typer.Option(metavar="BYTES", help="Memory of the process, such as 4GiB; auto, or 0 for none.")
    ] = "auto",
    local_directory: Annotated[
        str | None, typer.Option(metavar="DIR", help="Folder of the worker's own files; default temporary.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name in the scheduler's lists; default its address.")] = None,
    host: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="To listen on; default what leads to the scheduler.")
    ] = None,
    drain_timeout: Annotated[
        float | None, typer.Option(metavar="S", min=0, help="Longest wait for running tasks at the end; default none.")
    ] = None,
    give_up_after: Annotated[
        float | None, typer.Option(metavar="S", min=0, help="End when the scheduler was away so long; default never.")
    ] = None,
    metrics_port: MetricsPort = None,
    metrics_host: MetricsHost = "127.0.0.1",
    log_json: LogJson = False,
    **given: Any,
) -> None:
    """Work for a Dask scheduler; on SIGTERM finish what runs, then leave."""
    with Console(log_json=log_json) as console:
        from pipeline.runtime.cluster.worker import WorkerOptions, serve_worker
        from pipeline.runtime.compiling import compile_first
        from pipeline.runtime.monitoring.logs import wants_json
        from pipeline.runtime.resources import resources_of

        options = WorkerOptions(
            scheduler=scheduler,
            threads=threads,
            memory_limit=memory_limit,
            local_directory=local_directory,
            name=name,
            host=host,
            drain_timeout_s=drain_timeout,
            give_up_after_s=give_up_after,
            tls=resources_of(given).tls,
            log_json=log_json or wants_json(),
            metrics_port=metrics_port,
            metrics_host=metrics_host,
        )
        compile_first(console.on_event)
        serve_worker(options, console.status)
