"""Chimneys, roof units and dormers of simulated houses that models show, and boxes on clean roofs.

    python -m benchmarks.superstructures --out DIR [--split dev|test] [--draws 2] [--per-m2 20]

A draw is a scene of `pipeline/ruler/simulation/superstructures.py` and a part of the simulated city. A superstructure
is found if a face or a box of a model lies over its middle, within 0.1 m of its true top. A box that touches none is
invented; in the scene, a third of the clean roofs are under trees, a third under wires, and half carry aerials. IoU and
sides are of the boxes of chimneys alone.

DIR/SPLIT.json has a row per superstructure and per clean house. Scenes that are there already are not made again.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import shapely

from benchmarks.candidates import found_scene
from benchmarks.entries import markdown_table
from pipeline.model import BuildingResult, FaceKind
from pipeline.quality.residuals import surface_of
from pipeline.recipe import reconstruct_building
from pipeline.ruler.simulation.als import ScannerSettings
from pipeline.ruler.simulation.city import CITY_SCANNER, CityPlan
from pipeline.ruler.simulation.dataset import simulate
from pipeline.ruler.simulation.roof_dimensions import AdditionKind
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.ruler.simulation.simulated_scene import Scene
from pipeline.ruler.simulation.suites import Suite, suite_named
from pipeline.ruler.simulation.superstructures import (
    CHIMNEY_M,
    TrueSuperstructure,
    superstructures,
    true_superstructures,
)
from pipeline.settings import RunSettings

TOLERANCE_M = 0.1
"""Of the top."""
CITY_M = (400.0, 300.0)
NOISE_M = 0.02
"""Of the scene; the city has its own noise, and strips with shifts of their own."""
UNIT_M = 1.2
"""Chimneys are narrower."""
DORMERS_M = (0.7, 2.0)
"""Short sides of the dormers that count."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Judged:
    """A true superstructure, or a clean house."""

    scene: str
    kind: str
    """Chimney, unit, dormer, or one that is too small; `clean` for a clean house."""
    found: bool = False
    by_box: bool = False
    boxes: int = 0
    """Of a clean house."""
    iou: float = math.nan
    """With its box in plan."""
    wider_m: float = math.nan
    """Mean side of the box less the true one."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ShownBox:
    """A box of a model in the frame of a scene."""

    plan: shapely.Polygon
    top_z_m: float


def kind_of(one: TrueSuperstructure) -> str:
    """What a true superstructure counts as."""
    short = one.sides_m[0]
    if one.kind is not AdditionKind.BOX:
        return "dormers of 0.7 to 2 m" if DORMERS_M[0] <= short <= DORMERS_M[1] else "wider dormers"
    if short < CHIMNEY_M:
        return "narrower chimneys"
    return "chimneys of 0.6 m and more" if short <= UNIT_M else "roof units"


def shown_boxes(result: BuildingResult, scene: Scene) -> list[ShownBox]:
    """The boxes of a model."""
    shift = np.array(result.origin) - np.array(scene.origin)
    found = []
    for solid in result.boxes or ():
        top = next(face for face in solid.faces if face.kind is FaceKind.ROOF)
        corners = solid.vertices[list(top.rings[0])] + shift
        found.append(ShownBox(plan=shapely.Polygon(corners[:, :2]), top_z_m=float(corners[0, 2])))
    return found


def judged(results: Sequence[BuildingResult], scene: Scene) -> Iterator[Judged]:
    """All true superstructures and clean houses beside all models."""
    modelled = [result for result in results if result.solids]
    boxes = [box for result in modelled for box in shown_boxes(result, scene)]
    tree = shapely.STRtree([box.plan for box in boxes])
    surfaces = [
        (np.array(result.origin) - np.array(scene.origin), surface_of(result.faces, result.planes))
        for result in modelled
    ]
    outlines = shapely.STRtree(
        [
            shapely.transform(result.footprint, lambda xy, by=by: xy + by[:2])
            for result, (by, _) in zip(modelled, surfaces, strict=True)
        ]
    )
    used: set[int] = set()
    for one in true_superstructures(scene.buildings):
        middle = one.outline.centroid
        by_box, iou, wider = False, math.nan, math.nan
        for number in tree.query(one.outline, predicate="intersects").tolist():
            used.add(number)
            box = boxes[number]
            if box.plan.covers(middle) and abs(box.top_z_m - one.top_z_m) <= TOLERANCE_M:
                by_box = True
                iou = box.plan.intersection(one.outline).area / box.plan.union(one.outline).area
                wider = box.plan.length / 4 - one.outline.length / 4
        by_face = False
        for number in outlines.query(middle, predicate="within").tolist():
            by, surface = surfaces[number]
            z = surface.elevation(np.array([middle.x - by[0]]), np.array([middle.y - by[1]]))[0] + by[2]
            by_face = by_face or bool(abs(z - one.top_z_m) <= TOLERANCE_M)
        yield Judged(
            scene=scene.name, kind=kind_of(one), found=by_box or by_face, by_box=by_box, iou=iou, wider_m=wider
        )
    invented = [box.plan for number, box in enumerate(boxes) if number not in used]
    for house in scene.buildings:
        on_it = int(shapely.intersects(house.footprint, invented).sum()) if invented else 0
        if not house.dimensions.additions:
            yield Judged(scene=scene.name, kind="clean", boxes=on_it)
        elif on_it:
            yield Judged(scene=scene.name, kind="beside", boxes=on_it)


def suites(per_m2: float) -> dict[str, tuple[Suite, Callable[[int], Scene]]]:
    """The two kinds of scene, each with a function from a seed to its truth."""
    scanner = ScannerSettings(pulse_density_per_m2=per_m2, range_noise_m=NOISE_M)
    city = dataclasses.replace(
        suite_named("city"), scanner=dataclasses.replace(CITY_SCANNER, pulse_density_per_m2=per_m2), size_m=CITY_M
    )
    scene = Suite(
        name="superstructures",
        summary="houses with chimneys, roof units and dormers, and clean ones",
        make=lambda seed, _: superstructures(seed),
        scanner=scanner,
        size_m=(130.0, 480.0),
        is_sized=False,
    )
    return {
        "superstructures": (scene, superstructures),
        "city": (city, lambda seed: CityPlan(seed, CITY_M, city.scanner).part((0.0, 0.0, *CITY_M))),
    }


def measured(out: Path, split: str, draws: int, per_m2: float) -> list[Judged]:
    """Make, model and judge all scenes."""
    settings = RunSettings()
    building = settings.building
    building = dataclasses.replace(building, roof=dataclasses.replace(building.roof, superstructures=True))
    rows: list[Judged] = []
    for draw in range(draws):
        for name, (suite, truth) in suites(per_m2).items():
            folder, seed = out / f"{split}{draw}-{name}-{per_m2:g}", seed_of(split, draw)
            if not (folder / "truth" / "scene.json").exists():
                simulate(suite, folder, seed)
            tiles = sorted(str(tile) for tile in folder.rglob("*.laz"))
            candidates = found_scene(tiles, None, settings, None)
            results = [reconstruct_building(one, "arrangement", building) for one in candidates]
            rows += judged(results, truth(seed))
    return rows


def table(rows: Sequence[Judged]) -> str:
    """A line per scene and kind."""
    lines = []
    for scene, kind in dict.fromkeys((row.scene, row.kind) for row in rows):
        own = [row for row in rows if (row.scene, row.kind) == (scene, kind)]
        boxes = sum(row.boxes for row in own)
        if kind in ("clean", "beside"):
            lines.append([scene, kind, str(len(own)), "", "", f"{100 * boxes / len(own):.1f}", "", ""])
            continue
        ious, wider = [[x for row in own if not math.isnan(x := getattr(row, key))] for key in ("iou", "wider_m")]
        figures = [f"{sum(ious) / len(ious):.2f}", f"{sum(wider) / len(wider):+.2f}"] if ious else ["", ""]
        found, by_box = (sum(getattr(row, key) for row in own) / len(own) for key in ("found", "by_box"))
        lines.append([scene, kind, str(len(own)), f"{found:.3f}", f"{by_box:.3f}", "", *figures])
    heads = ["scene", "what", "number", "found", "by a box", "invented per 100", "IoU of boxes", "wider, m"]
    return markdown_table(heads, sorted(lines))


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--split", choices=("dev", "test"), default="dev")
    parser.add_argument("--draws", type=int, default=2)
    parser.add_argument("--per-m2", type=float, default=20.0, help="pulses per square metre of one strip")
    given = parser.parse_args()
    rows = measured(given.out.resolve(), given.split, given.draws, given.per_m2)
    (given.out / f"{given.split}.json").write_text(json.dumps(list(map(dataclasses.asdict, rows))), encoding="utf-8")
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
