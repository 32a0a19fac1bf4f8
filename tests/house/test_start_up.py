"""What is imported, and when: start-up counts in every worker process."""

import resource
import subprocess
import sys

import pytest
from measured import printed

HEAVY = {"dask", "distributed", "pandas", "geopandas", "pyarrow", "matplotlib", "fastapi", "laspy", "pyogrio"}
SCIENCE = {"numpy", "numba", "scipy", "shapely"}


def modules_after(statement: str) -> set[str]:
    """Top-level modules that a fresh interpreter has loaded after a statement."""
    return set(printed(f"{statement}\nimport sys\nprint(*(name.split('.')[0] for name in sys.modules))"))


@pytest.mark.parametrize(
    ("modules", "unused"),
    [
        ("pipeline.recipe", HEAVY),
        ("service.cli", HEAVY | SCIENCE),
        ("service.client", HEAVY | SCIENCE | {"pydantic", "starlette", "sqlalchemy"}),
        ("pipeline.settings", HEAVY | SCIENCE),
        ("pipeline.runtime.run", {"dask", "distributed", "matplotlib", "psutil", "pythonjsonlogger"}),
        ("service.app, service.run_settings", HEAVY - {"geopandas", "pyarrow", "fastapi"} | {"numba", "scipy"}),
    ],
)
def test_what_is_not_needed_is_not_imported(modules: str, unused: set[str]) -> None:
    assert modules_after(f"import {modules}") & unused == set()


def test_the_check_sees_a_heavy_import() -> None:
    assert "pandas" in modules_after("import pandas")


def test_help_comes_at_once() -> None:
    def spent_s() -> float:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime

    seconds = []
    for _ in range(3):
        before = spent_s()
        subprocess.run([sys.executable, "-m", "service.cli", "--help"], capture_output=True, check=True)
        seconds.append(spent_s() - before)
    # processor time, not the clock: a busy machine must not fail the test
    assert min(seconds) < 0.5
