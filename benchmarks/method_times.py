"""Seconds per building for every method: `python benchmarks/method_times.py --out DIR [--data ../shared/data]`.

    [--split test] [--methods METHOD[:PRESET] ...] [--repeat 1] [--most 400]

The candidates of a simulated scene (`hofmann310`), of `delft_west` (AHN3) and of `hdf_870000` (LiDAR HD), the real
tiles if they exist, are found by the stages of a run: ingest, split, join, gather. Then everything happens in
this one process. Each method models one building before the clock starts, so its kernels are loaded. Then the
methods take turns candidate by candidate, each time another one first: other work on the machine then slows all alike
and the ratios are fair. Time is processor time of this process.

Segmentation is the method itself, from the candidate to planes and labels (or faces); solids is the rest: roof
faces, extrusion, validity, residuals. Prints, and writes to DIR/method_times.md, median, mean and the 95 % quantile in
milliseconds per building. If there are more than `--most` candidates, every second, third ... is taken.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from benchmarks.candidates import candidates_of
from benchmarks.entries import Entry, Workplace, all_variants, hofmann_entries, markdown_table, run_settings, tiles_of
from pipeline.methods import Method, ReconstructSettings
from pipeline.model import Candidate, FloatArray, PreparedCloud, Segmentation, Status
from pipeline.recipe import reconstruct_building
from pipeline.runtime.compare import Variant, settings_of


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClockedSettings(ReconstructSettings):
    """Settings whose segmentation measures its time: the building is modelled once, with a clock within."""

    clocked: list[float] = dataclasses.field(default_factory=list)
    """Processor seconds of each segmentation, in their order."""

    def segmentation(self, method: Method) -> Callable[[PreparedCloud], Segmentation]:
        """The method with its settings bound, and a clock about it."""
        segment = super().segmentation(method)

        def clocked(cloud: PreparedCloud) -> Segmentation:
            began = time.process_time()
            try:
                return segment(cloud)
            finally:
                self.clocked.append(time.process_time() - began)

        return clocked


@dataclasses.dataclass(frozen=True, kw_only=True)
class Times:
    """What a method took on the candidates of an entry."""

    segmentation_s: FloatArray
    """(n,) float64, processor seconds per building."""
    solids_s: FloatArray
    """(n,) float64, all that follows."""
    statuses: tuple[str, ...]
    """(n,) what became of them."""


def clock(candidates: Sequence[Candidate], variants: Sequence[Variant], entry: Entry, repeat: int) -> dict[str, Times]:
    """Model all candidates by all methods in turns.

    Parameters
    ----------
    candidates : sequence of Candidate
        At least one; the smallest warms up the kernels.
    variants : sequence of Variant
        The methods.
    entry : Entry
        Gives the settings of the roof.
    repeat : int
        Times over; the shortest time of each building counts.
    """
    ways = {one: settings_of(run_settings(entry), one).building for one in variants}
    clocks = {
        one: ClockedSettings(method=way.method, roof=way.roof, roof_type=way.roof_type) for one, way in ways.items()
    }
    whole = {one: np.full((repeat, len(candidates)), np.nan) for one in variants}
    statuses: dict[Variant, list[str]] = {one: [] for one in variants}
    for one in variants:
        reconstruct_building(min(candidates, key=lambda candidate: len(candidate.points)), one.method, clocks[one])
        clocks[one].clocked.clear()
    for turn in range(repeat):
        for number, candidate in enumerate(candidates):
            first = (turn + number) % len(variants)
            for one in (*variants[first:], *variants[:first]):
                began = time.process_time()
                result = reconstruct_building(candidate, one.method, clocks[one])
                whole[one][turn, number] = time.process_time() - began
                if turn == 0:
                    statuses[one].append(result.status.value)
    found = {}
    for one in variants:
        inside = np.array(clocks[one].clocked).reshape(repeat, len(candidates))
        found[one.label] = Times(
            segmentation_s=inside.min(axis=0),
            solids_s=(whole[one] - inside).min(axis=0),
            statuses=tuple(statuses[one]),
        )
    return found


def reported(seconds: FloatArray) -> list[str]:
    """Median, mean and 95 % quantile in milliseconds."""
    figures = (np.median(seconds), seconds.mean(), np.quantile(seconds, 0.95))
    return [f"{1000.0 * float(value):.1f}" for value in figures]


def times_table(found: dict[str, Times]) -> str:
    """A row a method."""
    heads = [f"{part}, {figure}" for part in ("segmentation", "solids") for figure in ("median", "mean", "95 %")]
    rows = []
    for label, times in found.items():
        counts = "/".join(str(times.statuses.count(status)) for status in Status)
        together = times.segmentation_s + times.solids_s
        rows.append(
            [
                label,
                counts,
                *reported(times.segmentation_s),
                *reported(times.solids_s),
                f"{1000 * float(together.mean()):.1f}",
            ]
        )
    return markdown_table(["ms per building", "ok/doubtful/block/failed", *heads, "together, mean"], rows)


def entries(data: Path, split: str) -> list[Entry]:
    """What is timed: a simulated scene, and the real tiles that are there."""
    delft, hdf = data / "ahn3" / "delft_west.laz", data / "ign" / "hdf_870000_6617100.laz"
    real = [
        Entry(name="delft_west", tiles=(delft,), crs="EPSG:7415"),
        Entry(name="hdf_870000", tiles=(hdf,)),
    ]
    return [*hofmann_entries(split, 1), *(entry for entry in real if entry.tiles[0].exists())]


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--split", choices=("dev", "test"), default="test")
    parser.add_argument("--methods", nargs="*", metavar="METHOD[:PRESET]", help="default: all methods, both presets")
    parser.add_argument("--repeat", type=int, default=1, help="times over; the shortest time of a building counts")
    parser.add_argument("--most", type=int, default=400, help="candidates of an entry")
    arguments = parser.parse_args()
    place = Workplace(root=arguments.out)
    variants = [Variant.parse(text) for text in arguments.methods or ()] or all_variants(with_faithful=True)
    parts = []
    for entry in entries(arguments.data, arguments.split):
        found = list(candidates_of(tiles_of(entry, place), entry.crs, run_settings(entry)))
        chosen = found[:: -(-len(found) // arguments.most)]
        sizes = np.quantile([len(candidate.points) for candidate in chosen], [0.5, 0.95])
        head = f"{entry.name}: {len(chosen)} candidates of {sizes[0]:.0f} points in the median, {sizes[1]:.0f} at 95 %."
        parts.append(f"{head}\n\n{times_table(clock(chosen, variants, entry, arguments.repeat))}")
        print(parts[-1], flush=True)
    (place.root / "method_times.md").write_text("\n".join(parts), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
