"""A driver that only claims, renews, records and finishes, as fast as it can; a process of its own for tests.

`python store_hammer.py URL NAME LOG THREADS` works until no job is left, and appends a line for every job that it
brought to its end: job id and attempt.
"""

import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor

from service.errors import LeaseLostError
from service.jobs import JobEvent
from service.store import JobStore

LEASE_S = 1.0
PATIENCE_S = 600.0


def work(store: JobStore, name: str, log: int) -> None:
    """Until nothing waits and nothing runs."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        job = store.claim(name, lease_s=LEASE_S, max_attempts=1000)
        if job is None:
            counts = store.counts()
            if not any(count for status, count in counts.items() if not status.is_over):
                return
            time.sleep(0.05)
            continue
        try:
            store.renew(job, lease_s=LEASE_S)
            event = JobEvent(sequence=0, at=job.updated_at, kind="warning", message=f"{name} {job.attempt}")
            store.record(job, [event, event])
            store.succeed(job, message="done", summary={"by": name})
        except LeaseLostError:
            continue
        os.write(log, f"{job.job_id} {job.attempt}\n".encode())
    raise TimeoutError("jobs are left")


def main(url: str, name: str, path: str, threads: int) -> None:
    """Work with several threads over one store."""
    log = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    with JobStore(url) as store, ThreadPoolExecutor(threads) as crew:
        for one in [crew.submit(work, store, f"{name}-{number}", log) for number in range(threads)]:
            one.result()


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], sys.argv[3], int(sys.argv[4]))
