"""Fuzzy SART over Delft's old town with given footprints and classes: quality, validity, speed.

    python benchmarks/delft_footprints.py --data ../shared/data [--faithful]

The score is defined on the page of methods: vertical distance of all building points (class 6) inside the reference
footprint to the delivered top surface; a point without a roof is a miss. *Top-visible* points have no other of the
same footprint more than 1.1 m higher within 0.5 m in plan.
"""

from __future__ import annotations

import argparse
import collections
import json
import math
import sys
import time
from pathlib import Path

import laspy
import numpy as np
import pyogrio.raw
import shapely

from pipeline.geometry import top_visible
from pipeline.methods import ReconstructSettings
from pipeline.methods.settings import FuzzySartSettings
from pipeline.model import BuildingResult, Candidate, FloatArray, Status
from pipeline.quality.residuals import vertical_residuals
from pipeline.quality.validity import check_solid
from pipeline.recipe import reconstruct_building

TOLERANCE_M = 0.2
GROUND_REACH_M = 8.0


def load_candidates(data: Path) -> list[Candidate]:
    """One candidate a footprint, with the class 6 points inside it and class 2 points around as terrain."""
    clouds, classes = [], []
    for name in ("delft_west", "delft_east"):
        las = laspy.read(data / "ahn3" / f"{name}.laz")
        clouds.append(np.column_stack((las.x, las.y, las.z)))
        classes.append(np.asarray(las.classification))
    points, labels = np.concatenate(clouds), np.concatenate(classes)
    building, ground = points[labels == 6], points[labels == 2]
    _, _, geometries, _ = pyogrio.raw.read(data / "ahn3" / "footprints.gpkg")
    tree = shapely.STRtree(shapely.points(building[:, :2]))
    ground_tree = shapely.STRtree(shapely.points(ground[:, :2]))
    candidates = []
    for number, footprint in enumerate(shapely.force_2d(shapely.from_wkb(geometries))):
        inside = building[np.sort(tree.query(footprint, predicate="intersects"))]
        around = ground[np.sort(ground_tree.query(footprint, predicate="dwithin", distance=GROUND_REACH_M))]
        corner = np.floor(np.array([*footprint.bounds[:2], 0.0]))
        local = np.rint((inside - corner) * 1e3) / 1e3
        local = local[np.lexsort((local[:, 2], local[:, 1], local[:, 0]))]
        candidates.append(
            Candidate(
                building_id=f"footprint-{number}",
                origin=(float(corner[0]), float(corner[1]), 0.0),
                points=local,
                ground=np.rint((around - corner) * 1e3) / 1e3,
                ground_z_m=floor_of(inside, around),
                footprint=shapely.transform(footprint, lambda xy, corner=corner: xy - corner[:2]),
                source_id=str(number),
            )
        )
    return candidates


def floor_of(building: FloatArray, ground: FloatArray) -> float:
    """Lower fifth of the terrain around; of the building's points where there is none."""
    z = np.sort(ground[:, 2] if len(ground) else building[:, 2])
    return float(np.floor(z[len(z) // 5] * 1e3) / 1e3) if len(z) else 0.0


def figures(candidates: list[Candidate], results: list[BuildingResult], seconds: list[float]) -> dict[str, object]:
    """All figures of a run."""
    within, total, within_top, total_top, medians = 0, 0, 0, 0, []
    for candidate, result in zip(candidates, results, strict=True):
        residuals = np.abs(vertical_residuals(candidate.points, result.faces, result.planes))
        top = top_visible(candidate.points)
        good = residuals <= TOLERANCE_M
        within += int(good.sum())
        total += len(good)
        within_top += int(good[top].sum())
        total_top += int(top.sum())
        if not math.isnan(result.rmse_m):
            medians.append(result.rmse_m)
    solids = [solid for result in results for solid in result.solids]
    times = np.sort(np.array(seconds)) * 1e3
    return {
        "buildings": len(results),
        "lod2_share": sum(result.lod == "2.2" for result in results) / len(results),
        "within_0.2_m_of_all": within / total,
        "within_0.2_m_of_top_visible": within_top / total_top,
        "roof_faces": sum(len(result.faces) for result in results),
        "planes": sum(len(result.planes) for result in results),
        "vertices_per_roof_face": sum(
            shapely.get_num_coordinates(face.polygon) - 1 - len(face.polygon.interiors)
            for result in results
            for face in result.faces
        )
        / max(1, sum(len(result.faces) for result in results)),
        "solids": len(solids),
        "valid_share": sum(not check_solid(solid) for solid in solids) / max(1, len(solids)),
        "rmse_median_m": float(np.median(medians)),
        "status": dict(collections.Counter(str(result.status) for result in results)),
        "reasons": dict(collections.Counter(str(result.reason) for result in results if result.reason)),
        "roof_types": dict(collections.Counter(str(result.roof_type) for result in results)),
        "area_ratio": sum(result.footprint.area for result in results if result.solids and result.footprint)
        / sum(candidate.footprint.area for candidate in candidates if candidate.footprint),
        "ms_median": float(np.median(times)),
        "ms_mean": float(times.mean()),
        "ms_p95": float(np.percentile(times, 95.0)),
        "cpu_s": float(times.sum() / 1e3),
    }


def main() -> int:
    """Run and print; exit code 1 where a required figure is missed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="folder with ahn3/delft_west.laz and so on")
    parser.add_argument("--faithful", action="store_true", help="the paper to the letter")
    parser.add_argument("--without-footprints", action="store_true", help="footprints choose and score the points only")
    arguments = parser.parse_args()
    candidates = load_candidates(arguments.data)
    modelled = [Candidate(**{**vars(c), "footprint": None}) if arguments.without_footprints else c for c in candidates]
    settings = ReconstructSettings(method=FuzzySartSettings.faithful() if arguments.faithful else FuzzySartSettings())
    reconstruct_building(modelled[0], "fuzzy-sart", settings)
    results, seconds = [], []
    for candidate in modelled:
        start = time.process_time()
        results.append(reconstruct_building(candidate, "fuzzy-sart", settings))
        seconds.append(time.process_time() - start)
    table = figures(candidates, results, seconds)
    print(json.dumps(table, indent=2))
    for result in results:
        if result.status is not Status.OK:
            print(f"{result.building_id}: {result.status}, {result.reason}: {result.reason_detail}")
    required = (
        float(str(table["lod2_share"])) >= 0.98,
        float(str(table["within_0.2_m_of_all"])) >= 0.83,
        float(str(table["within_0.2_m_of_top_visible"])) >= 0.93,
        int(str(table["roof_faces"])) <= 850,
        float(str(table["valid_share"])) == 1.0,
    )
    return 0 if arguments.faithful or arguments.without_footprints or all(required) else 1


if __name__ == "__main__":
    sys.exit(main())
