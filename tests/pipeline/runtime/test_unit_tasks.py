"""Units over tile borders: a row of houses in one candidate becomes the same candidates whatever the lattice."""

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import shapely
from examples import examples
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.errors import RunCancelledError
from pipeline.io.gps_time import GpsTimeKind
from pipeline.recipe import ReconstructSettings, reconstruct_building
from pipeline.roof.roof_settings import RoofSettings
from pipeline.runtime.scratch.folder import POINT, Scratch
from pipeline.runtime.stages.divided_units import UnitTask, divide, is_intact, shares_of
from pipeline.runtime.stages.gather import gather, points_of
from pipeline.runtime.stages.outline import outlined
from pipeline.runtime.stages.sites import CandidateSite, PointRange, largest_first, object_id
from pipeline.runtime.stages.stored_sites import SitesBrief
from pipeline.runtime.stages.window_points import NO_GROUND, NO_POINT
from pipeline.terrain.lattice import CELL_MM
from pipeline.terrain.terrain_settings import SceneSettings, UnitSettings
from pipeline.tiling import Tile, TileGrid

CRS = "EPSG:28992"
EAVES_M = (6.0, 7.0, 5.5, 6.4)


@pytest.fixture(scope="module")
def row() -> npt.NDArray[np.void]:
    """Points of four touching gable houses of 8 m by 10 m with steps between them, turned by 23 deg."""
    random = np.random.default_rng(4)
    along, across = random.uniform(0, 8 * len(EAVES_M), 2000), random.uniform(0, 10, 2000)
    z = np.array(EAVES_M)[(along // 8).astype(int)] + 0.8 * (5 - np.abs(across - 5)) + random.normal(0, 0.02, 2000)
    c, s = math.cos(math.radians(23.0)), math.sin(math.radians(23.0))
    points = np.zeros(2000, POINT)
    points["x"] = np.rint(1000 * (85_000 + c * along - s * across))
    points["y"] = np.rint(1000 * (447_500 + s * along + c * across))
    points["z"] = np.rint(1000 * z)
    points["gps_time"] = random.uniform(0, 1, 2000)
    points["return_number"] = points["return_count"] = 1
    return points


def stored(points: npt.NDArray[np.void], grid: TileGrid, root: Path, fragments: int) -> tuple[CandidateSite, Scratch]:
    """The points as one candidate, in some fragments a tile, as a split stores them."""
    scratch = Scratch(str(root))
    scratch.create()
    column, line = grid.columns_rows(points["x"], points["y"])
    tiles = sorted({grid.tile_of(x, y) for x, y in zip(points["x"].tolist(), points["y"].tolist(), strict=True)})
    cells = np.column_stack((points["x"], points["y"])) // CELL_MM
    corner = cells.min(axis=0) - 20
    occupied = np.zeros((cells.max(axis=0) + 20 - corner)[::-1], np.bool_)
    occupied[cells[:, 1] - corner[1], cells[:, 0] - corner[0]] = True
    off_mm = np.where(occupied, NO_GROUND, NO_POINT)
    level = {"corner": corner, "off": off_mm, "terrain": np.zeros(occupied.shape, np.int32)}
    ranges = []
    for tile in tiles:
        own = points[(column == tile.column) & (line == tile.row)]
        scratch.put_arrays(f"tiles/{tile.key}", {"points": own.view(np.uint8)})
        scratch.put_arrays(f"ground/{tile.key}", level)
        cuts = np.linspace(0, len(own), fragments + 1).astype(int).tolist()
        ranges += [PointRange(tile=tile, start=a, stop=b) for a, b in itertools.pairwise(cuts)]
    lowest = min(zip(points["x"].tolist(), points["y"].tolist(), points["z"].tolist(), strict=True))
    owner, name = grid.tile_of(lowest[0], lowest[1]), object_id(CRS, lowest)
    return CandidateSite(building_id=name, owner=owner, ranges=tuple(ranges), points=len(points)), scratch


def task_of(grid: TileGrid, scratch: Scratch, own: UnitSettings) -> UnitTask:
    """A task whose candidates are given to it."""
    return UnitTask(
        tile=Tile(0, 0),
        share=0,
        shares=1,
        split=None,
        borders=(),
        scene=SceneSettings(units=own),
        roof=RoofSettings(),
        outlines=True,
        grid=grid,
        scratch=scratch,
        crs_name=CRS,
        scale=1,
        folder="units/x0_y0/some",
    )


def divided(site: CandidateSite, grid: TileGrid, scratch: Scratch, own: UnitSettings) -> list[CandidateSite]:
    units, _ = divide([site], task_of(grid, scratch, own))
    drawn, warnings = outlined(largest_first(units), RoofSettings(), grid, scratch)
    assert warnings == []
    return drawn


ONE_TILE = TileGrid(size_mm=1_000_000, halo_mm=0)


Terrace = tuple[CandidateSite, Scratch, list[CandidateSite]]


@pytest.fixture
def terrace(row: npt.NDArray[np.void], tmp_path: Path) -> Terrace:
    """The row as one candidate in one tile, the scratch that holds it, and its units."""
    site, scratch = stored(row, ONE_TILE, tmp_path, 1)
    return site, scratch, divided(site, ONE_TILE, scratch, UnitSettings())


@settings(max_examples=examples(12), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    grid=st.builds(
        TileGrid,
        size_mm=st.integers(3_000, 40_000),
        halo_mm=st.just(0),
        origin_x_mm=st.integers(0, 20_000),
        origin_y_mm=st.integers(0, 20_000),
    ),
    fragments=st.integers(1, 3),
    seed=st.integers(0, 99),
)
def test_units_do_not_depend_on_tiles_fragments_and_order(
    grid: TileGrid, fragments: int, seed: int, row: npt.NDArray[np.void], tmp_path_factory: pytest.TempPathFactory
) -> None:
    whole, scratch = stored(row, ONE_TILE, tmp_path_factory.mktemp("whole"), 1)
    expected = {u.building_id: u for u in divided(whole, ONE_TILE, scratch, UnitSettings())}
    assert len(expected) == len(EAVES_M)
    points = {name: points_of(scratch, unit) for name, unit in expected.items()}
    mixed = row[np.random.default_rng(seed).permutation(len(row))]
    site, scratch = stored(mixed, grid, tmp_path_factory.mktemp("cut"), fragments)
    units = divided(site, grid, scratch, UnitSettings())
    assert {u.building_id for u in units} == set(expected)
    for unit in units:
        assert np.array_equal(points_of(scratch, unit), points[unit.building_id])
        assert unit.outline.equals_exact(expected[unit.building_id].outline, 0.0)


def test_touching_units_share_their_walls(terrace: Terrace) -> None:
    _, scratch, units = terrace
    parts = [unit.outline for unit in units]
    whole = shapely.union_all(parts)
    assert whole.geom_type == "Polygon"
    assert not whole.interiors
    assert abs(whole.area - sum(outline.area for outline in parts)) < 0.05
    assert abs(whole.area / (8 * len(EAVES_M) * 10) - 1) < 0.04
    for unit in units:
        candidate, _ = gather(scratch, ONE_TILE, unit, GpsTimeKind.NONE)
        model = reconstruct_building(candidate, "fuzzy-sart", ReconstructSettings())
        drawn = shapely.transform(model.footprint, lambda xy, origin=candidate.origin: xy + origin[:2])
        assert shapely.symmetric_difference(drawn, unit.outline).area < 0.1


def test_the_outline_is_part_of_what_a_model_is_made_of(terrace: Terrace) -> None:
    _, scratch, (unit, *_) = terrace
    _, facts = gather(scratch, ONE_TILE, unit, GpsTimeKind.NONE)
    _, alone = gather(scratch, ONE_TILE, dataclasses.replace(unit, outline=None), GpsTimeKind.NONE)
    assert facts.input_hash != alone.input_hash


def test_a_block_that_cannot_be_drawn_costs_only_its_outlines_and_is_reported(
    terrace: Terrace, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, scratch, units = terrace

    def broken(*_: object) -> None:
        raise ValueError("a ring of two corners")

    monkeypatch.setattr("pipeline.roof.unit_outlines.unit_outlines", broken)
    drawn, (warning,) = outlined(units, RoofSettings(), ONE_TILE, scratch)
    assert [unit.building_id for unit in drawn] == [unit.building_id for unit in units]
    assert {unit.outline for unit in drawn} == {None}
    assert warning.endswith("are drawn one by one: ValueError: a ring of two corners")
    assert all(unit.building_id in warning for unit in units)
    scratch.cancel()
    with pytest.raises(RunCancelledError):
        outlined(units, RoofSettings(), ONE_TILE, scratch)


def test_raw_outlines_are_drawn_together_too(terrace: Terrace) -> None:
    _, scratch, units = terrace
    alone = [dataclasses.replace(unit, outline=None) for unit in units]
    drawn, warnings = outlined(alone, RoofSettings(straight_eaves=False), ONE_TILE, scratch)
    assert warnings == []
    outlines = [unit.outline for unit in drawn]
    assert all(outlines)
    assert sum(shapely.intersection(a, b).area for a, b in itertools.combinations(outlines, 2)) < 1e-7


def test_units_keep_every_point_once_in_the_tile_that_holds_it(row: npt.NDArray[np.void], tmp_path: Path) -> None:
    grid = TileGrid(size_mm=7_000, halo_mm=0)
    site, scratch = stored(row, grid, tmp_path, 2)
    units = divided(site, grid, scratch, UnitSettings())
    assert sum(unit.points for unit in units) == len(row)
    for unit in units:
        points = points_of(scratch, unit)
        lowest = min(zip(points["x"].tolist(), points["y"].tolist(), points["z"].tolist(), strict=True))
        assert unit.points == len(points)
        assert unit.building_id == object_id(CRS, lowest)
        assert unit.owner == grid.tile_of(lowest[0], lowest[1])
        for part in unit.ranges:
            held = scratch.array(f"{part.folder}/{part.tile.key}", "points").view(POINT)[part.start : part.stop]
            assert len(held)
            assert grid.core(part.tile).contains(held["x"], held["y"]).all()


def test_a_candidate_of_one_unit_stays_as_it_is(terrace: Terrace) -> None:
    site, scratch, _ = terrace
    (whole,) = divided(site, ONE_TILE, scratch, UnitSettings(split="nothing"))
    assert dataclasses.replace(whole, reach_mm=None) == site
    points = points_of(scratch, site)
    assert whole.reach_mm is not None
    (x0, y0, x1, y1), x, y = whole.reach_mm, points["x"], points["y"]
    assert 1000 < x.min() - x0 == x1 - x.max() == y.min() - y0 == y1 - y.max() < 4000
    empty = CandidateSite(building_id="a", owner=site.owner, ranges=(), points=0)
    assert divided(empty, ONE_TILE, scratch, UnitSettings()) == [empty]


def test_shares_of_a_tile_have_about_as_many_points_and_each_candidate_once() -> None:
    def site(number: int, points: int) -> CandidateSite:
        return CandidateSite(building_id=str(number), owner=Tile(0, 0), ranges=(), points=points)

    random = np.random.default_rng(3)
    sites = largest_first(site(k, int(n)) for k, n in enumerate(random.integers(0, 9_000, 80)))
    shares = shares_of(sites, 3)
    assert sorted(one.building_id for share in shares for one in share) == sorted(one.building_id for one in sites)
    points = [sum(one.points for one in share) for share in shares]
    assert max(points) - min(points) <= max(one.points for one in sites)
    assert shares_of([], 2) == [[], []]


def test_points_of_units_that_were_damaged_are_noticed(row: npt.NDArray[np.void], tmp_path: Path) -> None:
    grid = TileGrid(size_mm=7_000, halo_mm=0)
    site, scratch = stored(row, grid, tmp_path, 2)
    task = task_of(grid, scratch, UnitSettings())
    _, checksums = divide([site], task)
    assert set(checksums) == {part.tile.key for part in site.ranges}
    brief = SitesBrief(groups=(), rejected=(), checksums=checksums)
    assert is_intact(task, brief, task.folder)
    for tile in checksums:
        file = next(scratch.path(task.folder, tile).glob("*"))
        content = file.read_bytes()
        file.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
        assert not is_intact(task, brief, task.folder)
        file.write_bytes(content)


# --- strips that do not fit


def of_two_strips(points: npt.NDArray[np.void], up_mm: int) -> npt.NDArray[np.void]:
    """The first house of the row, whose southern half a second strip saw, that lies higher."""
    c, s = math.cos(math.radians(23.0)), math.sin(math.radians(23.0))
    east, north = points["x"] / 1000 - 85_000, points["y"] / 1000 - 447_500
    along = c * east + s * north
    house = points[along < 8].copy()
    house["source"] = 7 + (along[along < 8] < 4)
    house["z"] += up_mm * (house["source"] == 8)
    return house


def test_strips_that_do_not_fit_are_aligned_and_do_not_divide_a_house(
    row: npt.NDArray[np.void], tmp_path: Path
) -> None:
    points = of_two_strips(row, 400)
    site, scratch = stored(points, ONE_TILE, tmp_path, 1)
    (unit,) = divided(site, ONE_TILE, scratch, UnitSettings())
    candidate, _ = gather(scratch, ONE_TILE, unit, GpsTimeKind.NONE, RoofSettings())
    assert candidate.strip_offset_m == pytest.approx(0.4, abs=0.04)
    result = reconstruct_building(candidate, "arrangement", ReconstructSettings())
    assert len(result.planes) == 2
    assert result.rmse_m < 0.05
    assert result.strip_offset_m == candidate.strip_offset_m


def test_a_step_within_one_strip_is_a_step(row: npt.NDArray[np.void], tmp_path: Path) -> None:
    points = of_two_strips(row, 400)
    points["source"] = 7
    site, scratch = stored(points, ONE_TILE, tmp_path, 1)
    assert len(divided(site, ONE_TILE, scratch, UnitSettings())) == 2
    candidate, _ = gather(scratch, ONE_TILE, site, GpsTimeKind.NONE, RoofSettings())
    assert math.isnan(candidate.strip_offset_m)
    assert np.ptp(candidate.points[:, 2]) == pytest.approx(np.ptp(points["z"]) / 1e3)


def test_aligned_strips_do_not_depend_on_tiles_and_fragments(row: npt.NDArray[np.void], tmp_path: Path) -> None:
    found = []
    for number, (grid, fragments) in enumerate(((ONE_TILE, 1), (ONE_TILE, 3), (TileGrid(size_mm=7_000, halo_mm=0), 2))):
        site, scratch = stored(of_two_strips(row, 400), grid, tmp_path / str(number), fragments)
        (unit,) = divided(site, grid, scratch, UnitSettings())
        found.append(gather(scratch, grid, unit, GpsTimeKind.NONE, RoofSettings())[0])
    for other in found[1:]:
        assert other.building_id == found[0].building_id
        assert np.array_equal(other.points, found[0].points)
        assert other.strip_offset_m == found[0].strip_offset_m
