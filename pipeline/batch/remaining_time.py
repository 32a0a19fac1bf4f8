"""The remaining time of a run, as a range: from the progress of its stages and the plan of the others."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

_UNSEEN = 2.0
"""A stage that has not begun may take half as long as planned, or twice."""
_SEEN = 1.25
"""Factor by which the plan is off even if earlier stages went as planned: buildings differ. Measured."""
_KNOWN = 0.05
"""Share of a stage below which its plan still counts. Measured: of 6,565 buildings ten took 2 s, the others 28 s."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StageProgress:
    """The progress of a stage."""

    done: int
    """Units done."""
    total: int
    """Units of the stage."""
    kept: int = 0
    """Units of `done` that an earlier run did and that took no time now."""
    seconds: float = 0.0
    """Time since the stage began; its total time if it is over."""
    over: bool = False
    """Whether it is over."""


def remaining_s(planned: Mapping[str, float], seen: Mapping[str, StageProgress]) -> tuple[float, float] | None:
    """The least and the most seconds that a run is likely to take from now on; None if nothing was planned.

    `planned` has the seconds of all stages, by name, in their order, `seen` the progress of those that began.

    Examples
    --------
    Half of the only stage took 50 s, in 100 tasks; another one has not begun.

    >>> [round(s) for s in remaining_s({"split": 80.0}, {"split": StageProgress(done=100, total=200, seconds=50.0)})]
    [45, 55]
    >>> [round(s) for s in remaining_s({"split": 80.0}, {})]
    [40, 160]
    """
    if not planned:
        return None
    low = high = 0.0
    spent = expected = 0.0
    # stages without a plan count by their progress
    for name, seconds in {**dict.fromkeys(seen, 0.0), **planned}.items():
        stage = seen.get(name)
        if stage is None:
            continue
        worked = stage.done - stage.kept
        if stage.over:
            if name in planned and stage.total > stage.kept:
                spent += stage.seconds
                expected += seconds * (stage.total - stage.kept) / max(1, stage.total)
            continue
        left = stage.total - stage.done
        if worked > 0:
            own = stage.seconds / worked * left
            # the relative error of the mean of n similar tasks is 1 / sqrt(n)
            spread = 1.0 / math.sqrt(worked)
            least, most = own / (1.0 + spread), own * (1.0 + spread)
            if seconds > 0.0 and worked < _KNOWN * (stage.total - stage.kept):
                # the first tasks measure workers that warm up, not the stage: the plan counts, too
                share = left / max(1, stage.total)
                least, most = min(least, seconds * share / _UNSEEN), max(most, seconds * share * _UNSEEN)
            low += least
            high += most
        else:
            share = left / max(1, stage.total)
            low += seconds * share / _UNSEEN
            high += seconds * share * _UNSEEN
    pace = spent / expected if expected > 0.0 else 1.0
    doubt = _SEEN if expected > 0.0 else _UNSEEN
    names = list(planned)
    begun = max((k for k, name in enumerate(names) if name in seen), default=-1)
    unseen = pace * sum(planned[name] for name in names[begun + 1 :])
    return low + unseen / doubt, high + unseen * doubt


def duration(seconds: float) -> str:
    """A duration for people.

    >>> duration(4.2), duration(95.0), duration(3 * 3600.0 + 120.0)
    ('4 s', '1:35 min', '3:02 h')
    """
    if seconds < 60.0:
        return f"{seconds:.0f} s"
    whole = round(seconds)
    if seconds < 3600.0:
        return f"{whole // 60}:{whole % 60:02d} min"
    return f"{whole // 3600}:{whole % 3600 // 60:02d} h"
