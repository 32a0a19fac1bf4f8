"""A Dask worker under a nanny that drains on SIGTERM: the command `gablework worker`.

`dask worker` closes on SIGTERM in the middle of its task, which then runs again elsewhere. This one takes no new task,
finishes the running one, hands over its results, and then leaves. If the scheduler goes away it waits for its return.
"""

from __future__ import annotations

import asyncio
import dataclasses
import itertools
import logging
import signal
import time
from collections.abc import Callable
from typing import Any

import dask
from distributed import Nanny, Security, Worker
from distributed.core import Status
from distributed.worker_memory import parse_memory_limit

from pipeline.errors import ClusterError, SettingsError, causes
from pipeline.runtime.cluster import worker_setup
from pipeline.runtime.cluster.memory_needs import RESOURCE
from pipeline.runtime.cluster.tls import TlsFiles, check_address, explain_failure
from pipeline.runtime.cluster.worker_fork_server import forked_workers
from pipeline.runtime.monitoring import log_lines

_POLL_S = 0.1
_HAND_OVER_S = 30.0
"""Longest wait for clients to fetch results, which they do at once."""
_RETRY_S = 2.0
_STOPPING = (signal.SIGTERM, signal.SIGINT)


@dataclasses.dataclass(frozen=True, kw_only=True)
class WorkerOptions:
    """Options of a worker."""

    scheduler: str
    """Address of the scheduler."""
    threads: int = 1
    """Number of concurrent tasks. With one, a task that kills its process harms no other task."""
    memory_limit: str = "auto"
    """Bytes or a text such as `4GiB`; `auto` takes the machine's share, 0 sets none."""
    local_directory: str | None = None
    """Folder for the worker's files; a temporary folder by default."""
    name: str | None = None
    """Unique name in the scheduler's lists; its address by default."""
    host: str | None = None
    """Address to listen on; by default that of the route to the scheduler."""
    drain_timeout_s: float | None = None
    """Longest wait for a running task on SIGTERM; None waits for its end."""
    give_up_after_s: float | None = None
    """Seconds without the scheduler after which the worker ends; None keeps trying."""
    tls: TlsFiles | None = None
    """Certificates; None for those of Dask's own configuration."""
    log_json: bool = False
    """Whether nanny and worker log JSON."""
    metrics_port: int | None = None
    """Port of the worker's metrics for Prometheus; None for no metrics."""
    metrics_host: str = "127.0.0.1"
    """Address of the metrics."""

    @property
    def memory_bytes(self) -> int | None:
        """The memory limit, of which tasks declare their share; None without a limit."""
        try:
            limit = parse_memory_limit(self.memory_limit, self.threads, logger=logging.getLogger("distributed.worker"))
        except (ValueError, TypeError, AssertionError) as error:
            raise SettingsError(
                [f"memory limit is {self.memory_limit!r}: use bytes such as 4GiB, a share such as 0.5, auto, or 0"]
            ) from error
        return None if limit is None else int(limit)


class DrainingWorker(Worker):
    """A worker that its nanny can drain."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.handlers["drain"] = self.drain

    async def drain(self) -> int:
        """Take no new task, finish running ones, hand over the results; returns the number of finished tasks."""
        self.status = Status.closing_gracefully
        running = len(self.state.executing)
        while self.state.executing:
            await asyncio.sleep(_POLL_S)
        deadline = time.monotonic() + _HAND_OVER_S
        while self.data and time.monotonic() < deadline:
            await asyncio.sleep(_POLL_S)
        # unfetched results are copied to other workers, and queued tasks go there without being suspects
        await self.scheduler.retire_workers(workers=[self.address], close_workers=False, remove=True)
        return running


def serve_worker(options: WorkerOptions, say: Callable[[str], None]) -> None:
    """Run a worker until SIGTERM or SIGINT drains it; a second signal ends it at once.

    `say` gets one line of text at every change.

    Raises
    ------
    ClusterError
        The scheduler was away for longer than the options allow, the worker cannot start, or address and certificates
        do not match.
    SettingsError
        The memory limit is not valid.
    """
    configured = bool(dask.config.get("distributed.comm.tls.ca-file", None))
    check_address(options.scheduler, options.tls, configured=configured)
    log_lines.configure(as_json=options.log_json)
    quiet = {
        "distributed.admin.log-format": "%(asctime)s %(name)s %(levelname)s %(message)s",
        "distributed.worker.daemon": True,
        **worker_setup.LEAN_LOOP,
    }
    with dask.config.set(quiet), forked_workers() as forked, dask.config.set(forked):
        if options.log_json:
            log_lines.configure(as_json=True, also=("distributed",))
        asyncio.run(_serve(options, say))


async def _serve(options: WorkerOptions, say: Callable[[str], None]) -> None:
    """Keep a worker connected to the scheduler until a signal stops it."""
    stop, hurry = asyncio.Event(), asyncio.Event()

    def on_signal() -> None:
        (hurry if stop.is_set() else stop).set()

    for number in _STOPPING:
        asyncio.get_running_loop().add_signal_handler(number, on_signal)
    away_since_s = time.monotonic()
    reported = ""
    say(f"looking for the scheduler {options.scheduler}")
    while not stop.is_set():
        nanny = _nanny(options)
        try:
            if await _first(_start(nanny, options), stop):
                say(f"worker {nanny.worker_address} is at the scheduler {options.scheduler}")
                if not await _first(nanny.finished(), stop):
                    await _drain(nanny, options, hurry, say)
                    return
                say(f"the scheduler {options.scheduler} is gone: looking for it again")
                away_since_s = time.monotonic()
        except OSError as error:
            away_s = time.monotonic() - away_since_s
            why = await asyncio.to_thread(explain_failure, options.scheduler, options.tls)
            if why and why != reported:
                reported = why
                say(f"the scheduler {options.scheduler} cannot be used: {why}")
            if options.give_up_after_s is not None and away_s > options.give_up_after_s:
                raise ClusterError(
                    f"the scheduler {options.scheduler} was away for {away_s:.0f} s: {why or error}. Check the address"
                ) from error
        finally:
            await nanny.close()
        await _first(asyncio.sleep(_RETRY_S), stop)


def _nanny(options: WorkerOptions) -> Any:
    """A nanny that is not started yet."""
    memory_bytes = options.memory_bytes
    environment = {
        worker_setup.METRICS_PORT: "" if options.metrics_port is None else str(options.metrics_port),
        worker_setup.METRICS_HOST: options.metrics_host,
        worker_setup.LOG: "json" if options.log_json else "plain",
    }
    return Nanny(
        options.scheduler,
        nthreads=options.threads,
        memory_limit=options.memory_limit,
        local_directory=options.local_directory,
        name=options.name,
        host=options.host,
        worker_class=DrainingWorker,
        preload=[worker_setup.__name__],
        dashboard=False,
        security=None if options.tls is None else Security(**options.tls.security),
        resources=None if memory_bytes is None else {RESOURCE: memory_bytes},
        env=environment,
    )


async def _start(nanny: Any, options: WorkerOptions) -> None:
    """Start the worker's process and connect it; an OSError means that the scheduler does not answer."""
    try:
        await nanny
    except OSError:
        raise
    except (RuntimeError, ValueError, TypeError) as error:
        cause = next(itertools.islice(causes(error), 1, None), error)
        if isinstance(cause, OSError):
            raise ConnectionError(str(cause)) from error
        # TLS reports a scheduler without TLS by many kinds of errors
        why = await asyncio.to_thread(explain_failure, options.scheduler, options.tls)
        if why:
            raise ConnectionError(why) from error
        raise ClusterError(f"the worker for {options.scheduler} does not start: {cause}") from error


async def _drain(nanny: Any, options: WorkerOptions, hurry: asyncio.Event, say: Callable[[str], None]) -> None:
    """Let the worker finish its running tasks, then close it."""
    say("asked to end: no new tasks, running ones are finished (ask again to end at once)")
    # a worker that dies now is not restarted
    nanny.close_gracefully(reason="drain")

    async def drained() -> None:
        async with nanny.rpc(nanny.worker_address) as worker:
            count = await asyncio.wait_for(worker.drain(), options.drain_timeout_s)
        say(f"drained, tasks waited for: {count}")

    try:
        if not await _first(drained(), hurry):
            say("ended at once: its tasks will run again elsewhere")
    except TimeoutError:
        say(f"not drained within {options.drain_timeout_s:g} s: its tasks will run again elsewhere")
    except OSError as error:
        say(f"not drained ({error}): its tasks will run again elsewhere")


async def _first(work: Any, stop: asyncio.Event) -> bool:
    """Wait for some work or a stop: True if the work ended first. Otherwise the work is cancelled."""
    doing, stopping = asyncio.ensure_future(work), asyncio.ensure_future(stop.wait())
    try:
        await asyncio.wait({doing, stopping}, return_when=asyncio.FIRST_COMPLETED)
        if doing.done():
            await doing
            return True
        return False
    finally:
        for task in (doing, stopping):
            task.cancel()
        await asyncio.gather(doing, stopping, return_exceptions=True)
