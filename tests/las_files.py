"""LAS and LAZ files of points that a test makes."""

from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pyproj


def write_las(path: Path, xyz: np.ndarray, crs: str | None = None, point_format: int = 6, **fields: Any) -> Path:
    """Write points (n, 3) in units of the file, thousandths kept; `fields` are further dimensions by name."""
    header = laspy.LasHeader(version="1.4" if point_format >= 6 else "1.2", point_format=point_format)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(xyz.min(axis=0))
    if crs is not None:
        header.add_crs(pyproj.CRS.from_user_input(crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    for name, values in ({"return_number": 1, "number_of_returns": 1} | fields).items():
        las[name] = np.broadcast_to(np.asarray(values, np.uint8), len(xyz))
    las.write(path)
    return path
