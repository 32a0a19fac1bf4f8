"""The tables of a run as tests read them, and footprints for one."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow.dataset as ds
import shapely


def rows(run_dir: str, table: str = "buildings") -> list[dict[str, Any]]:
    """All rows of a table."""
    found: list[dict[str, Any]] = ds.dataset(f"{run_dir}/{table}", partitioning="hive").to_table().to_pylist()
    return found


def rows_by_id(run_dir: str, table: str = "buildings") -> dict[str, dict[str, Any]]:
    """All rows of a table, by the id of their building or object."""
    return {row["object_id" if table == "rejected" else "building_id"]: row for row in rows(run_dir, table)}


def write_footprints(path: Path, outlines: Mapping[str, Any], **attributes: str) -> Path:
    """Write footprints by their ids as GeoJSON in the CRS of the simulated suburb."""
    features = [
        {"type": "Feature", "properties": {"id": name, **attributes}, "geometry": shapely.geometry.mapping(outline)}
        for name, outline in outlines.items()
    ]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}))
    return path
