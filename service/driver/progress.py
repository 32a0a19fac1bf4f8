"""Turns the progress of a stage into a percentage of the whole job, and its name into a sentence."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

WEIGHTS = MappingProxyType(
    {
        "inputs": 4,
        "plan": 1,
        "ingest": 10,
        "cells": 2,
        "ground": 3,
        "split": 18,
        "join": 1,
        "outline": 6,
        "reconstruct": 35,
        "publish": 4,
        "octree": 5,
        "terrain": 1,
        "formats": 3,
        "outputs": 7,
    }
)
"""The stages of a job in their order, with their share of the time in percent; measured on city blocks. A job without
points, terrain or further formats skips their stages."""

CLASSIFY_WEIGHTS = MappingProxyType(
    {
        "inputs": 4,
        "plan": 1,
        "ingest": 10,
        "cells": 3,
        "ground": 4,
        "split": 21,
        "join": 1,
        "outline": 4,
        "classify": 22,
        "write": 12,
        "rasters": 10,
        "mosaics": 2,
        "outputs": 6,
    }
)
"""The stages of a classification, likewise."""

WORDS = MappingProxyType(
    {
        "compile": "kernels are translated for this machine",
        "inputs": "inputs are prepared",
        "plan": "the run is planned",
        "ingest": "points are read",
        "cells": "duplicates and outliers are marked",
        "ground": "the ground is found",
        "split": "surfaces are found in the tiles",
        "join": "surfaces are joined across the borders of tiles",
        "outline": "touching buildings are separated and outlined",
        "reconstruct": "buildings are modelled",
        "publish": "tiles are written",
        "octree": "points are arranged for viewing",
        "terrain": "the terrain is written",
        "formats": "further formats are written",
        "classify": "points are classified",
        "write": "files are written",
        "rasters": "rasters are drawn",
        "mosaics": "rasters are joined",
        "records": "the runs are compared",
        "points": "points are read for the pictures",
        "pictures": "pictures are drawn",
        "page": "the page is written",
        "outputs": "outputs are assembled",
    }
)
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
