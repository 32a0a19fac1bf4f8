"""Which strips a survey has: those of its ids, and of an id that several passes share, its passes by GPS time."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pipeline.terrain.flight_passes import SLICE_S, id_and_slice
from pipeline.terrain.flight_strip import Strip
from pipeline.terrain.survey_strips import NO_ROWS, Rows, counted

FEW_SQUARES = 12
"""Fewest squares that show an offset of two strips."""
_QUARTERS = (0.25, 0.5, 0.75)
"""Shares of the squares at which differences are read: a fault that only some squares show, such as a tide or a field
that grew between two flights, is not one of the strips; one that drifts or tilts a strip shows in the quartiles."""


class Difference(NamedTuple):
    """How two strips of rows differ."""

    first: int
    """Number of the first one."""
    second: int
    """Number of the second one."""
    low_m: float
    """How far the first lies above the second, metres: the lower quartile over the squares."""
    middle_m: float
    """The median."""
    high_m: float
    """The upper quartile."""
    squares: int
    """Squares that both saw."""

    def exceeds(self, limit_m: float) -> bool:
        """Whether enough squares show that they differ by more, at a quarter of these at least."""
        return self.squares >= FEW_SQUARES and max(-self.low_m, self.high_m) > limit_m


def differences(rows: Rows) -> list[Difference]:
    """The differences of all pairs of numbers in some rows, in their order."""
    rows = counted(rows)
    new = np.append(True, (rows[1:, :2] != rows[:-1, :2]).any(axis=1))[: len(rows)]
    found = []
    for own in np.split(rows, np.flatnonzero(new)[1:]) if len(rows) else []:
        total = np.cumsum(own[:, 3])
        squares = int(total[-1])
        # whole squares: the lower one of two in the middle
        low, middle, high = (float(own[np.searchsorted(total, share * squares), 2]) / 100.0 for share in _QUARTERS)
        found.append(Difference(int(own[0, 0]), int(own[0, 1]), low, middle, high, squares))
    return found


def named_strips(parts: Iterable[Rows], limit_m: float) -> tuple[Sequence[Strip], Rows]:
    """The strips of some rows, in their order, and the rows of pairs with the places of these in place of numbers.

    An id is one strip, unless places show passes of it that differ by more than `limit_m`. Then slices of time that
    follow one another are a strip, unless they differ so among themselves: then each of them is one.
    """
    rows = counted(np.concatenate([NO_ROWS, *parts]))
    pairs = rows[rows[:, 0] < rows[:, 1]]
    runs = _runs(sorted({*rows[:, :2].ravel().tolist()}))
    run_of = {number: k for k, run in enumerate(runs) for number in run}
    torn = {run_of[d.first] for d in differences(pairs) if run_of[d.first] == run_of[d.second] and d.exceeds(limit_m)}
    strip_of: dict[int, Strip] = {}
    for k, run in enumerate(runs):
        for piece in [[number] for number in run] if k in torn else [run]:
            strip_of |= dict.fromkeys(piece, _strip(piece))
    names, found = _by_strip(pairs, strip_of)
    alike = (d for d in differences(found) if names[d.first].source == names[d.second].source)
    shared = {names[d.first].source for d in alike if d.exceeds(limit_m)}
    return _by_strip(pairs, {n: one if one.source in shared else Strip(one.source) for n, one in strip_of.items()})


def _runs(numbers: Sequence[int]) -> list[list[int]]:
    """Ascending numbers, divided where one does not follow the one before.

    >>> _runs([3, 4, 7])
    [[3, 4], [7]]
    """
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return runs


def _strip(slices: Sequence[int]) -> Strip:
    """The strip of some slices of one id that follow one another."""
    (source, first), (_, last) = id_and_slice(slices[0]), id_and_slice(slices[-1])
    return Strip(source, first * SLICE_S, (last + 1) * SLICE_S)


def _by_strip(pairs: Rows, strip_of: Mapping[int, Strip]) -> tuple[Sequence[Strip], Rows]:
    """The strips, and the rows of two of them with their places in place of numbers."""
    names = sorted({*strip_of.values()})
    place = {strip: k for k, strip in enumerate(names)}
    numbers = sorted(strip_of)
    places = np.array([place[strip_of[number]] for number in numbers], np.int64)
    found = pairs.copy()
    for column in (0, 1):
        found[:, column] = places[np.searchsorted(numbers, pairs[:, column])] if len(pairs) else 0
    return names, counted(found[found[:, 0] != found[:, 1]])
