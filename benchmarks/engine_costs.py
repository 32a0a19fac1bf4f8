"""Costs of scheduler and driver per message and per byte of a result, by number of workers.

    python -m benchmarks.engine_costs --out DIR [--workers 2 20 100 300] [--tasks 2000]

A scheduler in a separate process serves the workers, which share one more process (they have nothing to do), and tasks
that do nothing go through `DaskExecutor` like those of a run, each in a message of its own. It reports the CPU seconds
of the scheduler and of the driver per task, with small results and with large ones. `scaling_simulation.py` reads
DIR/engine_costs.json; what the driver does beside messages is measured by `driver_scale.py`.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import psutil

from benchmarks.entries import markdown_table
from pipeline.runtime.cluster import dispatch
from pipeline.runtime.cluster.dask_executor import Cluster, DaskExecutor
from pipeline.runtime.monitoring.progress import Watch

_WAIT_S = 120.0
_WARM_TASKS = 200


def free_port() -> int:
    """A free port."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def wait_for_listener(port: int, log: Path) -> None:
    """Return once a process listens on a port of this machine."""
    end = time.monotonic() + _WAIT_S
    while True:
        with socket.socket() as asking:
            if asking.connect_ex(("127.0.0.1", port)) == 0:
                return
        if time.monotonic() > end:
            raise SystemExit(f"the scheduler did not come: see {log}")
        time.sleep(0.1)


def nothing(size_bytes: int) -> bytes:
    """A result of some size, made without work."""
    return bytes(size_bytes)


async def idle_workers(address: str, count: int) -> None:
    """Workers without work of their own, all in this process; until it is ended."""
    from distributed import Worker

    workers = [Worker(address, nthreads=1, memory_limit=0, dashboard=False) for _ in range(count)]
    await asyncio.gather(*workers)
    await asyncio.gather(*(worker.finished() for worker in workers))


@contextlib.contextmanager
def cluster_of(count: int, log: Path) -> Iterator[tuple[Cluster, psutil.Process]]:
    """A scheduler in one process, workers in another; and the scheduler's process."""
    port = str(free_port())
    address = f"tcp://127.0.0.1:{port}"
    dask = Path(sys.executable).parent / "dask"
    listening = ["--host", "127.0.0.1", "--port", port, "--dashboard-address", "127.0.0.1:0"]
    with log.open("ab") as out, contextlib.ExitStack() as stack:
        for command in (
            [str(dask), "scheduler", *listening],
            [sys.executable, "-m", "benchmarks.engine_costs", "--idle-workers", str(count), "--at", address],
        ):
            process = subprocess.Popen(command, stdout=out, stderr=out)
            stack.callback(process.wait)
            stack.callback(process.terminate)
            if command[0] == str(dask):
                scheduler = psutil.Process(process.pid)
                wait_for_listener(int(port), log)
        yield Cluster(scheduler=address), scheduler


def cpu_of(process: psutil.Process) -> float:
    """CPU seconds of another process so far."""
    times = process.cpu_times()
    return float(times.user + times.system)


def all_there(executor: DaskExecutor, count: int) -> None:
    """Wait until so many workers are there."""
    end = time.monotonic() + _WAIT_S
    while len(executor._client.scheduler_info(n_workers=-1)["workers"]) < count:  # noqa: SLF001 - nothing else knows
        if time.monotonic() > end:
            raise SystemExit(f"{count} workers did not come")
        time.sleep(0.2)


def cost_of_tasks(count: int, tasks: int, size_bytes: int, log: Path) -> dict[str, Any]:
    """CPU seconds per task of scheduler and driver, and the rate at which tasks went through."""
    from benchmarks.engine_costs import nothing as work  # not of __main__, which workers do not have

    with cluster_of(count, log) as (cluster, scheduler), cluster.executor() as executor:
        executor.prepare("noop", Watch())
        all_there(executor, count)
        for _ in executor.map("noop", work, [1] * _WARM_TASKS, Watch()):
            pass
        # as many as look at the workers each second: what the cluster costs when nothing happens
        idle_at, idle_cpu_s = time.perf_counter(), cpu_of(scheduler)
        time.sleep(3.0)
        idle_share = (cpu_of(scheduler) - idle_cpu_s) / (time.perf_counter() - idle_at)
        began_s, scheduler_s, driver_s = time.perf_counter(), cpu_of(scheduler), time.process_time()
        with mock.patch.object(dispatch, "_TOGETHER_S", 0.0):
            for _ in executor.map("noop", work, [size_bytes] * tasks, Watch()):
                pass
        wall_s = time.perf_counter() - began_s
        return {
            "workers": count,
            "tasks": tasks,
            "result_bytes": size_bytes,
            "scheduler_s": (cpu_of(scheduler) - scheduler_s - idle_share * wall_s) / tasks,
            "driver_s": (time.process_time() - driver_s) / tasks,
            "scheduler_idle_share": idle_share,
            "tasks_a_second": tasks / wall_s,
        }


def tables(costs: dict[str, Any]) -> str:
    """What was measured, as tables."""
    heads = ["workers", "bytes per result", "scheduler, ms per task", "driver, ms per task", "tasks per second"]
    rows = [
        [str(row["workers"]), str(row["result_bytes"])]
        + [f"{1e3 * row[name]:.2f}" for name in ("scheduler_s", "driver_s")]
        + [f"{row['tasks_a_second']:.0f}"]
        for row in costs["tasks"]
    ]
    return markdown_table(heads, rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--workers", type=int, nargs="+", default=[2, 20, 100, 300])
    parser.add_argument("--tasks", type=int, default=2000)
    parser.add_argument("--large", type=int, default=1_000_000, help="bytes of a large result")
    parser.add_argument("--idle-workers", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--at", help=argparse.SUPPRESS)
    wanted = parser.parse_args(arguments)
    if wanted.idle_workers:
        asyncio.run(idle_workers(wanted.at, wanted.idle_workers))
        return 0
    if wanted.out is None:
        parser.error("give --out")
    wanted.out.mkdir(parents=True, exist_ok=True)
    log = wanted.out / "engine_costs.log"
    costs: dict[str, Any] = {"tasks": []}
    kinds = [(count, wanted.tasks, 1000) for count in wanted.workers]
    kinds.append((wanted.workers[0], max(100, wanted.tasks // 10), wanted.large))
    for count, tasks, size_bytes in kinds:
        costs["tasks"].append(cost_of_tasks(count, tasks, size_bytes, log))
        print(costs["tasks"][-1], flush=True)
    (wanted.out / "engine_costs.json").write_text(json.dumps(costs, indent=1) + "\n", encoding="utf-8")
    text = tables(costs)
    (wanted.out / "engine_costs.md").write_text(text, encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
