"""Modelling of a batch: a task models some candidates, each on its own."""

from __future__ import annotations

import dataclasses
import functools
import math
import pickle
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely

from pipeline.errors import GableworkError, RunCancelledError, RunError
from pipeline.export.facts import CandidateFacts
from pipeline.io.crs import SpatialReference
from pipeline.io.gps_time import GpsTimeKind
from pipeline.methods import METHODS, ReconstructSettings
from pipeline.model import BuildingResult, Candidate, Guide, Reason, Status
from pipeline.runtime.isolation.limits import BUNDLE_SUFFIX, IsolationLimits, Loss
from pipeline.runtime.monitoring.logs import LOG
from pipeline.runtime.monitoring.tallies import TALLIES
from pipeline.runtime.scratch.folder import OpenScratch, Scratch
from pipeline.runtime.scratch.outcomes import DamagedError, Place, key_of, result_of
from pipeline.runtime.stages.batch_figures import LOST, REJECTED, BatchFigures, Modelled
from pipeline.runtime.stages.gather import gather
from pipeline.runtime.stages.sites import CandidateSite, StoredGroup
from pipeline.tiling import TileGrid

if TYPE_CHECKING:
    from pipeline.extras.overrides.overrides_file import OwnModelling
    from pipeline.runtime.isolation.replay_bundle import Bundle, Incident

_BUNDLE_TIMEOUT_S = 60.0
_NO_BUNDLE = "there is no bundle, since its points cannot be put together"


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


def model_batch(task: BatchTask) -> Batch:
    """Model a batch; raises OSError if scratch cannot be read or written, RunError if children cannot be started."""
    try:
        sites = task.group.sites(task.scratch)
        packed = dict(_here(task, sites) if task.isolation is None else _in_child(task, sites, task.isolation))
    except OSError:
        task.scratch.check_cancelled()  # the scratch of a run that is over is gone
        raise
    each = [packed[index] for index in range(len(sites))]
    for model in each:
        building = model.modelled
        TALLIES.building(building.status, building.reason)
        if building.reason in LOST:
            facts = {"building": building.building_id, "tile": building.owner.key, "reason": building.reason}
            LOG.warning("a building is lost", extra={**facts, "seconds": round(building.seconds, 3)})
    return Batch(
        modelled=tuple(model.modelled for model in each),
        stored={model.modelled.building_id: (model.made_from, model.stored) for model in each},
        compared=task.compared,
        slow_s=task.slow_s,
    )


def figures_of(batch: Batch) -> BatchFigures:
    """The figures of a batch, which travel to the driver."""
    return BatchFigures.of(batch.modelled, batch.slow_s, each=batch.compared)


def bundles_are_whole(task: BatchTask, figures: BatchFigures, _: str) -> bool:
    """Whether the bundles that a batch left in the quarantine are whole; not each loss has one."""
    from pipeline.runtime.isolation.replay_bundle import is_whole

    lost = (model.building_id for model in figures.notable if model.reason in LOST)
    bundles = [Path(task.quarantine, f"{building_id}{BUNDLE_SUFFIX}") for building_id in lost]
    return all(is_whole(bundle) for bundle in bundles if bundle.is_file())


def stored_results(scratch: Scratch, place: Place, only: Collection[str] | None = None) -> list[StoredResult]:
    """The models of a stored batch, or those of some building_ids. Only for our own scratch: pickles run code."""
    batch: Batch = result_of(scratch, place)
    wanted = batch.stored if only is None else [name for name in batch.stored if name in only]
    return [pickle.loads(batch.stored[name][1]) for name in wanted]  # noqa: S301


def _packed(
    task: BatchTask,
    site: CandidateSite,
    result: BuildingResult,
    facts: CandidateFacts,
    seconds: float,
    made_from: str = "",
    *,
    reused: bool = False,
) -> Packed:
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


def _here(task: BatchTask, sites: Sequence[CandidateSite]) -> Iterator[tuple[int, Packed]]:
    """Models made in this process: one that runs out of memory becomes a record, one that crashes ends all."""
    task = opened(task)
    for index, site in enumerate(sites):
        task.scratch.check_cancelled()
        try:
            packed = model_site(task, site)
        except MemoryError as error:
            detail = f"memory ran out: {error}".removesuffix(": ")
            result = failed_site(site, task.way_of(site).method, Reason.OUT_OF_MEMORY, detail)
            packed = _packed(task, site, result, CandidateFacts(), 0.0)
        yield index, packed


def _in_child(task: BatchTask, sites: Sequence[CandidateSite], limits: IsolationLimits) -> Iterator[tuple[int, Packed]]:
    """Models made in a supervised child process, so that a building can only harm itself."""
    from pipeline.runtime.isolation.isolated_items import supervise

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


def opened(task: BatchTask) -> BatchTask:
    """The task with a scratch whose arrays stay open from building to building: neighbours share tiles."""
    return dataclasses.replace(task, scratch=OpenScratch(task.scratch.root, task.scratch.attempt))


def _loads(task: BatchTask) -> tuple[str, ...]:
    """What a child loads before it works on the task: only its methods, since each costs a tenth of a second."""
    methods = dict.fromkeys((task.method, *(own.method for own in task.own.values())))
    return tuple(f"{__name__}:load_once:{method}" for method in methods)


def _cancelled(task: BatchTask) -> bool:
    task.scratch.check_mark()  # its error says more than a yes would; waiting for a building is not progress
    return False


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
        result = failed_site(site, task.method, Reason.INTERNAL_ERROR, f"{type(error).__name__}: {error}")
    seconds = time.perf_counter() - started
    if result.reason is Reason.INTERNAL_ERROR:
        from pipeline.runtime.isolation.replay_bundle import Incident

        incident = Incident(reason=result.reason.value, detail=result.reason_detail, seconds=seconds)
        result = _quarantined(task, candidate, result, incident)
        made_from = ""
    return _packed(task, site, result, facts, seconds, made_from, reused=reused)


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


def _lost(
    task: BatchTask, site: CandidateSite, loss: Loss, limits: IsolationLimits, cancelled: Callable[[], bool]
) -> Packed:
    """The record and the bundle of a building that ended its process; also made in a child."""
    from pipeline.runtime.isolation.isolated_items import supervise

    patient = dataclasses.replace(limits, timeout_s=max(limits.timeout_s, _BUNDLE_TIMEOUT_S))
    describe = functools.partial(lost_site, task, loss)
    ((_, described),) = supervise(describe, [site], patient, cancelled, second_chance=False, loads=_loads(task))
    if not isinstance(described, Loss):
        return described
    detail = f"{loss.detail}; {_NO_BUNDLE}: {described.detail}"
    result = failed_site(site, task.way_of(site).method, loss.reason, detail)
    return _packed(task, site, result, CandidateFacts(), loss.seconds)


def lost_site(task: BatchTask, loss: Loss, site: CandidateSite) -> Packed:
    """The record of a building that ended its process, and its bundle in the quarantine."""
    from pipeline.recipe import failed_building  # as above
    from pipeline.runtime.isolation.replay_bundle import Incident

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
    return _packed(task, site, _quarantined(task, candidate, result, incident), facts, loss.seconds)


def _quarantined(
    task: BatchTask, candidate: Candidate | None, result: BuildingResult, incident: Incident
) -> BuildingResult:
    """Write the bundle of a building; its result, which mentions a bundle that could not be written."""
    if not task.quarantine:
        return result
    if candidate is None:
        return dataclasses.replace(result, reason_detail=f"{result.reason_detail}; {_NO_BUNDLE}")
    from pipeline.runtime.isolation.replay_bundle import Bundle, write_bundle

    bundle = Bundle(
        candidate=candidate,
        method=task.method,
        settings=task.settings,
        incident=incident,
        reference=task.reference,
    )
    try:
        write_bundle(task.quarantine, bundle)
    except (OSError, RunError) as error:
        why = (error.strerror if isinstance(error, OSError) else None) or error
        detail = f"{result.reason_detail}; there is no bundle: {why}"
        return dataclasses.replace(result, reason_detail=detail)
    return result


def failed_site(site: CandidateSite, method: str, reason: Reason, detail: str) -> BuildingResult:
    """The record of a candidate whose points could not be gathered."""
    return BuildingResult(
        building_id=site.building_id,
        origin=(0.0, 0.0, 0.0),
        source_id=site.source_id,
        status=Status.FAILED,
        reason=reason,
        reason_detail=detail,
        method=method,
        footprint=site.footprint,
        ground_z_m=math.nan,
        n_points=site.points,
        density_per_m2=math.nan,
        touches_data_edge=False,
    )


def model_bundle(bundle: Bundle) -> BuildingResult:
    """The building of a bundle, modelled again; raises MemoryError where memory runs out."""
    from pipeline.recipe import reconstruct_building  # as above

    return reconstruct_building(bundle.candidate, bundle.method, bundle.settings)


@functools.cache
def load_once(method: str) -> None:
    """Load what modelling by one method needs, once per process."""
    load(method)


def load(*methods: str) -> None:
    """Load the libraries and compiled kernels for modelling, by modelling roofs of many and of few points."""
    from pipeline.recipe import reconstruct_building  # as above

    lattice = np.arange(-4.5, 15.0)
    east, north = (axis.ravel() for axis in np.meshgrid(lattice, lattice, indexing="ij"))
    outline = shapely.box(0.0, 0.0, 16.0, 10.0)  # partly without points, which only given outlines can be
    for spacing_m, slope, footprint in ((0.5, 0.6, None), (0.5, 0.0, outline), (1.0, 0.6, None)):
        places = np.arange(0.5 * spacing_m, 10.0, spacing_m)
        x, y = (axis.ravel() for axis in np.meshgrid(places, places, indexing="ij"))
        candidate = Candidate(
            building_id="",
            origin=(0.0, 0.0, 0.0),
            points=np.rint(np.column_stack((x, y, 9.0 - slope * np.abs(y - 5.0))) * 1e3) / 1e3,
            ground=np.column_stack((east, north, np.zeros(len(east)))),
            ground_z_m=0.0,
            footprint=footprint,
        )
        for method in methods or METHODS:
            reconstruct_building(candidate, method, ReconstructSettings())
