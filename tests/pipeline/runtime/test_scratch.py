"""Scratch: arrays come back as they were stored, whole or mapped."""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from pipeline.runtime.scratch.folder import POINT, OpenScratch, Scratch

ARRAYS: dict[str, npt.NDArray[Any]] = {
    "bytes": np.arange(POINT.itemsize * 7).astype(np.uint8),
    "lattice": np.arange(-6, 6, dtype=np.int32).reshape(3, 4),
    "by columns": np.asfortranarray(np.arange(12.0).reshape(3, 4)),
    "mask": np.eye(5, dtype=np.bool_),
    "cube": np.arange(24, dtype=np.int64).reshape(2, 3, 4),
    "empty": np.empty((0, 3), np.float64),
    "number": np.array(7, np.int64),
}


@pytest.mark.parametrize("mapped", [False, True])
@pytest.mark.parametrize("name", ARRAYS)
def test_an_array_comes_back_as_it_was_stored(tmp_path: Path, name: str, mapped: bool) -> None:
    scratch, array = Scratch(str(tmp_path)), ARRAYS[name]
    scratch.put_arrays("tiles/a", {"one": array})
    found: npt.NDArray[np.generic] = scratch.array("tiles/a", "one", mapped=mapped)
    assert found.dtype == array.dtype
    assert found.shape == array.shape
    assert np.array_equal(found, array)
    assert np.array_equal(np.load(tmp_path / "tiles" / "a" / "one.npy"), array)


def test_mapped_points_outlive_the_file_and_cannot_be_changed(tmp_path: Path) -> None:
    scratch = Scratch(str(tmp_path))
    scratch.put_arrays("tiles/a", {"points": ARRAYS["bytes"]})
    points = scratch.array("tiles/a", "points", mapped=True).view(POINT)
    scratch.put_arrays("tiles/a", {"points": np.zeros(POINT.itemsize, np.uint8)})
    assert points.tobytes() == ARRAYS["bytes"].tobytes()
    with pytest.raises(ValueError, match="read-only"):
        points["x"] = 0
    assert len(scratch.array("tiles/a", "points", mapped=True)) == POINT.itemsize


@pytest.mark.parametrize("name", ["bytes", "lattice", "cube", "empty"])
def test_some_rows_come_back_without_the_others(tmp_path: Path, name: str) -> None:
    scratch, array = Scratch(str(tmp_path)), ARRAYS[name]
    scratch.put_arrays("tiles/a", {"one": array})
    for start, stop in ((0, 0), (0, len(array)), (len(array) // 2, len(array))):
        found = scratch.rows("tiles/a", "one", start, stop)
        assert found.dtype == array.dtype
        assert np.array_equal(found, array[start:stop])


def test_rows_that_a_file_does_not_hold_are_reported(tmp_path: Path) -> None:
    scratch = Scratch(str(tmp_path))
    scratch.put_arrays("tiles/a", {"one": ARRAYS["lattice"]})
    with pytest.raises(ValueError, match="reshape"):
        scratch.rows("tiles/a", "one", 1, 4)


def test_a_scratch_for_one_batch_opens_each_array_once_and_travels_closed(tmp_path: Path) -> None:
    scratch = Scratch(str(tmp_path), "run")
    scratch.create()
    scratch.put_arrays("tiles/a", {"terrain": np.arange(12).reshape(6, 2)})
    opened = OpenScratch(scratch.root, scratch.attempt)
    terrain = opened.array("tiles/a", "terrain", mapped=True)
    (tmp_path / "tiles" / "a" / "terrain.npy").unlink()
    assert opened.array("tiles/a", "terrain", mapped=True) is terrain
    assert np.array_equal(opened.rows("tiles/a", "terrain", 2, 4), np.array([[4, 5], [6, 7]]))
    with pytest.raises(ValueError, match="ends before row 7"):
        opened.rows("tiles/a", "terrain", 2, 7)
    copy = pickle.loads(pickle.dumps(opened))
    assert copy == opened
    with pytest.raises(FileNotFoundError):
        copy.array("tiles/a", "terrain")
