"""Jobs per second that drivers can claim and finish: `python benchmarks/claim_jobs.py URL [THREADS] [JOBS]`.

Without a URL a SQLite database in a temporary folder is used. The work itself takes no time: claim, renew, succeed.
"""

from __future__ import annotations

import sys
import tempfile
import threading
import time

from service.jobs import InputReference, JobRequest
from service.store import JobStore


def main(url: str, threads: int, jobs: int) -> None:
    """Submit, then drain with several threads."""
    request = JobRequest(tiles=(InputReference(kind="path", value="/data/tile.laz"),))
    with JobStore(url) as store:
        store.migrate()
        began = time.perf_counter()
        for _ in range(jobs):
            store.create(request, owner=None, max_queued=10**6, max_queued_per_key=10**6)
        print(f"submit: {jobs / (time.perf_counter() - began):.0f} jobs/s, one thread")
        claimed: list[float] = []

        def drain(name: str) -> None:
            while True:
                began = time.perf_counter()
                job = store.claim(name, lease_s=600.0, max_attempts=3)
                if job is None:
                    return
                claimed.append(time.perf_counter() - began)
                store.renew(job, lease_s=600.0)
                store.succeed(job, message="", summary={})

        crew = [threading.Thread(target=drain, args=(str(number),)) for number in range(threads)]
        began = time.perf_counter()
        for one in crew:
            one.start()
        for one in crew:
            one.join()
        took = time.perf_counter() - began
        assert len(claimed) == jobs
        claimed.sort()
        print(f"claim, renew, succeed: {jobs / took:.0f} jobs/s with {threads} threads")
        print(f"one claim: median {1e3 * claimed[jobs // 2]:.1f} ms, 95 % {1e3 * claimed[jobs * 95 // 100]:.1f} ms")


if __name__ == "__main__":
    given = sys.argv[1:]
    with tempfile.TemporaryDirectory() as folder:
        main(
            given[0] if given else f"sqlite:///{folder}/jobs.db",
            int(given[1]) if len(given) > 1 else 4,
            int(given[2]) if len(given) > 2 else 1000,
        )
