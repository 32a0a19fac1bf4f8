"""Counts what a second run repeats after some tiles of a city changed: tasks by stage, buildings, time.

    python -m benchmarks.changed_tiles --out DIR [--tiles 100] [--changed 1] [--workers 2]

makes a city in tiles (`city_tiles.py`), runs it with a work folder, and then again after each of three changes, each
undone before the next:

- touched: a file is written again with the same points;
- one building: high points within 6 m of a high point near the middle of a file are raised by 1 m;
- flown again: all points of a tile have other noise (1 cm), as after a new flight.

The second run is right if its digest equals that of an independent run; `--check` makes one.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import shutil
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import laspy
import numpy as np

from benchmarks.city_tiles import main as make_tiles
from benchmarks.entries import markdown_table
from pipeline.runtime.monitoring.progress import Event
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import Resources
from pipeline.runtime.run import RunSummary, run
from pipeline.settings import RunSettings

STAGES = ("ingest", "split", "reconstruct", "publish")


@dataclasses.dataclass(frozen=True)
class Again:
    """What a run did."""

    what: str
    """The change before it."""
    done: dict[str, int]
    """Units that were not kept, by stage."""
    total: dict[str, int]
    """Units of each stage."""
    modelled: int
    """Buildings that were modelled anew."""
    buildings: int
    """All buildings."""
    seconds: float
    """Wall clock."""
    digest: str
    """Digest of the content."""

    @property
    def cells(self) -> list[str]:
        """As the table has them."""
        share = 100.0 * self.modelled / max(1, self.buildings)
        stages = [f"{self.done[name]} of {self.total[name]}" for name in STAGES if name != "reconstruct"]
        return [self.what, *stages, f"{self.modelled} of {self.buildings} ({share:.2f} %)", f"{self.seconds:.1f}"]


def one_building(las: laspy.LasData) -> None:
    """What is high around the high point nearest to the middle of the tile lies 1 m higher."""
    x, y, z = np.array(las.x), np.array(las.y), np.array(las.z)
    from_middle = np.hypot(x - 0.5 * (x.min() + x.max()), y - 0.5 * (y.min() + y.max()))
    high = z > np.median(z) + 4.0
    place = np.flatnonzero(high)[from_middle[high].argmin()]
    z[high & (np.hypot(x - x[place], y - y[place]) < 6.0)] += 1.0
    las.z = z


def flown_again(las: laspy.LasData) -> None:
    """All points have other noise."""
    las.z = np.array(las.z) + np.random.default_rng(7).normal(0.0, 0.01, len(las.points))


CHANGES: dict[str, Callable[[laspy.LasData], object]] = {
    "touched": len,
    "one building": one_building,
    "flown again": flown_again,
}


def measured(what: str, tiles: Path, folder: Path, workers: int, *, fresh: bool = False) -> Again:
    """Run the city with its work folder, or without any."""
    done: Counter[str] = Counter()
    total: Counter[str] = Counter()

    def on_event(event: Event) -> None:
        if event.kind == "progress":
            done[event.stage] = max(done[event.stage], event.done - kept[event.stage])
            if event.kept:
                kept[event.stage] = event.kept
                done[event.stage] = 0
            total[event.stage] = event.total

    kept: Counter[str] = Counter()
    out = folder / ("fresh" if fresh else "models")
    request = RunRequest(
        inputs=(str(tiles),),
        out=str(out),
        settings=RunSettings.from_mapping({"classes": "ignore"}),
        resources=Resources(workers=workers, work=None if fresh else str(folder / "work")),
        overwrite=fresh,
        meshes="tile",
    )
    began = time.perf_counter()
    summary: RunSummary = run(request, on_event)
    counts = summary.counts
    return Again(
        what=what,
        done={name: done[name] for name in STAGES},
        total={name: total[name] for name in STAGES},
        modelled=counts["candidates"] - counts["reused"],
        buildings=counts["candidates"],
        seconds=time.perf_counter() - began,
        digest=summary.digest,
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tiles", type=int, default=100)
    parser.add_argument("--changed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--check", action="store_true")
    given = parser.parse_args(arguments)
    tiles: Path = given.out / "tiles"
    make_tiles(["--out", str(tiles), "--tiles", str(given.tiles)])
    rows = [measured("first run", tiles, given.out, given.workers), measured("none", tiles, given.out, given.workers)]
    files = sorted(tiles.glob("*.laz"))
    step = len(files) // given.changed
    chosen = files[step // 2 :: step][: given.changed]
    for what, change in CHANGES.items():
        before = {path: path.read_bytes() for path in chosen}
        for path in chosen:
            las = laspy.read(path)
            change(las)
            las.write(path)
        rows.append(measured(what, tiles, given.out, given.workers))
        if given.check:
            whole = measured("fresh", tiles, given.out, given.workers, fresh=True)
            assert whole.digest == rows[-1].digest, f"{what}: another content than that of a fresh run"
            shutil.rmtree(given.out / "fresh")
        for path, content in before.items():
            path.write_bytes(content)
        measured("undone", tiles, given.out, given.workers)
    heads = ["change", "files read", "tiles split", "tiles published", "buildings modelled", "seconds"]
    print(markdown_table(heads, [row.cells for row in rows]))
    (given.out / "changed_tiles.json").write_text(json.dumps([dataclasses.asdict(row) for row in rows], indent=1))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
