"""Finished runs of small buildings, written as a run writes them."""

import dataclasses
import datetime as dt
from pathlib import Path

import small_buildings as small

from pipeline.export.records import RecordContext, RejectedObject
from pipeline.export.tile import write_tile
from pipeline.model import BuildingResult, Reason, Status
from pipeline.runtime.manifest import RunManifest, RunStatus, write_manifest


def moved(result: BuildingResult, east: float, north: float = 0.0) -> BuildingResult:
    """A building elsewhere, by whole metres."""
    x, y, z = result.origin
    return dataclasses.replace(result, origin=(x + east, y + north, z))


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
    tree = RejectedObject(
        object_id="tree",
        origin=small.ORIGIN,
        reason=Reason.VEGETATION,
        reason_detail="planarity 0.1, at least 0.6",
        outline=small.Polygon([(44, 30), (50, 30), (47, 36)]),
        area_m2=18.0,
        height_m=6.0,
        n_points=50,
    )
    write_tile(folder, "t1", results[:2], [tree] if results else [], context)
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
