"""The hierarchical ground filter within the scene: the buildings are found, and tiles change nothing."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from whole_scene import seen_m, split_alone, terrain_of

from pipeline.scene import WindowPoints, lattice_of
from pipeline.settings import RunSettings
from pipeline.terrain.lattice import NO_DATA, height_above
from pipeline.terrain.terrain_settings import (
    ClassesInUse,
    GroundSettings,
    OutlierSettings,
    SceneSettings,
    SurfaceSettings,
    VegetationSettings,
)
from pipeline.tiling import Tile, TileGrid, Window

GROUND = 2
WHOLE = Window(x0_mm=0, y0_mm=0, x1_mm=110_000, y1_mm=110_000)
HIERARCHICAL = SceneSettings(ground=GroundSettings(filter="hierarchical"))

NARROW = SceneSettings(
    outliers=OutlierSettings(cube_m=1.0),
    ground=GroundSettings(
        filter="hierarchical", seed_cell_m=8, level_ratio=8, passes=1, min_reach_m=3, bridge_m=5, clump_m=1
    ),
    vegetation=VegetationSettings(radius_m=0.5),
    surfaces=SurfaceSettings(max_circumradius_m=4.0),
)
"""Settings that look less far than the town is wide, so that the windows of its tiles do not all see the whole town."""


def inside(points: WindowPoints, window: Window) -> WindowPoints:
    return points.take(np.flatnonzero(window.contains(points.x_mm, points.y_mm)))


def test_the_ground_of_a_town_does_not_include_its_roofs(town: Any) -> None:
    points = town.points
    terrain, kept = terrain_of(points, WHOLE, HIERARCHICAL, ClassesInUse())
    height = height_above(points.x_mm, points.y_mm, points.z_mm, terrain.elevation_mm, 0, 0)
    found = kept & (height != NO_DATA) & (height < 500)
    assert found[town.truth == GROUND].mean() > 0.99
    assert found[town.truth != GROUND].mean() < 0.01


def test_trusted_classes_need_no_filter(town: Any) -> None:
    classes = ClassesInUse(ground=True, building=True)
    ground = dataclasses.replace(HIERARCHICAL.ground, filter="morphological", bridge_m=32)
    other, _ = terrain_of(town.points, WHOLE, dataclasses.replace(HIERARCHICAL, ground=ground), classes)
    terrain, _ = terrain_of(town.points, WHOLE, HIERARCHICAL, classes)
    np.testing.assert_array_equal(terrain.elevation_mm, other.elevation_mm)


@pytest.mark.parametrize(
    ("size_mm", "shift"), [(37_000, (0, 0)), (52_300, (-11_111, 7_777)), (110_000, (-40_500, 123))]
)
def test_tiles_change_neither_terrain_nor_fragments(town: Any, size_mm: int, shift: tuple[int, int]) -> None:
    points = town.points
    support_m = seen_m(NARROW, ClassesInUse())
    assert support_m < 80
    grid = TileGrid(size_mm=size_mm, halo_mm=math.ceil(1000 * support_m), origin_x_mm=shift[0], origin_y_mm=shift[1])
    whole = split_alone(points, WHOLE, WHOLE, NARROW, ClassesInUse())
    on_fragment = np.zeros(len(points), np.bool_)
    on_fragment[whole.core_index] = whole.point_fragment >= 0
    seen, cut_windows = 0, 0
    for tile in grid.tiles_over(WHOLE):
        assert isinstance(tile, Tile)
        window, core = grid.window(tile), grid.core(tile)
        index = np.flatnonzero(window.contains(points.x_mm, points.y_mm))
        part = split_alone(points.take(index), core, window, NARROW, ClassesInUse())
        cut_windows += len(index) < len(points)
        column0, row0, columns, rows = lattice_of(
            Window(
                x0_mm=max(core.x0_mm, 0),
                y0_mm=max(core.y0_mm, 0),
                x1_mm=min(core.x1_mm, 110_000),
                y1_mm=min(core.y1_mm, 110_000),
            )
        )
        local = slice(row0 - part.terrain.row0, row0 - part.terrain.row0 + rows)
        along = slice(column0 - part.terrain.column0, column0 - part.terrain.column0 + columns)
        np.testing.assert_array_equal(
            part.terrain.elevation_mm[local, along],
            whole.terrain.elevation_mm[row0 : row0 + rows, column0 : column0 + columns],
        )
        mine = index[part.core_index]
        np.testing.assert_array_equal(part.point_fragment >= 0, on_fragment[mine])
        seen += len(mine)
    assert seen == len(whole.core_index)
    assert cut_windows > 0


def test_the_filter_is_a_setting_of_the_ground_and_decides_how_far_it_looks() -> None:
    settings = RunSettings.from_mapping({"ground": {"filter": "hierarchical"}})
    assert settings.scene.ground.filter == "hierarchical"
    assert settings.scene.ground_support_m(ClassesInUse()) != GroundSettings().support_m
    assert settings.halo_m == RunSettings().halo_m
    assert settings.settings_hash != RunSettings().settings_hash
