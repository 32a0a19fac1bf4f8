"""The tables of Hofmann, Maas and Streilein (2003) for every method and preset, beside the printed ones.

    python -m benchmarks.hofmann_tables --out DIR [--split test] [--draws 3] [--methods METHOD[:PRESET] ...] [--jobs 2]
                                        [--page FILE]

Table 3-1 (2D parameter space, all 310 buildings), table 4-1 (3D, all), table 4-2 (3D, the 197 without difficulties):
buildings correct, passable and false by roof type, on draws of `hofmann310`. Writes DIR/hofmann_tables.md.

- Outcomes are those of the evaluation. Correct: all roof faces and no others are found *and* the roof type is right.
  Passable: at least half of the faces are found. False: the rest, including buildings that were not found.
- True buildings are where the survey saw them (as in `evaluate --as-surveyed`). The strips of this survey are off by
  0.3 m in plan and 0.2 m in elevation, like those of the paper, and a roof face counts as found within 0.3 m: without
  this the method would be blamed for the error of the GPS. The paper judged clusters, which a common shift of all
  points of a building does not affect.
- Counts are means of the draws, shares and 95 % bootstrap intervals are over the buildings of all draws together.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np

from benchmarks.entries import Workplace, all_variants, fill_page, hofmann_entries, markdown_table, measure_all
from pipeline.extras.compare.compare import Variant
from pipeline.model import BoolArray, RoofType
from pipeline.ruler.evaluation.bootstrap import Estimate, bootstrap, share
from pipeline.ruler.roof_families import family_of

OUTCOMES = ("correct", "passable", "false")
KINDS = tuple(kind.value for kind in (RoofType.FLAT, RoofType.PENT, RoofType.GABLE, RoofType.HIP, RoofType.COMBINATION))
ALL = "all"

PAPER: Mapping[str, Mapping[str, tuple[int, int, int]]] = MappingProxyType({
    "3-1": {"flat": (2, 0, 1), "pent": (11, 6, 0), "gable": (70, 83, 87), "hip": (4, 8, 5), "combination": (6, 5, 22),
            ALL: (93, 102, 115)},
    "4-1": {"flat": (1, 0, 2), "pent": (6, 2, 9), "gable": (135, 67, 37), "hip": (0, 6, 12), "combination": (9, 15, 9),
            ALL: (151, 90, 69)},
    "4-2": {"pent": (8, 0, 5), "gable": (109, 40, 8), "hip": (0, 4, 0), "combination": (8, 14, 1), ALL: (125, 58, 14)},
})  # fmt: skip
"""The printed counts of buildings correct, passable and false, misprints and all."""
SUBSETS = {"all 310 buildings": ("3-1", "4-1"), "the 197 without difficulties": ("4-2",)}
"""The tables of each subset."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outcomes:
    """What became of the buildings of all draws by one method, in the order of draws and buildings."""

    draws: int
    """How many scenes."""
    kind: tuple[str, ...]
    """(n,) true roof types."""
    good: BoolArray
    """(n,) bool, nothing makes it hard."""
    outcome: tuple[str, ...]
    """(n,) correct, passable or false."""

    def mask(self, kind: str, *, good_only: bool) -> BoolArray:
        """The buildings of a row; `kind` may be all."""
        chosen = np.array([kind in {ALL, one} for one in self.kind], np.bool_)
        return chosen & self.good if good_only else chosen

    def is_outcome(self, outcome: str) -> BoolArray:
        """Which buildings had it."""
        return np.array([one == outcome for one in self.outcome], np.bool_)

    def counts(self, kind: str, *, good_only: bool) -> list[float]:
        """Correct, passable and false, a draw."""
        mask = self.mask(kind, good_only=good_only)
        return [float((self.is_outcome(outcome) & mask).sum()) / self.draws for outcome in OUTCOMES]

    def correct(self, kind: str, *, good_only: bool) -> Estimate:
        """Share of correct ones with its interval; nan where there are none."""
        mask = self.mask(kind, good_only=good_only)
        if not mask.any():
            return Estimate(value=float("nan"), low=float("nan"), high=float("nan"))
        right = (self.is_outcome("correct")[mask]).astype(np.float64)
        return bootstrap({"correct": right, "n": np.ones(len(right))}, share("correct", "n"))


def read_outcomes(variant: Variant, place: Workplace, split: str, draws: int) -> Outcomes | None:
    """The outcomes of a method; None where a draw was not measured."""
    entries = list(hofmann_entries(split, draws))
    if not all(place.is_measured(variant, entry) for entry in entries):
        return None
    rows = [row for entry in entries for row in place.table(variant, entry, "buildings")]
    judged = [row for row in rows if not row["touches_data_edge"]]
    return Outcomes(
        draws=draws,
        kind=tuple(family_of(RoofType(row["true_type"])).value for row in judged),
        good=np.array([bool(row["good"]) for row in judged], np.bool_),
        outcome=tuple(row["outcome"] for row in judged),
    )


def counts_table(found: Mapping[str, Outcomes], printed: Sequence[str], *, good_only: bool) -> str:
    """Correct / passable / false: the printed counts, then the mean counts per draw of every method."""
    lines = [
        [f"paper, table {name}", *(" / ".join(map(str, PAPER[name].get(kind, ()))) for kind in _rows())]
        for name in printed
    ]
    for label, outcomes in found.items():
        counts = [outcomes.counts(kind, good_only=good_only) for kind in _rows()]
        lines.append([label, *(" / ".join(_count(value) for value in row) if sum(row) else "" for row in counts)])
    return markdown_table(["buildings: correct / passable / false", *_rows()], lines)


def interval_table(found: Mapping[str, Outcomes], *, good_only: bool) -> str:
    """Percent correct with the 95 % interval."""
    lines = []
    for label, outcomes in found.items():
        estimates = [outcomes.correct(kind, good_only=good_only) for kind in _rows()]
        lines.append([label, *("" if np.isnan(one.value) else reported_share(one) for one in estimates)])
    return markdown_table(["percent correct (95 % interval)", *_rows()], lines)


def _rows() -> tuple[str, ...]:
    return (*KINDS, ALL)


def _count(value: float) -> str:
    return f"{value:.1f}".removesuffix(".0")


def reported_share(estimate: Estimate) -> str:
    """A share in percent with its interval."""
    value, low, high = (100.0 * end for end in (estimate.value, estimate.low, estimate.high))
    return f"{value:.0f} ({low:.0f} to {high:.0f})"


def document(found: Mapping[str, Outcomes], split: str, draws: int) -> str:
    """All tables as Markdown."""
    parts = [f"`hofmann310`, {split} seeds, {draws} draws; counts are means per draw.\n"]
    for title, printed in SUBSETS.items():
        good_only = "4-2" in printed
        parts += [
            f"### {title[0].upper()}{title[1:]}\n",
            counts_table(found, printed, good_only=good_only),
            interval_table(found, good_only=good_only),
        ]
    return "\n".join(parts) + "\n"


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--split", choices=("dev", "test"), default="test")
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--methods", nargs="*", metavar="METHOD[:PRESET]", help="default: all methods, both presets")
    parser.add_argument("--jobs", type=int, default=2, help="draws at a time")
    parser.add_argument("--page", type=Path, help="fill in this page of results")
    arguments = parser.parse_args()
    place = Workplace(root=arguments.out)
    variants = [Variant.parse(text) for text in arguments.methods or ()] or all_variants(with_faithful=True)
    entries = hofmann_entries(arguments.split, arguments.draws)
    faults = measure_all([(entry, variants) for entry in entries], place, arguments.jobs)
    read = {one.label: read_outcomes(one, place, arguments.split, arguments.draws) for one in variants}
    reported = document(
        {label: one for label, one in read.items() if one is not None}, arguments.split, arguments.draws
    )
    (place.root / "hofmann_tables.md").write_text(reported, encoding="utf-8")
    print(reported)
    if arguments.page is not None:
        fill_page(arguments.page, place.root)
    print("\n".join(faults), file=sys.stderr)
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
