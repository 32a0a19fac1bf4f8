"""Time and memory of `gablework batch diff` on very many buildings: a lattice of gabled houses in the form of runs.

    python -m benchmarks.epochs_scale --out DIR [--buildings 200000 1000000] [--page docs/results/epochs.md]

One house in a hundred each is new, gone, raised, lowered, longer; outlines and heights jitter by some centimetres. The
comparison runs in a separate process, whose peak memory is measured. Writes DIR/epochs_scale.md and its lines into the
page.
"""

from __future__ import annotations

import argparse
import datetime as dt
import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyproj
import shapely

from benchmarks.entries import markdown_table
from benchmarks.results_page import filled
from pipeline.export.geoparquet import geo_metadata, parquet_bytes, stored_schema
from pipeline.ruler.epochs.records import Change
from pipeline.runtime.manifest import InputFile, RunManifest, RunStatus, write_manifest

ORIGIN = np.array([560_000.0, 5_930_000.0])
PITCH_M, TILE_M = 25.0, 1000.0
KINDS = (Change.UNCHANGED, Change.NEW, Change.GONE, Change.RAISED, Change.LOWERED, Change.RESHAPED)
SHARES = (0.95, 0.01, 0.01, 0.01, 0.01, 0.01)

Arrays = dict[str, Any]


def houses(count: int, epoch: int) -> Arrays:
    """The houses of an epoch (0, 1): corners, eave, ridge, names; and of all houses what happens to them."""
    layout, own = np.random.default_rng(1), np.random.default_rng(5 + epoch)
    side = math.isqrt(count)
    column, row = np.meshgrid(np.arange(side), np.arange(side))
    middle = ORIGIN + (np.column_stack([column.ravel(), row.ravel()]) + 0.5) * PITCH_M
    n = len(middle)
    length, width = layout.uniform(9.0, 15.0, n), layout.uniform(8.0, 11.0, n)
    eave, rise = layout.uniform(3.0, 9.0, n), layout.uniform(2.0, 4.0, n)
    kind = layout.choice(len(KINDS), n, p=SHARES)
    is_of = [KINDS[k] for k in range(len(KINDS))].index
    there = kind != is_of(Change.GONE if epoch else Change.NEW)
    low = middle - np.column_stack([length, width]) / 2.0
    high = middle + np.column_stack([length, width]) / 2.0
    if epoch:
        eave = eave + 2.8 * (kind == is_of(Change.RAISED)) - 1.5 * (kind == is_of(Change.LOWERED))
        high[:, 0] += 4.0 * (kind == is_of(Change.RESHAPED))
    low, high = low + own.normal(0.0, 0.05, (n, 2)), high + own.normal(0.0, 0.05, (n, 2))
    eave = eave + own.normal(0.0, 0.01, n)
    name = np.array([f"b{epoch}{k:08d}" for k in range(n)], dtype=object)
    found = {"low": low, "high": high, "eave": eave, "ridge": eave + rise, "name": name, "tile": middle // TILE_M}
    counts = {str(KINDS[k]): int(np.sum(kind == k)) for k in range(len(KINDS))}
    return {key: values[there] for key, values in found.items()} | {"counts": counts}


def put(folder: Path, table: str, tile: str, columns: Arrays, geometries: Any, crs: pyproj.CRS) -> None:
    """Write one table of a tile; columns that are not given are null."""
    schema = stored_schema(table)
    bounds = shapely.bounds(geometries)
    box = pa.StructArray.from_arrays([pa.array(bounds[:, k]) for k in range(4)], fields=list(schema.field("bbox").type))
    columns = {**columns, "geometry": shapely.to_wkb(geometries, flavor="iso"), "bbox": box}
    arrays = [
        pa.array(columns[field.name], type=field.type) if field.name in columns else pa.nulls(len(box), field.type)
        for field in schema
    ]
    made = pa.table(arrays, schema=schema)
    geo = json.dumps(geo_metadata(geometries, crs.to_json_dict()))
    path = folder / table / f"tile={tile}" / "part-0.parquet"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(parquet_bytes(made.replace_schema_metadata({"geo": geo})))


def write_run(folder: Path, count: int, epoch: int) -> dict[str, int]:
    """Write an epoch as a run directory; how many houses of which kind there are in both together."""
    crs, made = pyproj.CRS.from_epsg(25832), houses(count, epoch)
    tiles, of = np.unique(made["tile"].astype(np.int64), axis=0, return_inverse=True)
    for number, (column, row) in enumerate(tiles.tolist()):
        own = np.flatnonzero(of.ravel() == number)
        key = f"x{column}_y{row}"
        (west, south), (east, north) = made["low"][own].T, made["high"][own].T
        eave, ridge, name, n = made["eave"][own], made["ridge"][own], made["name"][own], len(own)
        area = (east - west) * (north - south)
        words = {"status": "ok", "reason_detail": "", "method": "arrangement", "roof_type": "gable"}
        words |= {"lod": "2.2", "settings_hash": "ab", "engine_version": "0"}
        numbers: Arrays = {"ground_z": 0.0, "n_points": 500, "n_planes": 2, "rmse_m": 0.04, "point_spacing_m": 0.4}
        numbers |= {"noise_m": 0.03, "ridge_z_sigma_m": 0.02, "is_curved": False, "valid": True}
        columns = {column: [value] * n for column, value in (words | numbers | {"touches_data_edge": False}).items()}
        columns |= {"building_id": name, "ridge_z": ridge, "height_m": ridge, "footprint_area_m2": area}
        columns |= {"volume_m3": area * (eave + ridge) / 2.0, "validity_codes": [[]] * n}
        outline = shapely.orient_polygons(shapely.normalize(shapely.box(west, south, east, north)))
        put(folder, "buildings", key, columns, outline, crs)
        middle = (south + north) / 2.0
        slope = (ridge - eave) / (middle - south)
        up = 1.0 / np.hypot(1.0, slope)
        halves = [
            shapely.polygons(np.stack([np.stack(corner, axis=1) for corner in corners], axis=1))
            for corners in (
                ((west, south, eave), (east, south, eave), (east, middle, ridge), (west, middle, ridge)),
                ((west, middle, ridge), (east, middle, ridge), (east, north, eave), (west, north, eave)),
            )
        ]
        normals = [np.stack([0.0 * up, sign * slope * up, up, 0.0 * up], axis=1) for sign in (-1.0, 1.0)]
        twice: Arrays = {"building_id": name, "origin_x": west, "origin_y": middle, "origin_z": ridge}
        planes = {column: np.concatenate([values] * 2) for column, values in twice.items()}
        planes |= {"plane_id": np.repeat([0, 1], n), "coefficients": list(np.concatenate(normals))}
        same = {
            "slope_deg": 0.0,
            "aspect_deg": 0.0,
            "o_distance_m": 0.0,
            "area_m2": 1.0,
            "n_points": 200,
            "rmse_m": 0.03,
        }
        planes |= {column: [value] * (2 * n) for column, value in same.items()}
        put(folder, "planes", key, planes, np.concatenate(halves), crs)
        put(folder, "rejected", key, {}, np.empty(0, dtype=object), crs)
    end = ORIGIN + math.isqrt(count) * PITCH_M + 50.0
    bounds = (float(ORIGIN[0]) - 50.0, float(ORIGIN[1]) - 50.0, float(end[0]), float(end[1]))
    manifest = RunManifest(
        status=RunStatus.FINISHED,
        engine_version="0",
        method="arrangement",
        settings={},
        settings_hash="ab",
        started_at=dt.datetime(2026, 1, 1, tzinfo=dt.UTC),
        crs={"epsg": 25832, "name": crs.name, "wkt": crs.to_wkt(), "horizontal_unit_m": 1.0, "vertical_unit_m": 1.0},
        inputs=(InputFile(path="a.laz", sha256="0", size_bytes=1, n_points=1, bounds_m=bounds),),
    )
    write_manifest(folder, manifest)
    return dict(made["counts"])


def measured(folder: Path, count: int) -> list[str]:
    """A row of the table."""
    runs = [folder / "old", folder / "new"]
    made, _ = (write_run(one, count, epoch) for epoch, one in enumerate(runs))
    command = [sys.executable, "-m", "service.cli", "batch", "diff", *map(str, runs), "--out", str(folder / "diff")]
    began = time.perf_counter()
    with subprocess.Popen([*command, "--quiet"], stdout=subprocess.DEVNULL) as child:
        _, code, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(code)
    seconds = time.perf_counter() - began
    if child.returncode != 0:
        raise SystemExit(f"the comparison of {count} buildings ended with {child.returncode}")
    reported = json.loads((folder / "diff" / "changes.json").read_text())["changes"]
    wrong = sum(abs(reported[kind]["rows"] - number) for kind, number in made.items())
    cpu = used.ru_utime + used.ru_stime
    return [
        f"{sum(made.values()):,}",
        f"{seconds:.0f} s",
        f"{cpu:.0f} s",
        f"{used.ru_maxrss / 2**10:,.0f} MiB",
        str(wrong),
    ]


def main() -> int:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--buildings", type=int, nargs="+", default=[200_000, 1_000_000])
    parser.add_argument("--page", type=Path)
    arguments = parser.parse_args()
    header = ["houses", "time", "processor time", "peak memory", "rows of another class than made"]
    text = markdown_table(header, [measured(arguments.out / f"{count}", count) for count in arguments.buildings])
    (arguments.out / "epochs_scale.md").write_text(text, encoding="utf-8")
    print(text)
    if arguments.page is not None:
        page, _ = filled(arguments.page.read_text(encoding="utf-8"), arguments.out)
        arguments.page.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
