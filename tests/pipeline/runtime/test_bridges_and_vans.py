"""Bridges and vehicles end to end: rejected with a reason, classified, the same in any tiles, kept in footprints."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
import shapely
from run_tables import rows, write_footprints

from pipeline.extras.classify.classify import ClassifySummary
from pipeline.ruler.simulation.bridges_and_vans import BRIDGES, bridges_and_vans
from pipeline.ruler.simulation.dataset import simulate
from pipeline.runtime.run import RunSummary

pytestmark = pytest.mark.slow
SEED = 7
DECK_CLASS = 17


@pytest.fixture(scope="module")
def street(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A LAZ tile of bridges and vehicles."""
    return simulate("bridges_and_vans", tmp_path_factory.mktemp("street"), SEED).laz


@pytest.fixture(scope="module")
def objects() -> list[shapely.Polygon]:
    """Plans of the bridges, then of the vehicles, in the CRS."""
    scene = bridges_and_vans(SEED)
    return [shapely.Polygon(box.corners + np.array(scene.origin[:2])) for box in scene.boxes]


def test_bridges_and_vehicles_are_listed_with_their_reasons_in_any_tiles(
    street: Path, objects: list[shapely.Polygon], reconstruct: Callable[..., RunSummary]
) -> None:
    whole = reconstruct(street, settings={"tile_size_m": 1000.0})
    rejected = rows(whole.run_dir, "rejected")
    boxes = [shapely.from_wkb(row["geometry"]) for row in rejected]
    tree = shapely.STRtree(boxes)
    found = [{rejected[k]["reason"] for k in tree.query(plan.centroid, predicate="within")} for plan in objects]
    assert sum("bridge" in reasons for reasons in found[:BRIDGES]) >= 0.95 * BRIDGES
    assert sum("vehicle" in reasons for reasons in found[BRIDGES:]) >= 0.85 * len(objects[BRIDGES:])
    assert whole.counts["candidates"] <= 0.05 * len(objects)
    cut = reconstruct(street, settings={"tile_size_m": 83.0, "lattice_x_m": 7.3, "lattice_y_m": -11.9})
    assert (cut.digest, cut.rejected) == (whole.digest, whole.rejected)
    assert Counter(row["reason"] for row in rejected) == whole.rejected


def test_the_points_of_a_bridge_get_the_class_of_decks(
    street: Path, objects: list[shapely.Polygon], run_classify: Callable[..., ClassifySummary]
) -> None:
    las = laspy.read(run_classify(street, settings={"tile_size_m": 70.0}).files[0].path)
    decks = shapely.union_all([shapely.buffer(plan, -0.5) for plan in objects[:BRIDGES]])
    vans = shapely.union_all([shapely.buffer(plan, -0.5) for plan in objects[BRIDGES:]])
    x, y, found = np.asarray(las.x), np.asarray(las.y), np.asarray(las.classification)
    on_deck, on_van = shapely.contains_xy(decks, x, y), shapely.contains_xy(vans, x, y)
    # where a deck is lower than the least height of an object, near its ends, it is ground
    assert np.isin(found[on_deck], [2, DECK_CLASS]).mean() > 0.97
    assert (found[on_deck] == DECK_CLASS).mean() > 0.4
    assert not (found[~on_deck & ~shapely.contains_xy(shapely.buffer(decks, 1.5), x, y)] == DECK_CLASS).any()
    assert (found[on_van] == 6).mean() < 0.05


def test_given_footprints_say_that_a_deck_or_a_van_is_a_building(
    street: Path, objects: list[shapely.Polygon], reconstruct: Callable[..., RunSummary], tmp_path: Path
) -> None:
    given = {"deck": objects[3], "van": objects[BRIDGES]}
    summary = reconstruct(street, footprints=str(write_footprints(tmp_path / "a.geojson", given)))
    made: dict[str, Any] = {row["source_id"]: row["status"] for row in rows(summary.run_dir)}
    assert made == {"deck": "ok", "van": "ok"}
    assert not summary.rejected
