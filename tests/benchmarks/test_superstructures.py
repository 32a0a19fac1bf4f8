"""Superstructures of a simulated scene: most are found, and clean roofs stay clean."""

import dataclasses
from pathlib import Path

import pytest
import shapely

from benchmarks.superstructures import Judged, judged, measured, suites, table
from pipeline.ruler.simulation.superstructures import SHAPES, superstructures, true_superstructures

SCENE = superstructures(1_000)


def test_half_of_the_houses_of_a_scene_are_clean() -> None:
    clean = [house for house in SCENE.buildings if house.building_id.startswith("clean")]
    assert 2 * len(clean) == len(SCENE.buildings)
    assert not any(house.dimensions.additions for house in clean)
    assert {house.shape for house in clean} == set(SHAPES)


def test_true_superstructures_stand_on_their_houses() -> None:
    houses = shapely.union_all([house.footprint for house in SCENE.buildings])
    found = list(true_superstructures(SCENE.buildings))
    assert len(found) > 40
    assert all(houses.buffer(0.01).contains(one.outline) for one in found)
    assert all(one.sides_m[0] <= one.sides_m[1] for one in found)


def test_without_models_nothing_is_found_or_invented() -> None:
    rows = list(judged([], SCENE))
    assert not any(row.found or row.boxes for row in rows)
    assert sum(row.kind == "clean" for row in rows) == len(SCENE.buildings) // 2


def test_the_table_counts_what_is_found_and_invented() -> None:
    one = Judged(scene="s", kind="chimneys of 0.6 m and more", found=True, by_box=True, iou=0.8, wider_m=0.1)
    rows = [one, dataclasses.replace(one, found=False, by_box=False), Judged(scene="s", kind="clean", boxes=1)]
    printed = table(rows)
    assert "| 2 | 0.500 | 0.500 |" in printed
    assert "| 1 |  |  | 100.0 |" in printed


def test_both_kinds_of_scene_have_the_density_that_is_asked_for() -> None:
    assert {suite.scanner.pulse_density_per_m2 for suite, _ in suites(12.0).values()} == {12.0}


@pytest.mark.slow
def test_chimneys_are_found_and_clean_roofs_stay_clean(tmp_path: Path) -> None:
    rows = [row for row in measured(tmp_path, "dev", 1, 20.0) if row.scene == "superstructures"]
    chimneys = [row.by_box or row.found for row in rows if row.kind == "chimneys of 0.6 m and more"]
    assert sum(chimneys) >= 0.9 * len(chimneys)
    assert sum(row.boxes for row in rows if row.kind == "clean") == 0
