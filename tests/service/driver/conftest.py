"""The programs that tests start, and a house to model."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import Programs, free_port, postgres_server, postgres_url, programs

from pipeline.ruler.simulation.dataset import simulate

__all__ = ["postgres_server", "postgres_url", "programs"]


@pytest.fixture(scope="module")
def lasting(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Programs]:
    """Programs that serve all tests of a file."""
    some = Programs(tmp_path_factory.mktemp("lasting"))
    try:
        yield some
    finally:
        some.end()


@pytest.fixture(scope="module")
def scheduler(lasting: Programs) -> str:
    """The address of a scheduler, without workers: drivers that need none, or share some, start without their own."""
    port = free_port()
    lasting.start_scheduler(port)
    return f"tcp://127.0.0.1:{port}"


@pytest.fixture(scope="session")
def tile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A gabled house."""
    return simulate("gable", tmp_path_factory.mktemp("gable")).laz
