"""Modelling of a batch: a task models some candidates, each on its own."""

from __future__ import annotations

import dataclasses
import functools
import math
import pickle
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from pipeline.errors import GableworkError, RunCancelledError
from pipeline.export.facts import CandidateFacts
from pipeline.io.crs import SpatialReference
from pipeline.io.gps_time import GpsTimeKind
from pipeline.methods import ReconstructSettings
from pipeline.model import BuildingResult, Candidate, Guide, Reason, Status
from pipeline.runtime.isolation.process_limits import IsolationLimits
from pipeline.runtime.monitoring.logs import LOG
from pipeline.runtime.scratch.folder import OpenScratch, Scratch
from pipeline.runtime.scratch.outcomes import DamagedError, Place, key_of, result_of
from pipeline.runtime.stages.batch_figures import REJECTED, BatchFigures, Modelled
from pipeline.runtime.stages.gather import gather
from pipeline.runtime.stages.sites import CandidateSite, StoredGroup
from pipeline.tiling import TileGrid

if TYPE_CHECKING:
    from pipeline.extras.overrides.overrides_file import OwnModelling
    from pipeline.runtime.isolation.replay_bundle import Bundle, Incident


@dataclasses.dataclass(frozen=True, kw_only=True)
class BatchTask:
    """Some candidates for one task."""

    group: StoredGroup
    """The candidates, in scratch."""
    method: str
    """Name of the method."""
    settings: ReconstructSettings
    """Its settings and those of the roof."""
    grid: TileGrid
    scratch: Scratch
    gps_kind: GpsTimeKind
    """Whether GPS times can be converted to dates."""
    isolation: IsolationLimits | None = None
    """Limits of the supervised child; None models in this process."""
    quarantine: str = ""
    """Folder for the bundles of buildings that ended their process or met a fault of ours; empty writes none."""
    reference: SpatialReference = dataclasses.field(default_factory=SpatialReference)
    """CRS of the run, for its bundles."""
    own: Mapping[str, OwnModelling] = dataclasses.field(default_factory=dict)
    """Method and settings of the buildings that have their own, by building_id."""
    guides: tuple[Guide, ...] = ()
    """Given lines of roofs near the candidates, in metres of the CRS."""
    earlier: tuple[Place, ...] = ()
    """Outcomes of earlier batches of these candidates' tile: models of the same input are taken from them."""
    compared: bool = False
    """Whether seconds are compared with those of other methods: a method is then loaded before the clock starts."""
    slow_s: float = math.inf
    """Seconds of a building from which the run hears of it."""

    @property
    def memory_bytes(self) -> int:
        """Estimated peak memory of the process that models them, one after the other."""
        from pipeline.runtime.cluster.memory_needs import building_bytes

        limit_bytes = None if self.isolation is None else self.isolation.memory_bytes
        return building_bytes(self.group.figures.largest, limit_bytes)

    @property
    def supervises(self) -> bool:
        """Whether buildings are modelled in child processes of the process that runs the task."""
        return self.isolation is not None

    def bundle_of(self, candidate: Candidate, incident: Incident) -> Bundle:
        """What modelling a candidate of the task again needs."""
        from pipeline.runtime.isolation.replay_bundle import Bundle

        return Bundle(
            candidate=candidate,
            method=self.method,
            settings=self.settings,
            incident=incident,
            reference=self.reference,
        )

    @functools.cached_property
    def way_key(self) -> str:
        """Digest of method and settings."""
        return key_of(self.method, self.settings)

    def way_of(self, site: CandidateSite) -> BatchTask:
        """The task with the method and the settings of one site."""
        own = self.own.get(site.building_id)
        return self if own is None else dataclasses.replace(self, method=own.method, settings=own.settings)


@dataclasses.dataclass(frozen=True, kw_only=True)
class StoredResult:
    """A model in scratch, waiting to be published."""

    result: BuildingResult
    facts: CandidateFacts
    is_rejected: bool = False
    """Whether it has too few points for a model and nothing else says that it is a building."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Batch:
    """The models of a batch."""

    modelled: tuple[Modelled, ...]
    """The figures, in the order of the candidates."""
    stored: Mapping[str, tuple[str, bytes]]
    """By building_id: the digest of all that the model was made from, empty where it must not be used again; and a
    pickled `StoredResult`."""
    compared: bool
    """As in the task."""
    slow_s: float
    """As in the task."""


@dataclasses.dataclass(frozen=True)
class Packed:
    """A model on its way to scratch: pickled once, where it was made, and never opened on the way."""

    modelled: Modelled
    """Its figures."""
    stored: bytes
    """A pickled `StoredResult`."""
    made_from: str = ""
    """Digest of candidate, method and settings; empty where the model must not be used again."""


def figures_of(batch: Batch) -> BatchFigures:
    """The figures of a batch, which travel to the driver."""
    return BatchFigures.of(batch.modelled, batch.slow_s, each=batch.compared)


def stored_results(scratch: Scratch, place: Place, only: Collection[str] | None = None) -> list[StoredResult]:
    """The models of a stored batch, or those of some building_ids. Only for our own scratch: pickles run code."""
    batch: Batch = result_of(scratch, place)
    wanted = batch.stored if only is None else [name for name in batch.stored if name in only]
    return [pickle.loads(batch.stored[name][1]) for name in wanted]  # noqa: S301


def packed_model(
    task: BatchTask,
    site: CandidateSite,
    result: BuildingResult,
    facts: CandidateFacts,
    seconds: float,
    made_from: str = "",
    *,
    reused: bool = False,
) -> Packed:
    """A model with its figures, on its way to scratch."""
    is_rejected = _is_rejected(task, site, result)
    own = task.own.get(site.building_id)
    facts = dataclasses.replace(
        facts,
        source_attributes=site.source_attributes,
        overridden=None if site.override is None else site.override.effects,
        settings_hash=None if own is None else own.settings_hash,
    )
    packed = pickle.dumps(
        StoredResult(result=result, facts=facts, is_rejected=is_rejected), protocol=pickle.HIGHEST_PROTOCOL
    )
    modelled = Modelled(
        building_id=result.building_id,
        owner=site.owner,
        status=REJECTED if is_rejected else result.status.value,
        reason=None if result.reason is None else result.reason.value,
        roof_type=result.roof_type.value,
        faces=len(result.faces),
        points=result.n_points,
        seconds=seconds,
        reused=reused,
        ended_s=time.time(),
        detail=result.reason_detail if result.status is Status.FAILED else "",
        # equal input makes an equal model, but its pickle may differ
        content=key_of(result.building_id, made_from or packed, facts, is_rejected),
    )
    return Packed(modelled=modelled, stored=packed, made_from=made_from)


def _is_rejected(task: BatchTask, site: CandidateSite, result: BuildingResult) -> bool:
    """Whether a candidate has too few points for a model, and neither a footprint nor a user says it is a building.

    A comparison keeps it, so that each method has a record of each candidate.
    """
    known = site.footprint is not None or site.override is not None
    return result.reason is Reason.TOO_FEW_POINTS and not known and not task.compared


def models_here(task: BatchTask, sites: Sequence[CandidateSite]) -> Iterator[tuple[int, Packed]]:
    """Models made in this process: one that runs out of memory becomes a record, one that crashes ends all."""
    task = opened(task)
    for index, site in enumerate(sites):
        task.scratch.check_cancelled()
        try:
            packed = model_site(task, site)
        except MemoryError as error:
            from pipeline.runtime.stages.lost_buildings import failed_site

            detail = f"memory ran out: {error}".removesuffix(": ")
            result = failed_site(site, task.way_of(site).method, Reason.OUT_OF_MEMORY, detail)
            packed = packed_model(task, site, result, CandidateFacts(), 0.0)
        yield index, packed


def opened(task: BatchTask) -> BatchTask:
    """The task with a scratch whose arrays stay open from building to building: neighbours share tiles."""
    return dataclasses.replace(task, scratch=OpenScratch(task.scratch.root, task.scratch.attempt))


def model_site(task: BatchTask, site: CandidateSite) -> Packed:
    """One candidate's model; a fault of the candidate becomes its record.

    Raises
    ------
    MemoryError
        Memory ran out; alone in a fresh process the candidate may succeed.
    OSError, GableworkError
        Scratch cannot be read, or the settings are wrong: a fault of the run, not of the candidate.
    """
    from pipeline.recipe import reconstruct_building  # loads all methods, which the driver does not need

    task = task.way_of(site)
    if task.compared:
        # a child that used another method has not loaded this one, which would count as time of its first building
        from pipeline.runtime.stages.rehearsal import load_once

        load_once(task.method)
    started = time.perf_counter()
    candidate: Candidate | None = None
    facts = CandidateFacts()
    made_from = ""
    reused = False
    try:
        candidate, facts = gather(task.scratch, task.grid, site, task.gps_kind, task.settings.roof, task.guides)
        made_from = key_of(candidate, task.way_key, *filter(None, [site.overlap]))
        earlier = _modelled_before(task, site.building_id, made_from)
        reused = earlier is not None
        result = earlier or _with_overlap(site, reconstruct_building(candidate, task.method, task.settings))
    except (MemoryError, OSError, GableworkError):
        raise
    except Exception as error:  # noqa: BLE001 - becomes the record
        from pipeline.runtime.stages.lost_buildings import failed_site

        result = failed_site(site, task.method, Reason.INTERNAL_ERROR, f"{type(error).__name__}: {error}")
    seconds = time.perf_counter() - started
    if result.reason is Reason.INTERNAL_ERROR:
        from pipeline.runtime.isolation.replay_bundle import Incident
        from pipeline.runtime.stages.lost_buildings import quarantined

        incident = Incident(reason=result.reason.value, detail=result.reason_detail, seconds=seconds)
        bundle = None if candidate is None else task.bundle_of(candidate, incident)
        result = quarantined(task.quarantine, result, bundle)
        made_from = ""
    return packed_model(task, site, result, facts, seconds, made_from, reused=reused)


def _with_overlap(site: CandidateSite, result: BuildingResult) -> BuildingResult:
    """The result, whose reason names the footprint that has its points."""
    if result.reason is None or not site.overlap:
        return result
    return dataclasses.replace(result, reason_detail="; ".join(filter(None, [result.reason_detail, site.overlap])))


def _modelled_before(task: BatchTask, building_id: str, made_from: str) -> BuildingResult | None:
    """The model that an earlier batch made of the same input by the same settings; None where there is none."""
    for place in task.earlier:
        known, stored = _batch_of(task.scratch, place).get(building_id, ("", b""))
        if known == made_from:
            found: StoredResult = pickle.loads(stored)  # noqa: S301 - our own scratch
            return found.result
    return None


@functools.lru_cache(maxsize=8)
def _batch_of(scratch: Scratch, place: Place) -> Mapping[str, tuple[str, bytes]]:
    """The models of an earlier batch; none where it has been removed since, or is damaged."""
    try:
        batch: Batch = result_of(scratch, place)
    except RunCancelledError:
        scratch.check_cancelled()
        return {}
    except DamagedError as fault:
        LOG.warning("models of an earlier run are made again", extra={"tile": place.unit, "reason": str(fault)})
        return {}
    return batch.stored
