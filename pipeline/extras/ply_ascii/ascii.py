"""Points as text, one row each: `x y z [intensity] ...`, or first and last echo of a pulse side by side in a row.

Columns are parted by white space, commas or semicolons, decimals by points. Rows that begin with `#`, `//` or `%` are
comments; lines of words above the first row of numbers are a header, and the names of columns in it are used
(`ascii_names`). The form with two echoes, `x1 y1 z1 [i1] x2 y2 z2 [i2]`, is recognised by what a pulse can do, or set
by `ascii_columns`.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.errors import EmptyInputError, InconsistentInputError, SettingsError, UnreadableInputError
from pipeline.extras.ply_ascii.ascii_names import COMMENT, SEPARATORS, columns_of, header_columns, is_complete
from pipeline.extras.ply_ascii.measured_points import measured, whole
from pipeline.io.file_facts import FileFacts, PointRecords, Readable, Window
from pipeline.io.reading import moved
from pipeline.model import FloatArray

SAMPLE_ROWS = 20_000
HEADER_LINES = 50
LINE_LIMIT = 65_536
"""Bytes; a longer line is not a row of points."""
BYTES_A_ROW = 24
"""A short row: blocks of the file are as many times this as rows are wanted."""
BLOCK_LIMIT = 1 << 24
"""Most bytes of text parsed at once."""

BEAM_SLACK = 1.0
"""Units of the CRS that two echoes of a pulse may differ in plan beside what the beam's angle explains."""
BEAM_TAN = 1.0
"""Tangent of the widest scan angle: 45 deg."""
SHARE_OF_ROWS = 0.99
"""Rows that must look like one pulse before a file is read as pulses."""

BYTE_ORDER_MARK = b"\xef\xbb\xbf"


class AsciiFile:
    """A text file of points, read through once when opened: it has no header that could tell count and bounds.

    Parameters
    ----------
    ascii_columns : str, optional
        Names of the columns, parted by spaces, such as `x y z - classification` or `x1 y1 z1 i1 x2 y2 z2 i2`;
        None to find out.
    facts : FileFacts, optional
        Those of the same file, opened before: then it is not read through again.

    Raises
    ------
    UnreadableInputError
        If there are no rows of numbers, a row differs from the others, or a header is not understood.
    InconsistentInputError
        If a coordinate is NaN or infinite.
    SettingsError
        If the columns do not fit the rows.
    """

    def __init__(self, path: Readable, ascii_columns: str | None = None, facts: FileFacts | None = None) -> None:
        self._path = path
        self._width = 0
        self._separator: str | None = None
        self._promised: int | None = None
        self._header_lines, header, sample = self._look(path)
        self._columns = self._choose(ascii_columns, header, sample)
        self._is_pairs = "x2" in self._columns
        self.facts = self._measure() if facts is None else facts

    def records(self, chunk_size: int, window: Window | None) -> Iterator[PointRecords]:
        """The records in file order; of a row with two echoes the first before the last."""
        del window
        rows_wanted = max(1, chunk_size // 2 if self._is_pairs else chunk_size)
        for first_line, rows in self._tables(rows_wanted):
            bad = ~np.isfinite(rows[:, list(self._columns.values())]).all(axis=1)
            if bad.any():
                at = int(np.argmax(bad))
                raise InconsistentInputError(
                    str(self._path),
                    f"row {at + 1} of those after line {first_line} holds {rows[at].tolist()}",
                    "Remove rows whose values are NaN or infinite",
                )
            for begin in range(0, len(rows), rows_wanted):
                piece = rows[begin : begin + rows_wanted]
                yield self._pulses(piece) if self._is_pairs else self._points(piece)

    def _tables(self, rows_wanted: int) -> Iterator[tuple[int, FloatArray]]:
        """Tables of about so many rows, each with the number of the line before it."""
        with self._path.open("rb") as stream:
            for _ in range(self._header_lines):
                stream.readline(LINE_LIMIT)
            line_number = self._header_lines
            while lines := _some_lines(stream, rows_wanted * BYTES_A_ROW):
                moved()
                rows = self._parse(lines, line_number)
                if len(rows):
                    yield line_number, rows
                line_number += len(lines)

    def _parse(self, lines: list[bytes], line_number: int) -> FloatArray:
        """The numbers of some lines."""
        if max(map(len, lines)) > LINE_LIMIT:
            raise UnreadableInputError(
                str(self._path),
                f"a line after line {line_number} has more than {LINE_LIMIT} bytes",
                "Give one point a line",
            )
        try:
            return _to_table(lines, self._width, self._separator)
        except ValueError:
            for number, line in enumerate(lines, start=line_number + 1):
                self._check_line(number, line)
            raise

    def _check_line(self, number: int, line: bytes) -> None:
        """Name the line that cannot be parsed."""
        try:
            _to_table([line], self._width, self._separator)
        except ValueError as fault:
            problem = f"line {number} is {line[:60].decode(errors='replace').strip()!r}, not {self._width} numbers"
            raise UnreadableInputError(str(self._path), problem, "Remove or repair the line") from fault

    def _look(self, path: Readable) -> tuple[int, list[bytes], FloatArray]:
        """The number of lines above the rows, those of them that are not blank, and the first rows."""
        header: list[bytes] = []
        with path.open("rb") as stream:
            for skipped in range(HEADER_LINES):
                line = stream.readline(LINE_LIMIT).removeprefix(BYTE_ORDER_MARK)
                fields = line.translate(SEPARATORS).split()
                if len(fields) >= 3 and not COMMENT.match(line) and _is_numbers(fields[:3]):
                    self._separator = self._separator_of(line)
                    self._width = len(fields)
                    sample = self._parse([line, *_some_lines(stream, SAMPLE_ROWS * BYTES_A_ROW)], skipped)
                    return skipped, header, sample
                if fields:
                    header.append(line)
                    lonely = path.suffix.lower() == ".pts" and len(fields) == 1 and fields[0].isdigit()
                    self._promised = int(fields[0]) if lonely else None
        raise UnreadableInputError(
            str(path), f"no row of at least three numbers in the first {HEADER_LINES} lines", "Give rows of x y z"
        )

    def _separator_of(self, line: bytes) -> str | None:
        """What parts the columns of a row; None for white space."""
        body = line.strip()
        if b";" in body and b"," not in body:
            return ";"
        if b"," in body and b";" not in body and b" " not in re.sub(rb"\s*,\s*", b",", body):
            return ","
        if b"," in body:
            raise UnreadableInputError(
                str(self._path),
                f"the row {body[:60].decode(errors='replace')!r} mixes commas with other separators",
                "Write decimals with points, and one separator: white space, comma or semicolon",
            )
        return None

    def _choose(self, wanted: str | None, header: list[bytes], sample: FloatArray) -> dict[str, int]:
        """Column by field: as set, else as the header names them, else x y z, else a row of two echoes."""
        if wanted is not None:
            columns = columns_of(wanted.lower().replace(",", " ").split())
            count = len(wanted.replace(",", " ").split())
            if not is_complete(columns) or count != self._width:
                raise SettingsError(
                    [f"ascii_columns is {wanted!r}: name x y z (or x1 y1 z1 x2 y2 z2) among the {self._width} columns"]
                )
            return columns
        named = header_columns(str(self._path), header, self._separator, self._width)
        if named is not None:
            return named
        half = self._width // 2
        if self._width in {6, 8} and looks_like_pulses(sample[:, :3], sample[:, half : half + 3]):
            return {"x": 0, "y": 1, "z": 2, "x2": half, "y2": half + 1, "z2": half + 2}
        return {"x": 0, "y": 1, "z": 2}

    def _points(self, rows: FloatArray) -> PointRecords:
        """One point a row."""
        at = self._columns

        def small(name: str, dtype: type[np.integer[Any]] = np.uint8) -> npt.NDArray[Any] | None:
            return whole(rows[:, at[name]], dtype) if name in at else None

        return PointRecords(
            xyz=np.ascontiguousarray(rows[:, [at["x"], at["y"], at["z"]]]),
            return_number=small("return_number"),
            return_count=small("return_count"),
            classification=small("classification"),
            gps_time=np.ascontiguousarray(rows[:, at["gps_time"]]) if "gps_time" in at else None,
            source_id=small("source_id", np.uint16),
        )

    def _pulses(self, rows: FloatArray) -> PointRecords:
        """Two returns a row; one where both echoes are the very same point, recorded twice."""
        at = self._columns
        first = rows[:, [at["x"], at["y"], at["z"]]]
        last = rows[:, [at["x2"], at["y2"], at["z2"]]]
        single = (first == last).all(axis=1)
        keep = np.column_stack((np.ones(len(rows), dtype=np.bool_), ~single)).ravel()
        number = np.tile(np.array([1, 2], dtype=np.uint8), len(rows))
        count = np.repeat(np.where(single, 1, 2).astype(np.uint8), 2)
        xyz = np.stack((first, last), axis=1).reshape(-1, 3)
        return PointRecords(xyz=xyz[keep], return_number=number[keep], return_count=count[keep])

    def _measure(self) -> FileFacts:
        """What a pass over the file finds."""
        at, pulses = self._columns, "rows hold the first and last echo of a pulse, read as two returns"
        facts = measured(
            "ascii",
            self.records(100_000, None),
            dimensions=tuple((name, "f8") for name in sorted(at, key=at.__getitem__) if name not in {"x2", "y2", "z2"}),
            warnings=(pulses,) if self._is_pairs else (),
        )
        if facts is None:
            raise EmptyInputError(str(self._path), "the file holds no rows of points", "Give a file with points")
        if self._promised not in {None, facts.point_count}:
            raise InconsistentInputError(
                str(self._path),
                f"the first line promises {self._promised} points, there are {facts.point_count}",
                "Get the file again",
            )
        return facts


def looks_like_pulses(first: FloatArray, last: FloatArray) -> bool:
    """Whether pairs of points can be echoes of one pulse each; `first` and `last` (n, 3) are the triplets of each row.

    A beam is a straight line not far from the vertical: its echoes differ in plan by no more than their difference in
    elevation allows, and the first is the higher one. Colours, normals or times beside a point do not do this, unless
    the whole cloud is as small as they are, hence the extent. Some pulses must have two different echoes.
    """
    drop = first[:, 2] - last[:, 2]
    apart = np.hypot(first[:, 0] - last[:, 0], first[:, 1] - last[:, 1])
    near = apart <= BEAM_SLACK + BEAM_TAN * np.abs(drop)
    if near.mean() < SHARE_OF_ROWS or (drop >= -BEAM_SLACK).mean() < SHARE_OF_ROWS or not (drop != 0.0).any():
        return False
    extent = np.ptp(first[:, :2], axis=0)
    return bool(extent.max() > 10.0 * (BEAM_SLACK + float(np.median(apart))))


def _some_lines(stream: io.BufferedReader, size: int) -> list[bytes]:
    """The lines of a block of about so many bytes, whole; empty at the end. A file without line ends stays bounded."""
    block = stream.read(min(max(size, 4096), BLOCK_LIMIT))
    return (block + stream.readline(LINE_LIMIT)).splitlines()


def _to_table(lines: list[bytes], width: int, separator: str | None) -> FloatArray:
    """(n, width) numbers of lines; comments and blank lines give none."""
    text = b"\n".join(lines)
    if b"#" in text or b"/" in text or b"%" in text or separator is not None:
        lines = [line for line in lines if not COMMENT.match(line) and not line.isspace()]
    if not b"".join(lines).strip():
        return np.empty((0, width))
    table: FloatArray = np.loadtxt(lines, dtype=np.float64, ndmin=2, comments=None, delimiter=separator)
    if table.shape[1] != width:
        raise ValueError(f"{table.shape[1]} columns, not {width}")
    return table


def _is_numbers(fields: list[bytes]) -> bool:
    try:
        _ = [float(field) for field in fields]
    except ValueError:
        return False
    return True
