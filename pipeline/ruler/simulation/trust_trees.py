"""Stands of trees of many kinds, without any building: what dense crowns look like where no pulse goes through."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping

import numpy as np

from pipeline.model import FloatArray
from pipeline.ruler.simulation.simulated_scene import Scene, Terrain, Tree, turned, undulating_terrain
from pipeline.ruler.simulation.suburb import tree_at

Range = tuple[float, float]

ORIGIN = (570_000.0, 5_939_000.0, 0.0)
"""Of all scenes of the suite."""
_OUTSIDE_M = 6.0
"""Trees stand this far beyond the edge of the data, too."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StandRule:
    """How a stand is drawn. Ranges hold for single trees, unless stated."""

    places: Callable[[float, float, np.random.Generator], FloatArray]
    """Trunks (n, 2), from the side of the scene and a spacing, metres."""
    spacing_m: Range
    """Distance of neighbouring trunks, one for the whole stand."""
    radius_share: Range
    """Radius of a crown over the spacing."""
    height_m: Range
    """The mean height of the stand is drawn from it; single trees differ by a sixth of it."""
    free_path_share: Range
    """Mean depth that a beam sinks into a crown over its height, one for the whole stand."""
    lumps: int = 4
    """Smaller crowns on each crown, which make it rough."""
    tiers: int = 1
    """Crowns on top of each other: conifers."""


def spread(side_m: float, spacing_m: float, random: np.random.Generator) -> FloatArray:
    """Places (n, 2) all over a scene, about a spacing apart."""
    line = np.arange(-_OUTSIDE_M, side_m + _OUTSIDE_M, spacing_m)
    grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    grid[:, 0] += spacing_m / 2 * (np.rint(grid[:, 1] / spacing_m) % 2)
    return grid + random.uniform(-0.25, 0.25, grid.shape) * spacing_m


def _wood(side_m: float, spacing_m: float, random: np.random.Generator) -> FloatArray:
    """The places (n, 2) of `spread`, without those on a ride through the middle: some ground is seen."""
    places = spread(side_m, spacing_m, random)
    azimuth = float(random.uniform(0.0, math.pi))
    across = (places - side_m / 2) @ (math.cos(azimuth), -math.sin(azimuth))
    return places[np.abs(across) > spacing_m + float(random.uniform(1.0, 3.0))]


def _lines(side_m: float, spacing_m: float, random: np.random.Generator) -> FloatArray:
    """Places (n, 2) along a few parallel lines, which gaps divide."""
    azimuth, apart = float(random.uniform(0.0, 360.0)), float(random.uniform(10.0, 18.0))
    along = np.arange(-0.7 * side_m, 0.7 * side_m, spacing_m)
    rows = []
    for v in np.arange(-0.5 * side_m, 0.5 * side_m, apart):
        kept = along[(along / 25.0 + random.uniform(0.0, 1.0)) % 1.0 > 0.2]
        rows.append(np.column_stack([kept, np.full(len(kept), v)]))
    places = np.concatenate(rows) + random.uniform(-0.1, 0.1, (sum(map(len, rows)), 2)) * spacing_m
    return turned(places, side_m / 2, side_m / 2, azimuth)


def _orchard(side_m: float, spacing_m: float, random: np.random.Generator) -> FloatArray:
    """Places (n, 2) in a square lattice."""
    line = np.arange(-0.7 * side_m, 0.7 * side_m, spacing_m)
    grid = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    return turned(grid, side_m / 2, side_m / 2, float(random.uniform(0.0, 90.0)))


def _clumps(side_m: float, spacing_m: float, random: np.random.Generator) -> FloatArray:
    """Places (n, 2) in clumps of one to nine, well apart."""
    clumps = []
    for middle in spread(side_m, 18.0, random):
        count = int(random.integers(1, 10))
        turn, away = random.uniform(0.0, 2 * math.pi, count), spacing_m * np.sqrt(np.arange(count)) * 0.6
        clumps.append(middle + np.column_stack([away * np.cos(turn), away * np.sin(turn)]))
    return np.concatenate(clumps)


def _apart(side_m: float, spacing_m: float, random: np.random.Generator) -> FloatArray:
    """Two thirds of the places (n, 2) of `spread`."""
    places = spread(side_m, spacing_m, random)
    return places[random.random(len(places)) < 0.67]


STANDS: Mapping[str, StandRule] = {
    "broadleaf_forest": StandRule(
        places=_wood, spacing_m=(4.0, 7.0), radius_share=(0.6, 0.85), height_m=(12.0, 24.0),
        free_path_share=(0.06, 0.3),
    ),
    "conifer_forest": StandRule(
        places=_wood, spacing_m=(2.6, 4.5), radius_share=(0.45, 0.65), height_m=(8.0, 28.0),
        free_path_share=(0.08, 0.3), lumps=0, tiers=3,
    ),
    "young_forest": StandRule(
        places=_wood, spacing_m=(1.8, 3.0), radius_share=(0.6, 0.8), height_m=(3.0, 7.0),
        free_path_share=(0.03, 0.25), lumps=1,
    ),
    "tree_rows": StandRule(
        places=_lines, spacing_m=(4.0, 9.0), radius_share=(0.42, 0.65), height_m=(6.0, 18.0),
        free_path_share=(0.04, 0.25),
    ),
    "hedges": StandRule(
        places=_lines, spacing_m=(0.6, 1.0), radius_share=(0.9, 1.4), height_m=(1.4, 4.5),
        free_path_share=(0.01, 0.1), lumps=0,
    ),
    "orchard": StandRule(
        places=_orchard, spacing_m=(3.5, 6.0), radius_share=(0.3, 0.5), height_m=(2.5, 5.0),
        free_path_share=(0.05, 0.3), lumps=1,
    ),
    "single_trees": StandRule(
        places=_apart, spacing_m=(12.0, 20.0), radius_share=(0.12, 0.35), height_m=(4.0, 18.0),
        free_path_share=(0.02, 0.28), lumps=5,
    ),
    "opaque_tall": StandRule(
        places=_clumps, spacing_m=(3.5, 7.0), radius_share=(0.5, 0.9), height_m=(8.0, 20.0),
        free_path_share=(0.003, 0.03), lumps=3,
    ),
    "opaque_low": StandRule(
        places=_clumps, spacing_m=(2.0, 5.0), radius_share=(0.5, 0.9), height_m=(2.5, 6.0),
        free_path_share=(0.003, 0.03), lumps=1,
    ),
}  # fmt: skip
"""The stands by name."""


def grown(
    x: float,
    y: float,
    radius_m: float,
    height_m: float,
    terrain: Terrain,
    *,
    free_path_share: float,
    lumps: int,
    random: np.random.Generator,
) -> list[Tree]:
    """A tree whose crown carries smaller ones, all within its radius and a tenth above its height."""  # fmt: skip
    trunk = tree_at(x, y, radius_m, height_m, terrain, free_path_share)
    trees = [trunk]
    for _ in range(lumps):
        turn, away = float(random.uniform(0.0, 2 * math.pi)), radius_m * float(random.uniform(0.25, 0.6))
        share = float(random.uniform(0.3, 0.45))
        top = trunk.crown_half_height_m * math.sqrt(1.0 - (away / radius_m) ** 2) + 0.1 * height_m * random.random()
        trees.append(
            dataclasses.replace(
                trunk,
                x=x + away * math.cos(turn),
                y=y + away * math.sin(turn),
                crown_z_m=trunk.crown_z_m + float(top) - share * radius_m,
                crown_radius_m=share * radius_m,
                crown_half_height_m=share * radius_m,
            )
        )
    return trees


def _tiers(tree: Tree, count: int) -> list[Tree]:
    """A crown as crowns of one free path on top of each other, narrower towards the top."""
    half = tree.crown_half_height_m / count
    bottom = tree.crown_z_m - tree.crown_half_height_m
    return [
        dataclasses.replace(
            tree,
            crown_z_m=bottom + (2 * k + 1) * half,
            crown_half_height_m=1.25 * half,
            crown_radius_m=tree.crown_radius_m * (1.0 - k / (count + 0.5)),
        )
        for k in range(count)
    ]


def stand(rule: StandRule, random: np.random.Generator, side_m: float) -> Scene:
    """A square scene with a stand of trees and nothing else."""
    terrain = undulating_terrain(
        50.0, float(random.uniform(0.0, 8.0)), float(random.uniform(0, 360)), 0.6, 90.0, random
    )
    spacing, mean = float(random.uniform(*rule.spacing_m)), float(random.uniform(*rule.height_m))
    free_path = float(random.uniform(*rule.free_path_share))
    trees: list[Tree] = []
    for x, y in rule.places(side_m, spacing, random):
        radius, height = spacing * float(random.uniform(*rule.radius_share)), mean * float(random.uniform(5 / 6, 7 / 6))
        tree = grown(
            float(x), float(y), radius, height, terrain, free_path_share=free_path, lumps=rule.lumps, random=random
        )
        trees += _tiers(tree[0], rule.tiers) if rule.tiers > 1 else tree
    return Scene(
        name="trees",
        origin=ORIGIN,
        extent=(0.0, 0.0, side_m, side_m),
        terrain=terrain,
        trees=tuple(trees),
    )
