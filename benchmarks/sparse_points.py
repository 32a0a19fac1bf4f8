"""Fits the weights of `pipeline/terrain/sparse_points.py`, and scores them on places that they were not fitted on.

    python -m benchmarks.sparse_points [--data ../shared/data]

The points are those above the ground of the western half of `sparse_0382`, of `forest_0906`, and of the tiles of
`benchmarks/unseen.py` thinned to 0.2, 0.3, 0.5, 0.7, 1, 1.5 and 2 points/m2; the truth is class 6. The table leaves one
place out at a time: a tile at all its densities, or a quarter of the two others from west to east. The last lines are
the weights from all places, to be copied into that module.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import laspy
import numpy as np

from benchmarks.entries import markdown_table
from benchmarks.ground import DATA
from benchmarks.unseen import FOREST, SPARSE, TILES, ClassScore, half_of, judged_points, thinned_to
from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.scene import BUILDING_CLASS, WindowPoints, split_tile, terrain_of
from pipeline.settings import RunSettings
from pipeline.terrain.candidates import Surfaces, judge_surfaces, unite_levels
from pipeline.terrain.ground import ground_points
from pipeline.terrain.lattice import NO_DATA, height_above
from pipeline.terrain.scene_settings import ClassesInUse
from pipeline.terrain.sparse_points import PRODUCTS, Role, Sign, SparsePoints, terms_of
from pipeline.tiling import Window

DENSITIES = (0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0)
RIDGE = 1.0
"""Penalty of squared weights of standardised terms: as much as one point says."""
NEWTON_STEPS = 12
"""Enough for six digits."""
SHARE_OF_SPARSE, SHARE_OF_FOREST, SHARE_OF_LARGE, SHARE_OF_SMALL = 2.5, 0.5, 0.8, 1.5
"""Weight of a point in the one real sparse survey with buildings, in the forest, in `delft_west`, which holds most
thinned points, and in the other tiles."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Place:
    """The points above the ground of a tile."""

    name: str
    place: str
    """Places of the same name are left out together."""
    terms: FloatArray
    """(n, T)."""
    true: BoolArray
    judged: BoolArray
    x: IntArray
    weight: float
    lost: int
    """Points of class 6 that count as ground or noise."""


def without_duplicates(las: laspy.LasData) -> laspy.LasData:
    """One of the points that share a place and a return number."""
    places = np.column_stack((np.rint(np.asarray(las.xyz) * 1000).astype(np.int64), np.asarray(las.return_number)))
    las.points = las.points[np.sort(np.unique(places, axis=0, return_index=True)[1])]
    return las


def window_points(las: laspy.LasData) -> WindowPoints:
    """The points of a file."""
    x, y, z = (np.rint(np.asarray(a) * 1000).astype(np.int64) for a in (las.x, las.y, las.z))
    number, count = (np.asarray(a).astype(np.uint8) for a in (las.return_number, las.number_of_returns))
    own = np.asarray(las.classification).astype(np.uint8)
    return WindowPoints(x_mm=x, y_mm=y, z_mm=z, return_number=number, return_count=count, classification=own)


def scene_of(points: WindowPoints) -> SparsePoints:
    """The points with their heights and roles, as the classes are found with default settings in one tile."""
    settings, classes = RunSettings.from_mapping({"classes": "ignore"}).scene, ClassesInUse()
    x, y, z = points.x_mm, points.y_mm, points.z_mm
    core = Window(x0_mm=int(x.min()), y0_mm=int(y.min()), x1_mm=int(x.max()) + 1, y1_mm=int(y.max()) + 1)
    terrain, kept = terrain_of(points, core, settings, classes)
    index = np.flatnonzero(kept)
    found = split_tile(points.take(index), core, terrain, settings, classes)
    parts = found.fragments
    surfaces = Surfaces(
        kind=parts.kind, sums=parts.sums, boxes_mm=parts.boxes_mm, lowest_point_mm=parts.lowest_point_mm,
        along_steps=np.unique(parts.along_steps[:, :2], axis=0),
    )  # fmt: skip
    leader = unite_levels(surfaces, judge_surfaces(surfaces, settings.candidates), settings.candidates)
    role = np.full(len(x), Role.OTHER, np.int8)
    held = found.point_fragment >= 0
    role[index[found.core_index[held]]] = np.where(leader[found.point_fragment[held]] >= 0, Role.HELD, Role.OTHER)
    height = height_above(x, y, z, terrain.elevation_mm, terrain.column0, terrain.row0)
    ground = ground_points(x, y, z, terrain, settings.ground)
    role[ground] = Role.GROUND
    role[~kept & ~ground] = Role.NOISE
    height[height == NO_DATA] = 0
    return SparsePoints(x_mm=x, y_mm=y, z_mm=z, height_mm=height, role=role, several=points.return_count > 1)


def sources(data: Path) -> Iterator[tuple[str, str, float, laspy.LasData]]:
    """Name, place, weight of a point, and points of all places at all densities."""
    yield "sparse_0382, western half", "sparse_0382", SHARE_OF_SPARSE, half_of(laspy.read(data / SPARSE), eastern=False)
    yield "forest_0906", "forest_0906", SHARE_OF_FOREST, laspy.read(data / FOREST)
    for tile in TILES:
        large = tile.name == "delft_west"
        for per_m2 in DENSITIES[:-3] if large else DENSITIES:
            las = thinned_to(per_m2)(laspy.read(data / tile.file))
            yield f"{tile.name}, {per_m2:g} per m2", tile.name, SHARE_OF_LARGE if large else SHARE_OF_SMALL, las


def places(data: Path) -> Iterator[Place]:
    """The points above the ground of all places."""
    for name, place, weight, read in sources(data):
        las = without_duplicates(read)
        judged, true = judged_points(place, las), np.asarray(las.classification) == BUILDING_CLASS
        scene = scene_of(window_points(las))
        above = scene.role >= Role.OTHER
        terms = terms_of(scene, above)
        yield Place(
            name=name, place=place, terms=terms[above], true=true[above], judged=judged[above],
            x=scene.x_mm[above], weight=weight, lost=int((true & judged & ~above).sum()),
        )  # fmt: skip


def fitted(terms: FloatArray, true: BoolArray, weights: FloatArray) -> FloatArray:
    """Intercept and weights (1 + T,) of the ridge logistic regression, by Newton's method."""
    mean, spread = terms.mean(axis=0), terms.std(axis=0) + 1e-9
    columns = np.column_stack((np.ones(len(terms)), (terms - mean) / spread))
    penalty = np.full(columns.shape[1], RIDGE)
    penalty[0] = 0.0
    found = np.zeros(columns.shape[1])
    for _ in range(NEWTON_STEPS):
        chance = 1.0 / (1.0 + np.exp(-(columns @ found)))
        curvature = (columns * (weights * chance * (1.0 - chance))[:, None]).T @ columns + np.diag(penalty)
        found = found + np.linalg.solve(curvature, columns.T @ (weights * (true - chance)) - penalty * found)
    slopes = found[1:] / spread
    return np.concatenate(([found[0] - float(slopes @ mean)], slopes))


def folds(everything: Sequence[Place]) -> list[list[BoolArray]]:
    """For each fold, the points that it leaves out, place by place."""
    out = []
    for name in dict.fromkeys(place.place for place in everything):
        own = [np.full(len(place.true), place.place == name) for place in everything]
        thinned = sum(place.place == name for place in everything) > 1
        if thinned:
            out.append(own)
            continue
        for quarter in range(4):
            parts = []
            for place, mine in zip(everything, own, strict=True):
                east = np.searchsorted(np.quantile(place.x, (0.25, 0.5, 0.75)), place.x)
                parts.append(mine & (east == quarter))
            out.append(parts)
    return out


def fitted_on(everything: Sequence[Place], left_out: Sequence[BoolArray] | None) -> FloatArray:
    """The weights from all judged points that are not left out."""
    used = [
        place.judged if left_out is None else place.judged & ~out
        for place, out in zip(everything, left_out or [place.judged for place in everything], strict=True)
    ]
    return fitted(
        np.concatenate([place.terms[own] for place, own in zip(everything, used, strict=True)]),
        np.concatenate([place.true[own] for place, own in zip(everything, used, strict=True)]),
        np.concatenate([np.full(int(own.sum()), place.weight) for place, own in zip(everything, used, strict=True)]),
    )


def logits_from_elsewhere(everything: Sequence[Place]) -> list[FloatArray]:
    """Logits of the points of each place, by weights from other places."""
    out = [np.zeros(len(place.true)) for place in everything]
    for left_out in folds(everything):
        weights = fitted_on(everything, left_out)
        for place, own, found in zip(everything, left_out, out, strict=True):
            found[own] = weights[0] + place.terms[own] @ weights[1:]
    return out


def score_of(place: Place, logits: FloatArray) -> ClassScore:
    """Class 6 of a place."""
    found = logits > 0.0
    return ClassScore(
        right=int((found & place.true & place.judged).sum()),
        said=int((found & place.judged).sum()),
        true=int((place.true & place.judged).sum()) + place.lost,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Score and fit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA)
    given = parser.parse_args(arguments)
    everything = list(places(given.data))
    rows = []
    for place, logits in zip(everything, logits_from_elsewhere(everything), strict=True):
        score = score_of(place, logits)
        rows.append([*score.row(place.name), str(score.said)])
    print(markdown_table(["tile", "points of class 6", "IoU", "recall", "precision", "found"], rows))
    weights = fitted_on(everything, None).tolist()
    print(f"    {weights[0]:.3f},  # where all terms are zero")
    names = [sign.name for sign in Sign] + [f"{one.name} {other.name}" for one, other in PRODUCTS]
    for name, weight in zip(names, weights[1:], strict=True):
        print(f"    {weight:.3f},  # {name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
