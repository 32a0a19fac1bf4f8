"""Damaged inputs for a service: each is uploaded and submitted as a job by the client; see `damaged_inputs.py`.

Outcomes are those of the command line. A refusal is one at upload or submission, or a job that failed by its input;
every other failure of a job is `internal`, and so is an answer that is a fault of the service. A job that is not over
in time hangs; it is dismissed.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from benchmarks.damaged_runs import Case, Outcome
from benchmarks.undamaged_inputs import CRS, write_inputs
from pipeline.errors import InputError, RemoteError, SettingsError
from service.client import Client, Job
from service.client.errors import RefusedError
from service.client.upload_memory import UploadMemory

ASKED_EVERY_S = 0.2
SERVER_FAULT = 500
REFUSED = {"job-failed-input", "job-failed-settings", "job-failed-refused"}


def send_cases(url: str, key: str | None, cases: Sequence[Case], at_once: int, time_limit_s: float) -> list[Outcome]:
    """The outcomes of those cases whose kind a service takes, so many jobs at once."""
    wanted = [case for case in cases if case.kind.rest]
    with tempfile.TemporaryDirectory(prefix="damaged-") as place:
        originals = Path(place, "originals")
        originals.mkdir()
        write_inputs(originals)

        def send(case: Case) -> Outcome:
            """In a thread: one case by a client of its own."""
            folder = Path(place, f"{case.kind.name}-{case.number}")
            with Client(url, key, memory=UploadMemory(folder / "memory")) as client:
                return _sent(client, case, originals, folder, time_limit_s)

        with ThreadPoolExecutor(at_once) as threads:
            return list(threads.map(send, wanted))


def _sent(client: Client, case: Case, originals: Path, folder: Path, time_limit_s: float) -> Outcome:
    """The outcome of one case."""
    damage, began = case.write(originals, folder), time.monotonic()
    result, detail = "named refusal", ""
    try:
        file = folder / case.file
        more = {} if case.kind.rest == "tiles" else {case.kind.rest: file}
        crs = CRS if case.kind.name == "ply" else None
        job = client.submit(file if not more else folder / "tile.laz", **more, crs=crs, meshes="tile", new=True)
        result, detail = _judged(_over(client, job, began + time_limit_s))
    except RefusedError as error:
        detail = str(error)
        if error.problem.status >= SERVER_FAULT:
            result = "internal"
    except (InputError, SettingsError) as error:
        detail = str(error)
    except RemoteError as error:
        result, detail = "internal", f"{type(error).__name__}: {error}"
    return Outcome(case=case, damage=damage, result=result, detail=detail, seconds=time.monotonic() - began)


def _over(client: Client, job: Job, deadline: float) -> Job:
    """The job once it is over; dismissed, and as it was, if that takes too long."""
    while not (job := client.job(job)).is_over:
        if time.monotonic() > deadline:
            client.cancel(job)
            break
        time.sleep(ASKED_EVERY_S)
    return job


def _judged(job: Job) -> tuple[str, str]:
    """One of `OUTCOMES`, and its reason."""
    if not job.is_over:
        return "hang", f"{job.status} {job.stage}: {job.message}"
    if job.problem is None:
        failed = job.summary.get("reasons", {}).get("internal_error", 0)
        return ("internal" if failed else "run"), job.message
    return ("named refusal" if job.problem.kind in REFUSED else "internal"), f"{job.problem.kind}: {job.problem.detail}"
