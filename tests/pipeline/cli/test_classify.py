"""`classify` as a user meets it: files, tables, machine output, errors."""

import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from command_line import invoke
from las_files import write_las

from pipeline.runtime import engine
from pipeline.runtime.cluster.local_executor import LocalExecutor
from pipeline.runtime.cluster.serial_executor import Executor, SerialExecutor


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A LAZ file of a flat house of 12 x 10 m and 6 m height on level ground, classes 0."""
    rng = np.random.default_rng(1)
    x, y = rng.uniform(0, 50, (2, 15_000))
    roof = (np.abs(x - 25) < 6) & (np.abs(y - 25) < 5)
    z = np.where(roof, 6.0, 0.0) + rng.normal(0, 0.01, len(x))
    path = tmp_path_factory.mktemp("house") / "house.laz"
    return write_las(path, np.column_stack((x, y, z)), point_format=1)


def test_a_file_comes_back_with_classes_and_rasters(house: Path, tmp_path: Path) -> None:
    words = (str(house), "--out", str(tmp_path / "out"), "--workers", "0", "--rasters", "--json")
    code, out, _ = invoke("classify", *words, "--crs", "EPSG:7415", "--allow-outside-area-of-use", "--raster-cell", "1")
    assert code == 0
    reported = json.loads(out)
    las = laspy.read(reported["files"][0]["path"])
    roof = (np.abs(las.x - 25) < 6) & (np.abs(las.y - 25) < 5)
    assert (np.asarray(las.classification) == np.where(roof, 6, 2)).mean() > 0.999
    assert reported["classes"].keys() == {"2", "6"}
    assert reported["buildings"] == 1
    names = {"house.laz", "terrain.tif", "surface.tif", "height.tif"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names


@pytest.mark.parametrize("is_small", [True, False])
def test_this_process_or_its_children_as_the_estimate_says_give_the_same_file(
    house: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_small: bool
) -> None:
    serial = tmp_path / "serial"
    assert invoke("classify", str(house), "--out", str(serial), "--workers", "0", "--quiet")[0] == 0
    engines: list[Executor] = []
    chosen = engine.executor_for

    def executor_for(*asked: Any, **more: Any) -> Executor:
        engines.append(chosen(*asked, **more))
        return engines[-1]

    monkeypatch.setattr("pipeline.runtime.engine.executor_for", executor_for)
    if not is_small:
        monkeypatch.setattr(engine, "ALONE_S", 0.0)
        monkeypatch.setattr("pipeline.runtime.isolation.preloading._SMALL_BYTES", 0)
    code, out, _ = invoke("classify", str(house), "--out", str(tmp_path / "auto"), "--json")
    assert code == 0
    assert [type(one) for one in engines] == [SerialExecutor if is_small else LocalExecutor]
    (reported,) = json.loads(out)["files"]
    assert (laspy.read(reported["path"]).points.array == laspy.read(serial / "house.laz").points.array).all()


def test_people_see_a_table_of_classes(house: Path, tmp_path: Path) -> None:
    code, out, _ = invoke("classify", str(house), "--out", str(tmp_path / "out"), "--workers", "0", "--quiet")
    assert code == 0
    assert "2 ground" in out
    assert "6 building" in out


def test_a_file_that_is_there_and_a_cell_without_extent_end_with_their_codes(house: Path, tmp_path: Path) -> None:
    (tmp_path / "house.laz").touch()
    code, _, err = invoke("classify", str(house), "--out", str(tmp_path), "--workers", "0")
    assert code == 4
    assert "--overwrite" in err
    code, _, err = invoke(
        "classify", str(house), "--out", str(tmp_path / "b"), "--workers", "0", "--rasters", "--raster-cell", "0"
    )
    assert code == 2
    assert "raster cell is 0" in err
    code, _, err = invoke("classify", str(tmp_path / "no.laz"), "--out", str(tmp_path / "c"), "--workers", "0")
    assert code == 3
    assert "no.laz" in err
