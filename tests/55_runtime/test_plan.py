"""What a plan says of inputs that cannot be used: of all of them, not of the first alone."""

from collections.abc import Sequence
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest

from pipeline.errors import CrsError, InputError, UnreadableInputError
from pipeline.io import ReadOptions
from pipeline.runtime.plan import make_plan
from pipeline.settings import RunSettings


def _file(path: Path, crs: str) -> str:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.add_crs(pyproj.CRS(crs))
    header.scales, header.offsets = np.full(3, 0.01), np.array([500_000.0, 5_000_000.0, 0.0])
    las = laspy.LasData(header)
    las.x, las.y, las.z = header.offsets[:, None] + np.arange(4.0)
    las.write(path)
    return str(path)


def _refused(paths: Sequence[str]) -> InputError:
    with pytest.raises(InputError) as refused:
        make_plan(paths, ReadOptions(), RunSettings())
    return refused.value


def test_inputs_that_cannot_be_read_are_named_together(tmp_path: Path) -> None:
    sound = _file(tmp_path / "a.laz", "EPSG:25832")
    broken = tmp_path / "b.laz"
    broken.write_bytes(b"<html>not found</html>")
    short = tmp_path / "c.laz"
    short.write_bytes(Path(sound).read_bytes()[:100])
    fault = _refused([sound, str(broken), str(short)])
    assert type(fault) is UnreadableInputError
    assert fault.path == str(broken)
    assert f"1 more input cannot be used: {short}: " in str(fault)


def test_of_many_inputs_that_cannot_be_used_some_are_named_and_the_others_counted(tmp_path: Path) -> None:
    paths = [str(tmp_path / f"{number:02}.laz") for number in range(25)]
    for path in paths:
        Path(path).write_bytes(b"<html>not found</html>")
    message = str(_refused(paths))
    assert [path for path in paths if path in message] == paths[:10]
    assert "24 more inputs cannot be used" in message
    assert message.endswith("; and 15 more")


def test_inputs_of_another_crs_are_named_together(tmp_path: Path) -> None:
    paths = [_file(tmp_path / f"{code}.laz", f"EPSG:{code}") for code in (25832, 25833, 25834)]
    fault = _refused(paths)
    assert type(fault) is CrsError
    assert fault.path == paths[1]
    assert f"{paths[2]}: its CRS is ETRS89 / UTM zone 34N" in str(fault)
