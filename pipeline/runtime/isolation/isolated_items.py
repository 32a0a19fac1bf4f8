"""Building work in supervised child processes, so that a building can cost only itself.

A process keeps the children that it started, one for each thread that is at work; they live from batch to batch. A
child announces every item before it touches it and sends every result as soon as it is done. When it dies, or is ended
for its memory, the announced item is tried once more, alone in a fresh child: memory may have been piled up, and
structures broken, by those before it. Only an item that fails again is given up, and nothing else is lost.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from pipeline.errors import RunError, SettingsError
from pipeline.model import Reason
from pipeline.runtime.isolation.child_pool import FRUITLESS_STARTS, borrowed_child, start_failure
from pipeline.runtime.isolation.supervision import Cause, End
from pipeline.runtime.monitoring.events import never

Item = TypeVar("Item")
Result = TypeVar("Result")

MIN_MEMORY_BYTES = 2**29
"""A child has a quarter of this in use before it begins."""

_WORN_SHARE = 0.5
"""A child that keeps more than this share of its limit between batches is not used again."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class IsolationLimits:
    """What one building may take before its process is ended.

    Raises
    ------
    SettingsError
        A limit under which no building could be modelled.
    """

    timeout_s: float = 600.0
    """Wall-clock seconds of one building; protects the run, and is told as such."""
    memory_bytes: int = 4 * 2**30
    """Private resident size of the child process."""

    def __post_init__(self) -> None:
        """Refuse limits that no building can keep."""
        faults = []
        if not (math.isfinite(self.timeout_s) and self.timeout_s > 0.0):
            faults.append(f"the time-out of a building is {self.timeout_s:g} s: use more than 0")
        if self.memory_bytes < MIN_MEMORY_BYTES:
            least = MIN_MEMORY_BYTES / 2**30
            faults.append(f"the memory of a building is {self.memory_bytes / 2**30:g} GiB: use at least {least:g} GiB")
        if faults:
            raise SettingsError(faults)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Loss:
    """Why there is no result of an item."""

    reason: Reason
    """crashed, timed_out or out_of_memory."""
    detail: str
    """What happened and the limit; the same whenever it happens again."""
    seconds: float
    """From its beginning to its end."""
    memory_bytes: int
    """Largest private memory of its child that was seen."""
    stderr: str
    """The last lines that its child wrote."""


_REASONS = {Cause.DIED: Reason.CRASHED, Cause.TIME: Reason.TIMED_OUT, Cause.MEMORY: Reason.OUT_OF_MEMORY}


def supervise(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    limits: IsolationLimits,
    cancelled: Callable[[], bool] = never,
    *,
    second_chance: bool = True,
    loads: Sequence[str] | None = None,
) -> Iterator[tuple[int, Result | Loss]]:
    """Call a function on items in a child process, and outlive whatever they do to it.

    Parameters
    ----------
    function : callable
        Of one item; both travel as pickles.
    items : sequence
        What it is called with.
    limits : IsolationLimits
        For each item.
    cancelled : callable
        Asked four times a second; once it is true the child is killed.
    second_chance : bool
        Whether an item that cost its process is tried once more, alone in a fresh one, before it is given up.
    loads : sequence of str, optional
        What new children call before they begin, as `pipeline.runtime.isolation.child_main` takes it.

    Yields
    ------
    int, Result or Loss
        The item's index, and what became of it; each item once, in any order.

    Raises
    ------
    RunCancelledError
        `cancelled` turned true.
    RunError
        Children die before they begin, so no item is to blame.
    Exception
        What `function` raised; only MemoryError counts as the item's own.
    """
    lots = deque([(tuple(enumerate(items)), False)] if items else [])
    fruitless = 0
    while lots:
        lot, alone = lots.popleft()
        end: End | None = None
        with borrowed_child(cancelled, fresh=alone, loads=loads) as child:
            for said in child.work(
                function, lot, timeout_s=limits.timeout_s, memory_bytes=limits.memory_bytes, cancelled=cancelled
            ):
                if isinstance(said, End):
                    end = said
                    break
                lot = tuple(entry for entry in lot if entry[0] != said.index)
                fruitless = 0
                yield said.index, said.result
            if end is not None or child.memory_bytes > _WORN_SHARE * limits.memory_bytes:
                child.end()
        if end is None:
            continue
        if end.index is None:
            fruitless += 1
            if fruitless == FRUITLESS_STARTS:
                raise RunError(start_failure(end.told, end.stderr))
            lots.appendleft((lot, alone))
            continue
        guilty = tuple(entry for entry in lot if entry[0] == end.index)
        rest = tuple(entry for entry in lot if entry[0] != end.index)
        if rest:
            lots.appendleft((rest, False))
        if alone or end.cause is Cause.TIME or not second_chance:
            yield end.index, _loss(end, alone=alone)
        else:
            lots.appendleft((guilty, True))


def _loss(end: End, *, alone: bool) -> Loss:
    return Loss(
        reason=_REASONS[end.cause],
        detail=end.told + (", also alone in a fresh process" if alone and end.cause is Cause.DIED else ""),
        seconds=end.seconds,
        memory_bytes=end.memory_bytes,
        stderr=end.stderr,
    )
