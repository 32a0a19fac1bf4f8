"""What a run tells while it runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Literal

from pipeline.errors import RunCancelledError

EventKind = Literal["run", "stage", "progress", "warning", "waiting", "finished"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Event:
    """One thing that happened; carries no object of the engine, so that it can be logged, stored or sent."""

    kind: EventKind
    """What happened; `waiting` means that no worker is there to go on."""
    stage: str = ""
    """plan, ingest, split, join, reconstruct or publish; empty for the run as a whole."""
    done: int = 0
    """Units done of this stage (files, tiles or candidates)."""
    total: int = 0
    """Units of this stage; 0 where unknown."""
    message: str = ""
    """One sentence for people; empty for mere progress."""
    kept: int = 0
    """Of the units done, those that were kept from an earlier run; told once, as the stage begins."""
    failed: int = 0
    """Of the units done, those that failed."""


Listener = Callable[[Event], None]


def ignore(event: Event) -> None:
    """Listen to nothing."""
    del event


def never() -> bool:
    """Call nothing off."""
    return False


def nothing() -> None:
    """Stop nothing."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Watch:
    """What an executor asks, tells and sets off while the tasks of a run are under way."""

    cancelled: Callable[[], bool] = never
    """Whether the run was called off; asked several times a second."""
    stop: Callable[[], None] = nothing
    """Tells the tasks in flight to end, because nobody waits for them any more."""
    listener: Listener = ignore
    """Gets events that no result tells: workers are missing, workers are back."""

    def check_cancelled(self) -> None:
        """End a run that was called off.

        Raises
        ------
        RunCancelledError
            It was called off.
        """
        if self.cancelled():
            raise RunCancelledError("the run was called off")
