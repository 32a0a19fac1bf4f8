"""Stored files show whether kernels are compiled; nothing is compiled to find out."""

import os
import subprocess
import sys
from pathlib import Path

KERNEL = """
from pipeline.compiler import kernel

@kernel
def half(x):
    return x / {divisor}
"""
ASKED = "from kernel import half; from pipeline.runtime.cluster.compiled_kernels import kernels_are_compiled as found; "


def says(folder: Path, words: str, **environment: str) -> list[str]:
    """What another process prints, that has its own cache."""
    path = os.pathsep.join([str(folder), *filter(None, sys.path)])
    env = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONPATH": path, **environment}
    ended = subprocess.run([sys.executable, "-c", words], env=env, capture_output=True, text=True, check=True)
    return ended.stdout.split()


def test_a_kernel_is_compiled_once_it_was_called_here_and_no_more_when_source_or_processor_change(
    tmp_path: Path,
) -> None:
    source = tmp_path / "kernel.py"
    source.write_text(KERNEL.format(divisor="2.0"))
    assert says(tmp_path, ASKED + "print(found((half,))); half(3.0); print(found((half,)))") == ["False", "True"]
    assert says(tmp_path, ASKED + "print(found((half,)))") == ["True"]
    assert says(tmp_path, ASKED + "print(found((half,)))", NUMBA_CPU_NAME="x86-64-v3") == ["False"]
    # of another length: Python believes its compiled copy of a source with the same second and length
    source.write_text(KERNEL.format(divisor="30.0"))
    assert says(tmp_path, ASKED + "print(found((half,)))") == ["False"]


def test_an_empty_cache_is_noticed_and_stays_empty_and_without_numba_nothing_need_be_compiled(tmp_path: Path) -> None:
    asked = "from pipeline.runtime.cluster.compiled_kernels import kernels_are_compiled as found; print(found())"
    assert says(tmp_path, asked) == ["False"]
    assert list((tmp_path / "cache").rglob("*.kernel")) == []
    assert says(tmp_path, asked, NUMBA_DISABLE_JIT="1") == ["True"]
