"""Ground against reference classes: tables by hand, labels of files, and the filter of a run."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import roofs_by_hand as by_hand
from las_files import write_las
from roofs_by_hand import points_of
from scipy import stats
from whole_scene import terrain_of

from pipeline.errors import InconsistentInputError
from pipeline.model import BoolArray, FloatArray
from pipeline.ruler.evaluation import ground_scores as ground
from pipeline.ruler.evaluation.ground_scores import (
    DEFINITIONS,
    GroundOfFiles,
    GroundOfRun,
    ground_blocks,
    ground_measures,
    matched_points,
    tile_figures,
)
from pipeline.ruler.evaluation.reference import Reference, ReferencePoints
from pipeline.ruler.evaluation.reference_points import read_points_reference
from pipeline.ruler.evaluation.subsets import Columns, subsets
from pipeline.scene import WindowPoints
from pipeline.terrain.ground import ground_points
from pipeline.terrain.terrain_settings import ClassesInUse, SceneSettings
from pipeline.tiling import Window

SETTINGS = SceneSettings()


def tile(xyz: FloatArray, is_ground: BoolArray, name: str = "t", *, last: BoolArray | None = None) -> ReferencePoints:
    return points_of(xyz, np.where(is_ground, 2, 0), name, last=True if last is None else last)


def reader(points: ReferencePoints) -> Callable[[], ReferencePoints]:
    return lambda: points


def reference_of(parts: Sequence[ReferencePoints]) -> Reference:
    tiles = tuple(reader(part) for part in parts)
    return dataclasses.replace(by_hand.reference([], has_faces=False, has_ground=True), tiles=tiles)


def blocks(*counts: tuple[int, int, int, int], tiles: str = "t") -> Columns:
    """Blocks of ground found and missed, objects taken for ground and found; a letter names the tile of each."""
    columns = dict(zip(("right", "missed", "taken", "other"), np.array(counts).T, strict=True))
    return {"tile": np.array(list(tiles), object), **columns}


def figures_of(rows: Columns) -> SimpleNamespace:
    """The figures of the only tile."""
    (found,) = by_hand.rows(tile_figures(rows))
    return found


def hilly(n: int = 40_000, side: float = 160.0, seed: int = 0) -> tuple[FloatArray, BoolArray]:
    """Rolling terrain with two houses and low outliers, at large coordinates."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(0, side, (2, n))
    z = 300.0 + 0.05 * x + 2.0 * np.sin(y / 25) + rng.normal(0, 0.03, n)
    is_ground = np.ones(n, np.bool_)
    for x0, y0, width, height in ((30, 40, 14, 6), (90, 100, 25, 9)):
        inside = (x >= x0) & (x < x0 + width) & (y >= y0) & (y < y0 + width)
        z[inside] += height
        is_ground[inside] = False
    z[:3] -= 40.0
    is_ground[:3] = False
    return np.round(np.column_stack((x + 513_800.0, y + 5_403_900.0, z)), 3), is_ground


# ------------------------------------------------------------------------------------------------------------ tables


def test_a_table_counts_as_by_hand() -> None:
    """45 and 5 of the ground, 10 and 40 of the objects: agreement .85, by chance .5, kappa .7."""
    figures = figures_of(blocks((45, 5, 10, 40)))
    assert figures.type_1 == pytest.approx(0.1)
    assert figures.type_2 == pytest.approx(0.2)
    assert figures.total == pytest.approx(0.15)
    assert figures.kappa == pytest.approx(0.7)
    assert (figures.ground, figures.object) == (50, 50)


def test_kappa_is_that_of_the_formula_over_single_points() -> None:
    rng = np.random.default_rng(3)
    truth = rng.random(5000) < 0.3
    found = np.where(rng.random(5000) < 0.85, truth, ~truth)
    xyz = np.column_stack((rng.uniform(0, 200, (5000, 2)), np.zeros(5000)))
    rows = ground_blocks(reference_of([tile(xyz, truth)]), lambda _: found)
    assert len(rows["tile"]) == 16
    agreed = np.mean(truth == found)
    chance = truth.mean() * found.mean() + (1 - truth.mean()) * (1 - found.mean())
    figures = figures_of(rows)
    assert figures.kappa == pytest.approx((agreed - chance) / (1 - chance))
    # of two kinds, with margins alike, kappa is close to the correlation
    assert figures.kappa == pytest.approx(stats.pearsonr(truth, found).statistic, abs=0.02)
    measured = {m.name: m for m in ground_measures(rows, subsets(reference_of([]))[0])}
    assert sorted(measured) == sorted(definition.name for definition in DEFINITIONS)
    assert measured["ground.type_1"].value == pytest.approx(np.mean(~found[truth]))
    assert measured["ground.type_2"].value == pytest.approx(np.mean(found[~truth]))
    assert measured["ground.total"].value == pytest.approx(1 - agreed)
    assert measured["ground.kappa"].value == pytest.approx(figures.kappa)
    assert measured["ground.type_1"].n == truth.sum()
    for measure in measured.values():
        assert measure.low < measure.value < measure.high


def test_only_last_returns_are_judged_and_neither_noise_nor_water() -> None:
    xyz, is_ground = hilly(100)
    points = tile(xyz, is_ground, last=np.arange(100) >= 10)
    points.classification[10:30] = np.repeat([7, 9, 18, 6], 5)
    figures = figures_of(ground_blocks(reference_of([points]), lambda _: np.zeros(100, np.bool_)))
    assert figures.ground + figures.object == 90 - 15
    assert math.isnan(figures.type_2) if figures.object == 0 else figures.type_2 == 0.0
    assert figures.type_1 == 1.0


def test_what_a_file_leaves_unclassified_is_object_only_where_it_names_no_objects() -> None:
    xyz, is_ground = hilly(100)
    points = tile(xyz, is_ground)
    points.classification[:] = np.repeat([2, 0, 1, 6], 25)
    reference = reference_of([points])
    every = figures_of(ground_blocks(reference, lambda _: np.ones(100, np.bool_)))
    assert (every.ground, every.object) == (25, 75)
    named = dataclasses.replace(reference, unclassified_is_object=False)
    facts = figures_of(ground_blocks(named, lambda _: np.ones(100, np.bool_)))
    assert (facts.ground, facts.object) == (25, 25)


def test_tiles_are_separate_and_add_up() -> None:
    rows = blocks((10, 0, 0, 10), (0, 10, 10, 0), (10, 0, 0, 10), tiles="aba")
    assert [(one.tile, one.total) for one in by_hand.rows(tile_figures(rows))] == [("a", 0.0), ("b", 1.0)]
    measured = {m.name: m.value for m in ground_measures(rows, subsets(reference_of([]))[0])}
    assert measured["ground.total"] == pytest.approx(1 / 3)
    assert ground_measures({}, subsets(reference_of([]))[0]) == []


# ------------------------------------------------------------------------------------------------------------- files


def test_points_are_matched_whatever_their_order_each_once() -> None:
    rng = np.random.default_rng(1)
    wanted = np.round(rng.uniform(0, 3, (400, 3)), 1) + np.array([600_000.0, 5_000_000.0, 0.0])  # many are equal
    numbers = rng.integers(1, 4, 400).astype(np.uint8)
    order = rng.permutation(400)
    match = matched_points(wanted, numbers, wanted[order], numbers[order])
    assert sorted(match) == list(range(400))
    assert (wanted[order][match] == wanted).all()
    assert (numbers[order][match] == numbers).all()
    # equal points pair up in their order
    assert (matched_points(wanted, numbers, wanted, numbers) == np.arange(400)).all()


def test_a_point_that_is_not_offered_has_no_match() -> None:
    wanted = np.array([(1.0, 1, 1), (2, 2, 2), (2, 2, 2), (3, 3, 3)])
    one = np.ones(4, np.uint8)
    offered = np.array([(3.0, 3, 3), (2, 2, 2.0004), (9, 9, 9)])
    assert matched_points(wanted, one, offered, one[:3]).tolist() == [-1, 1, -1, 0]
    assert matched_points(wanted, one, offered, np.array([1, 2, 1], np.uint8)).tolist() == [-1, -1, -1, 0]
    assert matched_points(wanted, one, offered[:0], one[:0]).tolist() == [-1] * 4


def write(path: Path, xyz: FloatArray, classes: np.ndarray) -> Path:
    return write_las(path, xyz, point_format=1, classification=classes)


def test_files_of_another_program_give_their_ground_in_any_order_and_tiling(tmp_path: Path) -> None:
    xyz, is_ground = hilly(3000)
    reference = read_points_reference([write(tmp_path / "reference.las", xyz, np.where(is_ground, 2, 0))])
    rng = np.random.default_rng(4)
    found = np.where(rng.random(3000) < 0.9, is_ground, ~is_ground)
    classes = np.where(found, 2, np.where(rng.random(3000) < 0.1, 7, 1))  # low noise is no ground, and is not dropped
    order = rng.permutation(3000)
    halves = [
        write(tmp_path / f"{k}.laz", xyz[part], classes[part]) for k, part in enumerate((order[:1700], order[1700:]))
    ]
    rows = ground_blocks(reference, GroundOfFiles(halves))
    direct = ground_blocks(reference, lambda _: found)
    assert {name: column.tolist() for name, column in rows.items()} == {n: c.tolist() for n, c in direct.items()}
    figures = figures_of(rows)
    assert figures.total == pytest.approx(np.mean(found != is_ground))


def test_points_that_are_in_no_file_are_counted_and_refused(tmp_path: Path) -> None:
    xyz, is_ground = hilly(300)
    reference = read_points_reference([write(tmp_path / "reference.las", xyz, np.where(is_ground, 2, 0))])
    moved = xyz.copy()
    moved[:7, 2] += 0.002
    other = write(tmp_path / "other.las", moved, np.full(300, 2))
    with pytest.raises(InconsistentInputError, match=r"7 of the 300 points of reference\.las are not in it"):
        ground_blocks(reference, GroundOfFiles([other]))
    with pytest.raises(InconsistentInputError, match="300 of the 300"):
        ground_blocks(reference, GroundOfFiles([]))


# --------------------------------------------------------------------------------------------------------------- run


def ground_of_a_window(xyz: FloatArray, last: BoolArray) -> BoolArray:
    """Twin: the functions that a run's split calls, over all points in one window."""
    x, y, z = np.rint(xyz.T * 1000).astype(np.int64)
    n = len(x)
    points = WindowPoints(
        x_mm=x,
        y_mm=y,
        z_mm=z,
        return_number=np.ones(n, np.uint8),
        return_count=np.where(last, 1, 2).astype(np.uint8),
        classification=np.zeros(n, np.uint8),
    )
    window = Window(x0_mm=int(x.min()), y0_mm=int(y.min()), x1_mm=int(x.max()) + 1, y1_mm=int(y.max()) + 1)
    terrain, kept = terrain_of(points, window.grown(200_000), SETTINGS, ClassesInUse())
    found: BoolArray = kept & ground_points(x, y, z, terrain, SETTINGS.ground)
    return found


@pytest.mark.parametrize("window_cells", [512, 230])
def test_the_ground_of_a_run_is_that_of_its_ground_stage(window_cells: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In windows of any size, over window borders too."""
    monkeypatch.setattr(ground, "WINDOW_CELLS", window_cells)
    xyz, is_ground = hilly()
    last = np.random.default_rng(8).random(len(xyz)) < 0.9
    points = tile(xyz, is_ground, last=last)
    found = GroundOfRun(reference_of([points]), SETTINGS)(points)
    assert (found == ground_of_a_window(xyz, last)).all()
    assert np.mean(found == is_ground) > 0.97
    assert not found[:3].any()


def test_the_ground_of_a_run_does_not_depend_on_the_tiles() -> None:
    xyz, is_ground = hilly()
    whole = tile(xyz, is_ground)
    labels = GroundOfRun(reference_of([whole]), SETTINGS)(whole)
    west = xyz[:, 0] < np.median(xyz[:, 0])
    parts = [tile(xyz[side], is_ground[side]) for side in (west, ~west)]
    found = GroundOfRun(reference_of(parts), SETTINGS)
    assert (found(parts[0]) == labels[west]).all()
    assert (found(parts[1]) == labels[~west]).all()


def test_samples_of_the_benchmark_stay_within_what_was_measured(shared_data: Path) -> None:
    """The samples of the filter test, without tuning."""
    limits = {"samp21": 0.02, "samp23": 0.05, "samp31": 0.03, "samp41": 0.045, "samp51": 0.035}
    for name, limit in limits.items():
        reference = read_points_reference([shared_data / "isprs" / f"{name}-utm.laz"])
        figures = figures_of(ground_blocks(reference, GroundOfRun(reference, SETTINGS)))
        assert figures.total < limit, name
        assert figures.kappa > 0.88, name
