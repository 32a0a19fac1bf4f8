"""The wheel that `make wheel` builds: its kernels serve the first model, and nothing is compiled."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
COUNTING = """
import os
from numba.core import event

class Counting(event.Listener):
    def on_start(self, told):
        line = f"{os.getpid()} {told.data['dispatcher'].py_func.__qualname__}\\n"
        with open(os.environ["COMPILED"], "a") as file:
            file.write(line)

    def on_end(self, told):
        pass

event.register("numba:compile", Counting())
"""


@pytest.mark.slow
def test_a_wheel_with_kernels_compiles_nothing_in_any_process_also_where_nothing_can_be_written(
    tmp_path: Path,
) -> None:
    source = tmp_path / "source"
    for name in ("pipeline", "service"):
        ignored = shutil.ignore_patterns("__pycache__", "node_modules", "viewer", "compiled")
        shutil.copytree(ROOT / name, source / name, ignore=ignored)
    for name in ("pyproject.toml", "hatch_build.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source / name)
    page = source / "service" / "viewer" / "dist"
    page.mkdir(parents=True)
    (page / "index.html").write_text("<!doctype html>")

    def done(command: list[str], **environment: str) -> str:
        ended = subprocess.run(
            command, cwd=tmp_path, env={**os.environ, **environment}, capture_output=True, text=True, check=False
        )
        assert ended.returncode == 0, ended.stderr
        return ended.stdout + ended.stderr

    program = [sys.executable, "-P", "-m", "service.cli"]
    done([*program, "warm-up", "all", "--into", str(source / "pipeline" / "compiled"), "--quiet"])
    build = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(tmp_path)]
    ended = subprocess.run(build, cwd=source, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    (wheel,) = tmp_path.glob("*.whl")
    version = f"cp{sys.version_info.major}{sys.version_info.minor}"
    platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    assert wheel.name.endswith(f"-{version}-{version}-{platform}.whl")

    installed, counted = tmp_path / "installed", tmp_path / "counted"
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(installed)
    counted.mkdir()
    (counted / "sitecustomize.py").write_text(COUNTING)
    done([*program, "simulate", "suburb", "--size", "70", "70", "--out", "scene", "--quiet"])
    (tmp_path / "file").write_text("")
    environment = {
        "PYTHONPATH": os.pathsep.join((str(counted), str(installed))),
        "NUMBA_CACHE_DIR": str(tmp_path / "file" / "kernels"),  # nothing can be written there
        "COMPILED": str(tmp_path / "compiled.txt"),
    }
    for words in (["--workers", "0", "--isolate"], ["--workers", "2"], []):
        out = tmp_path / f"models{len(words)}"
        command = [*program, "reconstruct", "scene/suburb.laz", "--out", str(out), *words, "--quiet"]
        said = done(command, **environment)
        assert "is compiled now" not in said, said
        manifest = json.loads((out / "run.json").read_text())
        assert manifest["counts"]["candidates"] > 0
    compiled = tmp_path / "compiled.txt"
    assert (compiled.read_text() if compiled.exists() else "") == ""
