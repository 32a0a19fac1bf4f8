"""Low small buildings in given outlines: how many get a model, and how near their roof points lie to it.

    python -m benchmarks.low_buildings --out DIR [--split dev|test] [--draws 2] [--classes ignore]

The suite `low_buildings` at 5, 10 and 15 pulses per m2: 7 to 25 m2, roofs 0.5 to 2.5 m above ground, with the true
outlines. With `--classes trust`, the default, the points have their true classes. Delivered is a building with a model
of LoD2.2. A roof point hits a roof face and lies inside its outline; one without a model is a miss. Houses beside the
low buildings are modelled too, but not counted.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely

from benchmarks.candidates import found_scene
from benchmarks.entries import markdown_table
from pipeline.model import BuildingResult, Status
from pipeline.quality.residuals import vertical_residuals
from pipeline.quality.validity import check_solid
from pipeline.recipe import reconstruct_building
from pipeline.ruler.evaluation.reference import Reference
from pipeline.ruler.evaluation.reference_truth import read_truth_reference
from pipeline.ruler.simulation.dataset import Output, simulate
from pipeline.ruler.simulation.low_buildings import CELLS
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.settings import RunSettings

TOLERANCE_M = 0.2


@dataclasses.dataclass(frozen=True, kw_only=True)
class LowScore:
    """The figures of the low buildings of some surveys."""

    buildings: int
    delivered: int
    """With a model of LoD2.2."""
    blocks: int
    invalid: int
    """Models with a solid that our checker rejects."""
    points: int
    """Roof points."""
    within: int
    """Of these, within 0.2 m of the model, vertically."""
    shares: tuple[float, ...]
    """The same share of each building."""

    def row(self, name: str) -> list[str]:
        """A row of the table."""
        return [
            name,
            str(self.buildings),
            f"{self.delivered / self.buildings:.1%}",
            str(self.blocks),
            str(self.invalid),
            f"{self.within / self.points:.3f}",
            f"{np.median(self.shares):.3f}",
            f"{np.mean(np.array(self.shares) >= 0.5):.1%}",
        ]


def roof_points(reference: Reference) -> list[np.ndarray]:
    """The roof points (n, 3) of every building of a reference, inside its outline."""
    found: list[list[np.ndarray]] = [[] for _ in reference.buildings]
    for tile in reference.points():
        on_roof = np.flatnonzero((tile.building >= 0) & tile.is_roof)
        for number in np.unique(tile.building[on_roof]).tolist():
            found[number].append(tile.xyz[on_roof[tile.building[on_roof] == number]])
    return [np.concatenate(parts) if parts else np.zeros((0, 3)) for parts in found]


def scored(results: Sequence[BuildingResult], reference: Reference) -> LowScore:
    """Compare models with the low buildings of a reference; both have the same outlines."""
    points = roof_points(reference)
    models = {one.source_id: one for one in results}
    delivered = blocks = invalid = within = total = 0
    shares = []
    for building, xyz in zip(reference.buildings, points, strict=True):
        if not building.building_id.startswith("low"):
            continue
        model = models.get(building.building_id)
        share = 0.0
        total += len(xyz)
        if model is not None and model.solids:
            near = np.abs(vertical_residuals(xyz - model.origin, model.faces, model.planes)) <= TOLERANCE_M
            within += int(near.sum())
            share = float(near.mean()) if len(xyz) else 0.0
            delivered += model.status.has_roof and model.lod == "2.2"
            blocks += model.status is Status.FALLBACK
            invalid += any(check_solid(solid) for solid in model.solids)
        shares.append(share)
    return LowScore(
        buildings=len(shares),
        delivered=delivered,
        blocks=blocks,
        invalid=invalid,
        points=total,
        within=within,
        shares=tuple(shares),
    )


def together(scores: Sequence[LowScore]) -> LowScore:
    """The figures of several surveys as one."""
    sums = {
        name: sum(getattr(score, name) for score in scores)
        for name in ("buildings", "delivered", "blocks", "invalid", "points", "within")
    }
    return LowScore(**sums, shares=tuple(share for score in scores for share in score.shares))


def measure(folder: Path, classes: str) -> LowScore:
    """Model one survey with its true outlines."""
    reference = read_truth_reference(folder / "truth")
    outlines = folder / "outlines.geojson"
    features = [
        {"type": "Feature", "properties": {"id": one.building_id}, "geometry": shapely.geometry.mapping(one.footprint)}
        for one in reference.buildings
    ]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    outlines.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}), encoding="utf-8")
    settings = RunSettings.from_mapping({"classes": classes})
    found = found_scene([str(folder / "low_buildings.laz")], None, settings, str(outlines))
    results = [reconstruct_building(one, settings.general.method, settings.building) for one in found.candidates]
    return scored(results, reference)


def main(words: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--split", choices=("dev", "test"), default="dev")
    parser.add_argument("--draws", type=int, default=2)
    parser.add_argument("--classes", choices=("trust", "ignore"), default="trust")
    arguments = parser.parse_args(words)
    rows, every = [], []
    scores: dict[str, list[LowScore]] = {cell.key: [] for cell in CELLS}
    for draw in range(arguments.draws):
        place = arguments.out / f"{arguments.split}{draw}"
        if not (place / "sweep.json").exists():
            simulate("low_buildings", place, seed_of(arguments.split, draw), output=Output(with_classes=True))
        for cell in CELLS:
            scores[cell.key].append(measure(place / cell.key, arguments.classes))
    for key, some in scores.items():
        rows.append(together(some).row(key))
        every += some
    rows.append(together(every).row("all"))
    heads = ["survey", "buildings", "delivered", "blocks", "invalid", "points within 0.2 m", "median", "half within"]
    print(markdown_table(heads, rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
