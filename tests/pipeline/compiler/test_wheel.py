"""After kernels were compiled ahead, or come with a wheel, no command compiles anything."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest
from checkout import ROOT

COUNTING = """
import os
from numba.core import event

class Counting(event.Listener):
    def on_start(self, started):
        line = f"{os.getpid()} {started.data['dispatcher'].py_func.__qualname__}\\n"
        with open(os.environ["COMPILED"], "a") as file:
            file.write(line)

    def on_end(self, ended):
        pass

event.register("numba:compile", Counting())
"""
KEEPING = """
import os
import shutil
from pathlib import Path

from pipeline.compiler import store, storing

loaded, saved = store.load, storing.save

def keep(name):
    shutil.copy(store.folder_of_kernels() / (name + store.ENDING), os.environ["KEPT"])

def load(name, fingerprint, **options):
    found = loaded(name, fingerprint, **options)
    if found is not None:
        keep(name)
    return found

def save(name, fingerprint, stored):
    saved(name, fingerprint, stored)
    keep(name)

store.load, storing.save = load, save
"""

PROGRAM = [sys.executable, "-P", "-m", "service.cli"]

METHODS = ("arrangement", "fuzzy-sart", "parameter-space-2d", "parameter-space-3d", "kmeans")
COMMANDS = (
    "simulate suburb --size 70 70 --with-classes --out scene",
    "reconstruct scene/suburb.laz --out arrangement",
    "reconstruct scene/suburb.laz --method kmeans --out kmeans",
    "reconstruct scene/suburb.laz --classes ignore --workers 0 --out serial",
    "reconstruct scene/suburb.laz --classes ignore --workers 2 --out cluster",
    "evaluate arrangement --truth scene/truth --out against-truth",
    "evaluate arrangement --points scene/suburb.laz --out against-points",
    "classify scene/suburb.laz --classes ignore --out classified",
    "classify scene/suburb.laz --classes ignore --rasters --workers 0 --out with-rasters",
    f"compare scene/suburb.laz --methods {','.join(METHODS)} --truth scene/truth --out compared",
    "compare scene/suburb.laz --methods kmeans,fuzzy-sart:faithful --workers 0 --out compared-serially",
    "batch diff arrangement kmeans --out changes",
)
"""Commands that compile nothing after `warm-up all`, by docs/how_to/plan_a_run.md.

The suite hofmann310 is left out: `simulate` calls `pipeline.ruler.simulation.survey_faults.move_faulty` for it, which
`kernels.json` lacks.
"""


def done(command: list[str], folder: Path, **environment: str) -> str:
    """Run a command in a folder; returns what it prints. It must succeed."""
    ended = subprocess.run(
        command, cwd=folder, env={**os.environ, **environment}, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, f"{' '.join(command)}\n{ended.stderr}"
    return ended.stdout + ended.stderr


@pytest.fixture(scope="module")
def ahead(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with exactly the kernels that `warm-up all` compiles, or finds compiled in the folder that tests use."""
    folder, keeping = tmp_path_factory.mktemp("ahead"), tmp_path_factory.mktemp("keeping")
    (keeping / "sitecustomize.py").write_text(KEEPING)
    done([*PROGRAM, "warm-up", "all", "--quiet"], ROOT, PYTHONPATH=str(keeping), KEPT=str(folder))
    return folder


@pytest.fixture
def counted(tmp_path: Path) -> Path:
    """A folder for PYTHONPATH: every Python process then writes the kernels it compiles to the file `COMPILED`."""
    folder = tmp_path / "counted"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(COUNTING)
    return folder


def noted(path: Path) -> list[str]:
    """Names of the kernels compiled by any process."""
    return [line.split()[1] for line in path.read_text().splitlines()] if path.exists() else []


@pytest.mark.slow
def test_no_command_compiles_anything_after_warm_up_all(ahead: Path, counted: Path, tmp_path: Path) -> None:
    kernels, compiled = tmp_path / "kernels", tmp_path / "compiled.txt"
    shutil.copytree(ahead, kernels)
    environment = {
        "PYTHONPATH": os.pathsep.join((str(counted), str(ROOT))),
        "NUMBA_CACHE_DIR": str(kernels),
        "COMPILED": str(compiled),
    }
    found = {}
    for command in COMMANDS:
        done([*PROGRAM, *command.split(), "--quiet"], tmp_path, **environment)
        found[command] = noted(compiled)
        compiled.unlink(missing_ok=True)
    assert {command: names for command, names in found.items() if names} == {}
    for method in METHODS:
        manifest = json.loads((tmp_path / "compared" / "runs" / method / "run.json").read_text())
        assert manifest["counts"]["candidates"] > 0
        assert manifest["settings"]["general"]["method"] == method

    # children of a command are counted, too
    (lost,) = kernels.glob("pipeline.terrain.thinning._highest_per_cell.*")
    lost.unlink()
    done([*PROGRAM, *COMMANDS[1].split(), "--overwrite", "--quiet"], tmp_path, **environment)
    assert "_highest_per_cell" in noted(compiled)


@pytest.mark.slow
def test_a_wheel_with_kernels_compiles_nothing_in_any_process_also_where_nothing_can_be_written(
    ahead: Path, counted: Path, tmp_path: Path
) -> None:
    source = tmp_path / "source"
    for name in ("pipeline", "service"):
        ignored = shutil.ignore_patterns("__pycache__", "node_modules", "viewer", "compiled")
        shutil.copytree(ROOT / name, source / name, ignore=ignored)
    for name in ("pyproject.toml", "hatch_build.py", "README.md", "LICENSE", "THIRD_PARTY_NOTICES.md"):
        shutil.copy(ROOT / name, source / name)
    page = source / "service" / "viewer" / "dist"
    page.mkdir(parents=True)
    (page / "index.html").write_text("<!doctype html>")

    into = str(source / "pipeline" / "compiled")
    done([*PROGRAM, "warm-up", "all", "--into", into, "--quiet"], ROOT, NUMBA_CACHE_DIR=str(ahead))
    build = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(tmp_path)]
    ended = subprocess.run(build, cwd=source, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    (wheel,) = tmp_path.glob("*.whl")
    version = f"cp{sys.version_info.major}{sys.version_info.minor}"
    platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    assert wheel.name.endswith(f"-{version}-{version}-{platform}.whl")

    installed = tmp_path / "installed"
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(installed)
    done([*PROGRAM, "simulate", "suburb", "--size", "70", "70", "--out", "scene", "--quiet"], tmp_path)
    (tmp_path / "file").write_text("")
    environment = {
        "PYTHONPATH": os.pathsep.join((str(counted), str(installed))),
        "NUMBA_CACHE_DIR": str(tmp_path / "file" / "kernels"),  # nothing can be written there
        "COMPILED": str(tmp_path / "compiled.txt"),
    }
    for words in (["--workers", "0", "--isolate"], ["--workers", "2"], []):
        out = tmp_path / f"models{len(words)}"
        command = [*PROGRAM, "reconstruct", "scene/suburb.laz", "--out", str(out), *words, "--quiet"]
        said = done(command, tmp_path, **environment)
        assert "is compiled now" not in said, said
        manifest = json.loads((out / "run.json").read_text())
        assert manifest["counts"]["candidates"] > 0
    assert noted(tmp_path / "compiled.txt") == []
