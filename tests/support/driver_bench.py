"""A driver with a scripted run in place of the science, for tests of what becomes of jobs."""

import threading
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import pytest
from migrated import with_tables
from processes import LONG_S, wait_for

from pipeline.errors import RunCancelledError
from pipeline.extras.compare.compare import CompareRequest, CompareSummary
from pipeline.runtime.monitoring.progress import Event
from pipeline.runtime.run import RunSummary
from service import traces
from service.driver import attempt
from service.driver.attempt import AttemptParts, perform
from service.driver.attempt_child import Order
from service.driver.attempt_process import DriverParts, InOwnProcess
from service.driver.leased_job import LeasedJob
from service.driver.process import Driver
from service.driver.shared_cluster import SharedCluster
from service.fetching import Fetched, JobFiles
from service.files import StateFolder
from service.jobs import InputReference, Job, JobFailure, JobRequest, JobStatus
from service.settings import ServiceSettings
from service.store import JobStore

SCRIPTED = ("gather", "run", "compare", "write_outputs", "write_comparison_outputs")
"""Steps of an attempt that the script replaces; a test may replace others."""

Telling = Callable[[int, int], None]


class Engine:
    """A cluster that only counts."""

    started = 0
    stopped = 0
    address = "tcp://127.0.0.1:1"
    embedded = True

    def mend(self, workers: int) -> None:
        """Nothing to mend."""

    def executor(self, priority: int = 0) -> Any:
        return SimpleNamespace(priority=priority)

    def __enter__(self) -> Self:
        type(self).started += 1
        return self

    def __exit__(self, *raised: object) -> None:
        type(self).stopped += 1


def run_summary(**values: Any) -> RunSummary:
    """The summary of a run of two buildings, with other values where some are given."""
    known = {"run_dir": "", "digest": "d" * 64, "statuses": {"ok": 2}, "reasons": {}, "rejected": {"tree": 1}}
    known |= {"roof_types": {"gable": 2}, "counts": {"points": 6}, "timings_s": {"total": 0.5}}
    return RunSummary(**{**known, "peak_memory_bytes": {"host:1": 5}, "warnings": (), **values})


class Script:
    """A run that does what the test says; by default it reports some progress and succeeds."""

    def __init__(self) -> None:
        self.runs = 0
        self.seen: list[Any] = []
        self.compared: list[CompareRequest] = []
        self.steps: list[Callable[[Any, Callable[[Event], None], Callable[[], bool]], None]] = []
        self.go_on = threading.Event()

    def gather(self, request: JobRequest, *, target: Path, **_others: Any) -> JobFiles:
        target.mkdir(parents=True)
        tiles = []
        for number, tile in enumerate(request.tiles):
            path = target / f"tile {number}.laz"
            path.write_bytes(b"points")
            tiles.append(Fetched(reference=tile, path=path, points=1, sha256=None))
        return JobFiles(tiles=tiles)

    def run(self, request: Any, on_event: Callable[[Event], None], executor: Any, cancelled: Any) -> RunSummary:
        self.runs += 1
        self.seen.append((request, executor))
        Path(request.out).mkdir(parents=True, exist_ok=True)
        Path(request.out, "run.json").write_text("{}")
        for done in range(4):
            on_event(Event(kind="progress", stage="split", done=done, total=3))
        on_event(Event(kind="warning", stage="split", message=f"{request.inputs[0]}: odd, see {request.out}/run.json"))
        if len(self.steps) >= self.runs:
            self.steps[self.runs - 1](request, on_event, cancelled)
        return run_summary(run_dir=request.out, warnings=(f"{request.inputs[0]}: odd",))

    def compare(
        self, request: CompareRequest, on_event: Callable[[Event], None], executor: Any, cancelled: Any
    ) -> CompareSummary:
        """A comparison that runs the script's run once, and says the same of every variant."""
        summary = self.run(request.run, on_event, executor, cancelled)
        labels = [variant.label for variant in request.variants]
        for number, label in enumerate(labels):
            on_event(Event(kind="stage", stage="reconstruct", done=number, total=len(labels), message=label))
        self.compared.append(request)
        return CompareSummary(out=request.run.out, runs=dict.fromkeys(labels, summary), seconds={})

    def write_outputs(self, _run_dir: Path, out_dir: Path, _wanted: Any, on_progress: Telling) -> None:
        out_dir.mkdir()
        (out_dir / "outputs.json").write_text("{}")
        on_progress(1, 1)

    def write_comparison_outputs(
        self, folder: Path, _labels: Any, out_dir: Path, wanted: Any, on_progress: Telling
    ) -> None:
        self.write_outputs(folder, out_dir, wanted, on_progress)

    def raises(self, error: Exception) -> None:
        """The next run raises."""

        def step(request: Any, on_event: Any, cancelled: Any) -> None:
            raise error

        self.steps.append(step)

    def waits(self, on_event: Event | None = None) -> None:
        """The next run goes on until the test says so, or until it is cancelled."""

        def step(request: Any, tell: Callable[[Event], None], cancelled: Callable[[], bool]) -> None:
            if on_event is not None:
                tell(on_event)
            while not self.go_on.wait(0.01):
                if cancelled():
                    raise RunCancelledError("the run was cancelled")

        self.steps.append(step)


class InThisProcess(InOwnProcess):
    """Attempts in the driver's own threads, where tests replace their steps."""

    def preload(self) -> None:
        """Everything is there."""

    def wait_until_ready(self) -> None:
        """Everything is there."""

    def close(self) -> None:
        """Nothing to end."""

    def __call__(self, held: LeasedJob, place: Path) -> tuple[str, dict[str, Any]]:
        """As `perform`."""
        parts = self._parts

        def executor() -> Any:
            parts.cluster.wait_until_there(held)
            held.engine = parts.cluster.engine()
            return held.engine.executor(held.job.priority)

        work = AttemptParts(
            settings=parts.settings, folder=parts.folder, place=place, uploads=parts.store, executor=executor
        )
        with traces.attempt(held.job, self._name):
            return perform(held, work)


class Bench:
    """A store, a state folder, and drivers in threads."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.patch = patch
        self.script = Script()
        self.tools: dict[str, Any] = {}
        self.work: Callable[[Order], tuple[str, dict[str, Any]]] | None = None
        """What processes of attempts do in place of the script, which runs in threads of this process."""
        self.performs: Callable[[DriverParts, str], InOwnProcess] | None = None
        """What does the work of attempts, in place of both."""
        self.settings = ServiceSettings(
            state=folder, poll_s=0.02, lease_s=30.0, driver_jobs=1, drain_s=40.0, max_attempts=3
        )
        self.store = JobStore(with_tables(self.settings.database))
        self.folder = StateFolder(folder.resolve())
        self._running: list[tuple[Driver, threading.Thread]] = []
        self.codes: list[int] = []

    def driver(self, *, parent_pipe: int | None = None, **changed: Any) -> Driver:
        settings = self.settings.model_copy(update=changed)
        scripted = {name: getattr(self.script, name) for name in SCRIPTED}
        for step, replaced in (scripted | self.tools).items():
            self.patch.setattr(attempt, step, replaced)
        cluster = SharedCluster(settings, Engine)

        def performs(parts: DriverParts, name: str) -> InOwnProcess:
            if self.performs is not None:
                return self.performs(parts, name)
            if self.work is not None:
                return InOwnProcess(parts, name, self.work)
            return InThisProcess(parts, name)

        name = f"d{len(self._running)}"
        driver = Driver(settings, name=name, parent_pipe=parent_pipe, perform=performs, cluster=cluster)
        thread = threading.Thread(target=lambda: self.codes.append(driver.run()), daemon=True)
        self._running.append((driver, thread))
        thread.start()
        return driver

    def submit(self, asked: Mapping[str, Any] | None = None, **values: Any) -> Job:
        request = JobRequest(tiles=(InputReference(kind="path", value="/data/a.laz"),), **(asked or {}))
        return self.store.create(request, owner=None, **values)

    def becomes(self, job: Job, *statuses: JobStatus) -> Job:
        def there() -> Job | None:
            found = self.store.get(job.job_id)
            return found if found.status in statuses else None

        return wait_for(there, f"{statuses}, it is {self.store.get(job.job_id)}")

    def over(self, job: Job) -> Job:
        return self.becomes(job, *(status for status in JobStatus if status.is_over))

    def done(self, *errors: Exception) -> Job:
        """A job as a driver leaves it whose runs raise these errors, one after the other."""
        job = self.submit()
        for error in errors:
            self.script.raises(error)
        self.driver()
        return self.over(job)

    def failure(self, *errors: Exception) -> JobFailure:
        """Why such a job failed."""
        failure = self.done(*errors).failure
        assert failure is not None
        return failure

    def under_way(self, **options: Any) -> tuple[Job, Driver]:
        """A job whose run goes on until the test says so, and its driver, with these options."""
        job = self.submit()
        self.script.waits()
        driver = self.driver(**options)
        self.runs()
        return job, driver

    def runs(self, number: int = 1) -> None:
        wait_for(lambda: self.script.runs >= number, f"run {number}")

    def end_leases(self) -> None:
        """Let the leases of all jobs lie in the past."""
        with self.store._database.write() as connection:
            connection.exec_driver_sql("UPDATE jobs SET lease_until = '2020-01-01 00:00:00.000000'")

    def end(self, *, at_once: bool = True) -> None:
        for driver, _ in self._running:
            driver.stop(at_once=at_once)
        self.join()

    def join(self) -> None:
        for _, thread in self._running:
            thread.join(LONG_S)
            assert not thread.is_alive()


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    one = Bench(tmp_path / "state", monkeypatch)
    try:
        yield one
    finally:
        one.script.go_on.set()
        one.end()
        one.store.close()
