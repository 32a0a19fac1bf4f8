"""What this process has done so far, counted: of a run's driver what it sent off, of a worker what it worked off.

Plain numbers without a library, so that counting costs nothing; `run_metrics` shows them to Prometheus.
"""

from __future__ import annotations

import threading
from collections import Counter, defaultdict


class Tallies:
    """Counts of one process; all of them only grow, but for `in_flight`."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.sent: Counter[str] = Counter()
        """Tasks sent to a cluster, by stage; one that is sent again counts again."""
        self.sent_bytes: Counter[str] = Counter()
        """Their sizes."""
        self.in_flight: Counter[str] = Counter()
        """Tasks on a cluster just now, by stage."""
        self.landed: Counter[tuple[str, str]] = Counter()
        """Tasks that came back, by stage and outcome: done, suspect (its workers died), sent again, taken back."""
        self.worked: Counter[tuple[str, str]] = Counter()
        """Tasks worked off in this process, by stage and outcome: done, failed, called off."""
        self.seconds: defaultdict[str, float] = defaultdict(float)
        """What these took, by stage, seconds of the clock."""
        self.busy = 0
        """Tasks that run in this process now."""
        self.buildings: Counter[tuple[str, str]] = Counter()
        """Buildings modelled by tasks of this process, by status and reason."""

    def send(self, stage: str, size_bytes: int) -> None:
        """A task leaves for the cluster."""
        with self._lock:
            self.sent[stage] += 1
            self.sent_bytes[stage] += size_bytes
            self.in_flight[stage] += 1

    def land(self, stage: str, outcome: str) -> None:
        """A task is on the cluster no longer."""
        with self._lock:
            self.in_flight[stage] -= 1
            self.landed[stage, outcome] += 1

    def begin(self) -> None:
        """A task begins in this process."""
        with self._lock:
            self.busy += 1

    def end(self, stage: str, outcome: str, seconds: float) -> None:
        """A task ends in this process."""
        with self._lock:
            self.busy -= 1
            self.worked[stage, outcome] += 1
            self.seconds[stage] += seconds

    def building(self, status: str, reason: str | None) -> None:
        """A building has its record."""
        with self._lock:
            self.buildings[status, reason or ""] += 1


TALLIES = Tallies()
"""Of this process."""
