"""Models made in a supervised child process, so that a building can only harm itself."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence

from pipeline.export.facts import CandidateFacts
from pipeline.runtime.isolation.isolated_items import supervise
from pipeline.runtime.isolation.process_limits import IsolationLimits, Loss
from pipeline.runtime.isolation.replay_bundle import Incident
from pipeline.runtime.stages.gather import gather
from pipeline.runtime.stages.lost_buildings import NO_BUNDLE, failed_site, quarantined
from pipeline.runtime.stages.model_batch import BatchTask, Packed, model_site, opened, packed_model
from pipeline.runtime.stages.sites import CandidateSite

_BUNDLE_TIMEOUT_S = 60.0


def models_in_child(
    task: BatchTask, sites: Sequence[CandidateSite], limits: IsolationLimits
) -> Iterator[tuple[int, Packed]]:
    """The models of a batch as they come, each with its place among the sites."""
    common = opened(task)
    cancelled = functools.partial(_cancelled, task)
    work = functools.partial(model_site, common)
    retried: dict[int, str] = {}
    for index, model in supervise(
        work, sites, limits, cancelled, on_second_chance=retried.__setitem__, loads=_loads(task)
    ):
        found = _lost(common, sites[index], model, limits, cancelled) if isinstance(model, Loss) else model
        if index in retried:
            found = dataclasses.replace(found, modelled=dataclasses.replace(found.modelled, retried=retried[index]))
        task.scratch.beat()
        yield index, found


def _loads(task: BatchTask) -> tuple[str, ...]:
    """What a child loads before it works on the task: only its methods, since each costs a tenth of a second."""
    methods = dict.fromkeys((task.method, *(own.method for own in task.own.values())))
    return tuple(f"pipeline.runtime.stages.rehearsal:load_once:{method}" for method in methods)


def _cancelled(task: BatchTask) -> bool:
    task.scratch.check_mark()  # its error says more than a yes would; waiting for a building is not progress
    return False


def _lost(
    task: BatchTask, site: CandidateSite, loss: Loss, limits: IsolationLimits, cancelled: Callable[[], bool]
) -> Packed:
    """The record and the bundle of a building that ended its process; also made in a child."""
    bundled = dataclasses.replace(limits, timeout_s=max(limits.timeout_s, _BUNDLE_TIMEOUT_S))
    describe = functools.partial(lost_site, task, loss)
    ((_, described),) = supervise(describe, [site], bundled, cancelled, second_chance=False, loads=_loads(task))
    if not isinstance(described, Loss):
        return described
    detail = f"{loss.detail}; {NO_BUNDLE}: {described.detail}"
    result = failed_site(site, task.way_of(site).method, loss.reason, detail)
    return packed_model(task, site, result, CandidateFacts(), loss.seconds)


def lost_site(task: BatchTask, loss: Loss, site: CandidateSite) -> Packed:
    """The record of a building that ended its process, and its bundle in the quarantine."""
    from pipeline.recipe import failed_building  # loads the science, which the process that watches does not need

    task = task.way_of(site)
    candidate, facts = gather(task.scratch, task.grid, site, task.gps_kind, task.settings.roof, task.guides)
    result = failed_building(candidate, task.method, loss.reason, loss.detail)
    incident = Incident(
        reason=loss.reason.value,
        detail=loss.detail,
        seconds=loss.seconds,
        memory_bytes=loss.memory_bytes,
        stderr=loss.stderr,
    )
    result = quarantined(task.quarantine, result, task.bundle_of(candidate, incident))
    return packed_model(task, site, result, facts, loss.seconds)
