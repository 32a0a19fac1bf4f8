"""Metrics for Prometheus: requests and durations, jobs by status and longest wait, schedules, disk, event streams."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

from prometheus_client import CollectorRegistry, Counter, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.disk import Disk
from service.jobs import JobStatus
from service.store import JobFilter, JobStore

BUCKETS_S = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 120.0)
"""Bounds of the histogram of durations in seconds."""


class _Jobs(Collector):
    """Counts in the store on each scrape."""

    def __init__(self, store: JobStore, streams: Callable[[], int], disk: Disk) -> None:
        self._store = store
        self._streams = streams
        self._disk = disk

    def collect(self) -> Iterator[Metric]:
        """The current figures."""
        counts = self._store.counts()
        jobs = GaugeMetricFamily("gablework_jobs", "Jobs by status.", labels=["status"])
        for status in JobStatus:
            jobs.add_metric([status.value], counts.get(status, 0))
        yield jobs
        yield GaugeMetricFamily(
            "gablework_oldest_waiting_job_seconds",
            "Longest wait of a job in the queue; 0 if none waits.",
            value=self._oldest_s(counts.get(JobStatus.ACCEPTED, 0)),
        )
        yield GaugeMetricFamily(
            "gablework_stalled_jobs",
            "Running jobs that make no progress, and whose process was not ended yet.",
            value=len(self._store.stalled()),
        )
        states, slots = self._store.schedules.counts()
        schedules = GaugeMetricFamily("gablework_schedules", "Schedules by state.", labels=["state"])
        for state, count in states.items():
            schedules.add_metric([state], count)
        yield schedules
        # a gauge: the counts of a schedule are removed with it
        fates = GaugeMetricFamily(
            "gablework_schedule_slots",
            "Slots of the existing schedules, by outcome.",
            labels=["outcome"],
        )
        for outcome, count in slots.items():
            fates.add_metric([outcome.value], count)
        yield fates
        yield GaugeMetricFamily(
            "gablework_disk_free_bytes", "Free bytes of the state folder's disk.", value=self._disk.free_bytes
        )
        yield GaugeMetricFamily(
            "gablework_disk_reserve_bytes",
            "Free bytes below which uploads and jobs are refused.",
            value=self._disk.reserve_bytes,
        )
        deliveries = GaugeMetricFamily(
            "gablework_webhook_deliveries", "Webhooks in the log, by state.", labels=["state"]
        )
        for state, count in self._store.webhooks.counts().items():
            deliveries.add_metric([state.value], count)
        yield deliveries
        yield GaugeMetricFamily("gablework_event_streams", "Event streams that are open.", value=self._streams())

    def _oldest_s(self, waiting: int) -> float:
        """Seconds since the job that waits longest was created."""
        if waiting == 0:
            return 0.0
        # the list has the newest first
        oldest = self._store.list(JobFilter(statuses=(JobStatus.ACCEPTED,), limit=1, offset=waiting - 1))
        return max(0.0, (self._store.now() - oldest[0].created_at).total_seconds()) if oldest else 0.0


class Metrics:
    """The figures of one application."""

    def __init__(self, store: JobStore, streams: Callable[[], int], disk: Disk) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "gablework_requests", "Requests answered.", ["method", "path", "status"], registry=self.registry
        )
        self.duration = Histogram(
            "gablework_request_duration_seconds",
            "Time from the head of the request to that of the answer.",
            ["method", "path"],
            buckets=BUCKETS_S,
            registry=self.registry,
        )
        self.received = Counter("gablework_received_bytes", "Bytes of bodies received.", registry=self.registry)
        self.registry.register(_Jobs(store, streams, disk))
        ProcessCollector(registry=self.registry)

    def render(self) -> bytes:
        """The text that Prometheus reads."""
        return generate_latest(self.registry)


METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
"""Methods that are counted by name; a client may send any other word."""


class Measured:
    """Counts requests by the template of their path, so ids do not become labels."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self.app = app
        self.metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass on, and count."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        began = time.perf_counter()
        method = scope["method"] if scope["method"] in METHODS else "other"

        async def counting_receive() -> Message:
            message = await receive()
            self.metrics.received.inc(len(message.get("body", b"")))
            return message

        async def counting_send(message: Message) -> None:
            if message["type"] == "http.response.start":
                path = _template(scope)
                self.metrics.requests.labels(method, path, str(message["status"])).inc()
                self.metrics.duration.labels(method, path).observe(time.perf_counter() - began)
            await send(message)

        await self.app(scope, counting_receive, counting_send)


def _template(scope: Scope) -> str:
    """The path as the route names it."""
    return str(getattr(scope.get("route"), "path", "unmatched"))
