"""The printed tables, and what is computed beside them."""

import numpy as np
import pytest

from benchmarks.hofmann_tables import (
    ALL,
    KINDS,
    OUTCOMES,
    PAPER,
    Outcomes,
    counts_table,
    difference,
    document,
    pattern,
    pattern_table,
)

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


def test_the_papers_own_tables_show_the_papers_pattern() -> None:
    rows = pattern(outcomes_of(PAPER_2D), outcomes_of(PAPER_3D))
    assert [shows for _, shows, _ in rows] == [True] * 6


def test_the_pattern_turned_round_does_not_show() -> None:
    shows = {sentence.split(":")[0]: yes for sentence, yes, _ in pattern(outcomes_of(PAPER_3D), outcomes_of(PAPER_2D))}
    del shows["3D"]  # which of the buildings were good in 2D the paper does not tell
    assert shows == {"gables": False, "hips": False, "pent": False, "flat": True, "all": False}


def test_a_method_that_finds_all_shows_no_pattern() -> None:
    perfect = outcomes_of({kind: (sum(PAPER_3D[kind]), 0, 0) for kind in KINDS})
    assert [shows for _, shows, _ in pattern(perfect, perfect)] == [False] * 6


def test_a_pair_is_two_and_three_dimensions_of_one_preset() -> None:
    one, other = outcomes_of(PAPER_2D), outcomes_of(PAPER_3D)
    both = {"parameter-space-2d": one, "parameter-space-3d": other}
    assert pattern_table(both).count("the paper's pattern") == 1
    assert pattern_table({"parameter-space-2d-faithful": one, "parameter-space-3d": other, "kmeans": one}) == ""


def test_a_difference_is_that_of_the_shares_with_an_interval_about_it() -> None:
    two, three = outcomes_of(PAPER_2D), outcomes_of(PAPER_3D)
    gain = difference(three, two, "gable")
    assert gain.value == pytest.approx((135 - 70) / 239)
    assert gain.low < gain.value < gain.high
    back = difference(two, three, "gable")
    assert (back.value, back.low, back.high) == pytest.approx((-gain.value, -gain.high, -gain.low))
    same = difference(two, two, ALL)
    assert (same.value, same.low, same.high) == (0.0, 0.0, 0.0)


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
    assert "Not both parameter spaces were measured" in reported
