"""A candidate knows its split returns: the pulses that went on below the roof."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np

from pipeline.model import Candidate
from pipeline.runtime.run import RunSummary


def test_split_returns_are_the_points_that_were_first_of_several(
    suburb: Path, reconstruct: Callable[..., RunSummary], candidates: list[Candidate]
) -> None:
    reconstruct(suburb)
    assert candidates
    las = laspy.read(suburb)
    first = (np.array(las.return_number) == 1) & (np.array(las.number_of_returns) > 1)
    mm = np.rint(np.column_stack((las.x, las.y, las.z)) * 1e3).astype(np.int64)
    count, wanted = 0, {tuple(row) for row in mm[first].tolist()}
    for candidate in candidates:
        origin_mm = np.rint(np.array(candidate.origin) * 1e3).astype(np.int64)
        points = np.rint(candidate.points * 1e3).astype(np.int64) + origin_mm
        split = np.rint(candidate.split_returns * 1e3).astype(np.int64) + origin_mm
        own = [tuple(row) for row in points.tolist() if tuple(row) in wanted]
        assert [tuple(row) for row in split.tolist()] == own
        count += len(own)
    assert count > 50


def test_a_file_of_single_returns_has_none(
    suburb: Path, tmp_path: Path, reconstruct: Callable[..., RunSummary], candidates: list[Candidate]
) -> None:
    las = laspy.read(suburb)
    las.return_number[:] = 1
    las.number_of_returns[:] = 1
    las.write(tmp_path / "single.laz")
    reconstruct(tmp_path / "single.laz")
    assert candidates
    assert sum(len(candidate.split_returns) for candidate in candidates) == 0
