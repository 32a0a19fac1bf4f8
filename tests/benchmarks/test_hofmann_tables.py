"""The printed tables, and what is computed beside them."""

import numpy as np
import pytest

from benchmarks.hofmann_tables import ALL, KINDS, OUTCOMES, PAPER, Outcomes, counts_table, document

Counts = dict[str, tuple[int, int, int]]

PAPER_2D: Counts = {kind: PAPER["3-1"][kind] for kind in KINDS}
PAPER_2D |= {"gable": (70, 83, 86), "hip": (4, 8, 6)}  # what the numbers of table 4-1 and the printed shares ask for
PAPER_3D: Counts = {kind: PAPER["4-1"][kind] for kind in KINDS}
PAPER_GOOD: Counts = {kind: PAPER["4-2"].get(kind, (0, 0, 0)) for kind in KINDS}
PAPER_GOOD |= {"pent": (6, 2, 5)}  # 8 of the good ones cannot be correct where 6 of all are


def outcomes_of(counts: Counts, good: Counts | None = None, draws: int = 1) -> Outcomes:
    """Buildings with these outcomes; of each outcome the first ones are good."""
    kinds, outcomes, is_good = [], [], []
    for kind in KINDS:
        for k, outcome in enumerate(OUTCOMES):
            number = counts[kind][k]
            kinds += [kind] * number
            outcomes += [outcome] * number
            is_good += [place < (good or PAPER_GOOD)[kind][k] for place in range(number)]
    return Outcomes(draws=draws, kind=tuple(kinds), good=np.array(is_good), outcome=tuple(outcomes))


def test_counts_are_means_of_the_draws() -> None:
    twice = {kind: tuple(2 * count for count in row) for kind, row in PAPER_3D.items()}
    good = {kind: tuple(2 * count for count in row) for kind, row in PAPER_GOOD.items()}
    pooled = outcomes_of(twice, good, draws=2)
    assert pooled.counts(ALL, good_only=False) == [151.0, 90.0, 69.0]
    assert pooled.counts(ALL, good_only=True) == [123.0, 60.0, 14.0]
    assert pooled.correct("gable", good_only=False).value == pytest.approx(135 / 239)


def test_the_tables_have_the_printed_rows_first_and_blanks_where_nothing_is() -> None:
    found = {"parameter-space-3d": outcomes_of(PAPER_3D)}
    rows = [line.strip("|").split("|") for line in counts_table(found, ["4-2"], good_only=True).splitlines()]
    printed = ["", "8 / 0 / 5", "109 / 40 / 8", "0 / 4 / 0", "8 / 14 / 1", "125 / 58 / 14"]
    assert [cell.strip() for cell in rows[2]] == ["paper, table 4-2", *printed]
    mine = ["", "6 / 2 / 5", "109 / 40 / 8", "0 / 4 / 0", "8 / 14 / 1", "123 / 60 / 14"]
    assert [cell.strip() for cell in rows[3]] == ["parameter-space-3d", *mine]


def test_the_document_holds_both_subsets() -> None:
    reported = document({"parameter-space-2d": outcomes_of(PAPER_2D)}, "dev", 1)
    assert "### All 310 buildings" in reported
    assert "### The 197 without difficulties" in reported
