"""The terrain of a tile: triangles, errors and processor time by tolerance.

    .venv/bin/python -m benchmarks.terrain ../shared/data/ahn3/delft_west.laz

Errors of cells are those that `run.json` states. Errors of points are those of class 2 of the file; points nearer than
a metre to a building, and beyond the terrain, do not count. Times are processor seconds of one process: of writing the
terrain, and of the whole run without it.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from unittest import mock

import laspy
import numpy as np
import shapely

from pipeline.export.terrain import read_terrain
from pipeline.model import FloatArray
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import SERIAL
from pipeline.runtime.run import run
from pipeline.runtime.stages import terrain
from pipeline.settings import RunSettings

TOLERANCES_M = (0.05, 0.1, 0.2, 0.5)
GROUND = 2
BESIDE_M = 1.0


def errors_at(points: FloatArray, folder: Path) -> FloatArray:
    """Vertical distances of points (n, 3) above the terrain of a run, without those beside buildings."""
    corners = np.concatenate(
        [
            (found := read_terrain(path.read_text().splitlines())).vertices[found.triangles]
            for path in sorted(folder.glob("terrain/*/*.city.jsonl"))
        ]
    )
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    corners, normal = corners[normal[:, 2] > 0.0], normal[normal[:, 2] > 0.0]
    flat = shapely.polygons(corners[:, :, :2])
    outside = shapely.union_all(flat, grid_size=0.001).boundary
    shapely.prepare(outside)
    counted = points[~shapely.dwithin(outside, shapely.points(points[:, :2]), BESIDE_M)]
    point, triangle = shapely.STRtree(flat).query(shapely.points(counted[:, :2]), predicate="within")
    away = counted[point] - corners[triangle, 0]
    above: FloatArray = (away * normal[triangle]).sum(axis=1) / normal[triangle, 2]
    return above


def main() -> None:
    """Print one row per tolerance."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tile", type=Path)
    tile: Path = parser.parse_args().tile
    las = laspy.read(tile)
    points = np.asarray(las.xyz)[np.asarray(las.classification) == GROUND]
    seconds = {"floors": 0.0, "tiles": 0.0}
    whole_write, whole_store = terrain.write_tile_terrain, terrain.store_floors

    def write(task: terrain.TerrainTask) -> terrain.TileTerrain:
        began = time.process_time()
        found = whole_write(task)
        seconds["tiles"] += time.process_time() - began
        return found

    def store(task: terrain.FloorsTask) -> object:
        began = time.process_time()
        found = whole_store(task)
        seconds["floors"] += time.process_time() - began
        return found

    print("| tolerance m | triangles | cells | rms m | max m | points | median m | rms m | p95 m | terrain s | run s |")
    for tolerance_m in (TOLERANCES_M[0], *TOLERANCES_M):  # the first compiles
        with (
            tempfile.TemporaryDirectory() as folder,
            mock.patch.object(terrain, "write_tile_terrain", write),
            mock.patch.object(terrain, "store_floors", store),
        ):
            settings = RunSettings.from_mapping({"terrain": "tin", "terrain_tolerance_m": tolerance_m})
            seconds.update(floors=0.0, tiles=0.0)
            out = Path(folder, "run")
            began = time.process_time()
            run(RunRequest(inputs=(str(tile),), out=str(out), settings=settings, resources=SERIAL))
            rest = time.process_time() - began - sum(seconds.values())
            counts = read_manifest(out).counts
            errors = errors_at(points, out)
        print(
            f"| {tolerance_m:g} | {counts['terrain_triangles']} | {counts['terrain_cells']} "
            f"| {counts['terrain_rms_error_mm'] / 1000:.3f} | {counts['terrain_max_error_mm'] / 1000:.3f} "
            f"| {len(errors)} | {np.median(errors):.3f} | {np.sqrt(np.mean(errors**2)):.3f} "
            f"| {np.percentile(np.abs(errors), 95):.3f} | {sum(seconds.values()):.2f} | {rest:.2f} |"
        )


if __name__ == "__main__":
    main()
