"""Real schedulers, workers, drivers and APIs on the loopback."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).parent))

from batch_faults import BatchRun
from processes import Programs, programs

from pipeline.synthetic.dataset import simulate

__all__ = ["programs"]


@pytest.fixture(scope="session")
def town_tile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A town of a few dozen buildings."""
    return simulate("town", tmp_path_factory.mktemp("scene"), 5, size_m=(150.0, 150.0), density_per_m2=3.0).laz


@pytest.fixture(scope="session")
def undisturbed_batch(town_tile: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[BatchRun]:
    """A batch run that nothing happens to."""
    folder = tmp_path_factory.mktemp("undisturbed")
    some = Programs(folder)
    try:
        run = BatchRun(some, folder / "run", town_tile)
        driver = run.start()
        assert driver.ended() == 0, driver.tail()
        assert run.status()["state"] == "finished"
        assert len(run.buildings()) >= 24
        yield run
    finally:
        some.end()
