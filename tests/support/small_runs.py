"""Finished runs of small buildings, written as a run writes them."""

import dataclasses
import datetime as dt
import hashlib
import json
import shutil
from pathlib import Path
from typing import Any

import pyproj
import small_buildings as small

from pipeline.export.record_rows import RecordContext, RejectedObject
from pipeline.export.tile import write_tile
from pipeline.io import storage_at
from pipeline.io.crs import SpatialReference
from pipeline.model import BuildingResult, Reason, Status
from pipeline.runtime.manifest import RunManifest, RunStatus, write_manifest
from pipeline.runtime.manifest_reading import read_manifest


def moved(result: BuildingResult, east: float, north: float = 0.0) -> BuildingResult:
    """A building elsewhere, by whole metres."""
    x, y, z = result.origin
    return dataclasses.replace(result, origin=(x + east, y + north, z))


TREE = RejectedObject(
    object_id="tree",
    origin=small.ORIGIN,
    reason=Reason.VEGETATION,
    reason_detail="planarity 0.1, at least 0.6",
    outline=small.Polygon([(44, 30), (50, 30), (47, 36)]),
    area_m2=18.0,
    height_m=6.0,
    n_points=50,
)


def street() -> list[BuildingResult]:
    """A fallback, two models, and a failed candidate that has an outline."""
    failed = dataclasses.replace(
        small.failed(), footprint=small.Polygon([(0, 0), (8, 0), (8, 8), (0, 8)]), status=Status.FAILED
    )
    return [moved(small.gable(), 0, 40), small.courtyard(), moved(small.two_parts(), 60, 0), moved(failed, 60, 40)]


def write_run(folder: Path, results: list[BuildingResult], unit_m: float = 1.0) -> Path:
    """Write a run of the given buildings on two tiles, in metres or in feet, with one rejected tree."""
    reference = small.Reference(horizontal_unit_m=unit_m, vertical_unit_m=unit_m)
    context = RecordContext(reference=reference, settings_hash="ab", engine_version="0")
    write_tile(folder, "t1", results[:2], [TREE] if results else [], context)
    write_tile(folder, "t2", results[2:], [], context)
    manifest = RunManifest(
        status=RunStatus.FINISHED,
        engine_version="0",
        method="fuzzy-sart",
        settings={},
        settings_hash="ab",
        started_at=dt.datetime(2026, 1, 1, tzinfo=dt.UTC),
        crs={"horizontal_unit_m": unit_m, "vertical_unit_m": unit_m},
    )
    write_manifest(folder, manifest)
    return folder


def write_whole_run(folder: Path) -> Path:
    """A finished run of the street, whose states list its files."""
    write_run(folder, street())
    for tile in ("t1", "t2"):
        paths = sorted(folder.rglob(f"tile={tile}/*"))
        files = {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}
        state = {"tile": tile, "state": "done", "error": "", "files": files}
        storage_at(folder).put(f"state/{tile}.json", json.dumps(state).encode())
    return folder


def content(folder: Path) -> dict[str, bytes]:
    """All files below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def restated(run_dir: Path, **changes: Any) -> None:
    """Change the manifest of a run."""
    write_manifest(run_dir, dataclasses.replace(read_manifest(run_dir), **changes))


def reference_of(epsg: int, **units: float) -> SpatialReference:
    """A CRS by its code."""
    return SpatialReference(wkt=pyproj.CRS.from_epsg(epsg).to_wkt(), name=str(epsg), epsg=epsg, **units)


def tiled_run(folder: Path, tiles: dict[str, list[BuildingResult]], contexts: small.Contexts) -> Path:
    """A finished run near Delft with these buildings on these tiles."""
    write_run(folder, [])
    for table in ("buildings", "planes", "rejected", "decisions", "cityjson"):
        shutil.rmtree(folder / table, ignore_errors=True)
    for key, results in tiles.items():
        write_tile(folder, key, results, [], contexts["compound"])
        files = {str(path.relative_to(folder)): "0" for path in folder.rglob(f"tile={key}/*")}
        storage_at(folder).put(f"state/{key}.json", json.dumps({"tile": key, "state": "done", "files": files}).encode())
    facts = dataclasses.asdict(reference_of(7415))
    facts.pop("vertical_unit_assumed")
    count = sum(map(len, tiles.values()))
    changed = dataclasses.replace(read_manifest(folder), crs=facts, counts={"candidates": count})
    write_manifest(folder, changed)
    return folder
