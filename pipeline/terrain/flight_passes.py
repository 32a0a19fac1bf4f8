"""Passes of a survey under one id, by the gaps in its GPS times.

Between two passes the aircraft turns and the scanner rests, so the times of one id over all inputs have gaps there.
Times are cut into slices that begin at fixed times: which slices hold points depends on neither order, files nor tiles.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterable, Sequence
from typing import Self

import numpy as np
import numpy.typing as npt

from pipeline.model import BoolArray, FloatArray, IntArray

SLICE_S = 8.0
"""Length of the slices, seconds; an empty one is a gap. Not a setting: an aircraft needs longer to turn and come back.
A power of two, so that no border is rounded."""
_MOST_SLICES = 2**14
"""An id with more slices, 36 hours of them, has times of another kind."""
_MOST_PASSES = 256
"""An id with more passes has times of another kind, such as random ones."""
_HALF = 2**39
_SPAN = 2 * _HALF
"""Numbers of slices for one id: half of them before time 0. The first says that times are not those of passes."""
FIRST_PASS = 2**16
"""Number of the first pass: those below are ids."""

NO_SLICES: IntArray = np.empty(0, np.int64)


def slices_of(source_id: npt.NDArray[np.uint16], gps_time: FloatArray) -> IntArray:
    """Which slices of time each id has points in: ascending numbers (k,), of an id and a slice.

    `source_id` (n,) are ids of strips, `gps_time` (n,) seconds, finite. Times beyond 4e12 s are not those of passes.
    """
    piece = np.floor(gps_time / SLICE_S)
    piece = np.where(np.abs(piece) < _HALF - 1, piece, -_HALF).astype(np.int64)
    return united_slices([source_id.astype(np.int64) * _SPAN + piece + _HALF])


def united_slices(parts: Iterable[IntArray]) -> IntArray:
    """The slices of several parts, ascending; of an id with too many, the one that says so."""
    found = _distinct(np.concatenate([NO_SLICES, *parts]))
    source = found // _SPAN
    useless = np.bincount(source, minlength=FIRST_PASS) > _MOST_SLICES
    useless[source[found % _SPAN == 0]] = True
    return _distinct(np.concatenate([found[~useless[source]], np.flatnonzero(useless) * _SPAN]))


def _distinct(numbers: IntArray) -> IntArray:
    """Numbers in their order, each once; not by np.unique, which loads np.ma."""
    numbers = np.sort(numbers[np.append(True, np.diff(numbers) != 0)[: len(numbers)]])
    kept: IntArray = numbers[np.append(True, np.diff(numbers) != 0)[: len(numbers)]]
    return kept


def ids_of(slices: IntArray) -> list[int]:
    """The ids of some slices."""
    ids: list[int] = _distinct(slices // _SPAN).tolist()
    return ids


def passes_of(slices: IntArray) -> tuple[Strip, ...]:
    """The passes of all ids that have several, in their order: slices that follow one another.

    >>> [str(one) for one in passes_of(slices_of(np.array([3, 7, 7], np.uint16), np.array([9.0, 9.0, 90.0])))]
    ['7 at GPS time 8 to 16', '7 at GPS time 88 to 96']
    """
    begins = np.append(True, np.diff(slices) > 1)[: len(slices)]
    first, last = slices[begins], slices[np.append(begins[1:], True)[: len(slices)]]
    source = first // _SPAN
    count = np.bincount(source, minlength=FIRST_PASS)[source]
    kept = (count > 1) & (count <= _MOST_PASSES)
    spans = np.column_stack((source, first % _SPAN - _HALF, last % _SPAN - _HALF + 1))[kept].tolist()
    return tuple(Strip(number, begin * SLICE_S, end * SLICE_S) for number, begin, end in spans)


def numbers_of(source_id: npt.NDArray[np.uint16], gps_time: FloatArray, passes: Sequence[Strip]) -> IntArray:
    """The pass of each point as its place in `passes` plus `FIRST_PASS`, (n,); its id where this has no passes."""
    number = source_id.astype(np.int64)
    if not passes:
        return number
    sources = np.array([one.source for one in passes], np.int64)
    begins = np.array([one.from_s for one in passes])
    for source in _distinct(sources).tolist():
        own = np.flatnonzero(sources == source)
        held = number == source
        number[held] = FIRST_PASS + own[0] + np.searchsorted(begins[own], gps_time[held], side="right") - 1
    return number


def strip_of(number: int, passes: Sequence[Strip]) -> Strip:
    """The strip of a number of `numbers_of`."""
    return Strip(number) if number < FIRST_PASS else passes[number - FIRST_PASS]


_LARGEST_ID = 2**16 - 1


_TIMED = re.compile(r"(\d+)(?: at GPS time (-?\d+) to (-?\d+))?")


@dataclasses.dataclass(frozen=True, order=True, slots=True)
class Strip:
    """A flight strip: the points of one id, or those of them within some GPS times."""

    source: int
    """`point_source_id`, or where this is 0 the `file_source_id` of the header."""
    from_s: float = -math.inf
    """GPS time from which on, seconds as in the file; `inf` and its negative where the id alone names the strip."""
    to_s: float = math.inf
    """GPS time before which."""

    def __str__(self) -> str:
        """As messages and `run.json` name it.

        >>> str(Strip(31)), str(Strip(0, 230400.0, 230464.0))
        ('31', '0 at GPS time 230400 to 230464')
        """
        if not self.is_timed:
            return str(self.source)
        return f"{self.source} at GPS time {self.from_s:.0f} to {self.to_s:.0f}"

    @property
    def is_timed(self) -> bool:
        """Whether it is named by GPS times, too."""
        return math.isfinite(self.from_s)

    @classmethod
    def of(cls, name: str) -> Self:
        """The strip of a name; raises ValueError for any other text.

        >>> Strip.of("0 at GPS time 230400 to 230464") == Strip(0, 230400.0, 230464.0)
        True
        """
        found = _TIMED.fullmatch(name)
        if found is None:
            raise ValueError(f"{name!r} does not name a strip: use an id, or 'ID at GPS time FROM to TO'")
        source, from_s, to_s = found.groups()
        return cls(int(source)) if from_s is None else cls(int(source), float(from_s), float(to_s))

    def holds(self, source_id: npt.NDArray[np.uint16], gps_time: FloatArray) -> BoolArray:
        """Which points are of the strip, (n,), by their ids and GPS times."""
        held: BoolArray = source_id == self.source
        return held & (gps_time >= self.from_s) & (gps_time < self.to_s) if self.is_timed else held


def ids_of_timed(strips: Iterable[Strip]) -> dict[Strip, int]:
    """Ids for strips that share theirs, so that all that follows separates them by ids; as many as there are ids left.

    They count down from the largest, which surveys hardly use; those that the strips have are left out. The same strips
    get the same ids.

    >>> ids_of_timed([Strip(4), Strip(65535, 0.0, 8.0), Strip(65535, 32.0, 40.0)])
    {Strip(source=65535, from_s=0.0, to_s=8.0): 65534, Strip(source=65535, from_s=32.0, to_s=40.0): 65533}
    """
    strips = sorted(strips)
    used = {strip.source for strip in strips}
    free = (number for number in range(_LARGEST_ID, 0, -1) if number not in used)
    return dict(zip((strip for strip in strips if strip.is_timed), free, strict=False))
