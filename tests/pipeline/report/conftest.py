"""Fixtures of the report tests: a finished run of small buildings."""

from collections.abc import Callable
from pathlib import Path

import pytest
from small_runs import street, write_run

from pipeline.model import BuildingResult

MakeRun = Callable[..., Path]


@pytest.fixture
def make_run(tmp_path: Path) -> MakeRun:
    """Write a run of the given buildings, in metres or in feet."""

    def make(results: list[BuildingResult], name: str = "run", unit_m: float = 1.0) -> Path:
        return write_run(tmp_path / name, results, unit_m)

    return make


@pytest.fixture
def street_run(make_run: MakeRun) -> Path:
    return make_run(street())
