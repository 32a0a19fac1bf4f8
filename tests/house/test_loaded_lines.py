"""The modules that a default run loads: what a run does not need is loaded only where an option or the data ask for it.

A chapter that comes later lives behind such a seam, or takes the place of something.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from plain_houses import houses, write_houses

MOST_LINES = 39_380
"""Lines of the loaded modules of `pipeline` and `service`, whole files. Lower it whenever the number falls."""
NAMED = 25
"""Largest modules that the failure names."""

PROGRAM = """
import atexit, sys
from service.cli import main
def print_loaded():
    packages = {"pipeline", "service"}
    own = [(name, found.__file__) for name, found in sys.modules.items() if name.split(".")[0] in packages]
    print(*(f"loaded {name} {path}" for name, path in own), sep="\\n")
atexit.register(print_loaded)
main()
"""


def loaded_lines(*words: str) -> dict[str, int]:
    """Lines of each module that a command has loaded when it ends, by its name."""
    ended = subprocess.run([sys.executable, "-c", PROGRAM, *words], capture_output=True, text=True, check=True)
    found = [line.split(" ", 2)[1:] for line in ended.stdout.splitlines() if line.startswith("loaded ")]
    return {name: len(Path(path).read_text().splitlines()) for name, path in found}


@pytest.mark.slow
def test_a_default_run_loads_no_more_lines_than_it_may(tmp_path: Path) -> None:
    scene = houses()
    tile = write_houses(tmp_path / "tile.laz", scene, classes=np.where(scene.house < 0, 2, 6))
    words = ("reconstruct", str(tile), "--workers", "0", "--overwrite", "--out", str(tmp_path / "run"))
    lines = loaded_lines(*words)
    if "pipeline.compiler.warm_up" in lines:  # the first run of a checkout compiles kernels
        lines = loaded_lines(*words)
    assert {"pipeline.runtime.run", "pipeline.recipe", "pipeline.export.tile"} <= set(lines)
    largest = sorted(lines, key=lambda name: -lines[name])[:NAMED]
    table = "\n".join(f"{lines[name]:6d} {name}" for name in largest)
    total = sum(lines.values())
    assert total <= MOST_LINES, f"{total} lines in {len(lines)} modules, {MOST_LINES} may be; the largest:\n{table}"
