"""The forecast of a run: its wall time and its memory, by the rates and, where it is worth it, by a sample."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from pipeline.runtime.compiling import compiling_s, kernel_groups
from pipeline.runtime.engine import Engine
from pipeline.runtime.expected import RATES, Expected, expected
from pipeline.runtime.monitoring.measurement import cores
from pipeline.runtime.request import RunRequest
from pipeline.runtime.run_plan import Plan

WORTH_S = 3.0
"""Runs that take less wall time by the rates are not sampled: the sample would take a good part of their time."""
_BY_SAMPLE = 1.5
"""Factor either way by which a run may differ from a forecast by a sample: docs/how_to/plan_a_run.md."""
_BY_RATES = 2.0
"""The same of a forecast by the rates alone; other machines may differ by more."""

_METHOD = "arrangement"
"""The default method."""
_DRIVER_GIB: Mapping[Engine, float] = {
    "serial": 0.0,
    "local": RATES.driver_gib,
    "cluster": RATES.cluster_driver_gib,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Forecast:
    """What a run is expected to take."""

    work: Expected
    """Its work."""
    sampled: bool
    """Whether a sample of it was run; otherwise the rates alone count."""
    stage_s: Mapping[str, float]
    """Wall seconds by stage."""
    total_s: float
    """Wall seconds in total."""
    cold_s: float
    """Seconds on top, to compile kernels."""
    process_bytes: int
    """Peak memory of the largest process."""
    memory_bytes: int
    """Peak memory of all processes together."""

    @property
    def range_s(self) -> tuple[float, float]:
        """Least and most seconds in total, with those to compile kernels."""
        factor = _BY_SAMPLE if self.sampled else _BY_RATES
        least_s, most_s = self.cold_s / _BY_RATES, self.cold_s * _BY_RATES
        return self.total_s / factor + least_s, self.total_s * factor + most_s


def forecast(
    request: RunRequest,
    plan: Plan,
    paths: Sequence[str],
    *,
    engine: Engine,
    workers: int,
    buildings: int | None = None,
    worth_s: float = WORTH_S,
) -> Forecast:
    """The forecast of a run with an engine and so many processes; on this machine its cores bound what works at once.

    Without compiled kernels nothing is sampled: that would compile them. Raises InputError if an input cannot be read.

    Parameters
    ----------
    buildings : int, optional
        Their number if it is known.
    worth_s : float
        Wall seconds by the rates from which on a sample is run.
    """
    work = dataclasses.replace(expected(plan, buildings), octree=request.points)
    if request.settings.general.method != _METHOD:
        work = dataclasses.replace(work, pace={"reconstruct": RATES.other_methods})
    here = request.resources.scheduler is None
    hands = min(workers, cores()) if here else workers
    total_s, stage_s = _total_s(work, engine, hands)
    general = request.settings.general
    groups = kernel_groups(method=general.method, points=request.points, terrain=general.terrain)
    cold_s = compiling_s(groups) if here else 0.0
    found = None
    if total_s >= worth_s and here and not cold_s:
        from pipeline.runtime.sample import sampled  # loads what runs

        found = sampled(work, request, plan, paths, hands=hands, buildings=buildings)
        if found is not None:
            work, (total_s, stage_s) = found, _total_s(found, engine, hands)
    largest, driver = work.process_bytes(alone=engine == "serial"), _DRIVER_GIB[engine] * 2**30
    return Forecast(
        work=work,
        sampled=found is not None,
        stage_s=stage_s,
        total_s=total_s,
        cold_s=cold_s,
        process_bytes=max(largest, round(driver)),
        memory_bytes=round(workers * largest + driver),
    )


def _total_s(work: Expected, engine: Engine, hands: int) -> tuple[float, dict[str, float]]:
    """Wall seconds in total and by stage."""
    stage_s = work.wall_s(hands)
    start_s = RATES.start_s + (RATES.cluster_start_s if engine == "cluster" else 0.0)
    return start_s + sum(stage_s.values()), stage_s
