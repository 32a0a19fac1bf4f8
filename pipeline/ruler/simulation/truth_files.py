"""The truth of a simulated data set on disk: exact models, conditions, labels and the manifest `scene.json`."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

import pipeline
from pipeline.export.facts import RecordContext
from pipeline.export.tile import write_tile
from pipeline.ruler.simulation.seeds import split_of
from pipeline.ruler.simulation.simulated_scene import Building, Scene
from pipeline.ruler.simulation.solids import truth_record
from pipeline.ruler.simulation.strips import ScannerSettings, reached, strip_shifts_m
from pipeline.ruler.simulation.survey_files import TileFiles, spatial_reference

CONDITIONS = pa.schema(
    [
        pa.field("building_id", pa.string(), nullable=False),
        pa.field("shape", pa.string(), nullable=False),
        pa.field("roof_type", pa.string(), nullable=False),
        pa.field("good", pa.bool_(), nullable=False),
        pa.field("defects", pa.list_(pa.string()), nullable=False),
        pa.field("groups", pa.list_(pa.int32()), nullable=False),
        pa.field("pitch_deg", pa.float64(), nullable=False),
        pa.field("terrain_slope_deg", pa.float64(), nullable=False),
        pa.field("touches_data_edge", pa.bool_(), nullable=False),
    ]
)
"""One row per building. `groups` has the group number of the face of each plane_id."""


def write_models(
    buildings: Sequence[Building],
    scene: Scene,
    settings: ScannerSettings,
    truth: Path,
    part: str,
) -> list[dict[str, Any]]:
    """Write the exact models of buildings as one part of a run directory; returns their rows for `write_conditions`."""
    context = RecordContext(
        reference=spatial_reference(scene), settings_hash="truth", engine_version=pipeline.__version__
    )
    cut = _cut_by_the_end_of_the_data(buildings, scene, settings)
    records = [
        truth_record(building, scene.origin, touches_data_edge=at_edge)
        for building, at_edge in zip(buildings, cut, strict=True)
    ]
    write_tile(truth, part, records, [], context, meshes="tile")
    return [
        {
            "building_id": building.building_id,
            "shape": building.shape.value,
            "roof_type": building.roof_type.value,
            "good": building.is_good,
            "defects": [str(defect) for defect in building.defects],
            "groups": list(building.groups),
            "pitch_deg": building.dimensions.pitch_deg,
            "terrain_slope_deg": round(scene.terrain.slope_deg(building.x, building.y), 3),
            "touches_data_edge": at_edge,
        }
        for building, at_edge in zip(buildings, cut, strict=True)
    ]


def write_conditions(rows: Iterable[dict[str, Any]], path: Path) -> None:
    """Write the table, sorted by building_id; it appears under its name only when complete."""
    table = pa.Table.from_pylist(sorted(rows, key=lambda row: str(row["building_id"])), schema=CONDITIONS)
    part = path.with_name(f".{path.name}")
    pq.write_table(table, part, compression="zstd")
    part.replace(path)


def _cut_by_the_end_of_the_data(buildings: Sequence[Building], scene: Scene, settings: ScannerSettings) -> list[bool]:
    """Which buildings reach out of the extent, or out of the strips of a survey of tiles."""
    data = shapely.box(*(scene.survey_extent or scene.extent))
    cut = [not data.contains(building.footprint) for building in buildings]
    if scene.survey_extent is None or not buildings:
        return cut
    ends = np.cumsum([len(building.vertices) for building in buildings])[:-1]
    seen = np.split(reached(np.concatenate([building.vertices for building in buildings]), scene, settings), ends)
    return [outside or not bool(flags.all()) for outside, flags in zip(cut, seen, strict=True)]


def write_manifest(
    scene: Scene,
    settings: ScannerSettings,
    seed: int,
    tiles: Iterable[TileFiles],
    truth: Path,
    **counts: int,
) -> None:
    """Write scene.json: the scene, its survey, and its tiles in their order.

    `scene` may be any part of a city. `counts` are the numbers of strips, buildings, trees and cars.
    """
    x, y, _ = scene.origin
    whole = scene.survey_extent or scene.extent
    listed = list(tiles)
    split = split_of(seed)
    manifest: dict[str, Any] = {
        "suite": scene.name,
        "seed": seed,
        "split": None if split is None else split.value,
        "engine_version": pipeline.__version__,
        "crs": scene.crs,
        "extent": [whole[0] + x, whole[1] + y, whole[2] + x, whole[3] + y],
        "points": sum(tile.points for tile in listed),
        **counts,
        "scanner": dataclasses.asdict(settings),
        "strip_shifts_m": [[round(part, 6) for part in shift] for shift in strip_shifts_m(scene, settings, seed)],
        "tiles": [
            {
                "laz": Path(os.path.relpath(tile.laz, truth)).as_posix(),
                "labels": tile.labels.relative_to(truth).as_posix(),
                "points": tile.points,
                "bounds": [round(value, 3) for value in tile.bounds],
            }
            for tile in listed
        ],
    }
    path = truth / "scene.json"
    part = path.with_name(f".{path.name}")
    part.write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")
    part.replace(path)
