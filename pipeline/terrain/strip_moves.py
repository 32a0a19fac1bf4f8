"""Flight strips that do not fit: the distance between them, in words, and the moves of whole strips.

If strips lie so far apart that houses would be lost, they move as wholes to their common mean.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pipeline.kernels.union_find import united
from pipeline.model import FloatArray, IntArray
from pipeline.terrain.flight_passes import Strip, ids_of, passes_of, strip_of
from pipeline.terrain.survey_strips import UNCLEAR, Rows, counted
from pipeline.terrain.terrain_settings import StripSettings

_FEW_TO_MOVE = 30
"""Fewest squares by which whole strips are moved: those of one roof may lie apart for a reason of its own."""
_MOST_NAMED = 5
"""Pairs of strips that a warning names; it counts the others."""
_LEAST_SHARE = 0.75
"""Least share of the squares on one or two surfaces whose points lie on two, from which on these are taken for strips:
greenhouses, crops and panels on a part of a survey show two surfaces, too."""
_LEAST_OF_ALL = 0.3
"""Least share of all squares, with those that show neither: these are rough, or have too few points."""
_MOST_SPREAD_M = 0.2
"""Largest distance of the quartiles of what lies between two such surfaces: it is alike where strips do not fit."""


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class StripOffset:
    """Two strips that do not fit."""

    first: Strip
    """The strip with the smaller id, or the earlier one."""
    second: Strip
    """The other one."""
    offset_m: float
    """How far the first lies above the second, metres: the median over the squares."""
    low_m: float
    """The lower quartile."""
    high_m: float
    """The upper quartile."""
    squares: int
    """Squares that both saw."""

    def __str__(self) -> str:
        """In words."""
        seen = f"({self.squares} places)"
        if self.high_m - self.low_m > 0.1:
            low, high = f"{self.low_m:+.2f}", f"{self.high_m:+.2f}"
            return f"strip {self.first} lies {low} to {high} m above strip {self.second} {seen}"
        side = "above" if self.offset_m > 0.0 else "below"
        return f"strip {self.first} lies {abs(self.offset_m):.2f} m {side} strip {self.second} {seen}"


def _all_pairs(rows: Rows, slices: IntArray, settings: StripSettings) -> tuple[Sequence[Strip], list[StripOffset]]:
    """All strips, and all pairs of them that some square compares."""
    names, rows = named_strips(rows, slices, min(settings.warn_m, settings.align_m))
    pairs = [
        StripOffset(
            first=names[found.first],
            second=names[found.second],
            offset_m=found.middle_m,
            low_m=found.low_m,
            high_m=found.high_m,
            squares=found.squares,
        )
        for found in differences(rows)
    ]
    return names, pairs


def offsets_of(rows: Rows, slices: IntArray, settings: StripSettings) -> list[StripOffset]:
    """Pairs of strips that differ by more than `warn_m` at a quarter of the squares, the largest offset first.

    `rows` are those of all tiles together, `slices` those of all inputs (`slices_of`).
    """
    found = [
        pair
        for pair in _all_pairs(rows, slices, settings)[1]
        if pair.squares >= FEW_SQUARES and max(-pair.low_m, pair.high_m) > settings.warn_m
    ]
    return sorted(found, key=lambda pair: (-max(-pair.low_m, pair.high_m), pair.first, pair.second))


def strips_warning(apart: Sequence[StripOffset], moves_mm: Mapping[Strip, int]) -> str:
    """What does not fit and what a run does about it, for people; `apart` is not empty."""
    named = "; ".join(map(str, apart[:_MOST_NAMED]))
    if len(apart) > _MOST_NAMED:
        named += f"; and {len(apart) - _MOST_NAMED} pairs more"
    moved = ", ".join(f"{strip} by {move / 1000.0:+.2f} m" for strip, move in sorted(moves_mm.items()) if move)
    if not moved:
        return f"flight strips do not fit: {named}. Buildings that two strips saw are aligned one by one"
    return f"flight strips do not fit: {named}. They are moved to their common mean: strip {moved}"


def surfaces_warning(rows: Rows, slices: IntArray, settings: StripSettings) -> str:
    """A sentence on points that lie on two surfaces nearly wherever these are smooth; empty where they do not.

    Neither their ids nor their GPS times say that two strips saw it.
    """
    names, _ = _all_pairs(rows, slices, settings)
    divided = [*{one.source for one in names if one.is_timed}]
    alone = rows[(rows[:, 0] == rows[:, 1]) & ~np.isin(rows[:, 0], divided)]
    two = alone[alone[:, 2] > 0]
    two[:, :2] = 0
    squares, clear = int(alone[:, 3].sum()), int(alone[alone[:, 2] != UNCLEAR, 3].sum())
    for found in differences(two):
        share = found.squares / squares
        enough = found.squares >= max(_FEW_TO_MOVE, _LEAST_SHARE * clear) and share >= _LEAST_OF_ALL
        if enough and found.high_m - found.low_m <= _MOST_SPREAD_M:
            return (
                f"at {100.0 * share:.0f} % of {squares} places the points lie on two surfaces {found.middle_m:.2f} m "
                "apart, as where flight strips do not fit, and neither point_source_id nor GPS time says which point "
                "is of which strip: houses there may be missing. Give each strip a point_source_id of its own"
            )
    return ""


def moves_of(rows: Rows, slices: IntArray, settings: StripSettings) -> dict[Strip, int]:
    """By how many millimetres each strip is moved up; empty where all strips fit, or ids separate those that do not.

    `rows` and `slices` are as for `offsets_of`. Strips that differ by no more than `align_m` keep their places to each
    other. The others are fitted by least squares over the squares that they share, so that the mean of all places that
    strips were compared at stays. Where GPS times name some strips, all are listed, even those that stay.
    """
    names, pairs = _all_pairs(rows, slices, settings)
    apart = [p for p in pairs if abs(p.offset_m) > settings.align_m and p.squares >= _FEW_TO_MOVE]
    stay = dict.fromkeys(names, 0) if any(strip.is_timed for strip in names) else {}
    if not apart:
        return stay
    index = {strip: k for k, strip in enumerate(sorted({strip for p in pairs for strip in (p.first, p.second)}))}
    close = [(index[p.first], index[p.second]) for p in pairs if abs(p.offset_m) <= settings.align_m]
    fit = np.array(close, np.int64).reshape(-1, 2)
    group = united(len(index), fit[:, 0], fit[:, 1])
    weight = np.zeros(len(index))
    for p in pairs:
        for strip in (p.first, p.second):
            weight[group[index[strip]]] += p.squares
    level = _levels(group, [(index[p.first], index[p.second], p.offset_m, p.squares) for p in apart], weight)
    moves = {strip: round(-100.0 * level[int(group[k])]) * 10 for strip, k in index.items()}
    return stay | {strip: move for strip, move in moves.items() if move}


def _levels(group: IntArray, pairs: Sequence[tuple[int, int, float, int]], weight: FloatArray) -> Mapping[int, float]:
    """Height of each group of strips above the mean of those it is compared with, metres.

    `pairs` are two strips, how far the first lies above the second, and the squares. Gauss and Seidel's iteration: few
    groups, added up in a fixed order.
    """
    roots = sorted({int(group[k]) for pair in pairs for k in pair[:2]})
    level = dict.fromkeys(map(int, group), 0.0)
    edges = [(int(group[a]), int(group[b]), offset, n) for a, b, offset, n in pairs if group[a] != group[b]]
    beside: dict[int, list[tuple[int, float, int]]] = {root: [] for root in roots}
    for a, b, offset, n in edges:
        beside[a].append((b, offset, n))
        beside[b].append((a, -offset, n))
    for _ in range(_ROUNDS):
        for root, others in beside.items():
            if others:
                total = sum(n for *_, n in others)
                level[root] = sum(n * (level[other] + offset) for other, offset, n in others) / total
    part = united(len(group), np.array([a for a, *_ in edges], np.int64), np.array([e[1] for e in edges], np.int64))
    for piece in {int(part[root]) for root in roots}:
        members = [root for root in roots if int(part[root]) == piece]
        mean = sum(weight[root] * level[root] for root in members) / sum(weight[root] for root in members)
        for root in members:
            level[root] -= mean
    return level


_ROUNDS = 500
"""Rounds of the iteration: far more than a chain of strips across a city needs to a centimetre."""


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
