"""The contracts of pyproject.toml hold, and would catch what they forbid."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def lint_imports(root: Path) -> subprocess.CompletedProcess[str]:
    """Run the contracts on the packages in a folder."""
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command as c; c()", "--no-cache"]
    environment = {**os.environ, "PYTHONPATH": str(root)}
    return subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def copied_house(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the sources that a test may spoil."""
    copy = tmp_path_factory.mktemp("house")
    for package in ("pipeline", "service"):
        shutil.copytree(ROOT / package, copy / package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", copy)
    return copy


def test_the_sources_keep_all_contracts(copied_house: Path) -> None:
    result = lint_imports(copied_house)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.parametrize(
    ("module", "statement", "contract"),
    [
        ("pipeline/model.py", "import service", "The service stands on the pipeline"),
        ("pipeline/geometry.py", "import pipeline.tin", "Layers of the pipeline"),
        ("pipeline/kernels/union_find.py", "import pipeline.geometry", "Layers of the pipeline"),
        ("pipeline/terrain/ground.py", "import pipeline.roof", "Layers of the pipeline"),
        ("pipeline/tin/delaunay.py", "import pipeline.io", "The science knows no files"),
        ("pipeline/extras/papers/fuzzy_sart_clusters.py", "import dask", "The science knows no files"),
        ("pipeline/recipe.py", "import pandas", "The science knows no files"),
        (
            "pipeline/extras/papers/fuzzy_sart_clusters.py",
            "import pipeline.segmentation.plane_refinement",
            "Steps of a segmentation do not import one another",
        ),
        (
            "pipeline/runtime/run_plan.py",
            "from dask.distributed import Client",
            "Only the engine's own modules import Dask",
        ),
        ("pipeline/runtime/run_context.py", "import pipeline.runtime.stages", "Chapters of a run"),
        ("pipeline/runtime/cluster/needs.py", "import pipeline.runtime.resources", "Chapters of a run"),
        ("pipeline/runtime/newcomer.py", "", "Chapters of a run"),
        ("pipeline/newcomer.py", "", "Layers of the pipeline"),
        ("service/newcomer.py", "", "Layers of the service"),
    ],
)
def test_a_forbidden_import_is_caught(copied_house: Path, module: str, statement: str, contract: str) -> None:
    path = copied_house / module
    before = path.read_text() if path.exists() else None
    path.write_text(f"{before or ''}\n{statement}\n")
    try:
        result = lint_imports(copied_house)
    finally:
        if before is None:
            path.unlink()
        else:
            path.write_text(before)
    assert result.returncode != 0
    broken = [line for line in result.stdout.splitlines() if " BROKEN" in line]
    assert any(contract in line for line in broken), result.stdout
