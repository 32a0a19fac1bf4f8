"""The programs that tests start, and a house to model."""

from pathlib import Path

import pytest
from processes import postgres_server, postgres_url, programs

from pipeline.ruler.simulation.dataset import simulate

__all__ = ["postgres_server", "postgres_url", "programs"]


@pytest.fixture(scope="session")
def tile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A gabled house."""
    return simulate("gable", tmp_path_factory.mktemp("gable")).laz
