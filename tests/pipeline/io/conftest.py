"""Small files of every format, made where a test needs them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj
import pytest
from las_files import copc_of

from pipeline.model import FloatArray

WriteLas = Callable[..., Path]


def _points(n: int) -> FloatArray:
    """So many points on a lattice of centimetres around Delft."""
    rng = np.random.default_rng(7)
    return np.round(
        np.column_stack((rng.uniform(84_000, 84_100, n), rng.uniform(447_000, 447_100, n), rng.uniform(0, 20, n))), 2
    )


def _record(xyz: FloatArray, version: str, point_format: int, crs: str | None, fields: dict[str, Any]) -> laspy.LasData:
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales = np.full(3, 0.01)
    header.offsets = np.array([84_000.0, 447_000.0, 0.0])
    if crs is not None:
        header.add_crs(pyproj.CRS.from_user_input(crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.return_number = np.ones(len(xyz), dtype=np.uint8)
    las.number_of_returns = np.ones(len(xyz), dtype=np.uint8)
    for name, values in fields.items():
        setattr(las, name, values)
    return las


@pytest.fixture
def points() -> Callable[[int], FloatArray]:
    """Makes (n, 3) coordinates, whole centimetres."""
    return _points


@pytest.fixture
def write_las() -> WriteLas:
    """Writes LAS or LAZ, by the path's suffix, with laspy: an independent writer."""

    def write(
        path: Path,
        xyz: FloatArray,
        *,
        version: str = "1.2",
        point_format: int = 1,
        crs: str | None = None,
        **fields: Any,
    ) -> Path:
        _record(xyz, version, point_format, crs, fields).write(path)
        return path

    return write


@pytest.fixture
def write_copc() -> WriteLas:
    """Writes COPC of two levels."""

    def write(path: Path, xyz: FloatArray, *, crs: str = "EPSG:7415", **fields: Any) -> Path:
        return copc_of(path, _record(xyz, "1.4", 6, None, fields), crs)

    return write
