"""Candidates that touch, end to end: their outlines are disjoint, whichever tiles hold them."""

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from plain_houses import Houses, write_houses
from run_tables import rows

from pipeline.runtime.run import RunSummary
from pipeline.runtime.stages import touching
from pipeline.runtime.stages.sites import CandidateSite, near_pairs
from pipeline.runtime.stages.stored_sites import SitesBrief, may_touch
from pipeline.runtime.stages.touching import _Extents, _or_warned
from pipeline.tiling import Tile

SHEDS = (((12.0, 12.0, 24.0, 20.0), 60.0), ((23.7, 13.0, 32.0, 19.0), 54.0), ((14.0, 19.7, 22.0, 27.0), 55.5))
"""Boxes and elevations of flat roofs; two are seen beneath the eaves of a much higher one. None touches the fourth."""
ALONE = ((48.0, 48.0, 58.0, 56.0), 57.0)
NOTHING_M2 = 1e-7
"""Coordinates in metres are rounded, so a smaller area does not count."""
TRUSTED = {"classes": "trust"}


@pytest.fixture
def sheds(tmp_path: Path) -> Path:
    """The sheds on level ground, classes set."""
    random = np.random.default_rng(11)
    x, y = random.uniform(0.0, 70.0, (2, 29_400))
    z, house = np.full(len(x), 50.0), np.full(len(x), -1, np.int8)
    for k, ((x0, y0, x1, y1), top) in enumerate((*SHEDS, ALONE)):
        inside = (x >= x0) & (x < x1) & (y >= y0) & (y < y1) & ((house < 0) | (random.random(len(x)) < 0.5))
        z[inside], house[inside] = top, k
    z += random.normal(0.0, 0.02, len(x))
    found = Houses(xyz=np.column_stack((x + 400_000.0, y + 5_700_000.0, z)), house=house)
    return write_houses(tmp_path / "sheds.laz", found, classes=np.where(house < 0, 2, 6))


@pytest.fixture
def town(tmp_path: Path) -> Path:
    """Two rows of gables, back to back, of different heights and depths, and sheds before them, all turned."""
    random = np.random.default_rng(23)
    x, y = random.uniform(0.0, 60.0, (2, 25_200))
    z, house = np.full(len(x), 50.0), np.full(len(x), -1, np.int8)
    for k in range(10):
        x0, deep = 14.0 + 6.3 * (k % 5), random.uniform(7.0, 10.0)
        y0, y1 = (30.0 - deep, 30.0) if k < 5 else (30.0, 30.0 + deep)
        inside = (x >= x0) & (x < x0 + 6.3) & (y >= y0) & (y < y1)
        z[inside] = 57.0 + 2.5 * ((k + k // 5) % 3) - 0.7 * np.abs(y[inside] - 0.5 * (y0 + y1))
        house[inside] = k
        shed = (x >= x0 + 1.0) & (x < x0 + 5.0) & (np.abs(y - 30.0) < deep + 3.1) & (np.abs(y - 30.0) >= deep)
        shed &= (y < 30.0) if k < 5 else (y > 30.0)
        z[shed], house[shed] = 52.6 + 0.2 * k, 10 + k
    z += random.normal(0.0, 0.02, len(x))
    turn = np.exp(0.37j) * (x + 1j * y)
    found = Houses(xyz=np.column_stack((turn.real + 400_000.0, turn.imag + 5_700_000.0, z)), house=house)
    return write_houses(tmp_path / "town.laz", found, classes=np.where(house < 0, 2, 6))


def overlaps_m2(run_dir: str) -> list[float]:
    """The overlap of each pair of outlines."""
    outlines = [shapely.force_2d(shapely.from_wkb(row["geometry"])) for row in rows(run_dir)]
    return [shapely.intersection(*pair).area for pair in itertools.combinations(outlines, 2)]


def test_sheds_that_touch_have_disjoint_outlines_in_any_tiles(
    sheds: Path, reconstruct: Callable[..., RunSummary]
) -> None:
    whole = reconstruct(sheds, settings={**TRUSTED, "tile_size_m": 1000.0})
    assert whole.statuses["ok"] == 4
    assert max(overlaps_m2(whole.run_dir)) < NOTHING_M2
    # borders of tiles between the sheds and through them
    for size_m, shift_m in ((30.0, 24.1), (24.0, 0.0), (41.5, 20.2)):
        tiles = {"tile_size_m": size_m, "lattice_x_m": shift_m, "lattice_y_m": shift_m}
        assert reconstruct(sheds, settings={**TRUSTED, **tiles}).digest == whole.digest


@pytest.mark.parametrize(("seen_m", "touch"), [(3.0, True), (0.0, False), (None, False)])
def test_a_slit_is_closed_where_something_but_no_ground_was_seen_in_it(
    seen_m: float | None, touch: bool, tmp_path: Path, reconstruct: Callable[..., RunSummary]
) -> None:
    """Two houses half a metre apart; points in the slit lie so high above the ground, or there are none."""
    random = np.random.default_rng(5)
    x, y = random.uniform(0.0, 50.0, (2, 20_000))
    z, kind = np.full(len(x), 50.0), np.full(len(x), 2, np.uint8)
    for x0, y0, x1, y1, top in ((12.0, 12.0, 22.0, 20.0, 60.0), (22.9, 14.0, 30.0, 24.0, 56.0)):
        inside = (x > x0) & (x < x1) & (y > y0) & (y < y1)
        z[inside], kind[inside] = top, 6
    slit = (x >= 22.0) & (x <= 22.9) & (y > 14.0) & (y < 20.0)
    z[slit], kind[slit] = 50.0 + (seen_m or 0.0), 2 if seen_m == 0.0 else 1
    keep = ~slit if seen_m is None else np.ones(len(x), np.bool_)
    z += random.normal(0.0, 0.02, len(x))
    found = Houses(xyz=np.column_stack((x + 4e5, y + 5.7e6, z))[keep], house=np.zeros(np.count_nonzero(keep), np.int8))
    cloud = write_houses(tmp_path / "slit.laz", found, classes=kind[keep])
    whole = reconstruct(cloud, settings={**TRUSTED, "tile_size_m": 1000.0})
    outlines = [shapely.force_2d(shapely.from_wkb(row["geometry"])) for row in rows(whole.run_dir)]
    assert len(outlines) == 2
    assert (shapely.distance(*outlines) < 0.002) == touch
    beside = shapely.box(4e5 + 22.4, 5.7e6 + 20.5, 4e5 + 22.5, 5.7e6 + 23.5)
    assert not any(outline.intersects(beside) for outline in outlines)
    assert shapely.intersection(*outlines).area < NOTHING_M2
    tiles = {"tile_size_m": 24.0, "lattice_x_m": 11.3, "lattice_y_m": 3.0}
    assert reconstruct(cloud, settings={**TRUSTED, **tiles}).digest == whole.digest


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"roof": {"straight_eaves": False}},
        {"method": "kmeans", "preset": "faithful"},
        {"lods": "1.2"},
    ],
    ids=["arranged", "raw", "one form per building", "blocks"],
)
def test_models_of_a_town_do_not_overlap(
    settings: dict[str, Any], town: Path, reconstruct: Callable[..., RunSummary]
) -> None:
    drawn = reconstruct(town, settings=TRUSTED | settings)
    found = overlaps_m2(drawn.run_dir)
    assert len(found) >= 15 * 14 // 2
    assert sum(found) < NOTHING_M2
    tiles = {"tile_size_m": 40.0, "lattice_x_m": 13.0, "lattice_y_m": 7.0}
    assert reconstruct(town, settings=TRUSTED | settings | tiles).digest == drawn.digest


def test_a_second_run_in_a_work_folder_draws_nothing_again(
    sheds: Path, tmp_path: Path, reconstruct: Callable[..., RunSummary]
) -> None:
    first, second = (
        reconstruct(sheds, settings=TRUSTED, work=str(tmp_path / "work"), out=str(tmp_path / name))
        for name in ("one", "two")
    )
    assert second.digest == first.digest
    kept = list((tmp_path / "work").glob("**/kept/touching/*/*"))
    assert len(kept) > 0
    third = reconstruct(sheds, settings=TRUSTED, work=str(tmp_path / "work"), out=str(tmp_path / "three"))
    assert third.digest == first.digest
    assert [path.stat().st_mtime_ns for path in kept] == [
        path.stat().st_mtime_ns for path in (tmp_path / "work").glob("**/kept/touching/*/*")
    ]


def test_units_of_one_block_that_were_drawn_together_are_not_compared() -> None:
    square = shapely.MultiPolygon([shapely.box(0, 0, 1, 1)])
    site = CandidateSite(
        building_id="a", owner=Tile(0, 0), ranges=(), points=9, block="x", outline=square, reach_mm=(0, 0, 9, 9)
    )
    other = dataclasses.replace(site, building_id="b", reach_mm=(5, 5, 12, 12))
    far = dataclasses.replace(site, building_id="c", reach_mm=(50, 5, 60, 12), block=None)
    given = dataclasses.replace(site, building_id="d", reach_mm=None)
    assert near_pairs([site, other, far, given]).tolist() == []
    alone = dataclasses.replace(other, outline=None)
    assert near_pairs([site, alone, far, given]).tolist() == [[0, 1]]
    assert near_pairs([far, given, other, dataclasses.replace(site, block=None)]).tolist() == [[2, 3]]


def test_without_candidates_nothing_touches() -> None:
    assert not may_touch([])
    assert not may_touch([SitesBrief(groups=(), rejected=())])


def test_a_fault_that_nothing_foresaw_is_a_warning_and_a_known_one_is_passed_on() -> None:
    warnings: list[str] = []
    site = CandidateSite(building_id="shed", owner=Tile(0, 0), ranges=(), points=0)

    def fails(error: Exception) -> None:
        raise error

    assert _or_warned(warnings, (site,), lambda: 3) == 3
    assert _or_warned(warnings, (site,), lambda: fails(ZeroDivisionError("by zero"))) is None
    assert warnings == ["the outlines of shed are not fitted to others: ZeroDivisionError: by zero"]
    with pytest.raises(OSError, match="scratch"):
        _or_warned(warnings, (site,), lambda: fails(OSError("scratch")))


def test_sites_that_are_apart_across_any_direction_do_not_come_near() -> None:
    turned = [shapely.Polygon([(x, 0), (x + 9, 9), (x + 8, 10), (x - 1, 1)]) for x in (0.0, 5.0, 7.0, 60.0)]
    sites = [
        CandidateSite(
            building_id=str(k),
            owner=Tile(0, 0),
            ranges=(),
            points=0,
            outline=shapely.MultiPolygon([outline]),
            reach_mm=(0, 0, 0, 0),
        )
        for k, outline in enumerate(turned)
    ]
    pairs = np.array(list(itertools.combinations(range(3), 2)))
    extents = _Extents(pairs, sites, None)
    # the last two touch; the first is 2.1 m away, though the boxes of all of them overlap
    assert [extents.come_near(k) for k in range(4)] == [False, True, True, False]
    extents.set(2, np.empty((0, 2)), 0.0)
    assert not extents.come_near(1)
    extents.set(1, shapely.get_coordinates(turned[1]) * 1e3, 100.0)
    assert not extents.come_near(1)
    extents.set(1, shapely.get_coordinates(turned[1]) * 1e3, 200.0)
    assert extents.come_near(1)
    assert extents.come_near(0)


@pytest.mark.slow
@pytest.mark.parametrize("fails", ["divided", "left_of"])
def test_models_do_not_overlap_after_a_fault_of_a_division(
    fails: str, sheds: Path, reconstruct: Callable[..., RunSummary], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr(touching, fails, fail)
    drawn = reconstruct(sheds, settings=TRUSTED)
    assert any("are not fitted to others: ZeroDivisionError" in warning for warning in drawn.warnings)
    assert drawn.statuses["ok"] == 4
    assert max(overlaps_m2(drawn.run_dir)) < NOTHING_M2


@pytest.mark.slow
def test_units_of_a_block_that_others_own_lie_beside_slits(
    tmp_path: Path, reconstruct: Callable[..., RunSummary]
) -> None:
    """Two units of a block face a house over a slit; all three, and a shed far away, have tiles of their own."""
    random = np.random.default_rng(7)
    x, y = random.uniform((-14.0, -14.0), (40.0, 32.0), (20_000, 2)).T
    z, kind = np.full(len(x), 50.0), np.full(len(x), 2, np.uint8)
    units, house, shed = ((18, 12, 27, 20, 57), (27, 12, 36, 20, 62)), (16.5, 20.7, 30, 27, 54), (-12, -12, -5, -5, 53)
    for x0, y0, x1, y1, top in (*units, house, shed):
        inside = (x > x0) & (x < x1) & (y > y0) & (y < y1)
        z[inside], kind[inside] = top, 6
    slit = (x >= 16.5) & (x <= 30.0) & (y > 20.0) & (y < 20.7)
    z[slit], kind[slit] = 53.0, 1
    z += random.normal(0.0, 0.02, len(x))
    found = Houses(xyz=np.column_stack((x + 4e5, y + 5.7e6, z)), house=np.zeros(len(x), np.int8))
    cloud = write_houses(tmp_path / "block.laz", found, classes=kind)
    whole = reconstruct(cloud, settings={**TRUSTED, "tile_size_m": 1000.0})
    assert whole.statuses["ok"] == 4
    tiles = {"tile_size_m": 24.0, "lattice_x_m": 16.0, "lattice_y_m": 20.3}
    assert reconstruct(cloud, settings={**TRUSTED, **tiles}).digest == whole.digest
