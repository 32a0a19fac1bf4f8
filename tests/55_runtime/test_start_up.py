"""What processes of ours spare themselves, and what those of others keep."""

from __future__ import annotations

import subprocess
import sys

import pytest

from pipeline.runtime.start_up import UNUSED

FORMATS = """
import sys
from pipeline.runtime.start_up import start_own_process
start_own_process()
start_own_process()
import laspy, numpy, pyarrow, pyogrio
assert pyarrow.array(numpy.arange(3)).to_pylist() == [0, 1, 2]
loaded = sorted(name for name in {unused!r} if name in sys.modules)
assert not loaded, loaded
finders = [finder for finder in sys.meta_path if type(finder).__module__ == "pipeline.runtime.start_up"]
assert len(finders) == 1, finders
try:
    import {package}
except ModuleNotFoundError as error:
    print(error.name)
"""
KERNELS = """
import sys
from pipeline.runtime.start_up import start_own_process
start_own_process()
import numpy
from pipeline.geometry import ring_area_m2
assert ring_area_m2(numpy.array([[0.0, 0.0], [2.0, 0.0], [2.0, 1.0], [0.0, 1.0]])) == 2.0
assert "scipy.linalg" not in sys.modules
from numba import njit
print(njit(lambda a, b: numpy.dot(a, b))(numpy.ones(3), numpy.full(3, 2.0)))
import scipy.sparse
"""


def told_by(script: str) -> str:
    """What a process of its own prints that runs a script; it must end well."""
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout.strip()


@pytest.mark.parametrize("package", sorted(UNUSED))
def test_a_process_of_ours_loads_the_formats_without_packages_that_it_never_uses(package: str) -> None:
    assert told_by(FORMATS.format(unused=sorted(UNUSED), package=package)) == package


def test_a_kernel_loads_no_linear_algebra_and_one_that_wants_blas_finds_it() -> None:
    assert told_by(KERNELS) == "6.0"


def test_a_program_that_imports_this_one_keeps_its_packages_and_its_garbage_collection() -> None:
    script = "import gc; t = gc.get_threshold(); import service.cli, pandas; print(gc.get_threshold() == t)"
    assert told_by(script) == "True"
