"""Objects that are easily taken for buildings, and buildings that are easily missed, without outlines or classes.

    python -m benchmarks.hard_objects --out DIR [--split dev|test] [--draws 3]

`bridges_and_vans` has no building: a bridge becomes one if models cover a fifth of its deck, a vehicle if they cover
half of it. `wide_halls` has eight halls across the edge of the data: one is found if models cover half of what lies
within the data.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import shapely

from benchmarks.entries import markdown_table, modelled
from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.simulation.bridges_and_vans import BRIDGES
from pipeline.ruler.simulation.dataset import simulate
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.ruler.simulation.suites import suite_named

DECK_SHARE = 0.2
"""A fifth of a deck is a house in the middle of the bridge."""
FOUND_SHARE = 0.5


def covered(suite: str, split: str, draw: int, out: Path) -> list[float]:
    """The share that models cover of each object within the data (boxes, else halls) of a scene."""
    plan, seed = suite_named(suite), seed_of(split, draw)
    scene, folder = plan.make(seed, plan.size_m), out / suite / f"{split}{draw}"
    if not (folder / "truth" / "scene.json").exists():
        simulate(suite, folder, seed)
    modelled(folder / f"{suite}.laz", folder / "run", meshes="none")
    outlines = shapely.union_all([model.footprint for model in read_models(folder / "run").models])
    halls = [one.footprint for one in scene.buildings if one.building_id.startswith("hall")]
    local = [shapely.Polygon(box.corners) for box in scene.boxes] or halls
    inside = [shapely.intersection(one, shapely.box(*scene.extent)) for one in local]
    moved = [shapely.transform(one, lambda xy: xy + scene.origin[:2]) for one in inside]
    return [shapely.intersection(one, outlines).area / one.area for one in moved]


def main(words: Sequence[str] | None = None) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--split", choices=("dev", "test"), default="dev")
    parser.add_argument("--draws", type=int, default=3)
    arguments = parser.parse_args(words)
    bridges: list[float] = []
    vans: list[float] = []
    halls: list[float] = []
    for draw in range(arguments.draws):
        shares = covered("bridges_and_vans", arguments.split, draw, arguments.out)
        bridges += shares[:BRIDGES]
        vans += shares[BRIDGES:]
        halls += covered("wide_halls", arguments.split, draw, arguments.out)
    rows = [
        [name, str(len(shares)), f"{np.mean(np.array(shares) >= least):.1%}"]
        for name, shares, least in (
            ("bridges", bridges, DECK_SHARE),
            ("vehicles", vans, FOUND_SHARE),
            ("halls at the edge", halls, FOUND_SHARE),
        )
    ]
    print(markdown_table(["objects", "number", "are buildings"], rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
