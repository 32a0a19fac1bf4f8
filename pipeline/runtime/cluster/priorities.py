"""The order of runs if workers are scarce: one table for everything that starts runs."""

from __future__ import annotations

from types import MappingProxyType
from typing import Literal

Traffic = Literal["interactive", "batch"]
"""`interactive`: a user waits for it (a job of the service, a command). `batch`: a run over a city, for days."""

PRIORITIES = MappingProxyType({"interactive": 0, "batch": -1_000_000})
"""Dask's priority of each kind of traffic: at a worker, waiting tasks with the highest number go first."""

_BAND = 499_999
"""Largest shift by a run's own priority: never into the other kind."""


def priority_of(traffic: Traffic, wish: int = 0) -> int:
    """The priority of a run's tasks; the user's wish is compared only with that of other runs of the same kind.

    Examples
    --------
    >>> priority_of("interactive", 7), priority_of("batch"), priority_of("batch", 7)
    (7, -1000000, -999993)
    >>> priority_of("interactive", -10**9) > priority_of("batch", 10**9)
    True
    """
    return PRIORITIES[traffic] + max(-_BAND, min(_BAND, wish))
