"""Memory of the test's process, and programs in processes of their own."""

import contextlib
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator


@contextlib.contextmanager
def memory_below(limit_bytes: float) -> Iterator[None]:
    """Python objects made within the block never take as much as the limit."""
    tracemalloc.start()
    try:
        yield
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < limit_bytes


def printed(program: str, *arguments: object) -> list[str]:
    """The words that a Python program prints."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
