"""Events of a run, and the interface for following and cancelling it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Literal

from pipeline.errors import RunCancelledError

TICK_S = 0.2
"""Seconds between two checks of the cluster and of the run's cancellation."""

EventKind = Literal["run", "stage", "progress", "warning", "waiting", "detail", "finished"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Event:
    """Something that happened; has no object of the engine, so it can be logged, stored or sent."""

    kind: EventKind
    """Kind of the event; `waiting` means that no worker is there, `detail` is for logs: about one building or task."""
    stage: str = ""
    """The name of a stage, such as ingest or reconstruct; empty for the run as a whole."""
    done: int = 0
    """Finished units of this stage (files, tiles or candidates)."""
    total: int = 0
    """Units of this stage; 0 where unknown."""
    message: str = ""
    """One sentence of text; empty for mere progress."""
    kept: int = 0
    """Finished units taken from an earlier run; sent once, when the stage begins."""
    failed: int = 0
    """Failed units, which are among the finished ones."""
    facts: Mapping[str, str | float] = dataclasses.field(default_factory=dict)
    """What a detail is about: tile, building, reason, seconds. A warning that comes before all others has a place."""


Listener = Callable[[Event], None]


def ignore(event: Event) -> None:
    """Listen to nothing."""
    del event


def never() -> bool:
    """Never cancel."""
    return False


def nothing() -> None:
    """Stop nothing, miss nothing."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Watch:
    """What an executor polls, calls and sends events to while the tasks of a run are in progress."""

    cancelled: Callable[[], bool] = never
    """Whether the run was cancelled; polled several times a second."""
    check_scratch: Callable[[], None] = nothing
    """Raises RunOverError where this process misses the run's scratch, too, when a task did."""
    stop: Callable[[], None] = nothing
    """Asks the tasks in flight to end, because their results are not needed any more."""
    listener: Listener = ignore
    """Gets events that do not come with a result: workers are missing or back."""

    def check_cancelled(self) -> None:
        """Raise RunCancelledError if the run was cancelled."""
        if self.cancelled():
            raise RunCancelledError("the run was cancelled")
