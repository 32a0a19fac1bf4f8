"""The statistics of `hofmann310` beside those of the data of Hofmann, Maas and Streilein (2003).

    python benchmarks/hofmann_statistics.py [--split test] [--draws 5] [--json]

For every building its point cloud is what the paper describes: the returns over it and over some of the ground around
it, reduced to barycentric coordinates and triangulated (Delaunay, in plan). A facet belongs to a roof face if all
three points were returned by that face alone. Each facet has a slope, an orientation and an O-distance (the distance of
its plane from the origin); the *spread* of a roof face is the range of 95 % of its facets.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely

from pipeline.geometry import aspects_deg, facet_normals, o_distances_m
from pipeline.model import FloatArray
from pipeline.ruler.simulation.als import joined, scan
from pipeline.ruler.simulation.hofmann310 import SCANNER, hofmann310
from pipeline.ruler.simulation.scene import Building
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.ruler.simulation.strips import Returns
from pipeline.ruler.simulation.survey_files import recorded
from pipeline.tin.delaunay import triangulate, unique_xy

SURROUNDINGS_M = 5.0
"""Ground around a building that belongs to its point cloud."""
FEWEST_FACETS = 11
"""The paper's smallest cluster: faces of fewer facets are not looked at."""
LOW_SLOPE_DEG = 10.0
LARGEST_SD_M = 1.3
"""Standard deviation of the O-distance of the paper's roof clusters."""
TYPICAL_AREA_M2 = (50.0, 150.0)
"""Plan area of a typical roof face: half of a house of 100 to 300 m2."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FaceSpread:
    """How the facets of one roof face scatter."""

    good: bool
    """Whether the paper would have expected a good result."""
    slope_deg: float
    """True slope."""
    area_m2: float
    """True area in plan."""
    facets: int
    """Number of facets."""
    orientation_deg: float
    """Range that 95 % of the facets' orientations lie in, 0 to 360."""
    orientation_two_thirds_deg: float
    """Range that two thirds of them lie in: one standard deviation to both sides, were they normal."""
    o_distance_m: float
    """Range that 95 % of the O-distances lie in."""
    o_distance_range_m: float
    """Range of all O-distances."""
    o_distance_sd_m: float
    """Their standard deviation."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Drawn:
    """What one draw of the suite measured."""

    spacing_m: float
    areas_m2: FloatArray
    sides_m: FloatArray
    pulses: FloatArray
    nuisances: float
    faces: tuple[FaceSpread, ...]


def spread_of_angles(degrees: FloatArray, share: float = 0.95) -> float:
    """Width of the narrowest sector that holds a share of some directions."""
    ordered = np.sort(degrees % 360.0)
    kept = max(1, int(np.ceil(share * len(ordered))))
    twice = np.concatenate([ordered, ordered + 360.0])
    return float(min(360.0, (twice[kept - 1 : kept - 1 + len(ordered)] - ordered).min()))


def inner_range(values: FloatArray) -> float:
    """Width of the range that 95 % of some values lie in."""
    low, high = np.percentile(values, [2.5, 97.5])
    return float(high - low)


def face_spreads(building: Building, points: FloatArray, own: FloatArray, face: FloatArray) -> list[FaceSpread]:
    """The spread of every roof face of a building in the TIN of its point cloud.

    Parameters
    ----------
    building : Building
        The truth.
    points : (n, 3) float64
        Its point cloud, scene frame.
    own : (n,) bool
        Points returned by the building alone.
    face : (n,) int
        Roof face of each of them, -1 for walls.
    """
    local = points - points.mean(axis=0)
    in_mm = np.rint(local * 1000.0).astype(np.int64)
    kept, _ = unique_xy(in_mm[:, :2], in_mm[:, 2])
    facets = triangulate(np.ascontiguousarray(in_mm[kept, :2])).facets
    xyz = np.ascontiguousarray(local[kept])
    normals = facet_normals(xyz, facets)
    distances = o_distances_m(normals, xyz[facets[:, 0]])
    aspects = aspects_deg(normals)
    label = np.where(own[kept], face[kept], -1)[facets]
    spreads = []
    for number, (plane, polygon) in enumerate(zip(building.planes, building.roof_polygons(), strict=True)):
        mine = (label == number).all(axis=1)
        if mine.sum() < FEWEST_FACETS:
            continue
        spreads.append(
            FaceSpread(
                good=building.is_good,
                slope_deg=plane.slope_deg,
                area_m2=polygon.area,
                facets=int(mine.sum()),
                orientation_deg=spread_of_angles(aspects[mine]),
                orientation_two_thirds_deg=spread_of_angles(aspects[mine], 2 / 3),
                o_distance_m=inner_range(distances[mine]),
                o_distance_range_m=float(np.ptp(distances[mine])),
                o_distance_sd_m=float(np.std(distances[mine])),
            )
        )
    return spreads


def draw_statistics(seed: int) -> Drawn:
    """Scan one draw and measure it."""
    scene = hofmann310(seed)
    block = joined(list(recorded(scan(scene, SCANNER, seed), Returns.LAST)))
    xyz = block.points.xyz - np.array(scene.origin)
    tree = shapely.STRtree(shapely.points(xyz[:, :2]))
    faces: list[FaceSpread] = []
    pulses = []
    for number, building in enumerate(scene.buildings):
        outline = building.footprint
        near = np.sort(tree.query(outline.buffer(SURROUNDINGS_M, join_style="mitre"), predicate="intersects"))
        own = (block.building[near] == number) & ~block.mixed[near]
        pulses.append(int((block.building[near] == number).sum()))
        faces += face_spreads(building, xyz[near], own, block.face[near])
    hit = sum(bool({"strip_shift", "wrong_rows"} & set(building.defects)) for building in scene.buildings)
    x0, y0, x1, y1 = scene.extent
    return Drawn(
        spacing_m=float(np.sqrt((x1 - x0) * (y1 - y0) / len(xyz))),
        areas_m2=np.array([building.footprint.area for building in scene.buildings]),
        sides_m=np.array([min(one.dimensions.length_m, one.dimensions.width_m) for one in scene.buildings]),
        pulses=np.array(pulses, dtype=np.float64),
        nuisances=hit / len(scene.buildings),
        faces=tuple(faces),
    )


def rows(draws: Sequence[Drawn]) -> list[tuple[str, str, str]]:
    """The table: statistic, paper, here."""
    areas, pulses = np.concatenate([one.areas_m2 for one in draws]), np.concatenate([one.pulses for one in draws])
    faces = [face for one in draws for face in one.faces]
    good = [face for face in faces if face.good]
    flat = [face for face in faces if face.slope_deg < 1e-6]
    low = [face for face in faces if 1e-6 < face.slope_deg < LOW_SLOPE_DEG]
    typical = [
        face for face in good if face.slope_deg >= 25.0 and TYPICAL_AREA_M2[0] <= face.area_m2 <= TYPICAL_AREA_M2[1]
    ]

    def median(name: str, of: Sequence[FaceSpread]) -> float:
        return float(np.median([getattr(face, name) for face in of])) if of else float("nan")

    def middle(name: str, of: Sequence[FaceSpread], unit: str, digits: int) -> str:
        values = [getattr(face, name) for face in of]
        if not values:
            return "no such face"
        low_value, high_value = np.percentile(values, [10, 90])
        reported = f"{np.median(values):.{digits}f} {unit} ({low_value:.{digits}f} to {high_value:.{digits}f})"
        return f"{reported}, {len(values)} faces"

    def band(first: float, last: float) -> list[FaceSpread]:
        return [face for face in good if first <= face.slope_deg < last]

    narrow = float(np.mean([face.o_distance_sd_m < LARGEST_SD_M for face in faces]))
    return [
        ("buildings", "310", f"310 in each of {len(draws)} draws"),
        ("point spacing", "1.2 m", f"{np.mean([one.spacing_m for one in draws]):.2f} m"),
        ("footprint, mean", "about 160 m2", f"{areas.mean():.0f} m2"),
        (
            "footprint, median; smallest; largest",
            "-",
            f"{np.median(areas):.0f}; {areas.min():.0f}; {areas.max():.0f} m2",
        ),
        ("shortest side", "4 m can be detected", f"{min(one.sides_m.min() for one in draws):.1f} m"),
        (
            "returns on a building, median (5 % to 95 %)",
            "-",
            f"{np.median(pulses):.0f} ({np.percentile(pulses, 5):.0f} to {np.percentile(pulses, 95):.0f})",
        ),
        ("strip borders, wrong rows", "16 %", f"{np.mean([one.nuisances for one in draws]):.0%}"),
        (
            f"spread of orientation, sloping faces below {LOW_SLOPE_DEG:g} deg",
            "more than 70 deg",
            middle("orientation_deg", low, "deg", 0),
        ),
        ("the same, two thirds of the facets", "-", middle("orientation_two_thirds_deg", low, "deg", 0)),
        ("95 % again, 10 to 20 deg", "-", middle("orientation_deg", band(10.0, 20.0), "deg", 0)),
        ("the same, 25 to 35 deg", "-", middle("orientation_deg", band(25.0, 35.0), "deg", 0)),
        ("the same, 35 to 45 deg", "-", middle("orientation_deg", band(35.0, 45.0), "deg", 0)),
        ("spread of orientation, flat roofs", "more than 90 deg", middle("orientation_deg", flat, "deg", 0)),
        ("range of O-distance, typical roof face", "about 2 m", middle("o_distance_range_m", typical, "m", 2)),
        ("the same, 95 % of the facets", "-", middle("o_distance_m", typical, "m", 2)),
        ("the same, all good faces", "-", middle("o_distance_range_m", good, "m", 2)),
        (
            "standard deviation of O-distance",
            "below 1.3 m on roofs",
            f"{narrow:.1%} of all faces; median {median('o_distance_sd_m', faces):.2f} m",
        ),
    ]


def main(words: Sequence[str] | None = None) -> dict[str, Any]:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", default="test", choices=("dev", "test"))
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--json", action="store_true", help="print a JSON document in place of the table")
    given = parser.parse_args(words)
    draws = [draw_statistics(seed_of(given.split, draw)) for draw in range(given.draws)]
    table = rows(draws)
    document: dict[str, Any] = {name: {"paper": paper, "here": here} for name, paper, here in table}
    if given.json:
        print(json.dumps(document, indent=2))
    else:
        print(f"| statistic | paper | here ({given.split}, {given.draws} draws) |\n| --- | --- | --- |")
        for name, paper, here in table:
            print(f"| {name} | {paper} | {here} |")
    return document


if __name__ == "__main__":
    main()
