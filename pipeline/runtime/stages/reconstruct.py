"""Reconstruct: a task models a batch of candidates, each on its own."""

from __future__ import annotations

import dataclasses
import functools
import math
import pickle
import time
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
import shapely

from pipeline.errors import GableworkError, RunCancelledError, RunError
from pipeline.export.facts import CandidateFacts
from pipeline.io.crs import SpatialReference
from pipeline.io.gps_time import GpsTimeKind
from pipeline.methods import METHODS, ReconstructSettings
from pipeline.model import BuildingResult, Candidate, Reason, RoofType, Status
from pipeline.runtime.cluster.memory_needs import building_bytes
from pipeline.runtime.isolation.isolated_items import IsolationLimits, Loss, supervise
from pipeline.runtime.isolation.replay_bundle import Bundle, Incident, write_bundle
from pipeline.runtime.monitoring.logs import LOG
from pipeline.runtime.monitoring.tallies import TALLIES
from pipeline.runtime.overrides.overrides_file import OwnModelling
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.scratch.outcomes import Place, key_of, result_of
from pipeline.runtime.stages.gather import gather
from pipeline.runtime.stages.join import CandidateSite
from pipeline.tiling import Tile, TileGrid

_POINTS_PER_BATCH = 20_000
_MAX_PER_BATCH = 64
_BUNDLE_TIMEOUT_S = 60.0
_LOST = frozenset({Reason.CRASHED, Reason.TIMED_OUT, Reason.OUT_OF_MEMORY, Reason.INTERNAL_ERROR})
"""Reasons that lie with the processes or with gablework, not with the building's points: each is worth a look."""
_NO_BUNDLE = "there is no bundle, since its points cannot be put together"


@dataclasses.dataclass(frozen=True, kw_only=True)
class BatchTask:
    """Some candidates for one task."""

    sites: tuple[CandidateSite, ...]
    """The candidates."""
    method: str
    """Name of the method."""
    settings: ReconstructSettings
    """Its settings and those of the roof."""
    grid: TileGrid
    scratch: Scratch
    gps_kind: GpsTimeKind
    """Whether GPS times tell dates."""
    isolation: IsolationLimits | None = None
    """Limits of the supervised child; None models in this process."""
    quarantine: str = ""
    """Folder for the bundles of buildings that cost their process, or met a fault of ours; empty keeps none."""
    reference: SpatialReference = dataclasses.field(default_factory=SpatialReference)
    """Of the run, for its bundles."""
    own: Mapping[str, OwnModelling] = dataclasses.field(default_factory=dict)
    """Method and settings of the buildings that have their own, by building_id."""
    earlier: tuple[Place, ...] = ()
    """Outcomes of earlier batches of these candidates' tile: what is modelled there from the same input is taken."""
    compared: bool = False
    """Whether seconds are held against those of other methods: a method is then loaded before the clock starts."""

    @property
    def memory_bytes(self) -> int:
        """What the process that models them may come to take: they come one after the other."""
        limit_bytes = None if self.isolation is None else self.isolation.memory_bytes
        return building_bytes(max((site.points for site in self.sites), default=0), limit_bytes)

    @property
    def supervises(self) -> bool:
        """Whether buildings are modelled in children of the process that has the task."""
        return self.isolation is not None

    def way_of(self, site: CandidateSite) -> BatchTask:
        """The task with the method and the settings of one site."""
        own = self.own.get(site.building_id)
        return self if own is None else dataclasses.replace(self, method=own.method, settings=own.settings)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Modelled:
    """What the driver learns of one building; the model itself stays in scratch."""

    building_id: str
    owner: Tile
    status: str
    reason: str | None
    roof_type: str
    faces: int
    points: int
    seconds: float
    reused: bool = False
    """Whether the model is that of an earlier batch, of the same input."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StoredResult:
    """A model in scratch, waiting to be published."""

    result: BuildingResult
    facts: CandidateFacts


@dataclasses.dataclass(frozen=True, kw_only=True)
class Batch:
    """The models of a batch."""

    told: tuple[Modelled, ...]
    """What the driver learns, in the order of the task's candidates."""
    stored: Mapping[str, tuple[str, bytes]]
    """By building_id: the digest of all that the model was made from, empty where that is not to be trusted again; and
    a pickled `StoredResult`."""


def told_of_batch(batch: Batch) -> tuple[Modelled, ...]:
    """What the driver learns of a batch."""
    return batch.told


def batches(sites: Sequence[CandidateSite]) -> list[tuple[CandidateSite, ...]]:
    """Group the candidates of a tile, which come largest first, to tasks of some seconds each.

    >>> from pipeline.runtime.stages.join import CandidateSite
    >>> site = lambda n: CandidateSite(building_id=str(n), owner=Tile(0, 0), ranges=(), points=n)
    >>> [len(b) for b in batches([site(30_000), site(14_000), site(5_000), site(4_000), site(10)])]
    [1, 2, 2]
    """
    groups: list[tuple[CandidateSite, ...]] = []
    current: list[CandidateSite] = []
    points = 0
    for site in sites:
        if current and (points + site.points > _POINTS_PER_BATCH or len(current) == _MAX_PER_BATCH):
            groups.append(tuple(current))
            current, points = [], 0
        current.append(site)
        points += site.points
    if current:
        groups.append(tuple(current))
    return groups


def model_batch(task: BatchTask) -> Batch:
    """Model a batch.

    Raises
    ------
    RunCancelledError
        The run was called off.
    OSError
        Scratch cannot be read or written.
    RunError
        Child processes cannot be started.
    """
    models = _here(task) if task.isolation is None else _in_child(task, task.isolation)
    try:
        packed = dict(models)
    except OSError:
        task.scratch.check_cancelled()  # a run that is over has no scratch any more
        raise
    each = [packed[index] for index in range(len(task.sites))]
    for model in each:
        building = model.told
        TALLIES.building(building.status, building.reason)
        if building.reason in _LOST:
            facts = {"building": building.building_id, "tile": building.owner.key, "reason": building.reason}
            LOG.warning("a building is lost", extra={**facts, "seconds": round(building.seconds, 3)})
    return Batch(
        told=tuple(model.told for model in each),
        stored={model.told.building_id: (model.made_from, model.stored) for model in each},
    )


def stored_results(scratch: Scratch, place: Place) -> list[StoredResult]:
    """What a batch modelled. Of this run's own scratch only: pickles run code."""
    batch: Batch = result_of(scratch, place)
    return [pickle.loads(stored) for _, stored in batch.stored.values()]  # noqa: S301


@dataclasses.dataclass(frozen=True)
class Packed:
    """A model on its way to scratch: pickled once, where it was made, and never opened on the way."""

    told: Modelled
    stored: bytes
    """A pickled `StoredResult`."""
    made_from: str = ""
    """Digest of candidate, method and settings; empty where the model is not to be taken again."""


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
    told = Modelled(
        building_id=result.building_id,
        owner=site.owner,
        status=result.status.value,
        reason=None if result.reason is None else result.reason.value,
        roof_type=result.roof_type.value,
        faces=len(result.faces),
        points=result.n_points,
        seconds=seconds,
        reused=reused,
    )
    own = task.own.get(site.building_id)
    facts = dataclasses.replace(
        facts,
        source_attributes=site.source_attributes,
        overridden=None if site.override is None else site.override.effects,
        settings_hash=None if own is None else own.settings_hash,
    )
    stored = StoredResult(result=result, facts=facts)
    packed = pickle.dumps(stored, protocol=pickle.HIGHEST_PROTOCOL)
    return Packed(told=told, stored=packed, made_from=made_from)


def _here(task: BatchTask) -> Iterator[tuple[int, Packed]]:
    """Models made in this process: one that runs out of memory has a record, one that crashes takes all along."""
    for index, site in enumerate(task.sites):
        task.scratch.check_cancelled()
        try:
            packed = model_site(task, site)
        except MemoryError as error:
            detail = f"memory ran out: {error}".removesuffix(": ")
            result = failed_site(site, task.way_of(site).method, Reason.OUT_OF_MEMORY, detail)
            packed = _packed(task, site, result, CandidateFacts(), 0.0)
        yield index, packed


def _in_child(task: BatchTask, limits: IsolationLimits) -> Iterator[tuple[int, Packed]]:
    """Models made in a supervised child process: each building can cost only itself."""
    common = dataclasses.replace(task, sites=())
    cancelled = functools.partial(_cancelled, task)
    work = functools.partial(model_site, common)
    for index, model in supervise(work, task.sites, limits, cancelled, loads=_loads(task)):
        if isinstance(model, Loss):
            yield index, _lost(common, task.sites[index], model, limits, cancelled)
        else:
            yield index, model


def _loads(task: BatchTask) -> tuple[str, ...]:
    """What a child calls that is to work on the task: of its methods only, since each costs a tenth of a second."""
    methods = dict.fromkeys((task.method, *(own.method for own in task.own.values())))
    return tuple(f"{__name__}:load_once:{method}" for method in methods)


def _cancelled(task: BatchTask) -> bool:
    return task.scratch.cancelled


def model_site(task: BatchTask, site: CandidateSite) -> Packed:
    """One candidate's model; a fault of its own becomes its record.

    Raises
    ------
    MemoryError
        As it came: alone in a fresh process it may be modelled.
    OSError, GableworkError
        Scratch cannot be read, the settings are none: that is the run's fault, not the candidate's.
    """
    from pipeline.reconstruct import reconstruct_building  # with all methods, which who hands out tasks does without

    task = task.way_of(site)
    if task.compared:
        # a child that has modelled by another method has not loaded this one: its first building would be charged
        load_once(task.method)
    started = time.perf_counter()
    candidate: Candidate | None = None
    facts = CandidateFacts()
    made_from = ""
    reused = False
    try:
        candidate, facts = gather(task.scratch, task.grid, site, task.gps_kind, beside=task.settings.roof.at_walls)
        made_from = key_of(candidate, task.method, _settings_key(task.settings))
        earlier = _modelled_before(task, site.building_id, made_from)
        reused = earlier is not None
        result = earlier or reconstruct_building(candidate, task.method, task.settings)
    except (MemoryError, OSError, GableworkError):
        raise
    except Exception as error:  # noqa: BLE001 - told in the record
        result = failed_site(site, task.method, Reason.INTERNAL_ERROR, f"{type(error).__name__}: {error}")
    seconds = time.perf_counter() - started
    if result.reason is Reason.INTERNAL_ERROR:
        incident = Incident(reason=result.reason.value, detail=result.reason_detail, seconds=seconds)
        result = _kept(task, candidate, result, incident)
        made_from = ""
    return _packed(task, site, result, facts, seconds, made_from, reused=reused)


@functools.lru_cache(maxsize=8)
def _settings_key(settings: ReconstructSettings) -> str:
    """Digest of settings, which most buildings of a batch share: they have more values than a small building has."""
    return key_of(settings)


def _modelled_before(task: BatchTask, building_id: str, made_from: str) -> BuildingResult | None:
    """The model of the same input by the same settings, where an earlier batch made it."""
    for place in task.earlier:
        known, stored = _batch_of(task.scratch, place).get(building_id, ("", b""))
        if known == made_from:
            found: StoredResult = pickle.loads(stored)  # noqa: S301 - of our own scratch
            return found.result
    return None


@functools.lru_cache(maxsize=8)
def _batch_of(scratch: Scratch, place: Place) -> Mapping[str, tuple[str, bytes]]:
    """The models of an earlier batch; nothing where it is gone meanwhile."""
    try:
        batch: Batch = result_of(scratch, place)
    except RunCancelledError:
        scratch.check_cancelled()
        return {}
    return batch.stored


def _lost(
    task: BatchTask, site: CandidateSite, loss: Loss, limits: IsolationLimits, cancelled: Callable[[], bool]
) -> Packed:
    """The record and the bundle of a building that cost its process; made in a child, too."""
    patient = dataclasses.replace(limits, timeout_s=max(limits.timeout_s, _BUNDLE_TIMEOUT_S))
    describe = functools.partial(lost_site, task, loss)
    ((_, described),) = supervise(describe, [site], patient, cancelled, second_chance=False, loads=_loads(task))
    if not isinstance(described, Loss):
        return described
    detail = f"{loss.detail}; {_NO_BUNDLE}: {described.detail}"
    result = failed_site(site, task.way_of(site).method, loss.reason, detail)
    return _packed(task, site, result, CandidateFacts(), loss.seconds)


def lost_site(task: BatchTask, loss: Loss, site: CandidateSite) -> Packed:
    """The record of a building that cost its process, and its bundle in the quarantine.

    Raises
    ------
    MemoryError, OSError
        Its points cannot be put together.
    """
    from pipeline.reconstruct import failed_building  # as above

    task = task.way_of(site)
    candidate, facts = gather(task.scratch, task.grid, site, task.gps_kind, beside=task.settings.roof.at_walls)
    result = failed_building(candidate, task.method, loss.reason, loss.detail)
    incident = Incident(
        reason=loss.reason.value,
        detail=loss.detail,
        seconds=loss.seconds,
        memory_bytes=loss.memory_bytes,
        stderr=loss.stderr,
    )
    return _packed(task, site, _kept(task, candidate, result, incident), facts, loss.seconds)


def _kept(task: BatchTask, candidate: Candidate | None, result: BuildingResult, incident: Incident) -> BuildingResult:
    """The result, its building's bundle written; the record says where that failed."""
    if not task.quarantine:
        return result
    if candidate is None:
        return dataclasses.replace(result, reason_detail=f"{result.reason_detail}; {_NO_BUNDLE}")
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
        told = (error.strerror if isinstance(error, OSError) else None) or error
        detail = f"{result.reason_detail}; there is no bundle: {told}"
        return dataclasses.replace(result, reason_detail=detail)
    return result


def failed_site(site: CandidateSite, method: str, reason: Reason, detail: str) -> BuildingResult:
    """The record of a candidate that could not even be put together."""
    return BuildingResult(
        building_id=site.building_id,
        origin=(0.0, 0.0, 0.0),
        source_id=site.source_id,
        status=Status.FAILED,
        reason=reason,
        reason_detail=detail,
        method=method,
        roof_type=RoofType.NONE,
        lod="",
        footprint=site.footprint,
        planes=(),
        faces=(),
        solids=(),
        validity_codes=(),
        ground_z_m=math.nan,
        n_points=site.points,
        density_per_m2=math.nan,
        rmse_m=math.nan,
        p95_m=math.nan,
        coverage=0.0,
        touches_data_edge=False,
    )


def model_bundle(bundle: Bundle) -> BuildingResult:
    """The building of a bundle, modelled again.

    Raises
    ------
    MemoryError
        As it came.
    """
    from pipeline.reconstruct import reconstruct_building  # as above

    return reconstruct_building(bundle.candidate, bundle.method, bundle.settings)


@functools.cache
def load_once(method: str) -> None:
    """Load what modelling by one method needs, where this process has not done so yet."""
    load(method)


def load(*methods: str) -> None:
    """Load all that modelling needs, by modelling roofs of many and of few points: libraries, and compiled kernels.

    Parameters
    ----------
    *methods : str
        Their names; without any, all methods.
    """
    from pipeline.reconstruct import reconstruct_building  # as above

    lattice = np.arange(-4.5, 15.0)
    east, north = (axis.ravel() for axis in np.meshgrid(lattice, lattice, indexing="ij"))
    outline = shapely.box(0.0, 0.0, 16.0, 10.0)  # partly without points, which is looked at in given outlines
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
