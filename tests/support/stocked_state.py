"""A state folder with jobs in every state, schedules and webhooks with their history: nothing has to run for it."""

import dataclasses
import datetime as dt
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import finished_runs as runs
from migrated import with_tables
from webhook_store_contract import claim_next, settle

from pipeline.schedule import Cron
from service.files import StateFolder
from service.jobs import Fault, Job, JobFailure, JobRequest
from service.outputs import write_comparison_outputs, write_outputs
from service.schedules import Definition
from service.settings import ServiceSettings
from service.store import JobStore
from service.webhooks import EventType, Result

HOOK = "https://hooks.example.org/gablework"
DRIVER = "a driver"
NIGHTS = 3
SUMMARY: Mapping[str, Any] = {"statuses": {"ok": 4, "fallback": 1, "failed": 1}}
"""That of the runs of `finished_runs`, as far as lists show it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stock:
    """Ids of what is there."""

    done: str
    """A reconstruction with buildings, which is kept."""
    compared: str
    """A comparison of two methods."""
    failed: str
    cancelled: str
    running: str
    waiting: str
    schedule: str
    """Runs every night; its jobs were skipped and missed, too."""
    paused: str
    """A schedule that is paused."""
    webhook: str
    """One that gets the ends of jobs."""
    delivered: str
    """A message that arrived."""
    undelivered: str
    """A message that was refused for good."""


def echo(title: str | None = None) -> JobRequest:
    """A job without tiles."""
    return JobRequest(process_id="echo", tiles=(), echo={"message": "hello", "delay": 0.0}, title=title)


class Stocking:
    """Fills a state folder as API, driver and clock would."""

    def __init__(self, state: Path) -> None:
        self._folder = StateFolder(state)
        settings = ServiceSettings(state=state)
        self._store = JobStore(with_tables(settings.database))

    def close(self) -> None:
        self._store.close()

    def _running(self, asked: JobRequest) -> Job:
        made = self._store.create(asked, owner=None)
        job = self._store.claim(DRIVER, lease_s=10 * 86_400.0, max_attempts=3)
        assert job is not None
        assert job.job_id == made.job_id, "another job waited"
        return job

    def fill(self, done: int) -> Stock:
        """Make all of it, with so many more jobs that are done."""
        store = self._store
        ends = [EventType.SUCCESSFUL, EventType.FAILED, EventType.DISMISSED]
        webhook, _ = store.webhooks.create(HOOK, events=ends, description="the map server", base="http://127.0.0.1")
        for number in range(done):
            # words of a search are looked for in ids, too, which have no letter beyond f
            store.succeed(self._running(echo(f"Tile no{number:03}")), message="done", summary={})
        reference = (runs.InputReference(kind="path", value="/srv/delft_west.laz"),)
        asked = JobRequest(tiles=reference, title="Delft West", settings={"candidates": {"min_area_m2": 15.0}})
        job = self._running(asked)
        run_dir = self._folder.run(job.job_id, job.attempt)
        runs.write_run(run_dir)
        write_outputs(run_dir, self._folder.outputs(job.job_id, job.attempt))
        store.succeed(job, message="6 buildings: 4 ok, 1 fallback, 1 failed", summary=SUMMARY)
        store.keep(job.job_id, keep=True)
        compared = self._running(
            JobRequest(
                process_id="compare",
                tiles=reference,
                methods=("fuzzy-sart", "fuzzy-sart:faithful"),
                title="Two methods",
            )
        )
        folder = runs.write_comparison(self._folder.comparison(compared.job_id, compared.attempt))
        write_comparison_outputs(folder, runs.LABELS, self._folder.outputs(compared.job_id, compared.attempt))
        store.succeed(compared, message="2 methods", summary={"runs": dict.fromkeys(runs.LABELS, SUMMARY)})
        failed = self._running(dataclasses.replace(asked, title="Delft Oost"))
        store.fail(
            failed,
            JobFailure(fault=Fault.INPUT, detail="delft_oost.laz: no usable CRS in the file; give the input crs"),
        )
        delivered, undelivered = self._deliver()
        cancelled = self._running(echo("Cancelled by hand"))
        store.dismiss(cancelled.job_id)
        store.dismissed(cancelled)
        schedule = self._schedule("Every night", is_paused=False)
        paused = self._schedule("Once a year", is_paused=True)
        now = store.now()
        for night in range(NIGHTS):
            store.schedules.tick(now=now + dt.timedelta(days=1 + 3 * night))
        held = store.claim(DRIVER, lease_s=10 * 86_400.0, max_attempts=3)
        assert held is not None
        waiting = store.create(echo("Waits in the line"), owner=None)
        return Stock(
            done=job.job_id,
            compared=compared.job_id,
            failed=failed.job_id,
            cancelled=cancelled.job_id,
            running=held.job_id,
            waiting=waiting.job_id,
            schedule=schedule,
            paused=paused,
            webhook=webhook.endpoint_id,
            delivered=delivered,
            undelivered=undelivered,
        )

    def _schedule(self, title: str, *, is_paused: bool) -> str:
        definition = Definition(
            title=title, cron=Cron("30 2 * * *", "Europe/Amsterdam"), request=echo(), is_paused=is_paused
        )
        return self._store.schedules.create(definition, owner=None, most=99).schedule_id

    def _deliver(self) -> tuple[str, str]:
        """Send all messages that wait; one arrives, the others are refused."""
        sent: list[str] = []
        while (parcel := claim_next(self._store, DRIVER)) is not None:
            delivery_id = parcel.delivery.delivery_id
            body = '{"type": "job.successful", "data": {"status": "successful"}}'
            if sent:
                result = Result(duration_ms=12, status=403, error="the receiver answered 403", is_final=True, body=body)
            else:
                result = Result(duration_ms=31, status=204, body=body)
            settle(self._store, parcel, result)
            sent.append(delivery_id)
        return sent[0], sent[1]


def stock(state: Path, done: int = 30) -> Stock:
    """Fill a state folder."""
    stocking = Stocking(state)
    try:
        return stocking.fill(done)
    finally:
        stocking.close()
