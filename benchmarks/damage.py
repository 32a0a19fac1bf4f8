"""Damage to files, drawn from a seed: the same call gives the same bytes.

Binary files lose, gain, repeat and swap blocks, have bits flipped, runs overwritten and extreme numbers written at any
place. LAS, LAZ and COPC also get them in their header fields, in their variable length records and in the table of
compressed chunks. Text gets huge and odd numbers, other types, deep nesting, and bytes that are not UTF-8.
"""

from __future__ import annotations

import contextlib
import io
import json
import random
import re
import sqlite3
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

Damage = Callable[[random.Random, bytes], bytes]

HEAD_BYTES = 700
"""The bytes at the start that half of all damage hits: a header is small, and most faults are in it."""
DEEP = 100_000
DIGITS = 5_000

FLOATS = (float("nan"), float("inf"), float("-inf"), 0.0, -0.0, 1e-320, 1e300, -1e300, 1e9, -1.0, 1e17)
WHOLE = (0, 1, 2, 7, 127, 128, 255, 256, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**53, 2**63 - 1, 2**64 - 1)
FORMATS = ("<B", "<H", "<I", "<Q", ">I", ">Q")

LAS_FIELDS = (
    *((6, "<H"), (24, "<B"), (25, "<B"), (94, "<H"), (96, "<I"), (100, "<I"), (104, "<B"), (105, "<H"), (107, "<I")),
    *((at, "<I") for at in range(111, 131, 4)),
    *((at, "<d") for at in range(131, 227, 8)),
    *((227, "<Q"), (235, "<Q"), (243, "<I"), (247, "<Q")),
)
"""Byte and format of the fields of a LAS header that say where things are, how many and how large."""
ODD_NUMBERS = (
    *("1e400", "-1e400", "nan", "inf", "-inf", "-0", "1e308", "-1", "0", "4294967296", "9223372036854775808"),
    *("0x10", "1_000", "1e-400", "", "abc", "9" * DIGITS, "0." + "3" * DIGITS, "1e9999999999"),
)
WKT_RECORD = 2112
ODD_CRS = (
    'GEOGCS["x",DATUM["x",SPHEROID["x",6378137,298.257223563]],PRIMEM["Greenwich",0],UNIT["degree",1]]',
    'GEOCCS["x",DATUM["x",SPHEROID["x",6378137,298]],PRIMEM["Greenwich",0],UNIT["m",1]]',
    'VERT_CS["x",VERT_DATUM["x",2005],UNIT["m",1]]',
    'LOCAL_CS["x",UNIT["m",0]]',
    'LOCAL_CS["x",UNIT["m",-1]]',
    'LOCAL_CS["x",UNIT["m",1e308]]',
    'ENGCRS["x",EDATUM["x"],CS[Cartesian,1],AXIS["x",east],LENGTHUNIT["metre",1]]',
    'ENGCRS["x",EDATUM["x"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1e-300]]',
    'TIMECRS["x",TDATUM["x"],CS[temporal,1],AXIS["x",future],TIMEUNIT["day",86400]]',
    'COMPD_CS["x",LOCAL_CS["x",UNIT["m",1]],VERT_CS["x",VERT_DATUM["x",2005],UNIT["m",0.001]]]',
    "EPSG:25832",
    "+proj=utm +zone=32",
    "[",
)
"""Systems in which points cannot lie, or hardly can, and text that is not WKT."""
ODD_BYTES = (
    b"\xff\xfe",
    b"\xe9",
    b"\xc3",
    b"\x00",
    b"\x1b[2J",
    b"\xed\xa0\x80",
    b"\xf4\x90\x80\x80",
    b"\xef\xbb\xbf",
    b"\r",
)
ODD_VALUES: tuple[Any, ...] = (
    *(None, True, 0, -1, 1e308, 2**64, 10**30, "", "x", "\0", "x" * 70_000, [], {}, [[]], [None], {"": None}),
    *([1, 2, 3, 4, 5], [[1e308, -1e308]], {"type": "Point"}, "Polygon", "GeometryCollection", "2026-02-30"),
)


ODD_TOKENS = (
    *(
        "true",
        "-1",
        "1e308",
        "nan",
        "inf",
        "2026-01-01",
        '""',
        '"\\u0000"',
        "[]",
        "{}",
        "[[[]]]",
        '"' + "x" * 70_000 + '"',
    ),
    *("9" * DIGITS, "[1, 'a', {}]", "07:32:00", "'''\n'''", '"../../../x"', '"C:\\\\x"', "{ file = 1, id = [] }"),
)
"""Values of TOML of other types."""


def _place(draw: random.Random, length: int) -> int:
    """A place in a file, half of the time near its start."""
    return draw.randrange(min(length, HEAD_BYTES) if draw.random() < 0.5 else length)


def _size(draw: random.Random, most: int) -> int:
    """A size from 1 on, small ones as likely as large ones."""
    return max(1, min(most, int(2 ** draw.uniform(0.0, max(most, 2).bit_length()))))


def flipped_bits(draw: random.Random, data: bytes) -> bytes:
    """A few bits turned."""
    made = bytearray(data)
    for _ in range(_size(draw, 64)):
        made[_place(draw, len(made))] ^= 1 << draw.randrange(8)
    return bytes(made)


def other_bytes(draw: random.Random, data: bytes) -> bytes:
    """A few bytes replaced by random ones."""
    made = bytearray(data)
    for _ in range(_size(draw, 64)):
        made[_place(draw, len(made))] = draw.randrange(256)
    return bytes(made)


def overwritten_run(draw: random.Random, data: bytes) -> bytes:
    """A run of bytes that are random, 0 or 255."""
    at, size = _place(draw, len(data)), _size(draw, len(data) // 2)
    run = draw.choice((draw.randbytes(size), bytes(size), b"\xff" * size))[: len(data) - at]
    return data[:at] + run + data[at + len(run) :]


def truncated(draw: random.Random, data: bytes) -> bytes:
    """The end missing, down to an empty file."""
    return data[: draw.choice((draw.randrange(len(data)), _place(draw, len(data)), len(data) - _size(draw, len(data))))]


def inserted_block(draw: random.Random, data: bytes) -> bytes:
    """Bytes too many: random ones, or a block of the file once more."""
    at, size = _place(draw, len(data)), _size(draw, len(data) // 2)
    source = _place(draw, len(data))
    return data[:at] + draw.choice((draw.randbytes(size), data[source : source + size])) + data[at:]


def removed_block(draw: random.Random, data: bytes) -> bytes:
    """A block missing."""
    at = _place(draw, len(data))
    return data[:at] + data[at + _size(draw, len(data) // 2) :]


def swapped_blocks(draw: random.Random, data: bytes) -> bytes:
    """Two blocks of one size in each other's place."""
    size = _size(draw, max(1, len(data) // 4))
    one, other = sorted((_place(draw, len(data)), _place(draw, len(data))))
    other = max(other, one + size)
    first, second = data[one : one + size], data[other : other + size]
    return data[:one] + second + data[one + size : other] + first + data[other + size :]


def extreme_number(draw: random.Random, data: bytes) -> bytes:
    """An extreme whole or floating point number at any place."""
    made = bytearray(data)
    for _ in range(_size(draw, 4)):
        _write(draw, made, _place(draw, len(data)), draw.choice((*FORMATS, "<d", "<f", ">d")))
    return bytes(made)


def las_field(draw: random.Random, data: bytes) -> bytes:
    """Extreme numbers in one or two fields of a LAS header."""
    made = bytearray(data)
    for _ in range(draw.choice((1, 1, 2))):
        _write(draw, made, *draw.choice(LAS_FIELDS))
    return bytes(made)


def las_record(draw: random.Random, data: bytes) -> bytes:
    """An extreme length or id, or other content, in a variable length record of LAS, or at the chunk table of LAZ."""
    made = bytearray(data)
    header_size, points_at, count = struct.unpack_from("<HII", data, 94)
    places, at = [(points_at, "<Q"), (points_at + 8, "<I")], header_size
    table_at = struct.unpack_from("<q", data, points_at)[0]
    if points_at < table_at < len(data) - 12:
        places += [(table_at + 4, "<I")] * 4 + [(k, "<B") for k in range(table_at, len(data))]
    for _ in range(count):
        size = struct.unpack_from("<H", data, at + 20)[0]
        places += [(at + 18, "<H"), (at + 20, "<H")] * 8
        places += [(k, draw.choice(("<B", "<H", "<I", "<d"))) for k in range(at + 54, at + 54 + size)]
        at += 54 + size
    for _ in range(draw.choice((1, 1, 2, 8))):
        _write(draw, made, *draw.choice(places))
    return bytes(made)


def las_crs(draw: random.Random, data: bytes) -> bytes:
    """Another CRS in the WKT of a LAS header, or odd numbers and bytes in it; of the same length."""
    at = data.find(b"LASF_Projection") - 2
    if at < 0:
        return las_record(draw, data)
    size = struct.unpack_from("<H", data, at + 20)[0]
    text = data[at + 54 : at + 54 + size].rstrip(b"\0")
    if struct.unpack_from("<H", data, at + 18)[0] != WKT_RECORD:
        made = las_record(draw, data)
    else:
        change = draw.choice((odd_number, odd_number, odd_text, deep_nesting, removed_block, None))
        other = draw.choice(ODD_CRS).encode() if change is None else change(draw, text)
        made = data[: at + 54] + other[:size].ljust(size, b"\0") + data[at + 54 + size :]
    return made


def _write(draw: random.Random, made: bytearray, at: int, form: str) -> None:
    """Write an extreme number, or one beside the number that is there, if the file has room."""
    size = struct.calcsize(form)
    if at + size > len(made):
        return
    if form[1] in "df":
        value: float = draw.choice(FLOATS)
        if form[1] == "f" and abs(value) > 1e38 and value == value and abs(value) != float("inf"):
            value = 3e38
        struct.pack_into(form, made, at, value)
        return
    here = struct.unpack_from(form, made, at)[0]
    whole = draw.choice((draw.choice(WHOLE), here + draw.choice((-1, 1, 1000)), here * 2, draw.getrandbits(8 * size)))
    struct.pack_into(form, made, at, whole % 2 ** (8 * size))


def odd_number(draw: random.Random, data: bytes) -> bytes:
    """Numbers of a text replaced."""
    places = [found.span() for found in re.finditer(rb"-?\d+(\.\d+)?", data)]
    if not places:
        return flipped_bits(draw, data)
    for first, end in sorted(draw.sample(places, min(len(places), draw.choice((1, 1, 1, 3)))), reverse=True):
        data = data[:first] + draw.choice(ODD_NUMBERS).encode() + data[end:]
    return data


def odd_text(draw: random.Random, data: bytes) -> bytes:
    """Bytes that are not UTF-8, or control characters, within words or anywhere."""
    words = [found.start() + 1 for found in re.finditer(rb"[A-Za-z]{2,}", data)]
    at = draw.choice(words) if words and draw.random() < 0.7 else _place(draw, len(data))
    return data[:at] + draw.choice(ODD_BYTES) + data[at + draw.randrange(2) :]


def moved_lines(draw: random.Random, data: bytes) -> bytes:
    """Lines missing, doubled or in another order."""
    lines = data.splitlines(keepends=True)
    at, size = draw.randrange(len(lines)), _size(draw, max(1, len(lines) // 2))
    some = lines[at : at + size]
    if draw.random() < 0.3:
        draw.shuffle(lines)
        return b"".join(lines)
    return b"".join([*lines[:at], *(some * draw.choice((0, 2, 3))), *lines[at + size :]])


def deep_nesting(draw: random.Random, data: bytes) -> bytes:
    """Brackets without end in the place of a value, or anywhere."""
    places = [found.span() for found in re.finditer(rb"-?\d+(\.\d+)?|\"[^\"]*\"", data)]
    first, end = draw.choice(places) if places else (len(data) // 2,) * 2
    depth = draw.choice((60, 1_000, DEEP))
    opening, closing = draw.choice(((b"[", b"]"), (b'{"a":', b"}"), (b"{a=", b"}"), (b"(", b")")))
    inside = draw.choice((b"", b"1")) if opening != b'{"a":' else b"1"
    return data[:first] + opening * depth + inside + closing * draw.choice((depth, 0)) + data[end:]


def odd_value(draw: random.Random, data: bytes) -> bytes:
    """JSON with values of other types, keys missing or under another name."""
    document = json.loads(data)
    for _ in range(draw.choice((1, 1, 2))):
        places: list[tuple[Any, Any]] = []
        stack = [document]
        while stack:
            node = stack.pop()
            keys = list(node) if isinstance(node, dict) else list(range(len(node)))
            places += [(node, key) for key in keys]
            stack += [node[key] for key in keys if isinstance(node[key], dict | list)]
        node, key = draw.choice(places)
        if draw.random() < 0.2:
            del node[key]
        elif isinstance(node, dict) and draw.random() < 0.2:
            node[draw.choice(("", "type", "Coordinates", "x" * 300))] = node.pop(key)
        else:
            node[key] = draw.choice(ODD_VALUES)
        if not document:
            break
    return json.dumps(document).encode()


def odd_token(draw: random.Random, data: bytes) -> bytes:
    """TOML with a value of another type, or a key under another name."""
    places = [found.span(1) for found in re.finditer(rb"= *([^\n]+)\n", data)]
    values: tuple[str, ...] = ODD_TOKENS
    if draw.random() < 0.3:
        places, values = (
            [found.span() for found in re.finditer(rb"[a-z_]+(?= *=)", data)],
            ("x", "path", "''", "a.b.c", "settings"),
        )
    first, end = draw.choice(places)
    return data[:first] + draw.choice(values).encode() + data[end:]


def odd_cell(draw: random.Random, data: bytes) -> bytes:
    """A GeoPackage that SQLite can read, with another value in one cell of any table, or a column or table missing."""
    with contextlib.closing(sqlite3.connect(":memory:")) as base:
        base.deserialize(data)
        base.text_factory = bytes
        for (name,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
            base.execute(f'DROP TRIGGER "{name.decode()}"')
        query = (
            "SELECT name FROM sqlite_master WHERE type = 'table' AND name NOT LIKE 'sqlite%' AND name NOT LIKE 'rtree%'"
        )
        tables = [name.decode() for (name,) in base.execute(query).fetchall()]
        table = draw.choice([*tables, *tables[-3:] * 3])
        columns = [row[1].decode() for row in base.execute(f'PRAGMA table_info("{table}")').fetchall()]
        column = draw.choice(columns)
        if draw.random() < 0.1:
            base.execute(
                draw.choice((f'DROP TABLE "{table}"', f'ALTER TABLE "{table}" RENAME COLUMN "{column}" TO "other"'))
            )
        else:
            rows = base.execute(f'SELECT rowid, "{column}" FROM "{table}"').fetchall()
            if not rows:
                return flipped_bits(draw, data)
            row, value = draw.choice(rows)
            odd: list[Any] = [None, -1, 2**62, 1e308, "", "x" * 70_000, b"\0", "0", float("inf")]
            if isinstance(value, bytes) and value:
                odd += [draw.choice((flipped_bits, extreme_number, truncated, odd_text))(draw, value) for _ in odd]
            update = (
                f'UPDATE OR IGNORE "{table}" SET "{column}" = {draw.choice(("?", "CAST(? AS TEXT)"))} WHERE rowid = ?'
            )
            with contextlib.suppress(sqlite3.IntegrityError):
                base.execute(update, (draw.choice(odd), row))
        base.commit()
        return base.serialize()


def odd_table(draw: random.Random, data: bytes) -> bytes:
    """GeoParquet that pyarrow can read, with other values in its metadata on geometry, or in a column."""
    table = pq.read_table(io.BytesIO(data))
    if draw.random() < 0.6:
        geo = odd_value(draw, table.schema.metadata[b"geo"])
        table = table.replace_schema_metadata({"geo": draw.choice((geo, geo, geo, odd_text(draw, geo)))})
    else:
        at = draw.randrange(table.num_columns)
        values = table.column(at).to_pylist()
        row = draw.randrange(len(values))
        values[row] = None
        column: Any = pa.array(values)
        if at == table.num_columns - 1 and draw.random() < 0.8:
            whole = table.column(at).to_pylist()
            whole[row] = draw.choice((flipped_bits, extreme_number, truncated))(draw, whole[row])
            column = pa.array(whole, pa.binary())
        elif draw.random() < 0.5:
            column = draw.choice(
                (pa.array([1.5, float("nan")]), pa.array([[1], []]), pa.nulls(2), pa.array([{"a": 1}, None]))
            )
        table = table.set_column(at, table.column_names[at], column)
    made = io.BytesIO()
    pq.write_table(table, made)
    return made.getvalue()


BINARY: tuple[Damage, ...] = (
    *(flipped_bits, other_bytes, overwritten_run, truncated, inserted_block, removed_block, swapped_blocks),
    extreme_number,
)
LAS: tuple[Damage, ...] = (*BINARY, *[las_field] * 3, *[las_record] * 3, *[las_crs] * 2)
TEXT: tuple[Damage, ...] = (*BINARY, *[odd_number, odd_text] * 3, *[moved_lines, deep_nesting] * 2)
JSON: tuple[Damage, ...] = (*TEXT, *[odd_value] * 8)
TOML: tuple[Damage, ...] = (*TEXT, *[odd_token] * 10)
GEOPACKAGE: tuple[Damage, ...] = (*BINARY, *[odd_cell] * 8)
PARQUET: tuple[Damage, ...] = (*BINARY, *[odd_table] * 8)
BY_SUFFIX = {
    ".las": LAS,
    ".laz": LAS,
    ".ply": TEXT,
    ".geojson": JSON,
    ".toml": TOML,
    ".gpkg": GEOPACKAGE,
    ".parquet": PARQUET,
}
"""The kinds of damage of some formats; all others are binary."""


def damaged(name: str, data: bytes, seed: str) -> tuple[str, bytes]:
    """A damaged copy of a file that differs from it, and the name of the damage; some have two kinds of damage."""
    draw = random.Random(seed)
    kinds = BY_SUFFIX.get(Path(name).suffix, BINARY)
    while True:
        some = [draw.choice(kinds)]
        made = some[0](draw, data)
        if made and draw.random() < 0.15:
            some.append(draw.choice(BINARY))
            made = some[-1](draw, made)
        if made != data:
            return " and ".join(one.__name__ for one in some), made
