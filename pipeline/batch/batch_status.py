"""The status of a batch run: a small file in its work folder, to be read while it runs and after it died."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime as dt
import json
import os
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pipeline.batch.remaining_time import StageProgress, duration, remaining_s
from pipeline.errors import RunError
from pipeline.io import LocalStorage
from pipeline.runtime.monitoring.progress import Event
from pipeline.runtime.scratch.work_folder import is_at_work

NAME = "status.json"
_EVERY_S = 1.0
"""Least seconds between two writes of a status."""
_WARNINGS = 20
"""Newest warnings in a status; run.json has all."""
_RATE_WINDOW_S = 60.0
_BUILDINGS = "reconstruct"
_TILES = "publish"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Status:
    """The state and progress of a batch run."""

    state: str
    """running, finished, incomplete (tiles failed), interrupted, failed; or dead: its process vanished."""
    batch: str
    """The batch file."""
    out: str
    """The run directory."""
    process: str
    """Its process, and the machine."""
    started_at: str
    """ISO 8601, UTC."""
    updated_at: str
    """Time of this status, ISO 8601, UTC."""
    points: int = 0
    """Points of all inputs, by their headers."""
    stage: str = ""
    """The stage that is under way, or the last one."""
    stages: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    """done, total, kept and seconds by stage."""
    buildings: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """done, failed, queued and total; empty until they are known."""
    tiles: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """published and total; empty until they are known."""
    rate_per_s: float | None = None
    """Units of the stage per second, over the last minute."""
    remaining_s: tuple[float, float] | None = None
    """Least and most seconds that the run will probably still take."""
    waiting: str = ""
    """Why the run does not advance, such as missing workers."""
    warnings: tuple[str, ...] = ()
    """The newest warnings."""
    message: str = ""
    """How the run ended."""


class StatusWriter:
    """Listens to a run and writes its status file.

    Parameters
    ----------
    clock : callable
        Seconds, monotonic; replaced in tests.
    now : callable
        Returns the present, with a time zone; replaced in tests.
    """

    def __init__(
        self,
        work_folder: str,
        batch: str,
        out: str,
        clock: Callable[[], float] = time.monotonic,
        now: Callable[[], dt.datetime] = lambda: dt.datetime.now(tz=dt.UTC),
    ) -> None:
        self._storage = LocalStorage(root=Path(work_folder))
        self._planned: dict[str, float] = {}
        self._clock, self._now = clock, now
        self._seen: dict[str, StageProgress] = {}
        self._began_s: dict[str, float] = {}
        self._recent: deque[tuple[float, int]] = deque()
        self._written_s = -1e9
        self._is_unwritten = False
        self._lock = threading.RLock()
        self._failed = 0
        started = self._now().isoformat(timespec="seconds")
        self.status = Status(
            state="running",
            batch=batch,
            out=out,
            process=f"{os.getpid()} on {socket.gethostname()}",
            started_at=started,
            updated_at=started,
        )

    def begin(self) -> None:
        """Record that the run is being planned."""
        with self._lock:
            self.status = dataclasses.replace(self.status, stage="plan")
            self._write()

    def plan(self, planned: Mapping[str, float], points: int) -> None:
        """Record the plan: seconds by stage, and points by the headers of the inputs."""
        with self._lock:
            self._planned = dict(planned)
            self.status = dataclasses.replace(self.status, points=points)
            self._write()

    def on_event(self, event: Event) -> None:
        """Record an event. The file is written once per second at most; `tick` writes the rest."""
        with self._lock:
            self._take(event)
            self._is_unwritten = True
            if self._clock() - self._written_s >= _EVERY_S:
                self._write()

    def tick(self) -> None:
        """Write the last events if no later one did; may be called from another thread."""
        with self._lock:
            if self._is_unwritten and self._clock() - self._written_s >= _EVERY_S:
                # the next event reports a full disk, in the thread of the run
                with contextlib.suppress(OSError, RunError):
                    self._write()

    def _take(self, event: Event) -> None:
        if event.kind in {"stage", "progress"}:
            self._advance(event)
        elif event.kind == "warning":
            warnings = (*self.status.warnings, event.message)[-_WARNINGS:]
            self.status = dataclasses.replace(self.status, warnings=warnings)
        elif event.kind == "waiting":
            self.status = dataclasses.replace(self.status, waiting=event.message)
        elif event.kind == "run" and self.status.waiting:
            self.status = dataclasses.replace(self.status, waiting="")

    def _advance(self, event: Event) -> None:
        now = self._clock()
        if event.stage != self.status.stage:
            self._recent.clear()
            before = self._seen.get(self.status.stage)
            if before is not None:
                self._seen[self.status.stage] = dataclasses.replace(before, over=True)
            self._began_s[event.stage] = now
            self._seen[event.stage] = StageProgress(done=event.done, total=event.total)
        stage = self._seen[event.stage]
        stage = dataclasses.replace(
            stage,
            done=event.done,
            total=event.total,
            kept=event.kept or stage.kept,
            seconds=now - self._began_s[event.stage],
        )
        self._seen[event.stage] = stage
        self._recent.append((now, event.done - stage.kept))
        while now - self._recent[0][0] > _RATE_WINDOW_S:
            self._recent.popleft()
        if event.stage == _BUILDINGS:
            self._failed = event.failed
        self.status = dataclasses.replace(self.status, stage=event.stage, waiting="")

    def _write(self) -> None:
        self._written_s = self._clock()
        self._storage.put(NAME, (json.dumps(dataclasses.asdict(self._whole()), indent=1) + "\n").encode())
        self._is_unwritten = False

    def _whole(self) -> Status:
        buildings, tiles = self._seen.get(_BUILDINGS), self._seen.get(_TILES)
        first, last = (self._recent[0], self._recent[-1]) if self._recent else ((0.0, 0), (0.0, 0))
        passed = last[0] - first[0]
        return dataclasses.replace(
            self.status,
            updated_at=self._now().isoformat(timespec="seconds"),
            stages={
                name: {"done": s.done, "total": s.total, "kept": s.kept, "seconds": round(s.seconds, 1)}
                for name, s in self._seen.items()
            },
            buildings={}
            if buildings is None
            else {
                "done": buildings.done,
                "failed": self._failed,
                "queued": buildings.total - buildings.done,
                "total": buildings.total,
            },
            tiles={} if tiles is None else {"published": tiles.done, "total": tiles.total},
            rate_per_s=round((last[1] - first[1]) / passed, 3) if passed > 0.0 else None,
            remaining_s=remaining_s(self._planned, self._seen) if self.status.state == "running" else None,
        )

    def summary(self) -> str:
        """Rate, failures and what is still to come, in a few words."""
        with self._lock:
            whole = self._whole()
        words = [] if whole.rate_per_s is None else [f"{whole.rate_per_s:.3g} per second"]
        if whole.stage == _BUILDINGS:
            words.append(f"{whole.buildings['failed']} failed, {whole.buildings['queued']} queued")
        if whole.remaining_s is not None:
            words.append(f"still {duration(whole.remaining_s[0])} to {duration(whole.remaining_s[1])}")
        return ", ".join(words)

    def end(self, state: str, message: str = "") -> Status:
        """Write how the run ended."""
        with self._lock:
            self.status = dataclasses.replace(self.status, state=state, message=message)
            self._write()
            return self._whole()


def read_status(work_folder: str) -> Status:
    """The status of the run of a work folder; `dead` if it says running and no process holds the folder.

    Raises RunError if there is none, or it cannot be read.
    """
    path = Path(work_folder, NAME)
    names = {field.name for field in dataclasses.fields(Status)}
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        status = Status(**{name: value for name, value in found.items() if name in names})
    except FileNotFoundError:
        raise RunError(f"{path} does not exist: this batch was never run") from None
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise RunError(f"{path} cannot be read: {error}. Run the batch again: it writes a new one") from error
    if status.state == "running" and not is_at_work(work_folder):
        message = f"cut off after {status.updated_at}: run the batch again, and it continues from there"
        return dataclasses.replace(status, state="dead", remaining_s=None, waiting="", message=message)
    return status


def buildings_before(work_folder: str) -> tuple[int, int]:
    """Buildings and points of the run before; zeros if unknown."""
    try:
        status = read_status(work_folder)
        return int(status.buildings.get("total", 0)), int(status.points)
    except (RunError, AttributeError, TypeError, ValueError):  # missing or damaged
        return 0, 0
