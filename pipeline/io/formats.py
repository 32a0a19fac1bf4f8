"""Which format a file has, by what it begins with and by its name."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from pipeline.errors import EmptyInputError, UnreadableInputError
from pipeline.io.file_facts import Readable
from pipeline.io.locations import is_url


@dataclasses.dataclass(frozen=True, kw_only=True)
class PointFormat:
    """A format of point clouds."""

    name: str
    words: str
    """Its name and its endings, for messages."""
    media_types: Mapping[str, str]
    """Media types of files by their endings, the usual one first; empty for an ending that has none of its own."""
    encodings: Mapping[str, tuple[str, str]]
    """The names that facts of files have for its variants, with their encoding and media type in STAC."""
    reader: str
    """The class that opens a file, "module:class": of a path, facts of the file from before, and `takes`."""
    takes: tuple[str, ...] = ()
    """Fields of `ReadOptions` that the reader takes."""
    count: str = ""
    """Function that reads the number of points from the header, "module:function"; empty without a header."""
    has_bounds: bool = False
    """Whether the header has bounds, so that a file is not read through for them."""
    has_parts: bool = False
    """Whether a part of a file can be read alone."""
    magic: tuple[bytes, ...] = ()
    """First bytes; a format without them is known by its content."""

    @property
    def suffixes(self) -> tuple[str, ...]:
        """Endings of its files."""
        return tuple(self.media_types)


FORMATS = (
    PointFormat(
        name="las",
        words="LAS and LAZ (.las, .laz, .copc.laz)",
        media_types={".las": "application/vnd.las", ".laz": "application/vnd.laszip"},
        encodings={
            "las": ("LAS", "application/vnd.las"),
            "laz": ("LASzip", "application/vnd.laszip"),
            "copc": ("COPC", "application/vnd.laszip+copc"),
        },
        reader="pipeline.io.las:LasFile",
        count="pipeline.io.las_header:promised_points",
        has_bounds=True,
        has_parts=True,
        magic=(b"LASF",),
    ),
    PointFormat(
        name="ply",
        words="PLY (.ply)",
        media_types={".ply": "application/ply"},
        encodings={"ply": ("PLY", "application/octet-stream")},
        reader="pipeline.extras.ply_ascii.ply:PlyFile",
        count="pipeline.extras.ply_ascii.ply:promised_vertices",
        magic=(b"ply\n", b"ply\r"),
    ),
    PointFormat(
        name="ascii",
        words="ASCII x y z (.xyz, .txt, .csv, .asc, .pts)",
        media_types={".xyz": "text/plain", ".txt": "", ".csv": "text/csv", ".asc": "", ".pts": ""},
        encodings={"ascii": ("text", "text/plain")},
        reader="pipeline.extras.ply_ascii.ascii:AsciiFile",
        takes=("ascii_columns",),
    ),
)
"""All formats of points, those with first bytes of their own first."""
LAS, ASCII = FORMATS[0], FORMATS[-1]
ENCODINGS: Mapping[str, tuple[str, str]] = {name: words for form in FORMATS for name, words in form.encodings.items()}
"""The encoding and the media type of each `FileFacts.format` in STAC."""
DIVISIBLE = frozenset(name for form in FORMATS if form.has_parts for name in form.encodings)
"""Those of files of which a part can be read alone."""
FOREIGN_MAGIC = {
    b"PK\x03\x04": "a zip archive: unpack it first",
    b"\x1f\x8b": "a gzip file: unpack it first",
    b"7z\xbc\xaf": "a 7z archive: unpack it first",
    b"ASTM-E57": "an E57 file: convert it to LAZ first",
    b"II*\0": "a TIFF raster, not points",
    b"MM\0*": "a TIFF raster, not points",
    b"\x89HDF": "an HDF5 file, not points",
    b"SQLi": "a GeoPackage or SQLite file: give it as footprints",
    b"%PDF": "a PDF file",
    b"ncols": "an ESRI ASCII raster, not points",
    b"NCOLS": "an ESRI ASCII raster, not points",
}
"""What is often mistaken for points, and what to do with it."""
POINT_SUFFIXES = tuple(suffix for form in FORMATS for suffix in form.suffixes)
GEOJSON_SUFFIXES = (".geojson", ".json")
"""Endings of GeoJSON."""
LINES_SUFFIXES = (".geojsonl", ".geojsons", ".ndjson")
"""Endings of GeoJSON with one feature per line."""
PARQUET_SUFFIXES = (".parquet", ".geoparquet")
"""Endings of GeoParquet."""
XML_SUFFIXES = (".gml", ".kml")
"""Endings of GML and KML."""
ARCHIVE_SUFFIXES = (".zip", ".kmz")
"""Endings of zip archives of vector files."""
VECTOR_FILE_SUFFIXES = (".gpkg", ".shp", *GEOJSON_SUFFIXES, *LINES_SUFFIXES, *PARQUET_SUFFIXES, ".fgb", *XML_SUFFIXES)
"""Endings of vector files that are not archives."""
VECTOR_SUFFIXES = (*VECTOR_FILE_SUFFIXES, *ARCHIVE_SUFFIXES)
"""Endings of all vector files that are read, as footprints, guides, areas and tile indexes; none ends a point file."""
UNREAD_VECTORS = {
    ".sqlite": "SQLite that is not a GeoPackage",
    ".tab": "MapInfo TAB",
    ".mif": "MapInfo MIF",
    ".gdb": "a File Geodatabase",
    ".gdbtable": "a File Geodatabase",
    ".dxf": "DXF",
}
"""Vector formats that are not read, by ending."""
CONVERT = "Convert it to GeoPackage (.gpkg)"
"""The fix for a vector format that is not read."""
VALID = f"Valid are {', '.join(form.words for form in FORMATS[:-1])} and {FORMATS[-1].words}"
TEXT_SUFFIXES = (".txt", ".csv", ".lst", ".list")
"""Endings of text files that may be indexes; what they begin with decides."""
SNIFF_BYTES = 4096
_FIRST_LINES = 1 << 12


def first_bytes(path: Readable) -> bytes:
    """The first bytes of a file.

    Raises
    ------
    UnreadableInputError
        If the file is not there, is a folder, or may not be read.
    EmptyInputError
        If it has no bytes.
    """
    try:
        if isinstance(path, Path) and (path.is_fifo() or path.is_char_device() or path.is_socket()):
            raise UnreadableInputError(str(path), "a pipe or a device, not a file", "Write it to a file first")
        with path.open("rb") as stream:
            head = stream.read(SNIFF_BYTES)
    except FileNotFoundError:
        raise UnreadableInputError(str(path), "no such file", "Check the path") from None
    except IsADirectoryError:
        fix = CONVERT if path.suffix.lower() == ".gdb" else "Give the files in it"
        raise UnreadableInputError(str(path), "a folder, not a file", fix) from None
    except OSError as fault:
        raise UnreadableInputError(
            str(path), f"cannot be read ({fault.strerror or fault})", "Check the file's permissions and the disk"
        ) from fault
    if not head:
        raise EmptyInputError(str(path), "the file has 0 bytes", "Get the file again")
    return head


def recognise_format(path: Readable) -> PointFormat:
    """The format of a file; raises UnreadableInputError if it is none of `FORMATS`, or not what its name says."""
    head, suffix = first_bytes(path), path.suffix.lower()
    for form in FORMATS:
        if head.startswith(form.magic):
            return form
    for magic, what in FOREIGN_MAGIC.items():
        if head.startswith(magic):
            raise UnreadableInputError(str(path), f"this is {what}", VALID)
    for form in FORMATS:
        if form.magic and suffix in form.suffixes:
            what = f"not a {form.name.upper()} file: it begins with {head[:4]!r}, not {form.magic[0].strip()!r}"
            raise UnreadableInputError(str(path), what, f"Get the file again. {VALID}")
    if b"\0" not in head and (suffix in ASCII.suffixes or looks_like_points(head)):
        return ASCII
    raise UnreadableInputError(str(path), f"format not known: it begins with {head[:8]!r}", VALID)


def looks_like_points(head: bytes) -> bool:
    r"""Whether text begins with rows of at least three numbers, after at most a few lines of header.

    >>> looks_like_points(b"x,y,z\n1.0,2.0,3.0\n4,5,6\n")
    True
    >>> looks_like_points(b"Read me first\nThe data are ...\n")
    False
    """
    for line in head.split(b"\n")[:20]:
        fields = line.replace(b",", b" ").replace(b";", b" ").split()
        if len(fields) >= 3 and all(_is_number(field) for field in fields[:3]):
            return True
    return False


def _is_number(field: bytes) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def names_points(text: str) -> bool:
    """Whether a text is a URL, or the name of a point file by its ending.

    >>> names_points("tiles/a.LAZ"), names_points("https://host/get?tile=7"), names_points("1.0 2.0 3.0")
    (True, True, False)
    """
    return is_url(text) or text.partition("?")[0].strip().lower().endswith(POINT_SUFFIXES)


def is_index(file: Readable) -> bool:
    """Whether a file is a tile index: by its ending, and where text may be points, by what it begins with."""
    suffix = file.suffix.lower()
    if suffix in VECTOR_SUFFIXES:
        return True
    if suffix not in TEXT_SUFFIXES:
        return False
    try:
        with file.open("rb") as stream:
            head = stream.read(_FIRST_LINES)
    except OSError:  # reading it reports the fault
        return False
    line = next(iter(lines_of(head.decode("utf-8-sig", errors="replace"))), "")
    return names_points(line)


def lines_of(text: str) -> list[str]:
    """Lines that say something."""
    stripped = (line.strip() for line in text.splitlines())
    return [line for line in stripped if line and not line.startswith("#")]
