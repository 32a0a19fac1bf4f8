"""The process of one attempt: it does the work of the job, talks to its driver, and is ended alone.

It has no connection to the database and holds no lease: it says what happens, and hears when it must end.
"""

from __future__ import annotations

import contextlib
import dataclasses
import threading
import time
import traceback
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from pipeline.errors import ClusterError, GableworkError
from pipeline.io.reading import seen_by
from pipeline.runtime.cluster.dask_executor import Cluster, load_dask
from pipeline.runtime.isolation import child_main
from pipeline.runtime.isolation.progress_reports import report_progress
from pipeline.runtime.monitoring import tracing
from pipeline.runtime.monitoring.progress import Event
from service import traces
from service.disk import has_no_space
from service.driver.attempt import AttemptParts, perform
from service.driver.driver_logs import configure
from service.driver.failure_words import Scrubber
from service.driver.leased_job import LOG
from service.errors import NoSpaceError, NoSuchUploadError, ServiceError, UnexpectedError
from service.files import StateFolder
from service.jobs import Job, LogLevel, Upload
from service.preflight import end_examiners
from service.settings import ServiceSettings

LOADS = ("service.driver.attempt_child:load",)
"""What the process loads before it is forked, as in `isolation.child_main`."""
_FLUSH_MS = 2000
"""Milliseconds for sending the last spans."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Order:
    """What the process must do."""

    job: Job
    settings: ServiceSettings
    place: Path
    """The folder in which the attempt works."""
    uploads: Mapping[str, Upload]
    """The uploads of the job that exist, by id."""
    driver: str
    """Name of the driver."""


@dataclasses.dataclass(frozen=True)
class Note:
    """A line for the job's log, from the process."""

    message: str
    level: LogLevel
    facts: Mapping[str, Any]


@dataclasses.dataclass(frozen=True)
class Name:
    """A name that replaces a path in messages, from the process."""

    path: str
    name: str


@dataclasses.dataclass(frozen=True)
class Moved:
    """The attempt got somewhere, which no event says."""


@dataclasses.dataclass(frozen=True)
class WorkersWanted:
    """The process is ready for the workers; the answer is `Lent`."""


@dataclasses.dataclass(frozen=True)
class Lent:
    """The scheduler of the workers, for the process."""

    address: str
    embedded: bool
    """Whether the workers belong to the driver, which mends them."""


@dataclasses.dataclass(frozen=True)
class WorkersMissing:
    """The process sees fewer workers than there should be."""

    present: int


@dataclasses.dataclass(frozen=True)
class End:
    """The attempt must end, for the process."""


class KnownUploads:
    """The uploads that the order names; as the store's."""

    def __init__(self, uploads: Mapping[str, Upload]) -> None:
        self._uploads = uploads

    def upload(self, upload_id: str, *, owner: str | None = None) -> Upload:
        """One upload.

        Raises
        ------
        NoSuchUploadError
            It did not exist when the attempt began.
        """
        del owner
        found = self._uploads.get(upload_id)
        if found is None:
            raise NoSuchUploadError(f"there is no upload {upload_id[:64]!r} (any more)")
        return found


class _NamingScrubber(Scrubber):
    """Names paths for the driver, too."""

    def name(self, path: str, name: str) -> None:
        super().name(path, name)
        child_main.say(Name(path, name))


class ChildJob:
    """The job, in the process of its attempt; a context manager. See `service.driver.attempt.Held`."""

    def __init__(self, job: Job) -> None:
        self.job = job
        self.scrub: Scrubber = _NamingScrubber()
        self._stopped = threading.Event()
        self._lent: Lent | None = None
        self._answered = threading.Event()
        self._over = object()
        self._ears = threading.Thread(target=self._hear, name="driver", daemon=True)

    def __enter__(self) -> Self:
        """Hear what the driver says."""
        self._ears.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Hear no more: what comes is for the next job of this process."""
        child_main.HEARD.put(self._over)
        self._ears.join()

    @property
    def facts(self) -> dict[str, object]:
        """Additional fields of a log line."""
        return {"job": self.job.job_id, "attempt": self.job.attempt}

    def cancelled(self) -> bool:
        """Whether the attempt must end."""
        return self._stopped.is_set()

    def wait(self, seconds: float) -> bool:
        """Wait, at most until the attempt must end; returns whether it must."""
        return self._stopped.wait(seconds)

    def record(self, event: Event) -> None:
        """Send an event of the run to the driver."""
        child_main.say(event)

    def move(self) -> None:
        """Let the driver know that the attempt got somewhere."""
        child_main.say(Moved())

    def note(self, message: str, *, level: LogLevel = LogLevel.INFO, **facts: Any) -> None:
        """Send a line for the job's log to the driver."""
        child_main.say(Note(message, level, facts))

    def lent(self) -> Lent:
        """The workers, as soon as the driver has some. It ends this process if it has none before the job must end."""
        child_main.say(WorkersWanted())
        self._answered.wait()
        assert self._lent is not None
        return self._lent

    def _hear(self) -> None:
        while (word := child_main.HEARD.get()) is not self._over:
            if isinstance(word, Lent):
                self._lent = word
                self._answered.set()
            elif isinstance(word, End):
                self._stopped.set()


class LentCluster(Cluster):
    """The workers of the driver: it mends them, not the process that uses them."""

    _MEND_S = 5.0

    def __init__(self, lent: Lent, settings: ServiceSettings) -> None:
        super().__init__(scheduler=lent.address, tls=settings.resources.tls)
        self._is_embedded = lent.embedded
        self._said_s = 0.0

    @property
    def embedded(self) -> bool:
        """Whether scheduler and workers belong to the driver of this process."""
        return self._is_embedded

    def mend(self, workers: int) -> None:
        """Let the driver restart workers that died during their start."""
        if self._is_embedded and time.monotonic() - self._said_s >= self._MEND_S:
            self._said_s = time.monotonic()
            child_main.say(WorkersMissing(workers))


def load() -> None:
    """Load what an attempt needs, before the process is forked; nothing here may start a thread."""
    import pyarrow.compute
    import pyarrow.parquet
    import pyproj

    import service.features.feature_writing
    import service.outputs.merged_cityjson
    import service.outputs.merged_table
    import service.outputs.report  # noqa: F401
    from pipeline.io.area_of_use import location_of

    load_dask()
    # opens the database of CRS, which every plan reads
    location_of(pyproj.CRS.from_epsg(28992).to_wkt("WKT2_2019"), (84_000.0, 447_000.0, 84_001.0, 447_001.0))
    del pyarrow


def attend(order: Order) -> tuple[str, dict[str, Any]]:
    """Do the work of a job in this process; see `service.driver.attempt.perform`.

    Raises
    ------
    GableworkError, ServiceError
        As `perform`; any other exception is logged here, and becomes an `UnexpectedError`.
    """
    configure(as_json=order.settings.log_json)
    # the peak memory that a job reports is its own
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    try:
        with ChildJob(order.job) as held:
            return _attended(held, order)
    finally:
        end_examiners()


def _attended(held: ChildJob, order: Order) -> tuple[str, dict[str, Any]]:
    parts = AttemptParts(
        settings=order.settings,
        folder=StateFolder(order.settings.state.resolve(), order.settings.reserve_bytes),
        place=order.place,
        uploads=KnownUploads(order.uploads),
        # jobs are interactive: they go before batch runs on the same scheduler
        executor=lambda: LentCluster(held.lent(), order.settings).executor(order.job.priority),
    )
    try:
        with traces.attempt(order.job, order.driver), seen_by(report_progress):
            return perform(held, parts)
    except MemoryError:
        raise
    except Exception as error:  # noqa: BLE001 - only what travels between processes reaches the driver
        raise _plain(error, held) from None
    finally:
        if tracing.is_on():
            tracing.provider().force_flush(_FLUSH_MS)


def _plain(error: Exception, held: ChildJob) -> Exception:
    """The error as the driver can receive and judge it, without its causes, which do not travel."""
    if isinstance(error, ClusterError):
        return error
    if has_no_space(error):
        return NoSpaceError(f"the disk is full ({type(error).__name__})")
    if isinstance(error, GableworkError | ServiceError):
        return error
    LOG.error("an unexpected fault: %s", error, extra=held.facts, exc_info=error)
    plain = UnexpectedError(type(error).__name__)
    plain.add_note("".join(traceback.format_exception(error)))
    return plain
