"""What is imported, and when: start-up counts in every worker process."""

from __future__ import annotations

import json
import resource
import subprocess
import sys

HEAVY = ("dask", "distributed", "pandas", "geopandas", "pyarrow", "matplotlib", "fastapi", "laspy", "pyogrio")


def modules_after(statement: str) -> set[str]:
    """Top-level modules that a fresh interpreter has loaded after a statement."""
    code = f"{statement}\nimport json, sys\nprint(json.dumps(sorted(set(m.split('.')[0] for m in sys.modules))))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(json.loads(result.stdout.splitlines()[-1]))


def test_the_science_imports_no_engine_and_no_data_frames() -> None:
    assert modules_after("import pipeline.reconstruct") & set(HEAVY) == set()


def test_the_console_script_imports_nothing_heavy() -> None:
    assert modules_after("import service.cli") & {*HEAVY, "numpy", "numba", "scipy", "shapely"} == set()


def test_settings_import_no_kernel_and_no_library() -> None:
    heavy = {*HEAVY, "numpy", "numba", "scipy", "shapely"}
    assert modules_after("import pipeline.settings") & heavy == set()


def test_a_serial_run_imports_no_engine_and_nothing_for_child_processes() -> None:
    unused = {"dask", "distributed", "matplotlib", "psutil", "pythonjsonlogger"}
    assert modules_after("import pipeline.runtime.run") & unused == set()


def test_the_api_knows_all_settings_without_the_science() -> None:
    unused = {"numba", "scipy", "dask", "distributed", "matplotlib", "pyogrio", "laspy", "pandas"}
    assert modules_after("import service.app, service.run_settings") & unused == set()


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
