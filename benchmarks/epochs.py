"""Precision and recall of `gablework batch diff` per class, against simulated epochs.

    python -m benchmarks.epochs --out DIR [--split dev|test] [--only suburb town] [--size 620] [--jobs 2]
                                [--page docs/results/epochs.md]

Scenes of the suites `suburb` and `town` are changed by `benchmarks.two_epochs`, scanned twice with other seeds
of the scanner, in `suburb-mixed` with two kinds of survey, reconstructed without footprints and compared. Existing
runs in DIR are used again. Writes DIR/epochs_SPLIT.md and DIR/CASE-SPLIT/diff, and its lines into the page.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import shapely

from benchmarks.entries import markdown_table
from benchmarks.results_page import filled
from benchmarks.two_epochs import TwoEpochs, Work, two_epochs
from pipeline.ruler.epochs.diff import DiffRequest, diff
from pipeline.ruler.epochs.records import Change
from pipeline.ruler.simulation.als import ScannerSettings, scan
from pipeline.ruler.simulation.scene import Scene
from pipeline.ruler.simulation.seeds import seed_of
from pipeline.ruler.simulation.suites import suite_named
from pipeline.ruler.simulation.survey_files import write_points
from pipeline.runtime.manifest import NAME, RunStatus
from pipeline.runtime.manifest_reading import read_manifest
from pipeline.runtime.request import RunRequest
from pipeline.runtime.resources import Resources
from pipeline.runtime.run import run

SCANS = (101, 202)
"""Seeds of the scanner in the earlier and the later epoch."""
EXPECTED: Mapping[Work | None, Change] = {
    Work.BUILT: Change.NEW,
    Work.DEMOLISHED: Change.GONE,
    Work.RAISED: Change.RAISED,
    Work.LOWERED: Change.LOWERED,
    Work.NEW_ROOF: Change.RESHAPED,
    Work.EXTENDED: Change.RESHAPED,
    None: Change.UNCHANGED,
}
"""The change expected for a building, by what was done to it."""
MISSED = "missed"
"""Verdict on a building that no row covers."""
_MIN_SHARE = 0.5


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """A scene and its two surveys."""

    suite: str
    """Suite of the scene."""
    draw: int
    """Which of the split."""
    earlier: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """What is other than in the suite's survey, in the earlier epoch."""
    later: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """The same in the later one."""

    def survey(self, which: int) -> ScannerSettings:
        """The survey of the earlier (0) or the later (1) epoch."""
        return dataclasses.replace(suite_named(self.suite).scanner, **(self.earlier, self.later)[which])

    def epochs(self, split: str, size_m: float) -> TwoEpochs:
        """The scene before and after."""
        seed = seed_of(split, self.draw)
        return two_epochs(suite_named(self.suite).make(seed, (size_m, size_m)), seed)


CASES: Mapping[str, Case] = {
    "suburb": Case(suite="suburb", draw=0),
    "town": Case(suite="town", draw=0),
    "suburb-mixed": Case(
        suite="suburb",
        draw=1,
        earlier={"pulse_density_per_m2": 2.0, "range_noise_m": 0.05, "strip_lift_m": 0.04, "strip_shift_m": 0.1},
        later={"pulse_density_per_m2": 10.0, "strip_lift_m": 0.02, "strip_shift_m": 0.05},
    ),
}
"""All cases by name."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Found:
    """The result of a case."""

    reported: Counter[tuple[Work | None, str]]
    """Buildings by what was done and the reported change; those within the scene's extent."""
    right: Counter[Change]
    """Rows by class over a building of which that is true."""
    rows: Counter[Change]
    """All rows by class."""
    sure_right: Counter[Change]
    """As `right`, of rows without doubt."""
    sure_rows: Counter[Change]
    """As `rows`, of rows without doubt."""


def reconstructed(scene: Scene, survey: ScannerSettings, seed: int, folder: Path, jobs: int) -> Path:
    """The run of a scanned scene; one that is there and finished is used again."""
    run_dir = folder / "run"
    if (run_dir / NAME).is_file() and read_manifest(run_dir).status is RunStatus.FINISHED:
        return run_dir
    folder.mkdir(parents=True, exist_ok=True)
    laz = folder / "points.laz"
    write_points(scan(scene, survey, seed), scene, laz, folder / "labels.parquet")
    run(
        RunRequest(
            inputs=(str(laz),), out=str(run_dir), meshes="none", resources=Resources(workers=jobs), overwrite=True
        )
    )
    return run_dir


def judged(epochs: TwoEpochs, changes: Path) -> Found:
    """Hold the rows of a comparison against what was done."""
    rows = pq.read_table(changes).to_pylist()
    geometries = shapely.from_wkb(np.array([row["geometry"] for row in rows], dtype=object))
    tree, areas = shapely.STRtree(geometries), shapely.area(geometries)
    origin, extent = np.array(epochs.later.origin[:2]), shapely.box(*epochs.later.extent)
    standing = {b.building_id: b for b in (*epochs.earlier.buildings, *epochs.later.buildings)}
    reported: Counter[tuple[Work | None, str]] = Counter()
    true_of: list[set[Change]] = [set() for _ in rows]
    for name, building in sorted(standing.items()):
        footprint = shapely.transform(building.footprint, lambda xy: xy + origin)
        near = tree.query(footprint, predicate="intersects")
        common = shapely.area(shapely.intersection(geometries[near], footprint))
        over = near[common >= _MIN_SHARE * np.minimum(areas[near], footprint.area)].tolist()
        work = epochs.works.get(name)
        for place in over:
            true_of[place].add(EXPECTED[work])
        if extent.covers(building.footprint):
            words = sorted({rows[place]["change"] for place in over})
            reported[work, "+".join(words) or MISSED] += 1
    changes_of = [Change(row["change"]) for row in rows]
    right = [change for change, true in zip(changes_of, true_of, strict=True) if change in true]
    sure = [not row["doubts"] for row in rows]
    return Found(
        reported=reported,
        right=Counter(right),
        rows=Counter(changes_of),
        sure_right=Counter(c for c, t, s in zip(changes_of, true_of, sure, strict=True) if s and c in t),
        sure_rows=Counter(c for c, s in zip(changes_of, sure, strict=True) if s),
    )


def tables(found: Mapping[str, Found]) -> str:
    """The tables of the page: reported changes by what was done, then precision by class."""
    header = ["scene", "done", "buildings", "reported", "recall", "not comparable", "reported otherwise"]
    rows: list[Sequence[str]] = []
    for name, one in found.items():
        for work in (*Work, None):
            reported = {word: count for (done, word), count in one.reported.items() if done is work}
            right, hidden = reported.pop(EXPECTED[work].value, 0), reported.pop(Change.NOT_COMPARABLE.value, 0)
            rest = ", ".join(f"{count} {word.replace('_', ' ')}" for word, count in sorted(reported.items()))
            comparable = right + sum(reported.values())
            recall = f"{100.0 * right / comparable:.1f} %" if comparable else "-"
            done = "nothing" if work is None else work.value.replace("_", " ")
            rows.append([name, done, str(comparable + hidden), str(right), recall, str(hidden), rest or "-"])
    recalls = markdown_table(header, rows)
    header = ["scene", "change", "rows", "true", "precision", "without doubt", "true of these", "precision of these"]
    rows = []
    for name, one in found.items():
        for change in (c for c in Change if c is not Change.NOT_COMPARABLE):
            counts = [one.rows[change], one.right[change], one.sure_rows[change], one.sure_right[change]]
            shares = [f"{100.0 * b / a:.1f} %" if a else "-" for a, b in (counts[:2], counts[2:])]
            numbers = [str(count) for count in counts]
            rows.append([name, change.value, *numbers[:2], shares[0], *numbers[2:], shares[1]])
    return f"{recalls}\n{markdown_table(header, rows)}"


def main() -> int:
    """Measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--split", choices=["dev", "test"], default="test")
    parser.add_argument("--only", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--size", type=float, default=620.0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--page", type=Path)
    arguments = parser.parse_args()
    found = {}
    for name in arguments.only:
        case, folder = CASES[name], arguments.out / f"{name}-{arguments.split}"
        epochs = case.epochs(arguments.split, arguments.size)
        runs = [
            reconstructed(scene, case.survey(k), SCANS[k], folder / ("earlier", "later")[k], arguments.jobs)
            for k, scene in enumerate((epochs.earlier, epochs.later))
        ]
        made = diff(DiffRequest(old=str(runs[0]), new=str(runs[1]), out=str(folder / "diff")))
        found[name] = judged(epochs, made.written[0])
    text = tables(found)
    part = arguments.out / f"epochs_{arguments.split}.md"
    part.write_text(text, encoding="utf-8")
    print(text)
    if arguments.page is not None:
        page, _ = filled(arguments.page.read_text(encoding="utf-8"), arguments.out)
        arguments.page.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
