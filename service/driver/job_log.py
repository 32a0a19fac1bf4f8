"""The log of an attempt: lines from the events of its run and from the driver, until they are written."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

from pipeline.runtime.monitoring.progress import Event
from service.jobs import LogLevel, NewLogLine

MAX_DETAILS = 1000
"""Lines about single buildings and tasks of one attempt; more are only counted, so the other lines are kept."""
_MAX_WAITING = 2000
"""Maximum number of lines that wait while the database does not answer; the oldest are dropped first."""


class AttemptLog:
    """Collects the lines of an attempt. It takes no locks: the caller does.

    Parameters
    ----------
    scrub : callable
        Removes the paths of this machine from a message.
    words : mapping of str to str
        Descriptions of stages.
    clock : callable
        Seconds, monotonic; replaced in tests.
    """

    def __init__(
        self, scrub: Callable[[str], str], words: Mapping[str, str], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._scrub = scrub
        self._words = words
        self._clock = clock
        self._waiting: list[tuple[float, NewLogLine]] = []
        self._stage: Event | None = None
        self._began_s = clock()
        self._details = 0
        self._left_out: Counter[str] = Counter()

    def hear(self, event: Event) -> None:
        """Take an event of the run."""
        if event.kind == "stage":
            self.end_stage()
            words = self._words.get(event.stage, event.stage)
            self.say(f"{event.message}: {words}" if event.message else words, stage=event.stage)
            self._stage, self._began_s = event, self._clock()
        elif event.kind == "progress":
            if event.message:
                self.say(event.message, stage=event.stage)
            if self._stage is not None and event.stage == self._stage.stage:
                self._stage = event
        elif event.kind in {"warning", "waiting"}:
            self.say(event.message, level=LogLevel.WARNING, stage=event.stage)
        elif event.kind == "detail":
            self._details += 1
            if self._details <= MAX_DETAILS:
                self.say(event.message, level=LogLevel.WARNING, stage=event.stage, **event.facts)
            else:
                self._left_out[event.stage] += 1

    def say(self, message: str, *, level: LogLevel = LogLevel.INFO, stage: str = "", **facts: Any) -> None:
        """Add a line."""
        line = NewLogLine(level=level, stage=stage, message=self._scrub(message), facts=facts)
        self._waiting = [*self._waiting, (self._clock(), line)][-_MAX_WAITING:]

    def end_stage(self) -> None:
        """Say how the stage ended that runs, if one does."""
        event, self._stage = self._stage, None
        if event is None:
            return
        left_out = self._left_out.pop(event.stage, 0)
        if left_out:
            message = f"{left_out} more lines about single buildings or tasks are left out: see the records"
            self.say(message, level=LogLevel.WARNING, stage=event.stage)
        counts: dict[str, Any] = (
            {"done": event.done, "total": event.total, "failed": event.failed} if event.total else {}
        )
        self.say("done", stage=event.stage, seconds=round(self._clock() - self._began_s, 3), **counts)

    def take(self) -> list[tuple[float, NewLogLine]]:
        """The lines that wait with the times at which they came; none wait afterwards."""
        waiting, self._waiting = self._waiting, []
        return waiting

    def put_back(self, lines: list[tuple[float, NewLogLine]]) -> None:
        """Let lines wait again that could not be written."""
        self._waiting = [*lines, *self._waiting][-_MAX_WAITING:]
