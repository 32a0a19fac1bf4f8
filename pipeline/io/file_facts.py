"""What every format's reader hands to `pipeline.io.source`: facts of a file, and its records in pieces."""

from __future__ import annotations

import dataclasses
import datetime as dt
from collections.abc import Iterator
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

from pipeline.io.gps_time import GpsTimeKind
from pipeline.model import BoolArray, ByteArray, FloatArray

if TYPE_CHECKING:
    import pyproj
import io
from typing import Literal, runtime_checkable

UNSORTED_CLASSES = (0, 1)
"""ASPRS classes of unclassified points: never classified, unassigned."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Window:
    """A rectangle in plan, closed on all sides, in the units of the CRS."""

    x_min: float
    """West."""
    y_min: float
    """South."""
    x_max: float
    """East."""
    y_max: float
    """North."""

    def contains(self, xyz: FloatArray) -> BoolArray:
        """(n,) bool, True for points inside or on the edge."""
        x, y = xyz[:, 0], xyz[:, 1]
        inside: BoolArray = (x >= self.x_min) & (x <= self.x_max) & (y >= self.y_min) & (y <= self.y_max)
        return inside


@dataclasses.dataclass(frozen=True, kw_only=True)
class Share:
    """One of some nearly equal stretches of a file, so that several processes can read it at once."""

    number: int
    """Which one, from 0."""
    of: int
    """How many there are."""

    def pieces(self, starts: npt.NDArray[np.int64], total: int) -> slice:
        """Which of the file's pieces belong to it, given the number of points before each, and of all.

        >>> starts = np.array([0, 40, 80])
        >>> [Share(number=k, of=2).pieces(starts, 100) for k in (0, 1)]
        [slice(0, 2, None), slice(2, 3, None)]
        """
        first, end = (np.searchsorted(starts * self.of, total * k) for k in (self.number, self.number + 1))
        return slice(int(first), int(end))


@dataclasses.dataclass(frozen=True, kw_only=True)
class PointRecords:
    """Points as the file has them. All arrays have one length n; None where the file has no such field."""

    xyz: FloatArray
    """(n, 3) float64, in the units of the CRS, easting, northing, elevation; finite, every reader sees to it."""
    return_number: ByteArray | None = None
    """(n,) uint8, 1 is the first return."""
    return_count: ByteArray | None = None
    """(n,) uint8, returns of the pulse."""
    classification: ByteArray | None = None
    """(n,) uint8, ASPRS class."""
    gps_time: FloatArray | None = None
    """(n,) float64, seconds as in the file."""
    source_id: npt.NDArray[np.uint16] | None = None
    """(n,) uint16, flight line."""
    withheld: BoolArray | None = None
    """(n,) bool, True where the producer says not to use the point."""

    def __len__(self) -> int:
        """Number of records."""
        return len(self.xyz)


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class FileFacts:
    """What a file says about itself before its points are read, in the units of its CRS."""

    format: str
    """las, laz, copc, ply or ascii."""
    point_count: int
    """Points in the file."""
    bounds: tuple[float, float, float, float, float, float]
    """x_min, y_min, z_min, x_max, y_max, z_max."""
    crs: pyproj.CRS | None = None
    """As in the header; None if there is none, or if it cannot be understood (then there is a warning)."""
    horizontal_unit_m: float | None = None
    """Metres per horizontal unit, if the header has it beside the CRS."""
    vertical_unit_m: float | None = None
    """Metres per vertical unit, if the header has it beside the CRS."""
    has_returns: bool = False
    """Whether any pulse has more than one return."""
    has_classes: bool = False
    """Whether sampled points carry a class other than 0 (never classified) and 1 (unassigned)."""
    has_gps_time: bool = False
    """Whether sampled points carry differing GPS times."""
    gps_time_kind: GpsTimeKind = GpsTimeKind.NONE
    """How to read the GPS times."""
    gps_time_range: tuple[float, float] | None = None
    """Smallest and largest sampled GPS time, seconds as in the file."""
    created: dt.date | None = None
    """Day on which the file was made, which is not the day of the flight."""
    dimensions: tuple[tuple[str, str], ...] = ()
    """What the file has of each point, in its order: name, and type as numpy writes it, such as i4. Fields of single
    bits are u1. Of text, the columns that are used, as f8."""
    typical_bounds: tuple[float, float, float, float, float, float] | None = None
    """As `bounds`, of nearly all sampled points: single far points do not widen them; None if unknown."""
    warnings: tuple[str, ...] = ()
    """What is odd but usable, one sentence each."""


class PointFile(Protocol):
    """An opened file of one format: its facts, and its records in pieces. Opened again for every pass."""

    @property
    def facts(self) -> FileFacts:
        """What the file says about itself."""

    def records(self, chunk_size: int, window: Window | None) -> Iterator[PointRecords]:
        """The records in pieces of at most `chunk_size`; those outside the window may be left out, but need not."""


class DivisibleFile(PointFile, Protocol):
    """A file of which any part can be read alone."""

    def records(self, chunk_size: int, window: Window | None, share: Share | None = None) -> Iterator[PointRecords]:
        """The records; with a share only those that belong to it."""


class FileStatus(Protocol):
    """Size and time of a file."""

    @property
    def st_size(self) -> int:
        """Bytes."""

    @property
    def st_mtime_ns(self) -> int:
        """When it was last written, nanoseconds since 1970; 0 if unknown."""


class Readable(Protocol):
    """A file that can be opened at any place; as text it is what messages call it."""

    @property
    def name(self) -> str:
        """The last part of its path."""

    @property
    def suffix(self) -> str:
        """The ending of the name, with its dot."""

    def stat(self) -> FileStatus:
        """Size and time; raises OSError if the file is missing."""

    def open(self, mode: Literal["rb"], /) -> io.BufferedReader:
        """Its bytes."""


@runtime_checkable
class ReadsOnce(Protocol):
    """A file behind a URL."""

    def read_once(self, begin: int, length: int) -> bytes:
        """Some bytes that no one reads again; no others are fetched."""


def bytes_of(file: Readable, stream: io.BufferedReader, begin: int, length: int) -> bytes:
    """Some bytes of an open file, which are read once; of a remote one no others are fetched."""
    if isinstance(file, ReadsOnce):
        return file.read_once(begin, length)
    stream.seek(begin)
    return stream.read(length)
