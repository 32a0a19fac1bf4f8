"""Reconstruct the real tiles as a user would, and print what came out.

    python benchmarks/real_tiles.py --data ../shared/data --out /tmp/real [--classes ignore] [--only delft_west]

For each tile one line: candidates by status, rejected objects, median RMSE, p95 and coverage of the records, seconds
by stage and peak memory of the largest process. Where the file has class 6, also how the models fit it: the share of
class-6 points within 0.2 m of the top surface (a point that no roof covers is a miss), and detection by area on a
0.5 m raster, with and without the ring of one cell at the edges of the reference. Pictures lie beside the runs.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from pipeline.io import ReadOptions, open_source
from pipeline.report.roof_models import RoofModel, read_roof_models

TILES = {
    "delft_west": ("ahn3/delft_west.laz", ["--crs", "EPSG:7415"]),
    "delft_east": ("ahn3/delft_east.laz", ["--crs", "EPSG:7415"]),
    "hdf_870000_6617100": ("ign/hdf_870000_6617100.laz", []),
    "hd_770500_6277500": ("ign/hd_770500_6277500.laz", []),
    "samp11": ("isprs/samp11-utm.laz", []),
    "CSite2": ("isprs/CSite2_orig-utm.laz", []),
    "autzen_trim": ("oregon/autzen_trim.las", []),
}
CELL_M = 0.5
BUILDING_CLASS = 6


def reconstruct(path: Path, run_dir: Path, options: list[str]) -> dict[str, Any]:
    """Run the console command; the summary that it prints as JSON."""
    command = [Path(sys.executable).with_name("gablework"), "reconstruct", path, "--out", run_dir, "--overwrite"]
    done = subprocess.run(
        [str(part) for part in (*command, "--json", *options)], check=False, capture_output=True, text=True
    )
    if done.returncode:
        sys.exit(f"{path}: exit code {done.returncode}\n{done.stderr[-2000:]}")
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary


def building_points(path: Path) -> np.ndarray:
    """(n, 3) metres: the points of class 6."""
    source = open_source(path, ReadOptions())
    chunks = [cloud.xyz[cloud.classification == BUILDING_CLASS] for cloud in source.chunks()]
    return np.concatenate(chunks)


def share_within(models: list[RoofModel], points: np.ndarray, tolerance_m: float = 0.2) -> tuple[float, float]:
    """Share of the points within the tolerance of the highest roof over them, and share that has a roof."""
    top = np.full(len(points), -np.inf)
    tree = shapely.STRtree([model.footprint for model in models])
    found, which = tree.query(shapely.points(points[:, :2]), predicate="intersects")
    for number in np.unique(which):
        index = found[which == number]
        height = models[number].top(points[index, 0], points[index, 1])
        top[index] = np.fmax(top[index], height)
    return float((np.abs(points[:, 2] - top) <= tolerance_m).mean()), float(np.isfinite(top).mean())


def detection(models: list[RoofModel], path: Path) -> dict[str, float]:
    """Completeness, correctness and quality by area, with the ring at the reference's edges and without."""
    from scipy import ndimage

    source = open_source(path, ReadOptions())
    x0, y0, _, x1, y1, _ = source.info.bounds_m
    shape = int((y1 - y0) / CELL_M) + 1, int((x1 - x0) / CELL_M) + 1
    every, building = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    for cloud in source.chunks():
        rows, columns = ((cloud.xyz[:, 1] - y0) / CELL_M).astype(int), ((cloud.xyz[:, 0] - x0) / CELL_M).astype(int)
        np.add.at(every, (rows, columns), 1)
        chosen = cloud.classification == BUILDING_CLASS
        np.add.at(building, (rows[chosen], columns[chosen]), 1)
    cross = ndimage.generate_binary_structure(2, 1)
    reference = ndimage.binary_closing(building * 2 > every, cross, iterations=2)
    reference = ndimage.binary_opening(reference, cross)
    centres = np.meshgrid(x0 + (np.arange(shape[1]) + 0.5) * CELL_M, y0 + (np.arange(shape[0]) + 0.5) * CELL_M)
    found = np.zeros(shape, bool)
    for model in models:
        found |= shapely.contains_xy(model.footprint, *centres)
    ring = ndimage.binary_dilation(reference, cross) & ~ndimage.binary_erosion(reference, cross)
    figures = {}
    for name, counted in (("", np.ones(shape, bool)), ("_without_ring", ~ring)):
        both = int((found & reference & counted).sum())
        wanted, given = int((reference & counted).sum()), int((found & counted).sum())
        figures[f"completeness{name}"] = both / max(1, wanted)
        figures[f"correctness{name}"] = both / max(1, given)
        figures[f"quality{name}"] = both / max(1, wanted + given - both)
    return figures


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--classes", default="trust")
    parser.add_argument("--only", default="")
    arguments = parser.parse_args()
    for name, (relative, options) in TILES.items():
        if arguments.only and name != arguments.only:
            continue
        path, run_dir = arguments.data / relative, arguments.out / f"{name}-{arguments.classes}"
        reconstruct(path, run_dir, [*options, "--classes", arguments.classes])
        report(name, path, run_dir)


def report(name: str, path: Path, run_dir: Path) -> None:
    """Print one tile's figures."""
    from pipeline.report.render import render_run
    from pipeline.report.table import run_statistics

    manifest = json.loads((run_dir / "run.json").read_text())
    counts = manifest["counts"]
    shown = ("candidates", "ok", "fallback", "failed", "rejected", "small_surfaces", "roof_faces", "outliers")
    print(f"{name}: " + ", ".join(f"{key} {counts[key]}" for key in shown))
    statistics = run_statistics(str(run_dir))
    print("  ", {key: value for key, value in statistics.items() if isinstance(value, dict) and value})
    print("   seconds:", ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in manifest["timings_s"].items()))
    print("   peak MB:", ", ".join(f"{size / 1e6:.0f}" for size in manifest["peak_memory_bytes"].values()))
    if manifest["crs"]["horizontal_unit_m"] == 1.0:
        points = building_points(path)
        if len(points):
            models = read_roof_models(run_dir)
            within, covered = share_within(models, points)
            print(f"   class 6: within 0.2 m {within:.3f}, covered {covered:.3f}")
            print("  ", {key: round(value, 3) for key, value in detection(models, path).items()})
    render_run(str(run_dir), str(run_dir) + ".png")


if __name__ == "__main__":
    main()
