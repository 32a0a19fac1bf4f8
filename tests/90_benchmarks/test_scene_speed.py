"""How the stages are timed, and how the times are reported."""

from pathlib import Path

import laspy
import numpy as np
import pytest

from benchmarks.scene_speed import STAGES, Lap, laps, large_file, main, profile, speed_row
from pipeline.ruler.simulation.dataset import simulate


@pytest.fixture(scope="module")
def suburb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("suburb")
    return simulate("suburb", folder, 3, size_m=(60.0, 60.0), density_per_m2=2.0).laz


def lap(ingest: float, split: float, join: float) -> Lap:
    seconds = {"ingest": ingest, "cells": 0.1, "ground": 0.2, "split": split, "join": join, "outline": 0.0}
    return Lap(seconds=seconds, cpu_s=1.0, points=3_000_000, candidates=1, peaks={}, scratch_bytes=0)


def test_a_row_holds_the_medians_of_each_stage_and_of_the_whole() -> None:
    row = speed_row("serial", [lap(1.0, 5.0, 0.5), lap(2.0, 3.0, 0.5), lap(3.0, 1.0, 0.5)])
    assert row == [
        "serial",
        "3000000",
        "2.00",
        "0.10",
        "0.20",
        "3.00",
        "0.50",
        "0.00",
        "5.80",
        "4.80 to 6.80",
        "0.52",
        "1.00",
    ]


def test_rounds_after_the_first_are_clocked_over_all_points(suburb: Path, tmp_path: Path) -> None:
    found = laps([str(suburb)], None, 0, 2, str(tmp_path))
    assert len(found) == 2
    assert len({(one.points, one.candidates, one.scratch_bytes) for one in found}) == 1
    assert found[0].points > 5_000
    assert found[0].candidates > 0
    for one in found:
        assert one.total_s == pytest.approx(sum(one.seconds[stage] for stage in STAGES))
        assert min(one.seconds[stage] for stage in STAGES) > 0.0
        assert all(peak > 10_000_000 for peak in one.peaks.values())
    assert not list(tmp_path.iterdir())  # scratch is gone


def test_the_profile_names_the_kernels(suburb: Path, tmp_path: Path) -> None:
    everything = 100_000  # on a fast machine each function takes next to nothing, so any may come last
    reported = profile([str(suburb)], None, str(tmp_path), everything)
    assert "tottime" in reported
    assert "ingest.py" in reported


def test_the_profile_names_no_more_functions_than_asked_for(suburb: Path, tmp_path: Path) -> None:
    assert len(profile([str(suburb)], None, str(tmp_path), 3).splitlines()) == 1 + 3


def test_a_tile_that_is_not_there_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["clock", "--out", str(tmp_path), "--data", str(tmp_path), "--tile", "none.laz"]) == 1
    assert "none.laz is not there" in capsys.readouterr().err


def test_a_piece_laid_side_by_side_holds_every_point_shifted(tmp_path: Path) -> None:
    path = large_file(tmp_path, (60.0, 40.0), (2, 3), 1.0)
    xyz = laspy.read(path).xyz
    n = len(xyz) // 6
    assert len(xyz) == 6 * n
    for k, shift in enumerate([(60.0 * column, 40.0 * row, 0.0) for column in range(2) for row in range(3)]):
        assert np.abs(xyz[k * n : (k + 1) * n] - xyz[:n] - shift).max() < 1e-6
    assert [entry.name for entry in tmp_path.iterdir()] == ["large_city.las"]


def test_a_large_city_is_made_once_split_and_removed(tmp_path: Path) -> None:
    words = ["large", "--out", str(tmp_path), "--piece", "80", "60", "--repeats", "1", "1", "--density", "1"]
    assert main([*words, "--workers", "0", "--simulate-only"]) == 0
    written = (tmp_path / "large_city.las").stat().st_mtime_ns
    assert main([*words, "--workers", "0", "--keep"]) == 0
    assert (tmp_path / "large_city.las").stat().st_mtime_ns == written
    reported = (tmp_path / "large.md").read_text()
    assert "0 workers" in reported
    assert "| driver | " in reported
    assert main([*words, "--workers", "0"]) == 0
    assert not (tmp_path / "large_city.las").exists()
