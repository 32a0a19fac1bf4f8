"""Classified files: every input read again and written as LAZ 1.4, its points unchanged except for their classes."""

from __future__ import annotations

import dataclasses
import math
import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from pipeline import __version__
from pipeline.errors import InconsistentInputError, UnreadableInputError
from pipeline.extras.classify.label import class_path
from pipeline.extras.classify.las_frame import LasFrame, read_frame
from pipeline.extras.classify.laz_writing import (
    KEEP,
    NEWER_FORMAT,
    WAVEFORM_FORMATS,
    LazWriter,
    classified,
    header_of,
    new_records,
    record_dtype,
    to_newer_format,
)
from pipeline.io import LocalStorage, ReadOptions, Source, SourceInfo, open_source
from pipeline.io.crs import SpatialReference
from pipeline.io.file_facts import PointRecords
from pipeline.io.formats import LAS
from pipeline.io.las import LasFile
from pipeline.io.las_header import WKT_RECORD_ID, ExtendedRecord
from pipeline.io.storage import BLOCK_BYTES
from pipeline.model import ByteArray, PointCloud
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.stages.ingest import to_records
from pipeline.tiling import Tile, TileGrid

CHUNK_POINTS = 500_000
PROJECTION = b"LASF_Projection"
GEOTIFF_RECORDS = (34735, 34736, 34737)
SOFTWARE = f"gablework {__version__}"
_FIX = "Leave the inputs alone until the command has ended"
_SCALE = 0.001
"""Units of the CRS in which points of files without integer coordinates are written."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClassifiedTask:
    """One input file."""

    parts: tuple[str, ...]
    """As ingest names its buckets in scratch."""
    path: str
    """The file."""
    used: int
    """Points that ingest took from it."""
    name: str
    """File name of the outcome."""
    out: str
    """Folder of the outcome."""
    options: ReadOptions
    """As ingest read it."""
    grid: TileGrid
    """The lattice."""
    scratch: Scratch
    """Where the classes are."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClassifiedFile:
    """A file that was written."""

    source: str
    """The input."""
    path: str
    """The LAZ file."""
    points: int
    """All of the input's."""
    classes: dict[int, int]
    """Points by class."""
    kept: int
    """Points that kept their own class: withheld ones and noise."""
    warnings: tuple[str, ...]
    """What could not be carried over."""


def output_name(path: str) -> str:
    """File name of the outcome of an input.

    >>> output_name("tiles/a.copc.laz"), output_name("b.xyz")
    ('a.laz', 'b.laz')
    """
    stem = Path(path).stem
    return f"{stem.removesuffix('.copc')}.laz"


def check_writable(info: SourceInfo) -> None:
    """Refuse a file that cannot be written anew without loss, before any work."""
    if info.format not in LAS.encodings:
        return
    frame = read_frame(Path(info.path))
    if frame.block.point_format in WAVEFORM_FORMATS:
        raise UnreadableInputError(
            info.path,
            f"point format {frame.block.point_format} carries waveforms, which classify does not write",
            "Convert it to a point format without waveforms first (1, 3, 6, 7 or 8)",
        )


class _Labels:
    """The classes of a file's points, tile by tile in the order of the file."""

    def __init__(self, task: ClassifiedTask) -> None:
        self._task = task
        self._done: Counter[Tile] = Counter()
        self._sizes: dict[Tile, dict[Path, int]] = {}

    def of(self, kept: npt.NDArray[np.bool_], cloud: PointCloud) -> ByteArray:
        """Classes of the next points of the file, `KEEP` for those that ingest left out."""
        labels = np.full(len(kept), KEEP, np.uint8)
        if len(cloud) == 0:
            return labels
        records = to_records(cloud)
        columns, rows = self._task.grid.columns_rows(records["x"], records["y"])
        places = np.column_stack((columns, rows))
        # points of one tile mostly come in runs
        order = np.lexsort((rows, columns))
        starts = np.flatnonzero(np.diff(places[order], axis=0, prepend=places[order[:1]] - 1).any(axis=1))
        given = np.empty(len(records), np.uint8)
        for start, stop in zip(starts.tolist(), [*starts[1:].tolist(), len(order)], strict=True):
            tile = Tile(*(int(v) for v in places[order[start]]))
            given[order[start:stop]] = self._next(tile, stop - start)
        labels[kept] = given
        return labels

    def _next(self, tile: Tile, count: int) -> ByteArray:
        """The next classes of a tile: its buckets of the file follow one another."""
        begin, missing, found = self._done[tile], count, []
        self._done[tile] += count
        for path, size in self._buckets(tile).items():
            if begin < size and missing:
                found.append(np.fromfile(path, np.uint8, missing, offset=begin))
                missing -= len(found[-1])
            begin = max(0, begin - size)
        if missing:
            raise InconsistentInputError(
                self._task.path,
                f"it has more points in tile {tile.key} than when it was first read",
                _FIX,
            )
        return np.concatenate(found)

    def _buckets(self, tile: Tile) -> dict[Path, int]:
        """The buckets of the file in a tile, with their numbers of points."""
        if tile not in self._sizes:
            paths = (class_path(self._task.scratch, tile, f"{part}.bin") for part in self._task.parts)
            self._sizes[tile] = {path: path.stat().st_size for path in paths if path.exists()}
        return self._sizes[tile]

    def check_all_given(self) -> None:
        """Refuse a file that ended early."""
        given = self._done.total()
        if given < self._task.used:
            raise InconsistentInputError(
                self._task.path, f"{given} of {self._task.used} points are left since it was first read", _FIX
            )


def write_classified(task: ClassifiedTask) -> ClassifiedFile:
    """Write one file; raises InputError if its input cannot be read any more."""
    task.scratch.check_cancelled()
    source = open_source(task.path, task.options)
    counts: Counter[int] = Counter()
    points = kept_own = 0
    storage = LocalStorage(root=Path(task.out))
    with storage.putting(task.name) as temporary, temporary.open("wb") as stream:
        plan = _las_plan(source) if isinstance(source.file, LasFile) else _plain_plan(source)
        writer = LazWriter(stream, plan.header, plan.records)
        labels = _Labels(task)
        for records, read in plan.pieces:
            task.scratch.check_cancelled()
            kept, cloud = source.select(read)
            found = labels.of(kept, cloud)
            written = classified(records, found)
            histogram = np.bincount(written["classification"])
            counts.update({int(code): int(histogram[code]) for code in np.flatnonzero(histogram)})
            points += len(written)
            kept_own += int((found == KEEP).sum())
            writer.write(written)
        labels.check_all_given()
        writer.close(_copied(Path(task.path), plan.extended))
    return ClassifiedFile(
        source=task.path,
        path=str(storage.path(task.name)),
        points=points,
        classes={code: counts[code] for code in sorted(counts)},
        kept=kept_own,
        warnings=plan.warnings,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Plan:
    """How one file is written."""

    header: bytes
    records: list[tuple[bytes, int, bytes, bytes]]
    extended: tuple[ExtendedRecord, ...]
    pieces: Iterator[tuple[npt.NDArray[np.void], PointRecords]]
    warnings: tuple[str, ...]


def _las_plan(source: Source) -> _Plan:
    """LAS and LAZ: header and records of the file itself, the CRS as WKT beside what is there."""
    file = source.file
    assert isinstance(file, LasFile)
    frame = read_frame(Path(source.info.path))
    block = frame.block
    point_format = NEWER_FORMAT[block.point_format]
    kept = [r for r in frame.records if r.user_id not in {b"copc", b"laszip encoded"}]
    extended = tuple(r for r in frame.extended if r.user_id != b"copc")
    present = {(r.user_id, r.record_id) for r in kept} | {(r.user_id, r.record_id) for r in extended}
    header_wkt = (PROJECTION, WKT_RECORD_ID) in present
    warnings: list[str] = []
    geotiff = {(PROJECTION, number) for number in GEOTIFF_RECORDS}
    if source.crs_given:
        # what the header says is not true
        wrong = {(PROJECTION, WKT_RECORD_ID), *geotiff}
        kept = [r for r in kept if (r.user_id, r.record_id) not in wrong]
        extended = tuple(r for r in extended if (r.user_id, r.record_id) not in wrong)
        header_wkt = False
    records = [(r.user_id, r.record_id, r.description, r.data) for r in kept]
    wkt = header_wkt
    if not header_wkt and source.info.reference.wkt is not None:
        records.append(wkt_record(source.info.reference))
        wkt = True
    elif not header_wkt and any(r.user_id == PROJECTION and r.record_id in GEOTIFF_RECORDS for r in kept):
        warnings.append(
            "its GeoTIFF keys are not understood, so they are kept and no WKT is written; give --crs EPSG:n"
        )
    size = np.dtype(record_dtype(block.point_format, block.point_size))["extra"].itemsize
    size += record_dtype(point_format, new_size(point_format)).itemsize
    header = header_of(
        point_format=point_format,
        size=size,
        scales=struct.unpack_from("<3d", frame.header, 131),
        offsets=struct.unpack_from("<3d", frame.header, 155),
        software=SOFTWARE,
        older=frame.header,
        wkt=wkt or not warnings,
    )
    return _Plan(
        header=header,
        records=records,
        extended=extended,
        pieces=_las_pieces(file, frame),
        warnings=tuple(warnings),
    )


def _las_pieces(file: LasFile, frame: LasFrame) -> Iterator[tuple[npt.NDArray[np.void], PointRecords]]:
    """All records in file order, in the newer format, and as readers have them."""
    for raw, read in file.whole_records(CHUNK_POINTS):
        yield to_newer_format(raw, frame.block.point_format, frame.block.point_size), read


def _plain_plan(source: Source) -> _Plan:
    """PLY and ASCII: format 6 with the columns that are read, coordinates in whole thousandths of the CRS's unit."""
    info = source.info
    units = (info.reference.horizontal_unit_m,) * 2 + (info.reference.vertical_unit_m,)
    low = [math.floor(info.bounds_m[k] / units[k]) for k in range(3)]
    high = [math.ceil(info.bounds_m[k + 3] / units[k]) for k in range(3)]
    if max(b - a for a, b in zip(low, high, strict=True)) / _SCALE > 2**31 - 1:
        raise InconsistentInputError(
            info.path, f"it spans {[b - a for a, b in zip(low, high, strict=True)]} units, too much for LAZ", "Split it"
        )
    offsets = (float(low[0]), float(low[1]), float(low[2]))
    header = header_of(
        point_format=6, size=new_size(6), scales=(_SCALE,) * 3, offsets=offsets, software=SOFTWARE, wkt=True
    )
    records = [] if info.reference.wkt is None else [wkt_record(info.reference)]

    def pieces() -> Iterator[tuple[npt.NDArray[np.void], PointRecords]]:
        for read in source.file.records(CHUNK_POINTS, None):
            yield _plain_records(read, offsets), read

    warning = (
        f"coordinates are rounded to {_SCALE:g} units; intensity, colours and other columns that runs do not use are"
        " left out: convert the file to LAZ first where they matter"
    )
    return _Plan(header=header, records=records, extended=(), pieces=pieces(), warnings=(warning,))


def _plain_records(read: PointRecords, offsets: tuple[float, float, float]) -> npt.NDArray[np.void]:
    """Records of format 6."""
    records = new_records(len(read))
    for axis, name in enumerate("XYZ"):
        records[name] = np.rint((read.xyz[:, axis] - offsets[axis]) / _SCALE).astype(np.int32)
    one = np.ones(len(read), np.uint8)
    number = one if read.return_number is None else np.clip(read.return_number, 1, 15)
    count = one if read.return_count is None else np.clip(read.return_count, number, 15)
    records["returns"] = number | (count << 4)
    if read.classification is not None:
        records["classification"] = read.classification
    if read.gps_time is not None:
        records["gps_time"] = read.gps_time
    if read.source_id is not None:
        records["point_source_id"] = read.source_id
    if read.withheld is not None:
        records["flags"] = read.withheld.astype(np.uint8) << 2
    return records


def new_size(point_format: int) -> int:
    """Bytes of a record without extra bytes."""
    return {6: 30, 7: 36, 8: 38}[point_format]


def wkt_record(reference: SpatialReference) -> tuple[bytes, int, bytes, bytes]:
    """The record with the CRS.

    The standard means WKT 1; where the CRS does not survive it, WKT 2 is written, which newer readers know.
    """
    import pyproj

    crs = reference.crs
    assert crs is not None
    text = str(reference.wkt)
    try:
        older = crs.to_wkt("WKT1_GDAL")
        if older and pyproj.CRS.from_wkt(older).equals(crs, ignore_axis_order=True):
            text = older
    except pyproj.exceptions.CRSError:
        pass
    return PROJECTION, WKT_RECORD_ID, b"OGC COORDINATE SYSTEM WKT", text.encode() + b"\0"


def _copied(
    path: Path, extended: tuple[ExtendedRecord, ...]
) -> Iterator[tuple[bytes, int, bytes, int, Iterator[bytes]]]:
    """The extended records of a file, in blocks."""

    def blocks(record: ExtendedRecord) -> Iterator[bytes]:
        left = record.size
        with path.open("rb") as stream:
            stream.seek(record.offset)
            while left:
                block = stream.read(min(left, BLOCK_BYTES))
                if not block:
                    raise UnreadableInputError(str(path), "truncated within its extended records", "Get the file again")
                left -= len(block)
                yield block

    for record in extended:
        yield record.user_id, record.record_id, record.description, record.size, blocks(record)
