"""Reliability of `detection_confidence`: which share of the buildings is right, by their confidence.

A building is right if at least half of the last returns within its outline and more than 1.5 m above its floor are of
class 6. The run must not have read the classes. Each run is given with the classified point file that it was made from:

    .venv/bin/gablework reconstruct tile.laz --out DIR --classes ignore
    .venv/bin/python -m benchmarks.detection_confidence DIR=tile.laz [DIR=tile.laz ...]

`--features FILE.json` also writes the figures of each building, from which the weights were fitted.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import shapely

from pipeline.export.geoparquet import read_table
from pipeline.scene import BUILDING_CLASS

ABOVE_FLOOR_M = 1.5
"""Lower points are ground and yard rather than roof or wall."""
MIN_SHARE = 0.5
"""Least share of class 6 of a right building."""
BINS = (0.0, 0.2, 0.4, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0)
COLUMNS = (
    "building_id", "geometry", "ground_z", "n_points", "density_per_m2", "noise_m", "share_within_0_2m", "n_planes",
    "footprint_area_m2", "height_m", "coverage", "detection_confidence",
)  # fmt: skip


def judged(run: Path, tile: Path) -> list[dict[str, Any]]:
    """The buildings of a run with a model, each with its figures and whether it is right (True or False)."""
    las = laspy.read(tile)
    x, y, z = (np.asarray(getattr(las, axis)) for axis in "xyz")
    is_last = np.asarray(las.return_number) >= np.asarray(las.number_of_returns)
    is_building = np.asarray(las.classification) == BUILDING_CLASS
    order = np.flatnonzero(is_last)[np.argsort(x[is_last], kind="stable")]
    found = []
    for row in read_table(str(run), "buildings").select(list(COLUMNS)).to_pylist():
        if row["share_within_0_2m"] is None:
            continue
        outline = shapely.from_wkb(row.pop("geometry"))
        x0, y0, x1, y1 = outline.bounds
        near = order[np.searchsorted(x[order], x0) : np.searchsorted(x[order], x1, side="right")]
        near = near[(y[near] >= y0) & (y[near] <= y1) & (z[near] > row["ground_z"] + ABOVE_FLOOR_M)]
        near = near[shapely.contains_xy(outline, x[near], y[near])]
        if len(near):
            found.append(row | {"run": run.name, "right": bool(is_building[near].mean() >= MIN_SHARE)})
    return found


def reliability(confidence: np.ndarray[Any, np.dtype[np.float64]], right: np.ndarray[Any, np.dtype[np.bool_]]) -> str:
    """A table in Markdown: per bin the number of buildings, their mean confidence and the share that is right."""
    lines = ["| confidence | buildings | mean confidence | share right |", "| --- | --- | --- | --- |"]
    for low, high in itertools.pairwise(BINS):
        inside = (confidence >= low) & ((confidence < high) | (high == BINS[-1]))
        if inside.any():
            share, mean = right[inside].mean(), confidence[inside].mean()
            lines.append(f"| {low:g} to {high:g} | {inside.sum()} | {mean:.3f} | {share:.3f} |")
    return "\n".join(lines)


def main() -> None:
    """Print the reliability of all runs together."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", help="DIR=FILE: a run directory and its classified point file")
    parser.add_argument("--features", type=Path, help="where the figures of each building go, as JSON")
    arguments = parser.parse_args()
    rows = [row for pair in arguments.runs for row in judged(*(Path(part) for part in pair.split("=", 1)))]
    if arguments.features is not None:
        arguments.features.write_text(json.dumps(rows))
    confidence = np.array(
        [math.nan if row["detection_confidence"] is None else row["detection_confidence"] for row in rows]
    )
    right = np.array([row["right"] for row in rows])
    print(f"{len(rows)} buildings, {right.mean():.3f} right")
    print(reliability(confidence, right))


if __name__ == "__main__":
    main()
