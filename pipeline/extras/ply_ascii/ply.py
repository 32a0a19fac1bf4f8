"""PLY, ascii and binary of both byte orders: the vertices as points, streamed.

Source: G. Turk, The PLY Polygon File Format, 1994.
"""

from __future__ import annotations

import dataclasses
import io
import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import EmptyInputError, InconsistentInputError, UnreadableInputError
from pipeline.extras.ply_ascii.measured_points import measured, whole
from pipeline.io.file_facts import FileFacts, PointRecords, Readable, Window
from pipeline.io.reading import moved

SCALARS = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
"""numpy's names of PLY's types."""
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}

PROPERTY_NAMES = {
    "return_number": ("return_number", "returnnumber", "scalar_return_number", "scalar_returnnumber"),
    "return_count": ("number_of_returns", "numberofreturns", "scalar_number_of_returns", "scalar_numberofreturns"),
    "classification": ("classification", "scalar_classification", "class"),
    "gps_time": ("gps_time", "gpstime", "scalar_gps_time", "scalar_gpstime"),
    "source_id": ("point_source_id", "pointsourceid", "scalar_point_source_id", "scalar_pointsourceid"),
}
"""What a property can be called, in lower case; CloudCompare writes `scalar_` before its own."""

HEADER_LIMIT = 65_536
LINE_LIMIT = 65_536
NUMBER_LIMIT = 64
"""Characters of a number; no row of numbers is longer than this allows, which bounds what is held at once."""
SINGLE_PRECISION_FAULT = 0.01
"""Units of the CRS; coarser single precision gives a warning."""
FIX = "Get the file again, or write it again"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Element:
    """One element of the header."""

    name: str
    """vertex, face, ..."""
    count: int
    """Promised items."""
    properties: tuple[tuple[str, str], ...]
    """Name and PLY type; the type of a list is `list`."""

    @property
    def has_lists(self) -> bool:
        """Whether items differ in length."""
        return any(kind == "list" for _, kind in self.properties)

    def dtype(self, byte_order: str) -> np.dtype[Any]:
        """The item as a numpy record."""
        return np.dtype([(name, byte_order + SCALARS[kind]) for name, kind in self.properties])


class PlyFile:
    """A PLY file. Opening it for the first time reads the vertices through, for their bounds.

    Parameters
    ----------
    facts : FileFacts, optional
        Those of the same file, opened before: then it is not read through again.

    Raises
    ------
    InputError
        If header and data do not fit one another, there are no vertices, or a coordinate is not finite.
    """

    def __init__(self, path: Readable, facts: FileFacts | None = None) -> None:
        self._path = path
        with path.open("rb") as stream:
            self._byte_order, self._elements = _read_header(path, stream)
            self._body = stream.tell()
        self._vertex = _vertex_of(path, self._elements)
        self._fields = self._find_fields()
        if self._byte_order:
            self._start = self._check_room()
        self.facts = self._measure() if facts is None else facts

    def records(self, chunk_size: int, window: Window | None) -> Iterator[PointRecords]:
        """The vertices in file order."""
        del window
        tables = self._binary_tables(chunk_size) if self._byte_order else self._ascii_tables(chunk_size)
        begin = 0
        for table in tables:
            moved()
            records = self._to_records(table)
            finite = np.isfinite(records.xyz).all(axis=1)
            if not finite.all():
                at = int(np.argmin(finite))
                raise InconsistentInputError(
                    str(self._path),
                    f"vertex {begin + at + 1} has the coordinates {records.xyz[at].tolist()}",
                    "Remove points whose coordinates are NaN or infinite",
                )
            begin += len(table)
            yield records

    def _check_room(self) -> int:
        """Byte at which the vertices begin in a binary file, when the promised bytes are there."""
        name, size = str(self._path), self._path.stat().st_size
        at, index = self._body, self._elements.index(self._vertex)
        for element in self._elements[:index]:
            if element.has_lists:
                raise UnreadableInputError(
                    name, f"element {element.name} with lists comes before the vertices", "Write the vertices first"
                )
            at += element.count * element.dtype(self._byte_order).itemsize
        itemsize = self._vertex.dtype(self._byte_order).itemsize
        held, is_last = (size - at) // itemsize, index == len(self._elements) - 1
        if held < self._vertex.count or (is_last and size != at + self._vertex.count * itemsize):
            raise InconsistentInputError(
                name, f"the header promises {self._vertex.count} vertices, the file has room for {max(held, 0)}", FIX
            )
        return at

    def _binary_tables(self, chunk_size: int) -> Iterator[npt.NDArray[np.void]]:
        """Structured arrays of at most so many vertices."""
        dtype = self._vertex.dtype(self._byte_order)
        with self._path.open("rb") as stream:
            stream.seek(self._start)
            for begin in range(0, self._vertex.count, chunk_size):
                count = min(chunk_size, self._vertex.count - begin)
                raw = stream.read(count * dtype.itemsize)
                if len(raw) != count * dtype.itemsize:
                    raise UnreadableInputError(str(self._path), f"truncated after vertex {begin}", FIX)
                yield np.frombuffer(raw, dtype=dtype)

    def _ascii_tables(self, chunk_size: int) -> Iterator[npt.NDArray[np.void]]:
        """Structured arrays of at most so many vertices."""
        index, name = self._elements.index(self._vertex), str(self._path)
        dtype = np.dtype([(prop, "f8") for prop, _ in self._vertex.properties])
        width = len(self._vertex.properties)
        with self._path.open("rb") as stream:
            stream.seek(self._body)
            for _ in range(sum(element.count for element in self._elements[:index])):
                if not stream.readline(LINE_LIMIT):
                    break
            for begin in range(0, self._vertex.count, chunk_size):
                count = min(chunk_size, self._vertex.count - begin)
                lines = list(itertools.islice(iter(lambda: stream.readline(width * NUMBER_LIMIT), b""), count))
                try:
                    table = (
                        np.loadtxt(lines, dtype=np.float64, ndmin=2, comments=None) if lines else np.empty((0, width))
                    )
                except ValueError as fault:
                    # numpy goes on with advice for programmers
                    said = str(fault).partition(";")[0][:100]
                    problem = f"vertices {begin + 1} to {begin + count} are damaged ({said})"
                    raise UnreadableInputError(name, problem, FIX) from fault
                if table.shape != (count, width):
                    raise InconsistentInputError(
                        name,
                        f"the header promises {self._vertex.count} vertices of {width} numbers,"
                        f" there are {begin + table.shape[0]} of {table.shape[1]}",
                        FIX,
                    )
                yield np.ascontiguousarray(table).view(dtype).ravel()
            if index == len(self._elements) - 1 and stream.read(LINE_LIMIT).strip():
                raise InconsistentInputError(
                    name, f"the header promises {self._vertex.count} vertices, the file has more", FIX
                )

    def _find_fields(self) -> dict[str, str]:
        names = [name for name, _ in self._vertex.properties]
        return {
            field: next(alias for alias in aliases if alias in names)
            for field, aliases in PROPERTY_NAMES.items()
            if any(alias in names for alias in aliases)
        }

    def _to_records(self, table: npt.NDArray[np.void]) -> PointRecords:
        """Arrays of the fields that are used."""

        def small(field: str, dtype: type[np.integer[Any]]) -> npt.NDArray[Any] | None:
            return whole(table[self._fields[field]].astype(np.float64), dtype) if field in self._fields else None

        xyz = np.column_stack([table[axis].astype(np.float64) for axis in "xyz"])
        time = self._fields.get("gps_time")
        return PointRecords(
            xyz=xyz,
            return_number=small("return_number", np.uint8),
            return_count=small("return_count", np.uint8),
            classification=small("classification", np.uint8),
            gps_time=None if time is None else table[time].astype(np.float64),
            source_id=small("source_id", np.uint16),
        )

    def _measure(self) -> FileFacts:
        """What a pass over the vertices finds."""
        dimensions = tuple((name, SCALARS[kind]) for name, kind in self._vertex.properties)
        facts = measured("ply", self.records(100_000, None), dimensions=dimensions)
        assert facts is not None  # the header promises some, and all are there
        bounds = np.abs(np.reshape(facts.bounds, (2, 3))).max(axis=0)
        return dataclasses.replace(facts, warnings=self._precision_warnings(bounds))

    def _precision_warnings(self, largest: npt.NDArray[np.float64]) -> tuple[str, ...]:
        """Tell where single precision is too coarse for the coordinates."""
        if not self._byte_order:
            return ()
        kinds = dict(self._vertex.properties)
        warnings = []
        for axis, value in zip("xyz", largest.tolist(), strict=True):
            step = float(np.spacing(np.float32(value)))
            if SCALARS[kinds[axis]] == "f4" and step > SINGLE_PRECISION_FAULT:
                warnings.append(
                    f"{axis} is in single precision: at {value:.0f} its steps are {step:g} units; write double"
                )
        return tuple(warnings)


def _with_property(element: Element, name: str, kind: str) -> Element:
    """The element with one more property."""
    return dataclasses.replace(element, properties=(*element.properties, (name, kind)))


def promised_vertices(path: Readable) -> int:
    """The number of vertices that the header promises; nothing else is read.

    Raises InputError if the header is damaged or has no vertices.
    """
    with path.open("rb") as stream:
        _, elements = _read_header(path, stream)
    return _vertex_of(path, elements).count


def _read_header(path: Readable, stream: io.BufferedReader) -> tuple[str, list[Element]]:
    """Byte order and elements; leaves the stream where the data begin."""
    byte_order: str | None = None
    elements: list[Element] = []
    while stream.tell() < HEADER_LIMIT:
        line = stream.readline(LINE_LIMIT)
        if not line:
            break
        try:
            words = line.decode("ascii").split()
            match words:
                case [] | ["ply"] | ["comment" | "obj_info", *_]:
                    continue
                case ["format", kind, _]:
                    byte_order = BYTE_ORDERS[kind]
                case ["element", name, count]:
                    elements.append(Element(name=name, count=int(count), properties=()))
                case ["property", "list", _, _, name]:
                    elements[-1] = _with_property(elements[-1], name, "list")
                case ["property", kind, name] if kind in SCALARS:
                    elements[-1] = _with_property(elements[-1], name.lower(), kind)
                case ["end_header"]:
                    if byte_order is None:
                        break
                    return byte_order, elements
                case _:
                    raise _damaged(path, line)
        except (UnicodeDecodeError, KeyError, ValueError, IndexError) as fault:
            raise _damaged(path, line) from fault
    raise UnreadableInputError(str(path), "truncated: the PLY header has no end or no format", FIX)


def _damaged(path: Readable, line: bytes) -> UnreadableInputError:
    """The error for a line of the header that means nothing."""
    return UnreadableInputError(str(path), f"the PLY header has the line {line[:60]!r}", FIX)


def _vertex_of(path: Readable, elements: list[Element]) -> Element:
    """The vertex element, fit to be points."""
    name = str(path)
    found = [element for element in elements if element.name == "vertex"]
    if len(found) != 1:
        raise UnreadableInputError(name, f"the PLY has {len(found)} vertex elements", "Give a PLY with points")
    vertex = found[0]
    missing = {"x", "y", "z"} - {prop for prop, _ in vertex.properties}
    names = [prop for prop, _ in vertex.properties]
    if missing or vertex.has_lists or len(set(names)) != len(names):
        raise UnreadableInputError(
            name,
            f"the vertices have the properties {' '.join(names)}",
            "Give a PLY with x, y, z and no lists there",
        )
    if vertex.count == 0:
        raise EmptyInputError(name, "the header promises 0 vertices", "Give a file with points")
    if vertex.count < 0:
        raise InconsistentInputError(name, f"the header promises {vertex.count} vertices", FIX)
    return vertex
