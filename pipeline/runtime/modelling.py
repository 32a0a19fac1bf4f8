"""Reconstruct: a task models a batch of candidates, each on its own."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence

from shapely import MultiPolygon, Polygon

from pipeline.export.records import CandidateFacts
from pipeline.io.gps_time import GpsTimeKind
from pipeline.methods import ReconstructSettings
from pipeline.model import BuildingResult
from pipeline.reconstruct import reconstruct_building
from pipeline.runtime.gather import gather
from pipeline.runtime.join import CandidateSite
from pipeline.runtime.scratch import Scratch
from pipeline.tiling import Tile, TileGrid

_POINTS_PER_BATCH = 20_000
_MAX_PER_BATCH = 64


@dataclasses.dataclass(frozen=True, kw_only=True)
class Footprints:
    """Given footprints as the workers need them."""

    polygons: tuple[Polygon | MultiPolygon, ...]
    """In metres of the CRS."""
    ids: tuple[str, ...]
    """Their own ids."""


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
    footprints: str | None
    """Name of the stored footprints' `Footprints`; None where none were given."""
    gps_kind: GpsTimeKind
    """Whether GPS times tell dates."""


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


def model_batch(task: BatchTask) -> tuple[Modelled, ...]:
    """Model a batch; the results are stored under `results/<tile>/<batch>` for their tiles to publish."""
    footprints: Footprints | None = None
    if task.footprints is not None:
        footprints = task.scratch.get_object(task.footprints)
    by_tile: dict[Tile, list[StoredResult]] = {}
    told = []
    for site in task.sites:
        started = time.perf_counter()
        candidate, facts = gather(
            task.scratch,
            task.grid,
            site,
            None if footprints is None else footprints.polygons,
            None if footprints is None else footprints.ids,
            task.gps_kind,
        )
        result = reconstruct_building(candidate, task.method, task.settings)
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
