"""Disjoint seeds: methods are tuned on the dev draws of a suite and reported on its test draws."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from pipeline.errors import SettingsError


class Split(StrEnum):
    """The permitted use of a draw of a suite."""

    DEV = "dev"
    """Inspect, tune, choose settings."""
    TEST = "test"
    """Report, whatever the result."""


FIRST_SEEDS: Mapping[Split, int] = {Split.DEV: 1_000, Split.TEST: 90_000}
"""Seed of draw 0 of each split."""
DRAWS = 89_000
"""Draws per split; the dev seeds end where the test seeds begin."""


def seed_of(split: str, draw: int) -> int:
    """The seed of a draw of a split; SettingsError if one is out of range.

    >>> seed_of("dev", 0), seed_of("test", 3)
    (1000, 90003)
    """
    faults = []
    if split not in list(Split):
        faults.append(f"split is {split!r}: use one of {', '.join(Split)}")
    if not 0 <= draw < DRAWS:
        faults.append(f"draw is {draw}: use 0 to {DRAWS - 1}")
    if faults:
        raise SettingsError(faults)
    return FIRST_SEEDS[Split(split)] + draw


def split_of(seed: int) -> Split | None:
    """The split of a seed; None if it belongs to neither.

    >>> split_of(1005), split_of(90_000), split_of(7)
    (<Split.DEV: 'dev'>, <Split.TEST: 'test'>, None)
    """
    for split, first in FIRST_SEEDS.items():
        if first <= seed < first + DRAWS:
            return split
    return None
