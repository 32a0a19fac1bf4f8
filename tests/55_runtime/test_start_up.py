"""What processes of ours set for themselves, and what those of others keep."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("start", "changed"),
    [("import service.cli", False), ("from pipeline.runtime.start_up import start_own_process as s; s(); s()", True)],
    ids=["imported as a library", "a process of ours"],
)
def test_garbage_is_collected_more_rarely_in_processes_of_ours_alone(start: str, changed: bool) -> None:
    script = f"import gc; usual = gc.get_threshold(); {start}; print(gc.get_threshold() != usual, gc.isenabled())"
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ended.stdout.split() == [str(changed), "True"]
