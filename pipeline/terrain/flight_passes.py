"""Passes of a survey under one id, by their GPS times.

A place is seen within seconds by one pass of the aircraft, and again after a turn at the earliest. Where the points of
one id at a place have times far apart, several passes saw it, whatever the id says. Times are cut into slices that
begin at fixed times, so the slice of a point depends on nothing else; slices that follow one another at a place are
one pass there.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.model import FloatArray, IntArray

SLICE_S = 8.0
"""Length of the slices, seconds. Points of one id at a place are of two passes if their times lie two slices apart or
more, and of one if less than one slice. Not a setting: an aircraft needs longer to turn and come back. What a conical
scanner sees to the front and to the back may be two passes, which fit. A power of two, so that no border is rounded."""
_HALF = 2**39
_SPAN = 2 * _HALF
"""Numbers of slices for one id: half of them before time 0. Times beyond 4e12 s are in the first or the last slice."""


@kernel
def slices_of(source_id: npt.NDArray[np.uint16], gps_time: FloatArray) -> IntArray:
    """Id and slice of time of each point as one number, (n,) int64; slices that follow one another differ by 1.

    `source_id` (n,) are ids of strips, `gps_time` (n,) seconds, finite.
    """
    found = np.empty(len(source_id), np.int64)
    for i in range(len(source_id)):
        number = min(max(math.floor(gps_time[i] / SLICE_S), 2.0 - _HALF), _HALF - 2.0)
        found[i] = np.int64(source_id[i]) * _SPAN + np.int64(number) + _HALF
    return found


def id_and_slice(number: int) -> tuple[int, int]:
    """The id and the slice, counted from time 0, of a number of `slices_of`.

    >>> id_and_slice(int(slices_of(np.array([7], np.uint16), np.array([-1.0]))[0]))
    (7, -1)
    """
    return number // _SPAN, number % _SPAN - _HALF
