"""Who goes first where workers are scarce: one table for all that starts runs."""

from __future__ import annotations

from types import MappingProxyType
from typing import Literal

Traffic = Literal["interactive", "batch"]
"""`interactive`: somebody waits for it (a job of the service, a command). `batch`: a run over a city, for days."""

PRIORITIES = MappingProxyType({"interactive": 0, "batch": -1_000_000})
"""Dask's priority of each kind of traffic: of the tasks that wait at a worker, those of the highest number go first."""

_BAND = 499_999
"""How far a run's own wish moves it within its kind: never into the next."""


def priority_of(traffic: Traffic, wish: int = 0) -> int:
    """The priority of a run's tasks.

    Parameters
    ----------
    traffic : {'interactive', 'batch'}
        What kind of run it is.
    wish : int
        What the user asked for; only compared with that of other runs of the same kind.

    Examples
    --------
    >>> priority_of("interactive", 7), priority_of("batch"), priority_of("batch", 7)
    (7, -1000000, -999993)
    >>> priority_of("interactive", -10**9) > priority_of("batch", 10**9)
    True
    """
    return PRIORITIES[traffic] + max(-_BAND, min(_BAND, wish))
