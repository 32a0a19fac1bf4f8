"""What processes of ours set for themselves, and what those of others keep."""

import subprocess
import sys

import pytest

STARTS = pytest.mark.parametrize(
    ("start", "ours"),
    [
        ("import service.cli", False),
        ("from pipeline.runtime.isolation.start_up import start_own_process as s; s(); s()", True),
    ],
    ids=["imported as a library", "a process of ours"],
)


@STARTS
def test_garbage_is_collected_more_rarely_in_processes_of_ours_alone(start: str, ours: bool) -> None:
    script = f"import gc; usual = gc.get_threshold(); {start}; print(gc.get_threshold() != usual, gc.isenabled())"
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ended.stdout.split() == [str(ours), "True"]


@STARTS
def test_what_is_left_at_the_end_is_collected_but_in_processes_of_ours(start: str, ours: bool) -> None:
    script = f"""{start}
import atexit, os
class Cycle:
    def __del__(self, write=os.write):
        write(1, b"collected ")
atexit.register(os.write, 1, b"closed ")
cycle = Cycle()
cycle.itself = cycle
"""
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ended.stdout.split() == (["closed"] if ours else ["closed", "collected"])


def test_pandas_is_hidden_in_processes_of_ours_except_from_pvlib() -> None:
    pytest.importorskip("pvlib", reason="the extra solar is not installed")
    script = """
from pipeline.runtime.isolation.start_up import start_own_process
start_own_process()
try:
    import pandas
except ModuleNotFoundError:
    print("hidden")
import pvlib
import pandas
print(pvlib.location.Location(52.0, 4.4).latitude)
"""
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ended.stdout.split() == ["hidden", "52.0"]
