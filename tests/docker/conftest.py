"""The files of docker/, read, and the programs that tests start."""

from pathlib import Path

import pytest
from container_files import Compose, Image, laid_over, read_compose, read_image
from processes import open_folder, postgres_server, programs

__all__ = ["open_folder", "postgres_server", "programs"]

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def root() -> Path:
    """The repository."""
    return ROOT


@pytest.fixture(scope="session")
def image() -> Image:
    """docker/Dockerfile."""
    return read_image(ROOT / "docker" / "Dockerfile")


@pytest.fixture(scope="session")
def compose() -> Compose:
    """docker/compose.yaml."""
    return read_compose(ROOT / "docker" / "compose.yaml")


@pytest.fixture(scope="session", params=["", "tls", "s3", "tls s3"], ids=["alone", "tls", "s3", "tls and s3"])
def composed_files(request: pytest.FixtureRequest, compose: Compose) -> Compose:
    """docker/compose.yaml alone, and with the files that may be laid over it."""
    for name in request.param.split():
        compose = laid_over(compose, read_compose(ROOT / "docker" / f"compose.{name}.yaml"))
    return compose
