"""How far tiles look: no farther than what is known of the points asks for, and the content stays the same."""

import math
from pathlib import Path
from typing import Any

import geopandas
import laspy
import numpy as np
import pytest
import shapely

from pipeline.errors import InputError
from pipeline.io import ReadOptions
from pipeline.runtime.run_plan import Plan, check_windows, make_plan, split_grid
from pipeline.runtime.stages import split
from pipeline.runtime.stages.split import Split, SplitTask, split_window
from pipeline.settings import RunSettings
from pipeline.terrain.terrain_settings import ClassesInUse, SceneSettings
from pipeline.tiling import MM, Tile, TileGrid

TRUSTED = ClassesInUse(ground=True, building=True)
NARROW: dict[str, Any] = {
    "outliers": {"cube_m": 1.0},
    "ground": {
        "max_window_m": 4,
        "trend_m": 4,
        "widest_m": 10,
        "regrowth_passes": 1,
        "regrowth_m": 1,
        "rejoin_passes": 1,
        "rejoin_m": 2,
        "bridge_m": 6,
        "embankment_m2": 0,
    },
    "surfaces": {"max_circumradius_m": 2.0},
    "vegetation": {"radius_m": 0.3, "company_m": 0.5},
}
"""Settings that look less far than the suburb is wide."""


@pytest.fixture(scope="module")
def classified(suburb: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The suburb with ground and buildings by height, and a strip without ground wider than terrain is drawn."""
    las = laspy.read(suburb)
    x, z = np.asarray(las.x), np.asarray(las.z)
    low = z < np.percentile(z, 60)
    las.classification = np.where(low, 2, 6).astype(np.uint8)
    strip = low & (np.abs(x - np.median(x)) < 9.0) & (np.random.default_rng(4).random(len(x)) < 0.995)
    las.classification[strip] = 1
    path = tmp_path_factory.mktemp("classified") / "classified.laz"
    las.write(path)
    return path


@pytest.fixture(scope="module")
def outlines(suburb: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Footprints all over the suburb, on roofs and off them."""
    las = laspy.read(suburb)
    x0, y0 = las.header.mins[:2]
    corners = [(x0 + 3 + i, y0 + 2 + j) for i in range(0, 55, 13) for j in (0, 20, 45)]
    boxes = [shapely.box(x, y, x + 9, y + 8) for x, y in corners]
    path = tmp_path_factory.mktemp("outlines") / "outlines.gpkg"
    geopandas.GeoDataFrame({"id": range(len(boxes))}, geometry=boxes, crs="EPSG:25832").to_file(path)
    return path


@pytest.fixture
def grids(monkeypatch: pytest.MonkeyPatch) -> list[TileGrid]:
    """Gets the lattices by which the runs of a test split their tiles."""
    seen: list[TileGrid] = []

    def watched(task: SplitTask, settings: SceneSettings) -> Split:
        seen.append(task.grid)
        return split_window(task, settings)

    monkeypatch.setattr(split, "split_window", watched)
    return seen


@pytest.mark.slow
@pytest.mark.parametrize("given", [False, True], ids=["found", "given"])
@pytest.mark.parametrize("trust", ["trust", "ignore"])
def test_narrow_windows_give_the_content_of_one_that_sees_everything(
    classified: Path, outlines: Path, reconstruct: Any, grids: list[TileGrid], trust: str, given: bool
) -> None:
    request = {"footprints": str(outlines)} if given else {}
    settings = NARROW | {"classes": trust}
    whole = reconstruct(classified, settings=settings | {"tile_size_m": 1000.0, "halo_m": 1000.0}, **request)
    assert whole.counts["candidates"] >= (12 if given else 3)
    assert {grid.halo_mm for grid in grids} == {1000 * MM}
    chosen = RunSettings.from_mapping(settings).scene
    support_m = chosen.split_support_m(footprints=given)
    for size in (11.0, 23.7):
        grids.clear()
        assert reconstruct(classified, settings=settings | {"tile_size_m": size}, **request).digest == whole.digest
        assert {grid.halo_mm for grid in grids} == {math.ceil(support_m * MM)}


@pytest.fixture
def plan(suburb: Path) -> Plan:
    """The plan of a suburb in tiles of 50 m."""
    return make_plan([str(suburb)], ReadOptions(), RunSettings.from_mapping({"tile_size_m": 50.0}))


def test_a_halo_of_the_user_stays(plan: Plan, suburb: Path) -> None:
    settings = RunSettings.from_mapping({"tile_size_m": 50.0, "halo_m": 300.0})
    own = make_plan([str(suburb)], ReadOptions(), settings)
    assert split_grid(own, settings, footprints=True).halo_mm == 300 * MM
    narrow = split_grid(plan, RunSettings(), footprints=True)
    assert narrow.halo_mm < plan.grid.halo_mm
    assert (narrow.size_mm, narrow.origin_x_mm) == (plan.grid.size_mm, plan.grid.origin_x_mm)


def test_the_memory_of_the_windows_that_are_used_is_counted(plan: Plan) -> None:
    points = {Tile(column, 0): 1_000_000 for column in range(11)}
    narrow = split_grid(plan, RunSettings(), footprints=True)
    limit = 500_000_000  # some two million points
    check_windows(plan, narrow, points, limit)
    with pytest.raises(InputError, match="and its halo hold about"):
        check_windows(plan, plan.grid, points, limit)
    with pytest.raises(InputError, match="tile x0_y0 and its halo hold about"):
        check_windows(plan, narrow, points, limit // 3)
