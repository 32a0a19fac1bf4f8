"""All suites: seeds that never meet, scenes that are the same for the same seed, buildings that stand apart."""

import functools
import json
from pathlib import Path

import pytest
import shapely
from command_line import app
from typer.testing import CliRunner

from pipeline.errors import SettingsError
from pipeline.ruler.simulation.roofs import RoofShape
from pipeline.ruler.simulation.seeds import DRAWS, FIRST_SEEDS, Split, seed_of, split_of
from pipeline.ruler.simulation.simulated_scene import Scene
from pipeline.ruler.simulation.suites import SUITES

SMALL = {"town": (150.0, 120.0), "city": (150.0, 100.0)}


@functools.cache
def scene_of(name: str, seed: int) -> Scene:
    suite = SUITES[name]
    return suite.make(seed, SMALL.get(name, suite.size_m))


def test_dev_and_test_seeds_never_meet() -> None:
    dev, test = ({seed_of(split, 0), seed_of(split, DRAWS - 1)} for split in Split)
    assert max(dev) < min(test)
    assert (seed_of("dev", 0), seed_of("test", 0)) == (1_000, 90_000)
    assert FIRST_SEEDS[Split.DEV] + DRAWS == FIRST_SEEDS[Split.TEST]


@pytest.mark.parametrize(("split", "draw"), [("dev", 0), ("dev", 88_999), ("test", 0), ("test", 12)])
def test_a_seed_knows_its_split_and_the_suites_own_belong_to_none(split: str, draw: int) -> None:
    assert split_of(seed_of(split, draw)) == split
    assert {split_of(suite.seed) for suite in SUITES.values()} == {None}


def test_an_unknown_split_and_an_impossible_draw_are_both_reported() -> None:
    with pytest.raises(SettingsError, match=r"split is 'tets': use one of dev, test; draw is -1: use 0 to 88999"):
        seed_of("tets", -1)


def test_every_roof_shape_is_a_suite_beside_the_scenes() -> None:
    scenes = {"suburb", "town", "cube", "hofmann310", "sweep", "city"}
    scenes |= {
        "low_buildings",
        "bridges_and_vans",
        "wide_halls",
        "outline_shapes",
        "broken_slopes",
        "curved_roofs",
        "trust",
    }
    assert scenes | {str(shape) for shape in RoofShape} == set(SUITES)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(SUITES))
def test_the_same_seed_gives_the_same_scene_and_another_one_another(name: str) -> None:
    first, again, other = scene_of(name, 1003), scene_of.__wrapped__(name, 1003), scene_of(name, 1004)
    assert [one.building_id for one in first.buildings] == [one.building_id for one in again.buildings]
    assert first.trees == again.trees

    def corners(scene: Scene) -> list[list[float]]:
        shapes = [building.vertices for building in scene.buildings] + [box.corners for box in scene.boxes]
        return [shape.ravel().tolist() for shape in shapes]

    assert corners(first) == corners(again)
    if name != "cube":  # the seed has no say
        assert corners(first) != corners(other)


@pytest.mark.parametrize(
    "name", ["suburb", "town", "hofmann310", "sweep", "city", "low_buildings", "outline_shapes", "broken_slopes"]
)
def test_buildings_have_names_of_their_own_and_never_overlap(name: str) -> None:
    scene = scene_of(name, 1003)
    assert len({one.building_id for one in scene.buildings}) == len(scene.buildings)
    outlines = [one.footprint for one in scene.buildings]
    for a, b in zip(*shapely.STRtree(outlines).query(outlines, predicate="intersects"), strict=True):
        if a < b:
            assert shapely.intersection(outlines[a], outlines[b]).area < 1e-6
            assert scene.buildings[a].block_id == scene.buildings[b].block_id


@pytest.mark.parametrize(
    ("name", "seed"),
    # in 1007, away from the middle of building 286 lies that building's own wing
    [("hofmann310", 1003), ("sweep", 1003), ("city", 1003), pytest.param("hofmann310", 1007, marks=pytest.mark.slow)],
)
def test_no_trunk_stands_in_a_building_and_no_eave_below_the_ground(name: str, seed: int) -> None:
    scene = scene_of(name, seed)
    index = shapely.STRtree([one.footprint for one in scene.buildings])
    places = [shapely.Point(tree.x, tree.y) for tree in scene.trees]
    assert index.query(places, predicate="intersects").size == 0
    for building in scene.buildings:
        x, y = shapely.get_coordinates(building.footprint.segmentize(1.0)).T
        ground = scene.terrain.elevation(x, y)
        assert building.floor_z_m <= float(ground.min()) + 1e-6
        assert building.eave_z_m > float(ground.max()) + 1.5


def test_the_command_takes_a_split_and_a_draw_and_writes_them_down(tmp_path: Path) -> None:
    done = CliRunner().invoke(
        app, ["simulate", "gable", "--out", str(tmp_path), "--split", "test", "--draw", "2", "--density", "1", "--json"]
    )
    assert done.exit_code == 0, done.output
    manifest = json.loads((tmp_path / "truth" / "scene.json").read_text())
    assert (manifest["seed"], manifest["split"]) == (90_002, "test")


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--split", "dev", "--seed", "3"], "both --seed 3 and --split dev"),
        (["--draw", "3"], "draw is 3 of no split"),
        (["--split", "train"], "split is 'train'"),
    ],
)
def test_the_command_refuses_seeds_that_contradict_each_other(words: list[str], problem: str, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["simulate", "gable", "--out", str(tmp_path), *words])
    assert done.exit_code == 2
    assert problem in done.output
    assert list(tmp_path.iterdir()) == []
