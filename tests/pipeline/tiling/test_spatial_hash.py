"""Hashing in space: duplicates by value, and slots that spread whatever is packed high in a key."""

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.model import BoolArray
from pipeline.spatial_hash import first_of_each, slot_of_key

Rows = npt.NDArray[np.int64]

rows = st.lists(
    st.tuples(
        st.integers(-2, 2),
        st.integers(-2, 2),
        st.integers(0, 1),
        st.integers(1, 2),
        st.sampled_from([0, 7]),
        st.integers(0, 3),
        st.integers(0, 3),
    ),
    max_size=80,
)


def kept_of(table: Rows) -> BoolArray:
    x, y, z, number, time, source, class_ = (np.ascontiguousarray(column) for column in table.reshape(-1, 7).T)
    return first_of_each(
        x,
        y,
        z,
        number.astype(np.uint8),
        time / 3.0,
        source.astype(np.uint16),
        class_.astype(np.uint8),
        np.ones(len(x), np.uint8),
    )


@settings(deadline=None)
@given(members=rows)
def test_one_of_each_set_of_equal_points_stays_by_source_then_class(members: list[tuple[int, ...]]) -> None:
    table = np.array(members, np.int64).reshape(-1, 7)
    kept = table[kept_of(table)].tolist()
    best: dict[tuple[int, ...], tuple[int, ...]] = {}
    for row in members:
        best[row[:5]] = min(best.get(row[:5], row[5:]), row[5:])
    assert len(kept) == len(best)
    assert {tuple(row[:5]): tuple(row[5:]) for row in kept} == best


@settings(deadline=None)
@given(members=rows, seed=st.integers(0, 1000))
def test_what_stays_does_not_depend_on_the_order(members: list[tuple[int, ...]], seed: int) -> None:
    table = np.array(members, np.int64).reshape(-1, 7)
    mixed = np.random.default_rng(seed).permutation(table)
    assert sorted(mixed[kept_of(mixed)].tolist()) == sorted(table[kept_of(table)].tolist())


def test_points_that_differ_in_any_column_all_stay() -> None:
    random = np.random.default_rng(1)
    table = np.column_stack(
        (
            random.integers(84_000_000, 84_100_000, (20_000, 2)),
            random.integers(-5000, 5000, 20_000),
            np.ones((20_000, 1), np.int64),
            np.arange(20_000),
            np.zeros((20_000, 2), np.int64),
        )
    )
    assert kept_of(table).all()
    assert kept_of(np.repeat(table, 3, axis=0)).sum() == 20_000


@pytest.mark.parametrize("shift", [0, 21, 31, 42])
@pytest.mark.parametrize("bits", [12, 16, 20])
def test_keys_that_differ_in_a_few_bits_anywhere_spread_over_the_slots(shift: int, bits: int) -> None:
    mask = (1 << bits) - 1
    slots = [int(slot_of_key(k << shift, mask)) for k in range(1000)]
    assert all(0 <= slot <= mask for slot in slots)
    # 1000 random keys leave at least 885 slots of 4096 taken, up to few standard deviations
    assert len(set(slots)) > 840
