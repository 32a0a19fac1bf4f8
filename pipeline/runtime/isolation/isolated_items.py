"""Items modelled in supervised child processes, so a bad building harms only itself.

A child announces each item before it begins and sends each result at once. If the child dies, or is ended for its
memory, the announced item is tried once more, alone in a fresh child, since earlier items may have used up memory or
corrupted it. Only an item that fails again is given up; nothing else is lost.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from pipeline.errors import RunError
from pipeline.model import Reason
from pipeline.runtime.isolation.child_pool import FRUITLESS_STARTS, borrowed_child, start_failure
from pipeline.runtime.isolation.process_limits import IsolationLimits, Loss
from pipeline.runtime.isolation.supervision import ChildEnd, EndCause
from pipeline.runtime.monitoring.progress import never

Item = TypeVar("Item")
Result = TypeVar("Result")

_WORN_SHARE = 0.5
"""A child that holds more than this share of its limit between batches is not used again."""


_REASONS = {EndCause.DIED: Reason.CRASHED, EndCause.TIME: Reason.TIMED_OUT, EndCause.MEMORY: Reason.OUT_OF_MEMORY}


def supervise(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    limits: IsolationLimits,
    cancelled: Callable[[], bool] = never,
    *,
    second_chance: bool = True,
    on_second_chance: Callable[[int, str], None] = lambda _index, _detail: None,
    loads: Sequence[str] | None = None,
    one: str = "building",
) -> Iterator[tuple[int, Result | Loss]]:
    """Call a function on items in a child process and survive the death of the child.

    Yields each item's index and its outcome, a result or a `Loss`, once and in any order. `cancelled` is polled four
    times a second; the child is killed once it is true. New children have the `loads`, as in `isolation.child_main`.

    Parameters
    ----------
    function : callable
        Takes one item; both are pickled.
    second_chance : bool
        Whether an item that killed its process is tried once more, alone in a fresh one, before it is given up.
    on_second_chance : callable
        Gets the index of such an item and what happened to its process.
    one : str
        The word for an item in messages.

    Raises
    ------
    RunCancelledError
        `cancelled` turned true.
    RunError
        Children die before they begin an item.
    Exception
        `function` raised it; only MemoryError is a loss of the item.
    """
    lots = deque([(tuple(enumerate(items)), False)] if items else [])
    fruitless = 0
    while lots:
        lot, alone = lots.popleft()
        end: ChildEnd | None = None
        with borrowed_child(cancelled, fresh=alone, loads=loads) as child:
            for message in child.work(
                function,
                lot,
                timeout_s=limits.timeout_s,
                memory_bytes=limits.memory_bytes,
                cancelled=cancelled,
                one=one,
            ):
                if isinstance(message, ChildEnd):
                    end = message
                    break
                lot = tuple(entry for entry in lot if entry[0] != message.index)
                fruitless = 0
                yield message.index, message.result
            if end is not None or child.memory_bytes > _WORN_SHARE * limits.memory_bytes:
                child.end()
        if end is None:
            continue
        if end.index is None:
            fruitless += 1
            if fruitless == FRUITLESS_STARTS:
                raise RunError(start_failure(end.detail, end.stderr))
            lots.appendleft((lot, alone))
            continue
        guilty = tuple(entry for entry in lot if entry[0] == end.index)
        rest = tuple(entry for entry in lot if entry[0] != end.index)
        if rest:
            lots.appendleft((rest, False))
        if alone or end.cause is EndCause.TIME or not second_chance:
            yield end.index, _loss(end, alone=alone)
        else:
            on_second_chance(end.index, end.detail)
            lots.appendleft((guilty, True))


def _loss(end: ChildEnd, *, alone: bool) -> Loss:
    return Loss(
        reason=_REASONS[end.cause],
        detail=end.detail + (", also alone in a fresh process" if alone and end.cause is EndCause.DIED else ""),
        seconds=end.seconds,
        memory_bytes=end.memory_bytes,
        stderr=end.stderr,
    )
