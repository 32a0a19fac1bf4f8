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


_PRINT_PEAK = """
from pathlib import Path
print(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0])
"""


def printed_with_peak(program: str, *arguments: object) -> list[str]:
    """The words that a Python program prints, then the largest resident size of its process in kB.

    `getrusage` will not do: it starts from the peak of the process that started the program.
    """
    return printed(program + _PRINT_PEAK, *arguments)
