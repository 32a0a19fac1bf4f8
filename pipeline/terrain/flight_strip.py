"""A flight strip by its name: an id, or an id and GPS times."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterable
from typing import Self

import numpy as np
import numpy.typing as npt

from pipeline.model import BoolArray, FloatArray

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
