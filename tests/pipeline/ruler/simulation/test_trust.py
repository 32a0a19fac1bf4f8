"""The suite of what is taken for a house: every kind of scene holds what its name says, and surveys keep their word."""

import collections
import dataclasses
import itertools
import json
from pathlib import Path

import laspy
import numpy as np
import pytest
import shapely

from pipeline.ruler.evaluation.reading import read_models
from pipeline.ruler.simulation.als import ScanBlock, scan, scan_all
from pipeline.ruler.simulation.dataset import simulate
from pipeline.ruler.simulation.simulated_scene import Scene
from pipeline.ruler.simulation.strips import Returns
from pipeline.ruler.simulation.suites import SUITES
from pipeline.ruler.simulation.survey_files import recorded
from pipeline.ruler.simulation.sweep import Cell
from pipeline.ruler.simulation.trust import CELLS, KINDS, trust
from pipeline.ruler.simulation.trust_trees import STANDS

SEED = 1_000
MOST_RETURNS = {Returns.FIVE: 5, Returns.FIRST_AND_LAST: 2, Returns.FIRST: 1, Returns.LAST: 1}


def cell_of(kind: str, least_density: float = 0.0) -> Cell:
    return min(
        (cell for cell in CELLS if cell.kind == kind and cell.density_per_m2 >= least_density),
        key=lambda cell: cell.density_per_m2,
    )


def scanned(scene: Scene, cell: Cell) -> ScanBlock:
    return scan_all(scene, cell.scanner(SUITES["trust"].scanner), SEED)


def test_cells_have_names_of_their_own_and_cover_densities_and_returns() -> None:
    assert len({cell.key for cell in CELLS}) == len(CELLS)
    assert {cell.kind for cell in CELLS} == set(KINDS)
    for kind in KINDS:
        cells = [cell for cell in CELLS if cell.kind == kind]
        assert {MOST_RETURNS[cell.returns] for cell in cells} >= {1, 5}
        assert {cell.with_classes for cell in cells} == {True, False}
    densities = [cell.density_per_m2 for cell in CELLS]
    assert (min(densities), max(densities)) == (0.3, 30.0)


@pytest.mark.parametrize("kind", list(KINDS))
def test_the_smallest_scene_of_each_kind_is_written_as_its_cell_says(kind: str, tmp_path: Path) -> None:
    cell = cell_of(kind)
    made = simulate(dataclasses.replace(SUITES["trust"], cells=(cell,)), tmp_path, SEED)
    las = laspy.read(tmp_path / cell.key / "trust.laz")
    assert made.points == len(las) > 1_000
    assert 1 <= int(np.max(las.number_of_returns)) <= MOST_RETURNS[cell.returns]
    assert np.all(np.asarray(las.return_number) <= np.asarray(las.number_of_returns))
    assert (set(np.asarray(las.classification).tolist()) != {1}) == cell.with_classes
    manifest = json.loads((tmp_path / cell.key / "truth" / "scene.json").read_text())
    scene = trust(SEED, cell.key)
    assert manifest["buildings"] == len(scene.buildings) == made.buildings
    assert len(read_models(tmp_path / cell.key / "truth").models) == made.buildings
    content = kind.removeprefix("noisy_")
    assert (len(scene.buildings) > 0) == (content not in {*STANDS, "bridges", "decks"})
    assert (len(scene.trees) > 0) == (content in {*STANDS, "houses_and_trees", "half_seen_shadow"})
    data = shapely.box(*scene.extent)
    assert all(data.contains(building.footprint) for building in scene.buildings)
    for a, b in itertools.combinations(scene.buildings, 2):
        assert not a.footprint.intersects(b.footprint), (a.building_id, b.building_id)


def test_seeds_and_surveys_have_layouts_of_their_own() -> None:
    keys = [cell.key for cell in CELLS if cell.kind == "houses"][:2]
    places = {(seed, key): trust(seed, key).buildings[0].x for seed in (1_000, 1_001) for key in keys}
    assert len(set(places.values())) == 4
    again = trust(1_000, keys[0])
    assert again.buildings[0].x == places[1_000, keys[0]]
    assert again.name == "trust"


@pytest.mark.parametrize("kind", ["opaque_tall", "opaque_low"])
def test_dense_crowns_let_next_to_nothing_through(kind: str) -> None:
    cell = cell_of(kind, 4.0)
    scene = trust(SEED, cell.key)
    block = scanned(scene, cell)
    beneath = shapely.STRtree([shapely.Point(t.x, t.y).buffer(0.6 * t.crown_radius_m) for t in scene.trees])
    xy = block.points.xyz[:, :2] - scene.origin[:2]
    under = np.unique(beneath.query(shapely.points(xy), predicate="intersects")[0])
    assert len(under) > 500
    assert np.mean(block.points.classification[under] == 2) < 0.01


def test_a_part_of_most_wet_roofs_has_no_points_and_the_rest_has_them() -> None:
    cell = cell_of("half_seen_wet", 4.0)
    scene = trust(SEED, cell.key)
    block = scanned(scene, cell)
    wet = dry = 0
    for number, house in enumerate(scene.buildings):
        plan = block.points.xyz[(block.building == number) & (block.face >= 0), :2] - scene.origin[:2]
        spots = shapely.union_all([shapely.Point(s.x, s.y).buffer(0.4) for s in house.wet_spots])
        inside = shapely.contains_xy(spots, *plan.T)
        wet, dry = wet + int(inside.sum()), dry + int((~inside).sum())
        share = shapely.intersection(spots, house.footprint).area / house.footprint.area
        assert share < 0.9
    assert sum(bool(house.wet_spots) for house in scene.buildings) >= len(scene.buildings) / 2
    assert wet < 0.02 * dry


def test_tall_things_hide_parts_of_houses_behind_them() -> None:
    cell = cell_of("half_seen_shadow", 4.0)
    scene = trust(SEED, cell.key)
    low = [one for one in scene.buildings if not one.building_id.startswith("tower")]
    seen, before = scanned(scene, cell), scanned(dataclasses.replace(scene, trees=(), buildings=tuple(low)), cell)
    shares = []
    for number, house in enumerate(low):
        whole = (before.building == number) & (before.face >= 0)
        left = (seen.building == scene.buildings.index(house)) & (seen.face >= 0)
        shares.append(float(left.sum() / whole.sum()))
    assert max(shares) <= 1.01
    assert sum(0.2 < share < 0.85 for share in shares) >= len(low) / 2


def test_pulses_go_through_glass_by_its_share_and_meet_what_is_beneath() -> None:
    cell = cell_of("glass", 4.0)
    scene = trust(SEED, cell.key)
    closed = dataclasses.replace(
        scene, buildings=tuple(dataclasses.replace(one, glass_share=0.0) for one in scene.buildings)
    )
    gone = dataclasses.replace(scene, buildings=tuple(one for one in scene.buildings if one.glass_share == 0.0))
    block, before, beneath = (scanned(one, cell) for one in (scene, closed, gone))
    for number, house in enumerate(scene.buildings):
        left, all_of_it = (int(((b.building == number) & (b.face >= 0)).sum()) for b in (block, before))
        assert left / all_of_it == pytest.approx(1.0 - house.glass_share, abs=0.06)
    rows = [{tuple(row) for row in b.points.xyz.tolist()} for b in (block, before, beneath)]
    assert rows[0] <= rows[1] | rows[2]
    assert np.all(np.diff(block.points.gps_time) >= 0)
    chunks = scan(scene, cell.scanner(SUITES["trust"].scanner), SEED, chunk_points=4_000, threads=1)
    assert np.array_equal(np.concatenate([one.points.xyz for one in chunks]), block.points.xyz)


def test_every_second_strip_is_a_step_too_high() -> None:
    cell = next(cell for cell in CELLS if cell.kind == "strips_apart" and cell.strip_step_m == 0.9)
    scene = trust(SEED, cell.key)
    block = scanned(scene, cell)
    ground = block.points.classification == 2
    x, y, z = (block.points.xyz[ground] - scene.origin).T
    off = z - scene.terrain.elevation(x, y)
    strips = block.points.source_id[ground]
    found = {int(strip): float(np.median(off[strips == strip])) for strip in np.unique(strips)}
    assert len(found) >= 2
    assert found == pytest.approx({strip: 0.9 * ((strip - 1) % 2) for strip in found}, abs=0.02)


@pytest.mark.parametrize("returns", list(Returns))
def test_recorded_returns_are_those_of_the_instrument(returns: Returns) -> None:
    cell = cell_of("conifer_forest", 4.0)
    block = scanned(trust(SEED, cell.key), cell)
    (kept,) = recorded(iter([block]), returns)
    times, number, count = kept.points.gps_time, kept.points.return_number, kept.points.return_count
    pulses = collections.Counter(times.tolist())
    assert all(pulses[time] == of for time, of in zip(times.tolist(), count.tolist(), strict=True))
    assert all(1 <= a <= b for a, b in zip(number.tolist(), count.tolist(), strict=True))
    assert pulses.keys() == set(block.points.gps_time.tolist())
    assert max(count.tolist()) <= MOST_RETURNS.get(returns, 7)
    if returns in {Returns.FIRST, Returns.LAST}:
        best = np.maximum if returns is Returns.FIRST else np.minimum
        _, pulse = np.unique(block.points.gps_time, return_inverse=True)
        ends = np.full(pulse.max() + 1, -np.inf if returns is Returns.FIRST else np.inf)
        best.at(ends, pulse, block.points.xyz[:, 2])
        assert np.abs(ends - kept.points.xyz[np.argsort(times), 2]).max() < 0.3  # noise may swap echoes of one height
