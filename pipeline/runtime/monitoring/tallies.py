"""Counts of a process: tasks sent by a run's driver, tasks run by a worker.

Plain numbers without a library, so counting costs nothing; `run_metrics` shows them to Prometheus.
"""

from __future__ import annotations

import threading
from collections import Counter, defaultdict


class Tallies:
    """Counts of one process; all except `in_flight` and `busy` only grow."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.sent: Counter[str] = Counter()
        """Tasks sent to a cluster, by stage; a task that is sent again counts again."""
        self.sent_bytes: Counter[str] = Counter()
        """Their sizes in bytes, by stage."""
        self.in_flight: Counter[str] = Counter()
        """Tasks on a cluster now, by stage."""
        self.landed: Counter[tuple[str, str]] = Counter()
        """Tasks that came back, by stage and outcome: done, suspect (its workers died), sent again, taken back."""
        self.worked: Counter[tuple[str, str]] = Counter()
        """Tasks run in this process, by stage and outcome: done, failed, cancelled."""
        self.seconds: defaultdict[str, float] = defaultdict(float)
        """Their wall-clock seconds, by stage."""
        self.busy = 0
        """Tasks that run in this process now."""
        self.buildings: Counter[tuple[str, str]] = Counter()
        """Buildings modelled by tasks of this process, by status and reason."""

    def send(self, stage: str, tasks: int, size_bytes: int) -> None:
        """Count tasks sent to the cluster together."""
        with self._lock:
            self.sent[stage] += tasks
            self.sent_bytes[stage] += size_bytes
            self.in_flight[stage] += tasks

    def land(self, stage: str, outcome: str, tasks: int) -> None:
        """Count tasks that came back from the cluster together."""
        with self._lock:
            self.in_flight[stage] -= tasks
            self.landed[stage, outcome] += tasks

    def begin(self) -> None:
        """Count the start of a task in this process."""
        with self._lock:
            self.busy += 1

    def end(self, stage: str, outcome: str, seconds: float) -> None:
        """Count the end of a task in this process."""
        with self._lock:
            self.busy -= 1
            self.worked[stage, outcome] += 1
            self.seconds[stage] += seconds

    def building(self, status: str, reason: str | None) -> None:
        """Count a modelled building."""
        with self._lock:
            self.buildings[status, reason or ""] += 1


TALLIES = Tallies()
"""Tallies of this process."""
