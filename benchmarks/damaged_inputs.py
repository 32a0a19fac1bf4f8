"""What becomes of damaged inputs: 500 damaged copies of each of eleven kinds, run by the command line.

    python -m benchmarks.damaged_inputs [--per-kind 500] [--seed 1] [--kinds las laz ...] [--processes 2] [--keep DIR]

Each copy is damaged by a seed of its own (`damage.py`), so the same call damages the same bytes; `--numbers 7 12` runs
single ones. Each run is a process of its own (`damaged_runs.py`), forked from one that has loaded the modules, with
limits of time and memory. Prints one row per kind:

- named refusal: the command ends with the exit code of an input, a setting or (batch files) a run directory
- run: it ends well, no building failed for a fault of gablework, and our checker finds all solids valid
- internal: the exit code of a fault of gablework, failed tiles, or a building with such a fault
- invalid: a solid breaks a rule
- crash: the process was ended by a signal; hang: it took longer than `--time-limit`

The exit code is 1 if anything but refusals and runs was found; the first lines of each are printed, and their files
stay in `--keep`.
"""

from __future__ import annotations

import argparse
import faulthandler
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from benchmarks.damaged_runs import GOOD, OUTCOMES, Case, Limits, Outcome, run_cases
from benchmarks.entries import markdown_table
from benchmarks.undamaged_inputs import KINDS, kind_named


def table_of(outcomes: Sequence[Outcome]) -> str:
    """One row per kind, and their sum."""
    rows = []
    names = [kind.name for kind in KINDS if any(one.case.kind.name == kind.name for one in outcomes)]
    for name in [*names, "all"]:
        some = [one for one in outcomes if name in {one.case.kind.name, "all"}]
        counts = Counter(one.result for one in some)
        slowest = max((one.seconds for one in some), default=0.0)
        rows.append([name, str(len(some)), *(str(counts[result]) for result in OUTCOMES), f"{slowest:.1f}"])
    return markdown_table(["kind", "files", *OUTCOMES, "slowest, s"], rows)


def main(words: Sequence[str] | None = None) -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--per-kind", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kinds", nargs="+", type=kind_named, default=list(KINDS))
    parser.add_argument("--numbers", nargs="+", type=int, help="Only these copies of each kind.")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--time-limit", type=float, default=Limits.time_s)
    parser.add_argument("--keep", type=Path, help="Folder for the files of all that went wrong.")
    parser.add_argument("--shown", type=int, default=20, help="Faults of each kind that are printed.")
    parser.add_argument("--verbose", action="store_true", help="Print a line per case.")
    arguments = parser.parse_args(words)
    numbers = arguments.numbers or range(arguments.per_kind)
    cases = [Case(kind=kind, number=number, seed=arguments.seed) for kind in arguments.kinds for number in numbers]
    limits = Limits(time_s=arguments.time_limit)
    faulthandler.enable()
    outcomes, shown = [], Counter[str]()
    for outcome in run_cases(cases, arguments.keep, limits, arguments.processes):
        outcomes.append(outcome)
        name = outcome.case.kind.name
        if arguments.verbose or (outcome.result not in GOOD and shown[name] < arguments.shown):
            shown[name] += 1
            print(outcome, flush=True)
    print(table_of(outcomes))
    return 0 if all(one.result in GOOD for one in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
