"""Turns the progress of a stage into a percentage of the whole job, and its name into a sentence."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

from pipeline.runtime.monitoring.stages import STAGES

WEIGHTS = MappingProxyType({stage.name: stage.weight for stage in STAGES if stage.weight})
"""The stages of a job in their order, with their share of the time in percent. A job without points, terrain or further
formats skips their stages."""
CLASSIFY_WEIGHTS = MappingProxyType({stage.name: stage.classify_weight for stage in STAGES if stage.classify_weight})
"""The stages of a classification, likewise."""
WORDS = MappingProxyType({stage.name: stage.message for stage in STAGES})
"""Descriptions of stages. Those without a weight belong to a comparison and are short."""

COMPILING = 10
"""Percent that kernels take which are compiled before the first job of an installation; its stages then begin at less,
and it stays there until they have more."""
_LAST = 99
_READING = frozenset({"inputs", "plan", "ingest"})
_START_S = 60.0
"""Seconds for the start of processes, on a busy machine with cold caches."""


def percent(stage: str, done: int, total: int, weights: Mapping[str, int] = WEIGHTS) -> int:
    """Progress of the whole job.

    Parameters
    ----------
    stage : str
        One of `weights`, or compile; any other counts as not begun.
    done, total : int
        Units of this stage; a `total` of 0 is unknown and counts as nothing done.
    weights : mapping
        The stages of the process.

    Returns
    -------
    int
        0 to 99: only the end of the job is 100.

    Examples
    --------
    >>> percent("compile", 53, 106), percent("inputs", 0, 1)
    (5, 0)
    >>> percent("reconstruct", 0, 80), percent("reconstruct", 40, 80), percent("outputs", 3, 3)
    (45, 62, 99)
    """
    share = min(max(done / total, 0.0), 1.0) if total > 0 else 0.0
    if stage == "compile":
        return int(COMPILING * share)
    if stage not in weights:
        return 0
    names = list(weights)
    before = sum(weights[name] for name in names[: names.index(stage)])
    return min(_LAST, int(before + weights[stage] * share))


@dataclasses.dataclass(frozen=True, kw_only=True)
class StepLimits:
    """How long one step of a stage may take: an attempt that says nothing for longer stands still.

    Examples
    --------
    >>> limits = StepLimits(stall_s=600.0, input_s=600.0, building_s=600.0)
    >>> limits.of("split"), limits.of("ingest"), limits.of("reconstruct")
    (600.0, 660.0, 1860.0)
    """

    stall_s: float
    """Seconds of most stages: of one task."""
    input_s: float
    """Seconds after which an input of which nothing more can be read is refused by its name, which comes first."""
    building_s: float
    """Seconds after which a building's process is ended. It is then tried again, and its points are saved."""

    def of(self, stage: str) -> float:
        """Seconds of a stage; an unknown one is like most, and an empty one is the start of the process."""
        if stage == "reconstruct":
            return max(self.stall_s, 3.0 * self.building_s + _START_S)
        if stage in _READING:
            return max(self.stall_s, self.input_s + _START_S)
        return self.stall_s if stage else max(self.stall_s, 2.0 * _START_S)
