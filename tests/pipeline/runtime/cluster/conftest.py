"""Real schedulers, workers, drivers and APIs on the loopback."""

from pathlib import Path

import pytest
from batch_faults import SETTINGS, Undisturbed, buildings_of
from processes import programs

from pipeline.ruler.simulation.dataset import simulate
from pipeline.runtime.digest import run_digest
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import SERIAL
from pipeline.runtime.run import run
from pipeline.settings import RunSettings

__all__ = ["programs"]


@pytest.fixture(scope="session")
def town_tile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A town of a few dozen buildings."""
    return simulate("town", tmp_path_factory.mktemp("scene"), 5, size_m=(150.0, 150.0), density_per_m2=3.0).laz


@pytest.fixture(scope="session")
def undisturbed_batch(town_tile: Path, tmp_path_factory: pytest.TempPathFactory) -> Undisturbed:
    """What a batch of the town delivers when nothing happens to it: a run in this process, which costs least."""
    out = str(tmp_path_factory.mktemp("undisturbed") / "run")
    run(RunRequest(inputs=(str(town_tile),), out=out, settings=RunSettings.from_mapping(SETTINGS), resources=SERIAL))
    found = Undisturbed(digest=run_digest(out), buildings=buildings_of(out))
    assert len(found.buildings) >= 24
    return found


@pytest.fixture(scope="session")
def tile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A simulated suburb of about 100 x 100 m."""
    return simulate("suburb", tmp_path_factory.mktemp("suburb"), 3, size_m=(100.0, 100.0), density_per_m2=4.0).laz


@pytest.fixture(scope="session")
def digest(tile: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The digest of an undisturbed run on it in one process, in tiles of 40 m."""
    out = str(tmp_path_factory.mktemp("run") / "run")
    settings = RunSettings.from_mapping({"tile_size_m": 40.0})
    return run(RunRequest(inputs=(str(tile),), out=out, settings=settings, resources=SERIAL)).digest
