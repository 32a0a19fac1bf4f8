"""The counts of candidates against houses, from tables made by hand."""

import numpy as np

from benchmarks.units import Relations, relations


def counted(*shares: tuple[int, int, int]) -> Relations:
    """Counts of (candidate, house, points)."""
    table = np.array(shares, np.int64)
    return relations(np.repeat(table[:, 0], table[:, 2]), np.repeat(table[:, 1], table[:, 2]))


def test_a_few_points_of_a_neighbour_do_not_bind() -> None:
    assert counted((0, 0, 90), (0, 1, 10), (1, 1, 100)) == Relations(
        candidates=2, houses=2, one_to_one=2, joining=0, joined=0, divided=0
    )


def test_a_block_holds_its_houses_and_a_house_can_be_divided() -> None:
    found = counted((0, 0, 50), (0, 1, 50), (0, 2, 50), (1, 3, 40), (2, 3, 60), (3, 4, 10), (4, -1, 99))
    assert found == Relations(candidates=4, houses=5, one_to_one=1, joining=1, joined=3, divided=1)


def test_a_small_house_in_a_large_candidate_is_joined() -> None:
    assert counted((0, 0, 1000), (0, 1, 20)).joined == 2


def test_points_without_houses_count_nothing() -> None:
    assert counted((0, -1, 5)) == Relations(candidates=0, houses=0, one_to_one=0, joining=0, joined=0, divided=0)
