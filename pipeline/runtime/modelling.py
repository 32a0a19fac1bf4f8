"""Reconstruct: a task models a batch of candidates, each on its own."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence

from pipeline.export.records import CandidateFacts
from pipeline.io.gps_time import GpsTimeKind
from pipeline.methods import ReconstructSettings
from pipeline.model import BuildingResult, Reason, RoofType, Status
from pipeline.reconstruct import reconstruct_building
from pipeline.runtime.gather import gather
from pipeline.runtime.isolation import IsolationLimits
from pipeline.runtime.join import CandidateSite
from pipeline.runtime.scratch import Scratch
from pipeline.tiling import Tile, TileGrid

_POINTS_PER_BATCH = 20_000
_MAX_PER_BATCH = 64


@dataclasses.dataclass(frozen=True, kw_only=True)
class BatchTask:
    """Some candidates for one task."""

    number: int
    """Names the batch's files in scratch."""
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
    """Folder for the bundles of buildings that cost their process; empty keeps none."""


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


@dataclasses.dataclass(frozen=True, kw_only=True)
class StoredResult:
    """A model in scratch, waiting to be published."""

    result: BuildingResult
    facts: CandidateFacts


def batches(sites: Sequence[CandidateSite]) -> list[tuple[CandidateSite, ...]]:
    """Group candidates, which come largest first, to tasks of some seconds each.

    >>> from pipeline.runtime.join import CandidateSite
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


def _model(task: BatchTask, site: CandidateSite) -> tuple[BuildingResult, CandidateFacts]:
    """One candidate's result; a fault of its own becomes its record, and only the loss of scratch is the run's."""
    try:
        candidate, facts = gather(task.scratch, task.grid, site, task.gps_kind)
        return reconstruct_building(candidate, task.method, task.settings), facts
    except MemoryError as error:
        return failed_site(site, task.method, f"memory ran out: {error}"), CandidateFacts()
    except OSError:
        raise
    except Exception as error:  # noqa: BLE001 - told in the record
        return failed_site(site, task.method, f"{type(error).__name__}: {error}"), CandidateFacts()


def failed_site(site: CandidateSite, method: str, detail: str) -> BuildingResult:
    """The record of a candidate that could not even be put together."""
    return BuildingResult(
        building_id=site.building_id,
        origin=(0.0, 0.0, 0.0),
        source_id=site.source_id,
        status=Status.FAILED,
        reason=Reason.INTERNAL_ERROR,
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


def model_batch(task: BatchTask) -> tuple[Modelled, ...]:
    """Model a batch; the results are stored under `results/<tile>/<batch>` for their tiles to publish."""
    by_tile: dict[Tile, list[StoredResult]] = {}
    told = []
    for site in task.sites:
        started = time.perf_counter()
        result, facts = _model(task, site)
        by_tile.setdefault(site.owner, []).append(StoredResult(result=result, facts=facts))
        told.append(
            Modelled(
                building_id=result.building_id,
                owner=site.owner,
                status=result.status.value,
                reason=None if result.reason is None else result.reason.value,
                roof_type=result.roof_type.value,
                faces=len(result.faces),
                points=result.n_points,
                seconds=time.perf_counter() - started,
            )
        )
    for tile, results in by_tile.items():
        task.scratch.put_object(f"results/{tile.key}/{task.number}.pickle", results)
    return tuple(told)
