"""Passes of a survey under one id, by the gaps in its GPS times.

Between two passes the aircraft turns and the scanner rests, so the times of one id over all inputs have gaps there.
Times are cut into slices that begin at fixed times: which slices hold points depends on neither order, files nor tiles.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from pipeline.model import FloatArray, IntArray
from pipeline.terrain.flight_strip import Strip

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
