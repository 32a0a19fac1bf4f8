"""Party walls of a finished run, tile by tile. The run directory is read and never changed."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import shapely

from pipeline.errors import SettingsError
from pipeline.export.result_file import SUFFIX, ResultFile
from pipeline.export.solid_geometry import SURFACES
from pipeline.export.stored_coordinates import decimals
from pipeline.extras.party_walls.contacts import ROUNDED_M, Contacts, Walls, contacts, wall_areas
from pipeline.extras.party_walls.party_wall_settings import PartyWallSettings
from pipeline.extras.party_walls.party_wall_tables import TABLES
from pipeline.extras.publish.finished_run import FinishedRun, Published, file_outside, new_file
from pipeline.model import BoolArray, FaceKind
from pipeline.runtime.manifest import RunManifest
from pipeline.runtime.monitoring.progress import Event, Listener, ignore
from pipeline.runtime.run_tiles import TILES_IN_MEMORY, RunTiles

_TABLE = "buildings"
_COLUMNS = ("building_id", "geometry", "solid", "solid_parts", "solid_surfaces")
_WALL = SURFACES[FaceKind.WALL]


def party_walls(  # each is an option of the command
    run_dir: str,
    out: str,
    *,
    buildings: str | None = None,
    settings: PartyWallSettings | None = None,
    overwrite: bool = False,
    on_event: Listener = ignore,
) -> Published:
    """Write which walls of which buildings of a finished run touch, as GeoParquet.

    The other parameters and errors are as in `publishing.Form`.

    Parameters
    ----------
    buildings : str, optional
        The file of the wall areas of each building; `out` is that of the pairs of walls.
    settings : PartyWallSettings, optional
        When two walls touch.
    """
    settings = settings or PartyWallSettings()
    targets = [file_outside(run_dir, name, SUFFIX, overwrite) for name in (out, buildings) if name is not None]
    if len(set(targets)) < len(targets):
        raise SettingsError([f"--out and --buildings are both {targets[0]}: give two files"])
    finished = FinishedRun.at(run_dir, {_TABLE})
    run = _Run(run_dir, finished.manifest)
    facts = {**finished.facts, **dataclasses.asdict(settings)}
    with contextlib.ExitStack() as stack:
        places = [stack.enter_context(new_file(target, overwrite)) for target in targets]
        files = [
            stack.enter_context(ResultFile(table, place, run.reference.projjson, facts))
            for table, place in zip(TABLES, places, strict=False)
        ]
        for done, tile in enumerate(run.tiles, start=1):
            _write_tile(files, run, tile, settings)
            on_event(Event(kind="progress", stage="party walls", done=done, total=len(run.tiles)))
        finished.check({})
    rows = dict(zip(("party_walls", "buildings"), (file.rows for file in files), strict=False))
    size = sum(target.stat().st_size for target in targets)
    return Published(place=", ".join(map(str, targets)), size_bytes=size, rows=rows)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Tile:
    """The buildings of a tile that have a model."""

    ids: Any
    """(n,) their ids."""
    footprints: Any
    """(n,) their footprints as WKB, as they are stored."""
    walls: Walls
    """Their walls, in metres."""


class _Run(RunTiles):
    """The walls of a run by tile; a bounded number of tiles is in memory."""

    def __init__(self, run_dir: str, manifest: RunManifest) -> None:
        super().__init__(run_dir, manifest, _TABLE)
        self.tile: Callable[[str], _Tile]
        self.tile = functools.lru_cache(TILES_IN_MEMORY)(self._tile)

    def _tile(self, tile: str) -> _Tile:
        rows = [row for batch in self.batches(_COLUMNS, tile) for row in batch.to_pylist() if row["solid"] is not None]
        faces, row = shapely.get_parts(shapely.from_wkb(_objects([one["solid"] for one in rows])), return_index=True)
        is_wall = _joined([[kind == _WALL for kind in one["solid_surfaces"]] for one in rows], bool)
        ids = np.array([one["building_id"] for one in rows], dtype=str)
        number = np.arange(len(faces)) - np.searchsorted(row, row)
        unit = self.unit_m
        return _Tile(
            ids=ids,
            footprints=[one["geometry"] for one in rows],
            walls=Walls(
                polygons=shapely.transform(faces[is_wall], lambda xyz: xyz * unit, include_z=True),
                building=ids[row[is_wall]] if rows else np.zeros(0, "U1"),
                part=_joined([one["solid_parts"] for one in rows], int)[is_wall],
                face=number[is_wall],
            ),
        )


def _objects(values: list[Any]) -> Any:
    """Values as an array of objects, also without any."""
    return np.array([*values, None], dtype=object)[:-1]


def _joined(lists: list[list[Any]], kind: type) -> Any:
    """Lists as one array."""
    return np.array([value for one in lists for value in one], dtype=kind)


def _write_tile(files: list[ResultFile], run: _Run, tile: str, settings: PartyWallSettings) -> None:
    """Add the rows of a tile to the files: the pairs, and the buildings if they are wanted."""
    own = run.tile(tile)
    if not len(own.ids):
        return
    walls = own.walls
    for other in run.near(tile, settings.max_distance_m + 2.0 * ROUNDED_M):
        if other != tile:
            walls = walls.with_others(run.tile(other).walls)
    is_own = np.arange(len(walls)) < len(own.walls)
    found = contacts(walls, is_own, settings)
    _write_pairs(files[0], run, tile, walls, found, is_own)
    for file in files[1:]:
        _write_buildings(file, tile, own, walls, found)


def _write_pairs(file: ResultFile, run: _Run, tile: str, walls: Walls, found: Contacts, is_own: BoolArray) -> None:
    """Add the pairs of different buildings of which the first is of the tile: so each pair is written once."""
    a, b = walls.building[found.first], walls.building[found.second]
    kept = np.flatnonzero(is_own[found.first] & (a != b))
    if not len(kept):
        return
    unit = run.unit_m
    digits = [decimals(metres) for metres in unit.tolist()]

    def stored(xyz: Any) -> Any:
        return np.column_stack([np.round(xyz[:, axis] / unit[axis], digits[axis]) for axis in range(3)])

    shapes = shapely.transform(found.polygons[kept], stored, include_z=True)
    columns = {
        "tile": [tile] * len(kept),
        "building_a": a[kept].tolist(),
        "face_a": walls.face[found.first[kept]],
        "building_b": b[kept].tolist(),
        "face_b": walls.face[found.second[kept]],
        "geometry": shapely.to_wkb(shapes, flavor="iso").tolist(),
        "area_m2": np.round(found.area_m2[kept], 3),
        "distance_m": np.round(found.distance_m[kept], 3) + 0.0,
        "angle_deg": np.round(found.angle_deg[kept], 2),
    }
    file.write(columns, shapes)


def _write_buildings(file: ResultFile, tile: str, own: _Tile, walls: Walls, found: Contacts) -> None:
    """Add the wall areas of the buildings of a tile."""
    areas = wall_areas(walls, found)
    order = np.argsort(own.ids)
    ids = own.ids[order]
    n_own = len(own.walls)
    at = np.searchsorted(ids, own.walls.building)
    whole, shared, inner = (
        np.bincount(at, values[:n_own], len(ids)) for values in (areas.whole_m2, areas.shared_m2, areas.inner_m2)
    )
    a, b = walls.building[found.first], walls.building[found.second]
    pairs = {*zip(a.tolist(), b.tolist(), strict=True), *zip(b.tolist(), a.tolist(), strict=True)}
    neighbours = np.zeros(len(ids), np.int64)
    for number, name in ((int(np.searchsorted(ids, one)), one) for one, other in pairs if one != other):
        if number < len(ids) and ids[number] == name:
            neighbours[number] += 1
    footprints = [own.footprints[k] for k in order.tolist()]
    columns = {
        "tile": [tile] * len(ids),
        "building_id": ids.tolist(),
        "geometry": footprints,
        "wall_area_m2": np.round(whole, 3),
        "shared_wall_area_m2": np.round(shared, 3),
        "inner_wall_area_m2": np.round(inner, 3),
        "exposed_wall_area_m2": np.round(np.maximum(whole - shared - inner, 0.0), 3) + 0.0,
        "neighbours": neighbours,
    }
    file.write(columns, shapely.from_wkb(_objects(footprints)))
