"""A tile from the points of its window alone: ground and split at once, where a run has stages."""

import dataclasses

import numpy as np

from pipeline.model import BoolArray, IntArray, LabelArray
from pipeline.scene import WindowPoints, lattice_of, split_tile, usable_as_ground
from pipeline.terrain.ground import Terrain, ground_of
from pipeline.terrain.outliers import dense_enough
from pipeline.terrain.surfaces import Fragments
from pipeline.terrain.terrain_settings import ClassesInUse, SceneSettings
from pipeline.tiling import Window


@dataclasses.dataclass(frozen=True, kw_only=True)
class WholeScene:
    """What is found in one window."""

    fragments: Fragments
    core_index: IntArray
    """Indices of the points that the core owns."""
    point_fragment: LabelArray
    """Their fragments."""
    terrain: Terrain
    outliers: int
    """Outliers in the core."""


def terrain_of(
    points: WindowPoints, window: Window, settings: SceneSettings, classes: ClassesInUse
) -> tuple[Terrain, BoolArray]:
    """Terrain of a window, and the mask of points that are not outliers.

    A run does the same in stages: outliers by tile, the ground by larger blocks.
    """
    kept = dense_enough(points.x_mm, points.y_mm, points.z_mm, settings.outliers)
    usable = usable_as_ground(points, kept, classes)
    window_cells = lattice_of(window)
    trusted = classes.ground
    terrain = ground_of(points.x_mm, points.y_mm, points.z_mm, usable, window_cells, settings.ground, trusted=trusted)
    return terrain, kept


def split_alone(
    points: WindowPoints, core: Window, window: Window, settings: SceneSettings, classes: ClassesInUse
) -> WholeScene:
    """Split the core of a tile; the window reaches `seen_m` beyond it."""
    terrain, kept = terrain_of(points, window, settings, classes)
    index = np.flatnonzero(kept)
    found = split_tile(points.take(index), core, terrain, settings, classes)
    return WholeScene(
        fragments=found.fragments,
        core_index=index[found.core_index],
        point_fragment=found.point_fragment,
        terrain=terrain,
        outliers=int((core.contains(points.x_mm, points.y_mm) & ~kept).sum()),
    )


def seen_m(settings: SceneSettings, classes: ClassesInUse) -> float:
    """How far all steps together look beyond the core."""
    return settings.outliers.support_m + settings.ground_support_m(classes) + settings.terrain_m(footprints=False)
