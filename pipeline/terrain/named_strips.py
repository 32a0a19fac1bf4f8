"""The strips of a survey: one per id, or one per pass (by GPS time) if several passes share an id."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pipeline.model import IntArray
from pipeline.terrain.flight_passes import ids_of, passes_of, strip_of
from pipeline.terrain.flight_strip import Strip
from pipeline.terrain.survey_strips import Rows, counted

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


def named_strips(rows: Rows, slices: IntArray, limit_m: float) -> tuple[Sequence[Strip], Rows]:
    """All strips of a survey, in their order, and the rows of pairs with the places of these in place of numbers.

    `slices` are those of all inputs. An id is one strip, unless 12 places show that passes of it differ by more than
    `limit_m`: then each pass is one.
    """
    passes = passes_of(slices)
    pairs = rows[rows[:, 0] < rows[:, 1]]
    strip = {number: strip_of(number, passes) for number in {*pairs[:, :2].ravel().tolist()}}
    divided = {
        strip[found.first].source
        for found in differences(pairs)
        if strip[found.first].source == strip[found.second].source and found.exceeds(limit_m)
    }
    undivided = (Strip(number) for number in ids_of(slices) if number not in divided)
    names = sorted([*undivided, *(one for one in passes if one.source in divided)])
    place = {one: k for k, one in enumerate(names)}
    found = []
    for *numbers, cm, squares in pairs.tolist():
        both = [strip[number] for number in numbers]
        parts = [one.source in divided for one in both]
        # of two strips that stay whole counts what was compared by ids, of others what was compared by passes
        timed = [one.is_timed for one in both]
        if not all(t >= p for t, p in zip(timed, parts, strict=True)) or any(timed) > any(parts):
            continue
        a, b = (place[one if part else Strip(one.source)] for one, part in zip(both, parts, strict=True))
        found.append((a, b, cm, squares) if a < b else (b, a, -cm, squares))
    return names, counted(np.array(found, np.int64).reshape(-1, 4))
