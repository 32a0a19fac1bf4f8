"""Simulated points beside real ones: spacing, local planes, multiple returns.

    python benchmarks/simulated_against_real.py [--data ../shared/data] [--split dev] [--draw 0] [--json]

The real tiles are `delft_west` (AHN3) and `CSite2` (ISPRS filter test, Stuttgart). Beside each are the cells of
`sweep` whose survey is nearest, and a quarter of a square kilometre of `city` flown the same way, since the sweep is a
field of detached houses and the real tiles are old towns. Measured alike everywhere:

- distance to the nearest neighbour in plan, among the first returns (5 %, median, 95 %), and points per square metre;
- sigma of the plane through each point and its eight nearest neighbours in plan, over buildings (median, 90 %), the
  orthogonal residuals with six degrees of freedom. Buildings are class 6; where a tile has no classes, on both sides
  all last returns more than 3 m over the lowest within 12 m: roofs, and crowns that nothing penetrated;
- the share of pulses with several returns: all, and those whose first return is of a building, or of anything else
  above the ground. The ISPRS file has a first and a last return of every pulse: there two are several where they
  differ by 0.5 m in height.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from scipy import ndimage

from pipeline.geometry import nearest_neighbours
from pipeline.model import BoolArray, ByteArray, FloatArray
from pipeline.ruler.simulation.als import ScannerSettings, scan_all
from pipeline.ruler.simulation.city import CITY_SCANNER, CityPlan
from pipeline.ruler.simulation.scene import Scene
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.ruler.simulation.sweep import SCANNER, cell_name, sweep

NEIGHBOURS = 8
RAISED_M = 3.0
WINDOW_M = 24.0
CELL_M = 2.0
APART_M = 0.5
CITY_M = (500.0, 500.0)
CITY_CORNER_M = (100.0, 100.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Points:
    """What is measured of a tile."""

    xyz: FloatArray
    """(n, 3) float64, metres."""
    number: ByteArray
    """(n,) uint8, return number."""
    count: ByteArray
    """(n,) uint8, returns of the pulse."""
    classes: ByteArray
    """(n,) uint8, ASPRS class; 0 where there are none."""
    is_several: BoolArray
    """(n,) bool, whether the pulse has several returns."""


def real_points(path: Path) -> Points:
    """A tile; of a file with two returns of every pulse, several are those that differ in height."""
    tile = laspy.read(path)
    number, count = np.asarray(tile.return_number), np.asarray(tile.number_of_returns)
    xyz = np.asarray(tile.xyz)
    if (count == 2).all():
        # The k-th first and the k-th last return are of one pulse.
        first, last = np.flatnonzero(number == 1), np.flatnonzero(number == 2)
        several = np.zeros(len(xyz), bool)
        several[first] = several[last] = np.abs(xyz[first, 2] - xyz[last, 2]) > APART_M
    else:
        several = count > 1
    is_sound = np.abs(xyz[:, 2] - np.median(xyz[:, 2])) < 100.0
    points = Points(xyz=xyz, number=number, count=count, classes=np.asarray(tile.classification), is_several=several)
    return taken(points, is_sound)


def simulated_points(scene: Scene, settings: ScannerSettings, seed: int, *, with_classes: bool) -> Points:
    """The scan of a scene."""
    cloud = scan_all(scene, settings, seed).points
    classes = cloud.classification if with_classes else np.zeros(len(cloud), np.uint8)
    return Points(
        xyz=cloud.xyz - np.array(scene.origin),
        number=cloud.return_number,
        count=cloud.return_count,
        classes=classes,
        is_several=cloud.return_count > 1,
    )


def taken(points: Points, keep: BoolArray) -> Points:
    """Some of the points."""
    return Points(**{field.name: getattr(points, field.name)[keep] for field in dataclasses.fields(Points)})


def is_raised(xyz: FloatArray) -> BoolArray:
    """Which points lie well over the lowest around them."""
    cell = np.floor((xyz[:, :2] - xyz[:, :2].min(axis=0)) / CELL_M).astype(int)
    lowest = np.full(cell.max(axis=0) + 1, np.inf)
    np.minimum.at(lowest, (cell[:, 0], cell[:, 1]), xyz[:, 2])
    ground = ndimage.minimum_filter(lowest, size=int(WINDOW_M / CELL_M) + 1, mode="nearest")
    raised: BoolArray = xyz[:, 2] - ground[cell[:, 0], cell[:, 1]] > RAISED_M
    return raised


def nearest_distances(xyz: FloatArray) -> FloatArray:
    """Distance in plan from each point to its nearest neighbour; points at one place count as one."""
    plan = np.unique(np.round(xyz[:, :2], 2), axis=0)
    nearest = nearest_neighbours(plan, 1)[:, 0]
    away: FloatArray = np.hypot(*(plan[nearest] - plan).T)
    return away


def local_sigmas(xyz: FloatArray) -> FloatArray:
    """Standard deviation of each point's neighbourhood about its best plane (orthogonal least squares)."""
    near = nearest_neighbours(np.ascontiguousarray(xyz), NEIGHBOURS)
    patches = np.concatenate([xyz[:, None], xyz[near]], axis=1)
    patches = patches - patches.mean(axis=1, keepdims=True)
    smallest = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", patches, patches))[:, 0]
    sigmas: FloatArray = np.sqrt(np.maximum(smallest, 0.0) / (NEIGHBOURS + 1 - 3))
    return sigmas


def covered_m2(xyz: FloatArray) -> float:
    """Area with points: cells of 2 m, gaps inside closed."""
    cell = np.floor((xyz[:, :2] - xyz[:, :2].min(axis=0)) / CELL_M).astype(int)
    filled = np.zeros(cell.max(axis=0) + 1, bool)
    filled[cell[:, 0], cell[:, 1]] = True
    return float(ndimage.binary_closing(np.pad(filled, 4), iterations=3).sum()) * CELL_M**2


def measured(points: Points) -> dict[str, str]:
    """All figures of a tile."""
    first, last = points.number == 1, points.number == points.count
    away = np.percentile(nearest_distances(points.xyz[first]), [5, 50, 95])
    area = covered_m2(points.xyz)
    has_classes = bool((points.classes == 6).any())
    building = points.classes == 6 if has_classes else last & is_raised(points.xyz)
    sigmas = np.percentile(local_sigmas(points.xyz[building]), [50, 90])
    several = points.is_several[first]
    figures = {
        "pulses per m2": f"{first.sum() / area:.1f}",
        "returns per m2": f"{len(first) / area:.1f}",
        "nearest first return, 5 %": f"{away[0]:.2f} m",
        "nearest first return, median": f"{away[1]:.2f} m",
        "nearest first return, 95 %": f"{away[2]:.2f} m",
        "sigma of local planes on buildings, median": f"{sigmas[0]:.3f} m",
        "sigma of local planes on buildings, 90 %": f"{sigmas[1]:.3f} m",
        "pulses with several returns": f"{several.mean():.1%}",
    }
    if has_classes:
        classes = points.classes[first]
        figures["of those that hit a building first"] = f"{several[classes == 6].mean():.1%}"
        other = (classes != 6) & (classes != 2) & (classes != 9)
        figures["of those that hit something else above ground first"] = f"{several[other].mean():.1%}"
        figures["share of pulses that hit such a thing first"] = f"{other.mean():.1%}"
    else:
        figures["of those that hit something raised first"] = f"{several[is_raised(points.xyz)[first]].mean():.1%}"
    return figures


def city_part(seed: int, settings: ScannerSettings) -> Scene:
    """A part of a city on its plain."""
    x, y = CITY_CORNER_M
    plan = CityPlan(seed, (x + CITY_M[0], y + CITY_M[1]), settings)
    return dataclasses.replace(plan.part((x, y, x + CITY_M[0], y + CITY_M[1])), survey_extent=None)


def compared(data: Path, seed: int) -> dict[str, dict[str, dict[str, str]]]:
    """Both comparisons: by real tile, by column, the figures."""

    def cell(density: float, noise: float) -> ScannerSettings:
        return dataclasses.replace(SCANNER, pulse_density_per_m2=density, range_noise_m=noise)

    fields = sweep(seed)
    like_ahn3 = dataclasses.replace(
        CITY_SCANNER, pulse_density_per_m2=6.0, range_noise_m=0.02, strip_overlap=1.0, wrong_row_share=0.0
    )
    like_isprs = dataclasses.replace(
        CITY_SCANNER,
        pulse_density_per_m2=0.8,
        range_noise_m=0.04,
        altitude_m=1000.0,
        strip_overlap=0.4,
        jitter=1.0,
        beam_radius_m=0.3,
    )
    delft = {"delft_west": measured(real_points(data / "ahn3" / "delft_west.laz"))}
    for density in (8.0, 16.0):
        settings = cell(density, 0.02)
        delft[f"sweep {cell_name(density, 0.02)}"] = measured(
            simulated_points(fields, settings, seed, with_classes=True)
        )
    delft["city, two strips of 6 per m2"] = measured(
        simulated_points(city_part(seed, like_ahn3), like_ahn3, seed, with_classes=True)
    )
    stuttgart = {"CSite2": measured(real_points(data / "isprs" / "CSite2_orig-utm.laz"))}
    for noise in (0.05, 0.10):
        stuttgart[f"sweep {cell_name(1.0, noise)}"] = measured(
            simulated_points(fields, cell(1.0, noise), seed, with_classes=False)
        )
    stuttgart["city, 0.8 per m2, irregular"] = measured(
        simulated_points(city_part(seed, like_isprs), like_isprs, seed, with_classes=False)
    )
    return {"delft_west": delft, "CSite2": stuttgart}


def main(words: Sequence[str] | None = None) -> dict[str, Any]:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--split", default="dev", choices=("dev", "test"))
    parser.add_argument("--draw", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="print a JSON document in place of the tables")
    given = parser.parse_args(words)
    document = compared(given.data, seed_of(given.split, given.draw))
    if given.json:
        print(json.dumps(document, indent=2))
        return document
    for columns in document.values():
        names = list(columns)
        print("| | " + " | ".join(names) + " |\n|" + " --- |" * (len(names) + 1))
        for figure in columns[names[0]]:
            print(f"| {figure} | " + " | ".join(columns[name][figure] for name in names) + " |")
        print()
    return document


if __name__ == "__main__":
    main()
