"""Publishing one tile: its tables, meshes and city objects, each file whole or not at all."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from pipeline.errors import RunError
from pipeline.export.cityjson import cityjson_lines
from pipeline.export.decisions import decision_rows, decisions_path, decisions_table
from pipeline.export.facts import RecordContext, RejectedObject
from pipeline.export.folders import Put, put_local
from pipeline.export.geoparquet import geo_table, parquet_bytes
from pipeline.export.obj import obj_text
from pipeline.export.record_rows import building_row, plane_rows, rejected_row
from pipeline.export.solid_geometry import lod_suffix, model_at
from pipeline.export.stored_coordinates import one_unit
from pipeline.model import BuildingResult
from pipeline.options import MESHES


@dataclasses.dataclass(frozen=True, kw_only=True)
class TileFiles:
    """What one tile published."""

    digests: Mapping[str, str]
    """sha256 of every file in hexadecimal, by its path relative to the run directory, in path order."""
    tables: Mapping[str, pa.Table]
    """Its tables by their names, without that of decisions."""
    n_buildings: int
    """Rows of the buildings table."""
    n_planes: int
    """Rows of the planes table."""
    n_rejected: int
    """Rows of the rejected table."""


def mesh_path(tile_key: str, building_id: str, meshes: str, lod: str | None = None) -> str | None:
    """Where a building's mesh lies in the run directory; None where none is written.

    >>> mesh_path("x85_y447", "abc", "building"), mesh_path("x85_y447", "abc", "glb", "1.2")
    ('meshes/x85_y447/abc.obj', 'meshes/x85_y447/x85_y447-lod12.glb')
    """
    if meshes == "none":
        return None
    stem = building_id if meshes == "building" else tile_key
    ending = "" if lod is None else f"-{lod_suffix(lod)}"
    return f"meshes/{tile_key}/{stem}{ending}.{'glb' if meshes == 'glb' else 'obj'}"


def building_rows(
    results: Sequence[BuildingResult], context: RecordContext, tile_key: str, meshes: str
) -> list[dict[str, Any]]:
    """The rows of the buildings of a tile."""
    return [
        building_row(
            result, context, mesh_path=mesh_path(tile_key, result.building_id, meshes) if result.solids else None
        )
        for result in results
    ]


def city_lines(
    results: Sequence[BuildingResult],
    rows: Sequence[Mapping[str, Any]],
    context: RecordContext,
    title: str,
    corner: Sequence[float] | None = None,
) -> Iterator[str]:
    """The lines of the CityJSONSeq file of buildings with their rows; elevations in the unit of the file."""
    reference = one_unit(context.reference)
    if reference is not context.reference:
        own = dataclasses.replace(context, reference=reference)
        rows = [
            {
                name: value
                for name, value in building_row(result, own, mesh_path=row.get("mesh_path")).items()
                if name in row
            }
            for result, row in zip(results, rows, strict=True)
        ]
    yield from cityjson_lines(list(zip(results, rows, strict=True)), reference, title, corner)


def mesh_files(
    tile_key: str, results: Sequence[BuildingResult], lines: Sequence[str], context: RecordContext, meshes: str
) -> Iterator[tuple[str, bytes]]:
    """The mesh files of a tile as path and content: one set with the records' models, one per coarser level of detail.

    GLB files are made of the lines of the tile's CityJSONSeq. `meshes` is one of `pipeline.options.MESHES`.
    """
    reference = one_unit(context.reference)
    units_m = reference.horizontal_unit_m, reference.vertical_unit_m
    for lod in (None, *context.further_lods):
        modelled = [result for result in results if model_at(result, lod) is not None]
        groups = [[result] for result in modelled] if meshes == "building" else [modelled] if modelled else []
        if meshes == "glb":
            from pipeline.export.glb import glb_bytes

            path = mesh_path(tile_key, "", meshes, lod)
            if path is not None and (data := glb_bytes(lines, *units_m, lod)):
                yield path, data
            continue
        for group in groups:
            path = mesh_path(tile_key, group[0].building_id, meshes, lod)
            if path is not None:
                yield path, obj_text(group, context.reference, lod).encode()


def write_tile(
    run_dir: str | Path,
    tile_key: str,
    results: Sequence[BuildingResult],
    rejected: Sequence[RejectedObject],
    context: RecordContext,
    meshes: str = "building",
    put: Put | None = None,
) -> TileFiles:
    """Publish one tile's buildings, planes, rejected objects, decisions, meshes and city objects.

    Every file is put atomically and depends on the arguments only, so a task may run twice, also at the same time.
    Tables without rows are written, too. Buildings and rejected objects come in any order.

    Parameters
    ----------
    run_dir : str or Path
        The local run directory; used only in messages if `put` is given.
    tile_key : str
        The hive key, such as x85_y447; never a bare integer, which readers would take for a number.
    meshes : str
        One of `pipeline.options.MESHES`.
    put : callable, optional
        Stores a file elsewhere, such as in an object store; `put_local(run_dir)` by default.

    Raises
    ------
    RunError
        A file cannot be written, the key is a bare integer, `meshes` is unknown, or an id comes twice.
    """
    if meshes not in MESHES:
        raise RunError(f"meshes is {meshes!r}: use one of {', '.join(MESHES)}")
    if not tile_key or tile_key.lstrip("+-").isdigit() or set(tile_key) & set("/\\= "):
        raise RunError(f"tile key {tile_key!r} cannot be a folder's hive key: use a form such as x85_y447")
    results = sorted(results, key=lambda result: result.building_id)
    _check_unique([result.building_id for result in results], tile_key)
    _check_unique([entry.object_id for entry in rejected], tile_key)
    store = put or put_local(run_dir)
    digests: dict[str, str] = {}
    tables: dict[str, pa.Table] = {}
    for path, data in _tile_files(tile_key, results, rejected, context, meshes, tables):
        store(path, data)
        digests[path] = hashlib.sha256(data).hexdigest()
    return TileFiles(
        digests=dict(sorted(digests.items())),
        tables=tables,
        n_buildings=len(results),
        n_planes=sum(len(result.planes) for result in results),
        n_rejected=len(rejected),
    )


def _check_unique(ids: Sequence[str], tile_key: str) -> None:
    """Refuse a tile that holds one object twice."""
    twice = sorted({name for name in ids if ids.count(name) > 1}) if len(set(ids)) < len(ids) else []
    if twice:
        raise RunError(f"tile {tile_key} holds {twice[0]} more than once: an object has one owner and one record")


def _tile_files(
    tile_key: str,
    results: Sequence[BuildingResult],
    rejected: Sequence[RejectedObject],
    context: RecordContext,
    meshes: str,
    written: dict[str, pa.Table],
) -> Iterator[tuple[str, bytes]]:
    """The tile's files as path and content, and in `written` its tables.

    Meshes come first, so that no row names a mesh that is not there yet.
    """
    reference = context.reference
    rows = building_rows(results, context, tile_key, meshes)
    lines = list(city_lines(results, rows, context, f"buildings of tile {tile_key}"))
    yield from mesh_files(tile_key, results, lines, context, meshes)
    yield f"cityjson/tile={tile_key}/part-0.city.jsonl", "".join(f"{line}\n" for line in lines).encode()
    decisions = decisions_table(row for result in results for row in decision_rows(result))
    yield decisions_path(tile_key), parquet_bytes(decisions)
    tables = {
        "planes": [row for result in results for row in plane_rows(result, context)],
        "rejected": [rejected_row(entry, context) for entry in rejected],
        "buildings": rows,
    }
    projjson = reference.projjson
    for name, table_rows in tables.items():
        written[name] = table = geo_table(name, table_rows, projjson)
        yield f"{name}/tile={tile_key}/part-0.parquet", parquet_bytes(table)
