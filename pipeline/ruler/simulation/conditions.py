"""The conditions of each building of a suite: the table that splits a score by difficulty."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pipeline.ruler.simulation.scene import Building, Terrain

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

_STEP_M = 0.05
"""Step of the central differences."""


def terrain_slope_deg(terrain: Terrain, x: float, y: float) -> float:
    """Slope of the terrain at a place of the scene frame, by central differences."""
    east = terrain.elevation(np.array([x - _STEP_M, x + _STEP_M]), np.array([y, y]))
    north = terrain.elevation(np.array([x, x]), np.array([y - _STEP_M, y + _STEP_M]))
    return math.degrees(math.atan(math.hypot(float(np.diff(east)[0]), float(np.diff(north)[0])) / (2 * _STEP_M)))


def condition_row(building: Building, terrain: Terrain, *, touches_data_edge: bool) -> dict[str, Any]:
    """The row of a building: the columns of `CONDITIONS`."""
    return {
        "building_id": building.building_id,
        "shape": building.shape.value,
        "roof_type": building.roof_type.value,
        "good": building.is_good,
        "defects": [str(defect) for defect in building.defects],
        "groups": list(building.groups),
        "pitch_deg": building.dimensions.pitch_deg,
        "terrain_slope_deg": round(terrain_slope_deg(terrain, building.x, building.y), 3),
        "touches_data_edge": touches_data_edge,
    }


def write_conditions(rows: Iterable[dict[str, Any]], path: Path) -> None:
    """Write the table, sorted by building_id; it appears under its name only when complete."""
    table = pa.Table.from_pylist(sorted(rows, key=lambda row: str(row["building_id"])), schema=CONDITIONS)
    part = path.with_name(f".{path.name}")
    pq.write_table(table, part, compression="zstd")
    part.replace(path)
