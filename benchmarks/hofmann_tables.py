"""The tables of Hofmann, Maas and Streilein (2003) for every method and preset, beside the printed ones.

    python benchmarks/hofmann_tables.py --out DIR [--split test] [--draws 3] [--methods METHOD[:PRESET] ...] [--jobs 2]

Table 3-1 (2D parameter space, all 310 buildings), table 4-1 (3D, all), table 4-2 (3D, the 197 without difficulties):
buildings correct, passable and false by roof type, on draws of `hofmann310`. Writes DIR/hofmann_tables.md.

- Outcomes are those of the evaluation. Correct: all roof faces and no others are found *and* the roof type is right.
  Passable: at least half of the faces are found. False: the rest, including buildings that were not found.
- True buildings are where the survey saw them (as in `evaluate --as-surveyed`). The strips of this survey are off by
  0.3 m in plan and 0.2 m in elevation, like those of the paper, and a roof face counts as found within 0.3 m: without
  this the method would be blamed for the error of the GPS. The paper judged clusters, which a common shift of all
  points of a building does not affect.
- Counts are means of the draws, shares and 95 % bootstrap intervals are over the buildings of all draws together.

The last part tests whether the figures show the pattern of the paper, sentence by sentence.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np

from benchmarks.entries import Workplace, all_variants, hofmann_entries, markdown_table, measure_all
from pipeline.model import BoolArray, FloatArray, RoofType
from pipeline.ruler.evaluation.bootstrap import Estimate, Sums, bootstrap, share
from pipeline.runtime.compare import Variant

OUTCOMES = ("correct", "passable", "false")
KINDS = tuple(kind.value for kind in (RoofType.FLAT, RoofType.PENT, RoofType.GABLE, RoofType.HIP, RoofType.COMBINATION))
ALL = "all"
TWO_D, THREE_D = "parameter-space-2d", "parameter-space-3d"
FAR_BETTER = 0.15
"""Difference of shares that counts as far better; the paper's is .27."""
ABOUT_NONE = 0.10
"""Share that counts as about none; the paper's is 0 of 18."""
RELIABLE = 0.90
"""Share from which a roof type counts as reliably found; of the paper's three flat roofs two were, and one."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PrintedRow:
    """A row as printed: number of buildings, counts and percentages of correct, passable, false."""

    number: int
    counts: tuple[int, int, int]
    percent: tuple[int, int, int]


def _printed(*rows: tuple[str, int, tuple[int, int, int], tuple[int, int, int]]) -> Mapping[str, PrintedRow]:
    return MappingProxyType(
        {kind: PrintedRow(number=number, counts=counts, percent=percent) for kind, number, counts, percent in rows}
    )


PAPER: Mapping[str, Mapping[str, PrintedRow]] = MappingProxyType(
    {
        "3-1": _printed(
            ("flat", 3, (2, 0, 1), (67, 0, 32)),
            ("pent", 17, (11, 6, 0), (65, 35, 0)),
            ("gable", 240, (70, 83, 87), (29, 35, 36)),
            ("hip", 17, (4, 8, 5), (22, 44, 33)),
            ("combination", 33, (6, 5, 22), (18, 15, 67)),
            (ALL, 310, (93, 102, 115), (30, 33, 37)),
        ),
        "4-1": _printed(
            ("flat", 3, (1, 0, 2), (33, 0, 67)),
            ("pent", 17, (6, 2, 9), (35, 12, 53)),
            ("gable", 239, (135, 67, 37), (56, 28, 16)),
            ("hip", 18, (0, 6, 12), (0, 29, 71)),
            ("combination", 33, (9, 15, 9), (27, 46, 27)),
            (ALL, 310, (151, 90, 69), (49, 29, 22)),
        ),
        "4-2": _printed(
            ("pent", 13, (8, 0, 5), (62, 0, 38)),
            ("gable", 157, (109, 40, 8), (69, 25, 6)),
            ("hip", 4, (0, 4, 0), (0, 100, 0)),
            ("combination", 23, (8, 14, 1), (35, 61, 4)),
            (ALL, 197, (125, 58, 14), (63, 29, 7)),
        ),
    }
)
"""The printed tables, misprints and all."""
LEVEL_DEG = 7.0
"""Slope from which terrain is a plausible roof to the paper's 2D tree."""
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
    terrain_deg: FloatArray
    """(n,) float64, slope of the terrain beneath."""

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


def difference(first: Outcomes, second: Outcomes, kind: str, *, good_only: bool = False) -> Estimate:
    """Share correct of the first less that of the second, of the same buildings, which are drawn in pairs."""
    mask = first.mask(kind, good_only=good_only)
    columns = {
        "first": first.is_outcome("correct")[mask].astype(np.float64),
        "second": second.is_outcome("correct")[mask].astype(np.float64),
        "n": np.ones(int(mask.sum())),
    }

    def statistic(sums: Sums) -> FloatArray:
        return np.asarray((sums["first"] - sums["second"]) / sums["n"], np.float64)

    return bootstrap(columns, statistic)


def misprints(table: Mapping[str, PrintedRow]) -> list[str]:
    """What does not agree within a printed table: counts with numbers, percentages with counts, rows with the sum."""
    found = []
    for kind, row in table.items():
        if sum(row.counts) != row.number:
            found.append(f"{kind}: {' + '.join(map(str, row.counts))} is {sum(row.counts)}, not {row.number}")
        for outcome, count, percent in zip(OUTCOMES, row.counts, row.percent, strict=True):
            exact = 100.0 * count / row.number
            if abs(exact - percent) > 0.5 + 1e-9:
                found.append(f"{kind}: {count} of {row.number} {outcome} is {exact:.0f} %, not {percent} %")
    numbers = sum(row.number for kind, row in table.items() if kind != ALL)
    if numbers != table[ALL].number:
        found.append(f"the numbers of the types add up to {numbers}, not {table[ALL].number}")
    for k, outcome in enumerate(OUTCOMES):
        total = sum(row.counts[k] for kind, row in table.items() if kind != ALL)
        if total != table[ALL].counts[k]:
            found.append(f"{outcome}: the types add up to {total}, not {table[ALL].counts[k]}")
    return found


def contradictions() -> list[str]:
    """Where table 4-2 has more buildings of an outcome than table 4-1, of which its buildings are a part."""
    found = []
    for kind, good in PAPER["4-2"].items():
        for outcome, part, whole in zip(OUTCOMES, good.counts, PAPER["4-1"][kind].counts, strict=True):
            if part > whole:
                found.append(f"{kind}: {part} of the {good.number} good ones {outcome}, but {whole} of all")
    return found


def read_outcomes(variant: Variant, place: Workplace, split: str, draws: int) -> Outcomes | None:
    """The outcomes of a method; None where a draw was not measured."""
    entries = list(hofmann_entries(split, draws))
    if not all(place.is_measured(variant, entry) for entry in entries):
        return None
    rows = [row for entry in entries for row in place.table(variant, entry, "buildings")]
    judged = [row for row in rows if not row["touches_data_edge"]]
    return Outcomes(
        draws=draws,
        kind=tuple(row["true_type"] for row in judged),
        good=np.array([bool(row["good"]) for row in judged], np.bool_),
        outcome=tuple(row["outcome"] for row in judged),
        terrain_deg=np.array([row["terrain_slope_deg"] for row in judged], np.float64),
    )


def counts_table(found: Mapping[str, Outcomes], printed: Sequence[str], *, good_only: bool) -> str:
    """Correct / passable / false: the printed counts, then the mean counts a draw of every method."""
    lines = [
        [
            f"paper, table {name}",
            *(_slashed(PAPER[name][kind].counts) if kind in PAPER[name] else "" for kind in _rows()),
        ]
        for name in printed
    ]
    for label, outcomes in found.items():
        counts = [outcomes.counts(kind, good_only=good_only) for kind in _rows()]
        lines.append([label, *(" / ".join(_count(value) for value in row) if sum(row) else "" for row in counts)])
    return markdown_table(["buildings: correct / passable / false", *_rows()], lines)


def percent_table(found: Mapping[str, Outcomes], printed: Sequence[str], *, good_only: bool) -> str:
    """The same in percent: as printed, and over all draws."""
    lines = [
        [
            f"paper, table {name}",
            *(_slashed(PAPER[name][kind].percent) if kind in PAPER[name] else "" for kind in _rows()),
        ]
        for name in printed
    ]
    for label, outcomes in found.items():
        cells = []
        for kind in _rows():
            counts = outcomes.counts(kind, good_only=good_only)
            total = sum(counts)
            cells.append(" / ".join(f"{100.0 * value / total:.0f}" for value in counts) if total else "")
        lines.append([label, *cells])
    return markdown_table(["percent: correct / passable / false", *_rows()], lines)


def interval_table(found: Mapping[str, Outcomes], *, good_only: bool) -> str:
    """Percent correct with the 95 % interval."""
    lines = []
    for label, outcomes in found.items():
        estimates = [outcomes.correct(kind, good_only=good_only) for kind in _rows()]
        lines.append([label, *("" if np.isnan(one.value) else reported_share(one) for one in estimates)])
    return markdown_table(["percent correct (95 % interval)", *_rows()], lines)


def _rows() -> tuple[str, ...]:
    return (*KINDS, ALL)


def _slashed(values: Sequence[int]) -> str:
    return " / ".join(str(value) for value in values)


def _count(value: float) -> str:
    return f"{value:.1f}".removesuffix(".0")


def reported_share(estimate: Estimate, sign: str = "") -> str:
    """A share in percent with its interval."""
    value, low, high = (100.0 * end for end in (estimate.value, estimate.low, estimate.high))
    return f"{value:{sign}.0f} ({low:{sign}.0f} to {high:{sign}.0f})"


def pattern(flat: Outcomes, full: Outcomes) -> list[tuple[str, bool, str]]:
    """The paper's pattern on the figures of a 2D and a 3D method: sentence, whether it shows, the figures."""
    gables, pents, whole = (difference(full, flat, kind) for kind in ("gable", "pent", ALL))
    hips = full.correct("hip", good_only=False)
    flats = {"2D": flat.correct("flat", good_only=False), "3D": full.correct("flat", good_only=False)}
    good, everything = full.correct(ALL, good_only=True), full.correct(ALL, good_only=False)

    def beside(kind: str, gain: Estimate) -> str:
        two, three = flat.correct(kind, good_only=False), full.correct(kind, good_only=False)
        return f"2D {reported_share(two)}, 3D {reported_share(three)}, difference {reported_share(gain, '+')}"

    return [
        (
            f"gables: 3D far better than 2D (by {100 * FAR_BETTER:.0f} points or more; paper 29 to 56 %)",
            gables.value >= FAR_BETTER and gables.low > 0.0,
            beside("gable", gables),
        ),
        (
            f"hips: about none in 3D ({100 * ABOUT_NONE:.0f} % or fewer; paper 0 of 18)",
            hips.value <= ABOUT_NONE,
            f"3D {reported_share(hips)}, 2D {reported_share(flat.correct('hip', good_only=False))}",
        ),
        ("pent: worse in 3D than in 2D (paper 65 to 35 %)", pents.value < 0.0, beside("pent", pents)),
        (
            f"flat: by accident (in neither space {100 * RELIABLE:.0f} %; paper 2 and 1 of 3)",
            all(one.value < RELIABLE for one in flats.values()),
            ", ".join(f"{name} {reported_share(one)}" for name, one in flats.items()),
        ),
        ("all: 3D better than 2D (paper 30 to 49 %)", whole.low > 0.0, beside(ALL, whole)),
        (
            "3D: better where nothing makes it hard (paper 49 to 63 %)",
            good.value > everything.value,
            f"all {reported_share(everything)}, good {reported_share(good)}",
        ),
    ]


def pattern_table(found: Mapping[str, Outcomes]) -> str:
    """The pattern of every pair of a 2D and a 3D method of one preset; empty where there is no pair."""
    parts = []
    for label, outcomes in found.items():
        other = label.replace(TWO_D, THREE_D, 1)
        if label.startswith(TWO_D) and other in found:
            rows = [
                (sentence, "yes" if shows else "no", reported)
                for sentence, shows, reported in pattern(outcomes, found[other])
            ]
            header = ["the paper's pattern", "shows?", f"percent correct: {label} and {other}"]
            parts.append(markdown_table(header, rows))
    return "\n".join(parts)


def terrain_table(found: Mapping[str, Outcomes]) -> str:
    """Percent correct of pent and gable roofs on terrain of less and of more slope than the least of a roof in 2D."""
    heads, masks = [], []
    first = next(iter(found.values()))
    for kind in ("pent", "gable"):
        for name, is_steep in ((f"below {LEVEL_DEG:g} deg", False), (f"{LEVEL_DEG:g} deg and more", True)):
            mask = first.mask(kind, good_only=False) & ((first.terrain_deg >= LEVEL_DEG) == is_steep)
            heads.append(f"{kind}, {name} (n = {int(mask.sum())})")
            masks.append(mask)
    rows = []
    for label, outcomes in found.items():
        right = outcomes.is_outcome("correct").astype(np.float64)
        estimates = [
            bootstrap({"correct": right[mask], "n": np.ones(int(mask.sum()))}, share("correct", "n"))
            if mask.any()
            else None
            for mask in masks
        ]
        rows.append([label, *("" if one is None else reported_share(one) for one in estimates)])
    return markdown_table(["percent correct by slope of the terrain", *heads], rows)


def document(found: Mapping[str, Outcomes], split: str, draws: int) -> str:
    """All tables as Markdown."""
    parts = [f"`hofmann310`, {split} seeds, {draws} draws; counts are means per draw.\n"]
    for title, printed in SUBSETS.items():
        good_only = "4-2" in printed
        parts += [
            f"### {title[0].upper()}{title[1:]}\n",
            counts_table(found, printed, good_only=good_only),
            percent_table(found, printed, good_only=good_only),
            interval_table(found, good_only=good_only),
        ]
    parts.append("### Does the pattern of the paper show?\n")
    parts.append(pattern_table(found) or "Not both parameter spaces were measured.\n")
    if found:
        parts += ["### Terrain that could be a roof\n", terrain_table(found)]
    parts.append("### Misprints of the paper\n")
    parts += [f"- table {name}: {reported}" for name, table in PAPER.items() for reported in misprints(table)]
    parts += [f"- table 4-2 against 4-1: {reported}" for reported in contradictions()]
    return "\n".join(parts) + "\n"


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--split", choices=("dev", "test"), default="test")
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--methods", nargs="*", metavar="METHOD[:PRESET]", help="default: all methods, both presets")
    parser.add_argument("--jobs", type=int, default=2, help="draws at a time")
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
    print("\n".join(faults), file=sys.stderr)
    return int(bool(faults))


if __name__ == "__main__":
    sys.exit(main())
