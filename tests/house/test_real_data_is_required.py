"""Where the real data must be there, a test that needs them cannot quietly skip."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1]

SKIPPING = """
import pytest


@pytest.fixture
def tile(shared_data):
    return shared_data / "tile.laz"


def test_that_needs_the_data(tile):
    pytest.skip("the file is not there")


def test_that_skips_for_another_reason():
    pytest.skip("no such program")
"""


def outcome(house: Path, required: str) -> str:
    """The closing line of pytest in a small house of its own."""
    # without the plugins, whose import takes longer than all the rest
    environment = {**os.environ, "GABLEWORK_REQUIRE_SHARED_DATA": required, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests"]
    return subprocess.run(command, cwd=house, env=environment, capture_output=True, text=True, check=False).stdout


@pytest.mark.parametrize("data_are_there", [True, False])
def test_a_skip_becomes_a_failure_only_where_the_data_are_required(tmp_path: Path, data_are_there: bool) -> None:
    house = tmp_path / "house"
    (house / "tests").mkdir(parents=True)
    for name in ("conftest.py", "support/examples.py"):
        shutil.copy(TESTS / name, house / "tests")
    (house / "tests" / "test_skipping.py").write_text(SKIPPING)
    if data_are_there:
        (tmp_path / "shared" / "data").mkdir(parents=True)
    assert "2 skipped" in outcome(house, required="0")
    closing = outcome(house, required="1")
    assert re.search("1 failed, 1 skipped|1 skipped, 1 error", closing), closing


def test_real_data_are_found_through_the_fixture_only() -> None:
    direct = re.compile(r"shared[\"']?\s*/\s*[\"']?data|SHARED_DATA")
    exempt = {TESTS / "conftest.py", Path(__file__).resolve()}
    found = [path.name for path in TESTS.rglob("*.py") if path not in exempt and direct.search(path.read_text())]
    assert found == []
