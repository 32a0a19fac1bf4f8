"""Metrics for Prometheus: the events of a run as figures, and the tallies of the process.

The driver of a run:

    serve_metrics(port)
    run(request, on_event=combined(RunMetrics(), console.on_event))

A worker shows only its tallies: `gablework worker --metrics-port N`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

from prometheus_client import REGISTRY, CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from pipeline.errors import SettingsError
from pipeline.runtime.monitoring.measurement import TALLIES, Tallies, peak_of_process
from pipeline.runtime.monitoring.progress import Event, Listener
from pipeline.runtime.monitoring.stages import STAGES

UNITS = {stage.name: stage.unit for stage in STAGES}
"""Units counted by each stage; other stages count tasks."""


class RunMetrics(Collector):
    """A listener that turns the events of a run into metrics.

    Parameters
    ----------
    registry : CollectorRegistry, optional
        Registry to show them in; the process's own by default.
    clock : callable
        Seconds since 1970; replaced in tests.
    """

    def __init__(self, registry: CollectorRegistry = REGISTRY, clock: Callable[[], float] = time.time) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._stage = ""
        self._waiting = False
        self._finished = False
        self._warnings = 0
        self._heard_s = clock()
        self._units: dict[str, tuple[int, int, int]] = {}
        self._registry = registry
        registry.register(self)

    def __call__(self, event: Event) -> None:
        """Record an event of the run."""
        with self._lock:
            self._heard_s = self._clock()
            if event.kind == "warning":
                self._warnings += 1
                return
            if event.kind == "detail":
                return
            self._waiting = event.kind == "waiting"
            self._finished = event.kind == "finished"
            if event.kind in {"stage", "progress"}:
                if event.kind == "stage":
                    self._stage = event.stage
                self._units[event.stage] = (event.done, event.total, event.failed)

    def close(self) -> None:
        """Remove the metrics from the registry."""
        self._registry.unregister(self)

    def collect(self) -> Iterator[Metric]:
        """The present figures."""
        with self._lock:
            units, stage = dict(self._units), "" if self._finished else self._stage
            waiting, finished, warnings, heard_s = self._waiting, self._finished, self._warnings, self._heard_s
        now = GaugeMetricFamily("gablework_run_stage", "1 for the stage that the run is in.", labels=["stage"])
        for name in dict.fromkeys([*UNITS, *units]):
            now.add_metric([name], float(name == stage))
        yield now
        counted = GaugeMetricFamily(
            "gablework_run_units",
            "Units of each stage (files, tiles, buildings) by state; failed ones are among the done.",
            labels=["stage", "unit", "state"],
        )
        for name, (done, total, failed) in units.items():
            unit = UNITS.get(name, "tasks")
            for state, value in (("done", done), ("failed", failed), ("queued", max(0, total - done))):
                counted.add_metric([name, unit, state], value)
        yield counted
        yield GaugeMetricFamily("gablework_run_waiting", "1 while no worker is there to go on.", value=float(waiting))
        yield GaugeMetricFamily("gablework_run_finished", "1 once the run is over.", value=float(finished))
        yield CounterMetricFamily("gablework_run_warnings", "Warnings so far.", value=warnings)
        yield GaugeMetricFamily(
            "gablework_run_last_event_timestamp_seconds", "When the run was last heard of.", value=heard_s
        )


class TallyMetrics(Collector):
    """The tallies of a process as metrics."""

    def __init__(self, tallies: Tallies = TALLIES) -> None:
        self._tallies = tallies

    def collect(self) -> Iterator[Metric]:
        """The present figures."""
        known = self._tallies
        flying = GaugeMetricFamily("gablework_tasks_in_flight", "Tasks on the cluster now.", labels=["stage"])
        for stage, count in dict(known.in_flight).items():
            flying.add_metric([stage], count)
        yield flying
        for name, meaning, counts in (
            ("gablework_tasks_sent", "Tasks sent to the cluster.", dict(known.sent)),
            ("gablework_task_bytes_sent", "Bytes of these tasks.", dict(known.sent_bytes)),
            ("gablework_task_seconds", "Seconds that tasks of this process took.", dict(known.seconds)),
        ):
            by_stage = CounterMetricFamily(name, meaning, labels=["stage"])
            for stage, value in counts.items():
                by_stage.add_metric([stage], value)
            yield by_stage
        for name, meaning, outcomes in (
            ("gablework_tasks_landed", "Tasks that came back from the cluster.", dict(known.landed)),
            ("gablework_tasks_worked", "Tasks that this process worked off.", dict(known.worked)),
        ):
            by_outcome = CounterMetricFamily(name, meaning, labels=["stage", "outcome"])
            for (stage, outcome), value in outcomes.items():
                by_outcome.add_metric([stage, outcome], value)
            yield by_outcome
        buildings = CounterMetricFamily(
            "gablework_buildings", "Buildings that this process modelled.", labels=["status", "reason"]
        )
        for (status, reason), value in dict(known.buildings).items():
            buildings.add_metric([status, reason], value)
        yield buildings
        yield GaugeMetricFamily("gablework_tasks_running", "Tasks that run in this process now.", value=known.busy)
        yield GaugeMetricFamily(
            "gablework_peak_memory_bytes", "Largest resident size of this process so far.", value=peak_of_process()[1]
        )


def combined(*listeners: Listener) -> Listener:
    """One listener that passes every event to several."""

    def pass_on(event: Event) -> None:
        for listener in listeners:
            listener(event)

    return pass_on


def serve_metrics(port: int, host: str = "127.0.0.1") -> Callable[[], None]:
    """Serve the figures of this process at `http://host:port/metrics` from a new thread; returns what stops the server.

    No key is required, so everyone who can reach the address can read the figures. Raises SettingsError if the port is
    taken, or the address does not belong to this machine.
    """
    tallies = TallyMetrics()
    try:
        server, thread = start_http_server(port, addr=host)
    except OSError as error:
        raise SettingsError(
            [f"metrics cannot be shown on {host}:{port}: {error.strerror or error}; use another port"]
        ) from error
    REGISTRY.register(tallies)

    def end() -> None:
        server.shutdown()
        server.server_close()
        thread.join()
        REGISTRY.unregister(tallies)

    return end
