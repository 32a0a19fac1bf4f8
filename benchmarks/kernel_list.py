"""Writes pipeline/compiler/kernels.json: the kernels that Python calls, with their signatures and users.

    make kernels

runs commands that reach all parts of the product in an empty folder of kernels, and lists what they compiled. Run it
after a kernel was added or removed, or is called with other types. It takes some minutes. A kernel that
the list lacks is compiled at its first call, so an old list costs only time.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from pipeline.compiler.signatures import to_json
from pipeline.compiler.store import ENDING, Stored
from pipeline.compiler.warm_up import LIST, Listed, write_list


def commands(folder: Path) -> dict[str, list[str]]:
    """What to run, by group: a group lists what those before it did not compile. Scenes come first, under no name."""
    scene = folder / "scene"
    tile, truth = scene / "suburb.laz", scene / "truth"
    gables = folder / "gables"
    every = "fuzzy-sart,parameter-space-2d,parameter-space-3d,kmeans"
    faithful = ",".join(f"{name}:faithful" for name in every.split(","))
    return {
        "": [f"simulate suburb --out {scene} --with-classes", f"simulate hofmann310 --out {gables}"],
        "reconstruct": [
            f"reconstruct {tile} --out {folder}/plain --classes ignore --workers 0",
            f"reconstruct {tile} --out {folder}/apart --classes ignore --workers 2",
            f"reconstruct {tile} --out {folder}/trusted --workers 2 --lods 1.2,1.3,2.2",
            f"reconstruct {tile} --out {folder}/given --workers 0 --footprints {truth}/buildings/*/*.parquet",
            f"reconstruct {gables}/hofmann310.laz --out {folder}/others --workers 0 --meshes glb",
        ],
        "simulate": [
            f"simulate suburb --out {folder}/again",
            f"simulate city --size 60 60 --out {folder}/city",
            f"simulate hofmann310 --out {folder}/gables_again",
        ],
        "evaluate": [
            f"evaluate {folder}/plain --truth {truth} --out {folder}/report",
            f"evaluate {folder}/plain --points {tile} --out {folder}/measured",
        ],
        "classify": [f"classify {tile} --out {folder}/classified --rasters --classes ignore"],
        "terrain": [f"reconstruct {tile} --out {folder}/terrain --classes ignore --workers 0 --terrain tin"],
        "compare": [f"compare {tile} --methods {every},{faithful} --out {folder}/compared"],
        "diff": [f"batch diff {folder}/plain {folder}/trusted --out {folder}/changes"],
        "solar": [f"solar {folder}/plain --out {folder}/solar.parquet"],
    }


def compiled(folder: Path) -> dict[str, Listed]:
    """The kernels of a folder that Python calls, by file name."""
    found = {}
    for path in folder.glob(f"*{ENDING}"):
        content = path.read_bytes()
        stored = Stored.from_bytes(content, Stored.fingerprint_of(content))
        if stored is None or not stored.machine_code:
            continue
        function, _, signature, *_ = pickle.loads(stored.facts)
        found[path.name] = Listed(
            kernel=f"{function.modname}:{function.qualname}",
            arguments=[to_json(kind) for kind in signature.args],
            weight=-(-len(content) // 1000),
        )
    return found


def expanded(pattern: str) -> list[str]:
    """The files that an absolute pattern matches."""
    return sorted(str(path) for path in Path("/").glob(pattern.lstrip("/")))


def main() -> None:
    """Run the commands and write the list."""
    groups: dict[str, list[Listed]] = {}
    with TemporaryDirectory(prefix="gablework-") as name:
        folder = Path(name)
        known: set[str] = set()
        for group, lines in commands(folder).items():
            # scenes are made apart: their kernels are listed with `simulate`
            kernels = folder / ("kernels" if group else "kernels of scenes")
            environment = {**os.environ, "NUMBA_CACHE_DIR": str(kernels)}
            for command in lines:
                print(command, flush=True)
                words = [w for word in command.split() for w in (expanded(word) if "*" in word else (word,))]
                subprocess.run([sys.executable, "-m", "service.cli", *words, "--quiet"], env=environment, check=True)
            if not group:
                continue
            found = compiled(kernels)
            groups[group] = [one for file, one in found.items() if file not in known]
            known.update(found)
            print(f"{group}: {len(groups[group])} kernels", flush=True)
    write_list(groups, LIST)


if __name__ == "__main__":
    main()
