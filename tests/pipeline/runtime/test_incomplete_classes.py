"""Class 6 that leaves out a part of the roofs: undecided points on them belong to them, other classes do not."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from plain_houses import AREAS_M2, Houses, houses, write_houses
from run_tables import rows


def areas_of(run_dir: str) -> list[float]:
    return sorted(row["footprint_area_m2"] for row in rows(run_dir))


def assert_three_houses(summary: Any) -> None:
    assert summary.statuses == {"ok": 3}
    assert areas_of(summary.run_dir) == pytest.approx(AREAS_M2, rel=0.06)


def classes_of(found: Houses) -> npt.NDArray[np.uint8]:
    """The true classes."""
    return np.where(found.house >= 0, 6, 2).astype(np.uint8)


@pytest.mark.parametrize("code", [1, 12, 28, 70])
def test_scattered_undecided_points_belong_to_the_roof(code: int, tmp_path: Path, reconstruct: Any) -> None:
    found = houses()
    classes = classes_of(found)
    left_out = (classes == 6) & (np.random.default_rng(1).random(len(classes)) < 0.4)
    classes[left_out] = code
    assert_three_houses(reconstruct(write_houses(tmp_path / "tile.laz", found, classes)))


def test_a_strip_of_class_12_belongs_to_the_roof(tmp_path: Path, reconstruct: Any) -> None:
    found = houses()
    strips = np.random.default_rng(2).integers(1, 3, len(found.house))
    classes = np.where(strips == 2, 12, classes_of(found))
    assert_three_houses(reconstruct(write_houses(tmp_path / "tile.laz", found, classes, strips)))


def test_half_a_roof_without_a_class_belongs_to_the_other_half(tmp_path: Path, reconstruct: Any) -> None:
    found = houses()
    x, classes = found.xyz[:, 0] - 400_000.0, classes_of(found)
    for house, middle in enumerate((16.0, 47.0, 33.0)):
        classes[(found.house == house) & (x > middle)] = 1
    assert_three_houses(reconstruct(write_houses(tmp_path / "tile.laz", found, classes)))


@pytest.mark.parametrize("code", [5, 9, 17, 26])
def test_points_of_another_class_do_not_belong_to_the_roof(code: int, tmp_path: Path, reconstruct: Any) -> None:
    found = houses()
    x, classes = found.xyz[:, 0] - 400_000.0, classes_of(found)
    classes[(found.house == 1) & (x > 50.0)] = code
    summary = reconstruct(write_houses(tmp_path / "tile.laz", found, classes))
    # a third of the second house is something else by its class
    assert areas_of(summary.run_dir) == pytest.approx(sorted((AREAS_M2[0], 100.0, AREAS_M2[2])), rel=0.06)


def test_a_hedge_without_a_class_does_not_join_the_house_that_it_touches(tmp_path: Path, reconstruct: Any) -> None:
    found = houses()
    random = np.random.default_rng(3)
    hedge = random.uniform((400_055.0, 5_700_012.0, 50.5), (400_057.0, 5_700_022.0, 54.9), (250, 3))
    whole = Houses(
        xyz=np.concatenate((found.xyz, hedge)), house=np.concatenate((found.house, np.full(len(hedge), -1, np.int8)))
    )
    classes = np.concatenate((classes_of(found), np.full(len(hedge), 1, np.uint8)))
    assert_three_houses(reconstruct(write_houses(tmp_path / "tile.laz", whole, classes)))


@pytest.mark.slow
def test_what_class_6_leaves_out_does_not_depend_on_tiles(tmp_path: Path, reconstruct: Any) -> None:
    found = houses()
    random = np.random.default_rng(4)
    classes = classes_of(found)
    classes[(classes == 6) & (random.random(len(classes)) < 0.3)] = 1
    classes[(found.house == 2) & (found.xyz[:, 1] > 5_700_048.0)] = 12
    path = write_houses(tmp_path / "tile.laz", found, classes)
    runs = [reconstruct(path, settings={"tile_size_m": size, "lattice_x_m": 7.0}) for size in (0.0, 50.0, 23.0)]
    assert_three_houses(runs[0])
    assert len({run.digest for run in runs}) == 1
