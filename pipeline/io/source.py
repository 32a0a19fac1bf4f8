"""A point file of any format as a stream of `PointCloud` in metres, and what can be known of it beforehand."""

from __future__ import annotations

import dataclasses
import datetime as dt
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import shapely

from pipeline.errors import CrsError, InconsistentInputError, SettingsError
from pipeline.io.area_of_use import Location, location_of
from pipeline.io.crs import SpatialReference
from pipeline.io.crs_resolution import resolve_reference
from pipeline.io.file_facts import (
    DivisibleFile,
    FileFacts,
    FileStatus,
    PointFile,
    PointRecords,
    Readable,
    Share,
    Window,
)
from pipeline.io.formats import DIVISIBLE, PointFormat, recognise_format
from pipeline.io.gps_time import GpsTimeKind, utc_of
from pipeline.io.places import file_at
from pipeline.io.reading import one_input
from pipeline.io.strays import MOST_STRAYS, ROUNDING, off_earth, without_strays
from pipeline.model import BoolArray, ByteArray, FloatArray, PointCloud
from pipeline.registry import loaded

if TYPE_CHECKING:
    from shapely import MultiPolygon, Polygon

NOISE_CLASSES = (7, 18)
"""ASPRS low point (noise) and high noise."""
IMPOSSIBLE_DENSITY = 1e5
"""Points a square unit that no airborne survey has in metres or feet; one point a square metre is 1e10 a degree."""


CAUSES = ("withheld", "noise_class", "outside", "off_earth")
"""Why points are left out."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReadOptions:
    """What the user says about the inputs and wants of them."""

    crs: str | None = None
    """EPSG code, WKT or PROJ string that overrides the header's CRS."""
    vertical_unit: str | None = None
    """Unit of elevation that overrides the header's: m, ft, us-ft or another word of `crs_given.UNITS_M`."""
    bbox: tuple[float, float, float, float] | None = None
    """x_min, y_min, x_max, y_max in the units of the CRS; closed."""
    aoi: Polygon | MultiPolygon | None = None
    """Area of interest in the units of the CRS; closed."""
    keep_withheld: bool = False
    """Use points that the producer withheld."""
    drop_classes: tuple[int, ...] = NOISE_CLASSES
    """ASPRS classes that are left out."""
    class_table: tuple[int, ...] | None = None
    """The ASPRS class of each of the 256 codes of the file; None where its codes are those of ASPRS."""
    ascii_columns: str | None = None
    """Names of the columns of ASCII files, see `pipeline.extras.ply_ascii.ascii`; None to find out."""

    def __post_init__(self) -> None:
        """Check every field."""
        faults = []
        if self.bbox is not None:
            x_min, y_min, x_max, y_max = self.bbox
            if not (np.isfinite(self.bbox).all() and x_min < x_max and y_min < y_max):
                faults.append(f"bbox is {self.bbox}: use x_min y_min x_max y_max with x_min < x_max and y_min < y_max")
        if self.aoi is not None and (self.aoi.is_empty or not self.aoi.is_valid):
            faults.append(
                f"aoi is {'empty' if self.aoi.is_empty else shapely.is_valid_reason(self.aoi)}: use a valid polygon"
            )
        wrong = [c for c in self.drop_classes if not 0 <= c <= 255]
        if wrong:
            faults.append(f"drop_classes has {wrong}: use ASPRS classes 0 to 255")
        if self.class_table is not None and len(self.class_table) != 256:
            faults.append(f"class_table has {len(self.class_table)} entries: use 256, one a code")
        if faults:
            raise SettingsError(faults)

    @property
    def window(self) -> Window | None:
        """The rectangle outside which no point is wanted; None without a limit."""
        boxes = [box for box in (self.bbox, None if self.aoi is None else self.aoi.bounds) if box is not None]
        if not boxes:
            return None
        return Window(
            x_min=max(box[0] for box in boxes),
            y_min=max(box[1] for box in boxes),
            x_max=min(box[2] for box in boxes),
            y_max=min(box[3] for box in boxes),
        )


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class SourceInfo:
    """What is known of a file before its points are read."""

    path: str
    """The file."""
    format: str
    """las, laz, copc, ply or ascii."""
    point_count: int
    """Points in the file, before anything is dropped."""
    bounds_m: tuple[float, float, float, float, float, float]
    """x_min, y_min, z_min, x_max, y_max, z_max in metres of the CRS: from the header, or measured where it has none;
    single far points do not widen them."""
    reference: SpatialReference
    """CRS and units."""
    density_per_m2: float
    """Points per square metre of the bounds: too low if the data do not fill them; nan if they have no area."""
    has_returns: bool
    """Whether any pulse has more than one return."""
    has_classes: bool
    """Whether sampled points carry a class other than 0 (never classified) and 1 (unassigned)."""
    has_gps_time: bool
    """Whether sampled points carry differing GPS times."""
    gps_time_kind: GpsTimeKind
    """How to read the GPS times."""
    acquired_from: dt.datetime | None
    """Earliest sampled time, UTC; None unless the file has adjusted standard GPS times."""
    acquired_to: dt.datetime | None
    """Latest sampled time, UTC."""
    created: dt.date | None
    """Day on which the file was made, which says nothing about the flight."""
    warnings: tuple[str, ...]
    """What is odd but usable, one sentence each."""
    file_size: int
    """Bytes."""
    modified_ns: int
    """When the file was last written, nanoseconds since 1970."""
    facts: FileFacts
    """What the file says about itself."""
    etag: str = ""
    """What a server calls this state of the file; empty if it says nothing, and for files of this machine."""
    in_parts: bool = True
    """Whether a part of it can be read alone: some servers send whole files only."""

    @property
    def is_divisible(self) -> bool:
        """Whether each share of it can be read alone: text can only be read from its first line on."""
        return self.format in DIVISIBLE

    @property
    def location(self) -> Location | None:
        """The place on Earth; None without a CRS, or for one without such places."""
        if self.reference.wkt is None:
            return None
        unit = self.reference.horizontal_unit_m
        x_min, y_min, _, x_max, y_max, _ = self.bounds_m
        return location_of(self.reference.wkt, (x_min / unit, y_min / unit, x_max / unit, y_max / unit))

    def is_of(self, path: Readable) -> bool:
        """Whether a file is still the one that was looked at, by its size, its time and its server's word."""
        try:
            now = path.stat()
        except OSError:  # opening it reports the fault
            return False
        return (now.st_size, now.st_mtime_ns, _etag_of(now)) == (self.file_size, self.modified_ns, self.etag)


@dataclasses.dataclass(kw_only=True, slots=True)
class Findings:
    """What a pass over the points of a file, or over a share of them, found."""

    n_read: int = 0
    """Points that were read."""
    dropped: Counter[str] = dataclasses.field(default_factory=Counter)
    """Points left out, by cause: outside, then off_earth, withheld, noise_class."""
    beyond_bounds: int = 0
    """Points outside the bounds in the header."""
    off_earth: tuple[float, ...] = ()
    """x, y, z of the first point that does not lie on Earth."""

    def __add__(self, other: Findings) -> Findings:
        """Those of two shares, in the order of the file."""
        return Findings(
            n_read=self.n_read + other.n_read,
            dropped=self.dropped + other.dropped,
            beyond_bounds=self.beyond_bounds + other.beyond_bounds,
            off_earth=self.off_earth or other.off_earth,
        )

    def of_whole(self, info: SourceInfo) -> Findings:
        """The same of a whole file, where a window of COPC left nodes unread: their points lie outside."""
        unread = Findings(dropped=Counter(outside=info.point_count - self.n_read))
        return self + unread

    def warnings(self, path: str) -> tuple[str, ...]:
        """What is odd but usable in a whole file; raises InconsistentInputError if many points do not lie on Earth."""
        found = []
        if self.beyond_bounds:
            found.append(f"{self.beyond_bounds} points lie outside the bounds in the header")
        if count := self.dropped["off_earth"]:
            x, y, z = self.off_earth
            problem = f"{count} of {self.n_read} points do not lie on Earth, such as x {x:.10g}, y {y:.10g}, z {z:.10g}"
            if count > max(1, MOST_STRAYS * self.n_read):
                raise InconsistentInputError(path, problem, "Check the columns, the scale and the units")
            found.append(f"{problem}: left out")
        return tuple(found)


def opened_as(form: PointFormat, path: Readable, options: ReadOptions, facts: FileFacts | None = None) -> PointFile:
    """A file of a format, opened; faster with the facts of the same file, opened before."""
    taken = {name: getattr(options, name) for name in form.takes}
    file: PointFile = loaded(form.reader)(path, facts=facts, **taken)
    return file


class Source:
    """A point file, opened: its facts, and its points as often as wanted.

    Parameters
    ----------
    known : SourceInfo, optional
        Of the same file by the same options, opened before; not believed where the file was changed since.
    """

    def __init__(self, path: Readable, options: ReadOptions, known: SourceInfo | None = None) -> None:
        self._path = path
        self._options = options
        if known is not None and not known.is_of(path):
            known = None
        self._file = opened_as(recognise_format(path), path, options, None if known is None else known.facts)
        self._info = _info_of(path, self._file, options) if known is None else known
        self.findings = Findings()
        """What the last pass of `chunks` found."""
        self._warnings: tuple[str, ...] = ()

    @property
    def info(self) -> SourceInfo:
        """What is known before the points are read."""
        return self._info

    @property
    def dropped(self) -> dict[str, int]:
        """Points left out by the last pass of `chunks`, by cause."""
        return {cause: self.findings.dropped[cause] for cause in CAUSES}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Those of `info`, and what the last pass of `chunks` over the whole file found."""
        return self._info.warnings + self._warnings

    def chunks(self, chunk_size: int = 1_000_000, share: Share | None = None) -> Iterator[PointCloud]:
        """The wanted points in metres, in the file's order (COPC with a window: in the octree's), in pieces.

        A piece has at least one and at most `chunk_size` points, which bounds the memory. Only divisible files have
        shares; what was found of all shares together is judged by `Findings`. Raises UnreadableInputError if the data
        end or break before the promised count, InconsistentInputError if a coordinate is NaN or infinite, or if many
        points of a whole file do not lie on Earth.
        """
        if chunk_size < 1:
            raise SettingsError([f"chunk_size is {chunk_size}: use 1 or more"])
        self.findings, self._warnings = Findings(), ()
        window = self._options.window
        if self._options.aoi is not None:
            shapely.prepare(self._options.aoi)
        if window is None or (window.x_min <= window.x_max and window.y_min <= window.y_max):
            factors = self._factors
            for records in self._records(chunk_size, window, share):
                self.findings.n_read += len(records)
                self.findings.beyond_bounds += self._count_beyond_bounds(records)
                classed = self._classed(records)
                kept = _select(classed, self._wanted(classed, window))
                if len(kept):
                    yield _to_cloud(kept, factors)
        if share is None:
            self.findings = self.findings.of_whole(self._info)
            self._warnings = self.findings.warnings(str(self._path))

    def _records(self, chunk_size: int, window: Window | None, share: Share | None) -> Iterator[PointRecords]:
        if share is None:
            return self._file.records(chunk_size, window)
        return cast("DivisibleFile", self._file).records(chunk_size, window, share)

    @property
    def file(self) -> PointFile:
        """The reader of the file's format."""
        return self._file

    @property
    def crs_given(self) -> bool:
        """Whether the CRS or unit that the user gives makes another CRS than the header's, or a missing one."""
        own, used = self._file.facts.crs, self._info.reference.crs
        given = self._options.crs is not None or self._options.vertical_unit is not None
        return given and used is not None and own != used

    def select(self, records: PointRecords) -> tuple[BoolArray, PointCloud]:
        """Which of some records `chunks` keeps, (m,) bool, and these in metres, as `chunks` gives them."""
        classed = self._classed(records)
        keep = self._wanted(classed, self._options.window)
        return keep, _to_cloud(_select(classed, keep), self._factors)

    @property
    def _factors(self) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        """Metres a unit of easting, northing and elevation."""
        reference = self._info.reference
        return np.array([reference.horizontal_unit_m, reference.horizontal_unit_m, reference.vertical_unit_m])

    def _classed(self, records: PointRecords) -> PointRecords:
        """The records with ASPRS classes."""
        table = self._options.class_table
        if table is None or records.classification is None:
            return records
        return dataclasses.replace(records, classification=np.array(table, dtype=np.uint8)[records.classification])

    def _wanted(self, records: PointRecords, window: Window | None) -> BoolArray:
        """(n,) bool, True for the points to keep; counts the others."""
        options = self._options
        keep: BoolArray = np.ones(len(records), dtype=np.bool_)
        if window is not None:
            keep &= window.contains(records.xyz)
            if options.aoi is not None:
                inside = np.flatnonzero(keep)
                keep[inside] = shapely.intersects_xy(options.aoi, records.xyz[inside, 0], records.xyz[inside, 1])
            self.findings.dropped["outside"] += int(len(keep) - keep.sum())
        stray = off_earth(records.xyz, self._factors) if len(records) else None
        if stray is not None:
            stray &= keep
            self.findings.dropped["off_earth"] += int(stray.sum())
            if stray.any() and not self.findings.off_earth:
                self.findings.off_earth = tuple(records.xyz[np.argmax(stray)].tolist())
            keep &= ~stray
        if records.withheld is not None and not options.keep_withheld:
            self.findings.dropped["withheld"] += int((keep & records.withheld).sum())
            keep &= ~records.withheld
        if records.classification is not None and options.drop_classes:
            table = np.zeros(256, dtype=np.bool_)
            table[list(options.drop_classes)] = True
            noise = table[records.classification]
            self.findings.dropped["noise_class"] += int((keep & noise).sum())
            keep &= ~noise
        return keep

    def _count_beyond_bounds(self, records: PointRecords) -> int:
        """Points outside the bounds that the file claims, by more than rounding."""
        beyond: BoolArray | None = None
        for axis in range(3):
            low, high = self._file.facts.bounds[axis] - ROUNDING, self._file.facts.bounds[axis + 3] + ROUNDING
            values = records.xyz[:, axis]
            if values.min() < low or values.max() > high:
                outside = (values < low) | (values > high)
                beyond = outside if beyond is None else beyond | outside
        return 0 if beyond is None else int(beyond.sum())


def open_source(
    path: str | Path | Readable, options: ReadOptions | None = None, known: SourceInfo | None = None
) -> Source:
    """Open a LAS, LAZ, COPC, PLY or ASCII file, and check all that can be checked without reading it through.

    `known` is what was found when the file was opened before, by the same options: what takes time is not done again.

    Raises
    ------
    UnreadableInputError
        Not there, no permission, not one of the formats, truncated.
    InconsistentInputError
        Header and data disagree.
    EmptyInputError
        No points.
    CrsError
        The CRS is geographic or not understood.
    """
    file = file_at(path) if isinstance(path, str | Path) else path
    if not isinstance(file, Path):  # requests have limits of their own
        return Source(file, options or ReadOptions(), known)
    with one_input(str(file)):
        return Source(file, options or ReadOptions(), known)


def _info_of(path: Readable, file: PointFile, options: ReadOptions) -> SourceInfo:
    """The facts of a file in metres, with the user's overrides."""
    facts = file.facts
    reference, warnings = resolve_reference(
        path=str(path),
        header_crs=facts.crs,
        header_horizontal_unit_m=facts.horizontal_unit_m,
        header_vertical_unit_m=facts.vertical_unit_m,
        crs=options.crs,
        vertical_unit=options.vertical_unit,
    )
    _refuse_degrees(path, facts, reference)
    plan, up = reference.horizontal_unit_m, reference.vertical_unit_m
    bounds, strays = without_strays(facts.bounds, facts.typical_bounds, np.array([plan, plan, up]))
    x_min, y_min, z_min, x_max, y_max, z_max = bounds
    bounds_m = (x_min * plan, y_min * plan, z_min * up, x_max * plan, y_max * plan, z_max * up)
    # spoiled bounds are cut with a wide margin, which holds no points
    filled = facts.typical_bounds if strays and facts.typical_bounds is not None else bounds
    area_m2 = (filled[3] - filled[0]) * (filled[4] - filled[1]) * plan * plan
    acquired, now = None, path.stat()
    if facts.gps_time_kind is GpsTimeKind.ADJUSTED and facts.gps_time_range is not None:
        acquired = utc_of(facts.gps_time_range[0]), utc_of(facts.gps_time_range[1])
    return SourceInfo(
        path=str(path),
        format=facts.format,
        point_count=facts.point_count,
        bounds_m=bounds_m,
        reference=reference,
        density_per_m2=facts.point_count / area_m2 if area_m2 > 0.0 else float("nan"),
        has_returns=facts.has_returns,
        has_classes=facts.has_classes,
        has_gps_time=facts.has_gps_time,
        gps_time_kind=facts.gps_time_kind,
        acquired_from=acquired[0] if acquired else None,
        acquired_to=acquired[1] if acquired else None,
        created=facts.created,
        warnings=facts.warnings + warnings + strays,
        file_size=now.st_size,
        modified_ns=now.st_mtime_ns,
        facts=facts,
        etag=_etag_of(now),
        in_parts=not getattr(path, "is_held", False),
    )


def _etag_of(status: FileStatus) -> str:
    """What a server calls a state of a file; empty for files of this machine."""
    return str(getattr(status, "etag", ""))


def _refuse_degrees(path: Readable, facts: FileFacts, reference: SpatialReference) -> None:
    """Refuse coordinates without a CRS that can only be degrees, before they are taken for metres."""
    x_min, y_min, _, x_max, y_max, _ = facts.bounds
    area = (x_max - x_min) * (y_max - y_min)
    on_the_globe = max(-x_min, x_max) <= 180.0 and max(-y_min, y_max) <= 90.0
    if reference.wkt is None and on_the_globe and facts.point_count > IMPOSSIBLE_DENSITY * area > 0.0:
        raise CrsError(
            str(path),
            f"no CRS, and coordinates that look like degrees: {facts.point_count} points in"
            f" {x_max - x_min:g} by {y_max - y_min:g} units at x {x_min:g}, y {y_min:g}",
            "Reproject the file to a projected CRS, or give --crs EPSG:n where these are lengths",
        )


def _select(records: PointRecords, keep: BoolArray) -> PointRecords:
    """The records of a mask; the very same where it keeps all."""
    if keep.all():
        return records
    arrays: dict[str, Any] = {}
    for field in dataclasses.fields(records):
        array = getattr(records, field.name)
        arrays[field.name] = None if array is None else array[keep]
    return PointRecords(**arrays)


def _to_cloud(records: PointRecords, factors: np.ndarray[tuple[int], np.dtype[np.float64]]) -> PointCloud:
    """Metres, and the defaults for fields that the file does not have."""
    n = len(records)
    xyz = records.xyz if (factors == 1.0).all() else records.xyz * factors
    number, count = _honest_returns(records)
    return PointCloud(
        xyz=xyz,
        return_number=number,
        return_count=count,
        classification=_or(records.classification, n),
        gps_time=np.zeros(n) if records.gps_time is None else _finite(records.gps_time),
        source_id=np.zeros(n, dtype=np.uint16) if records.source_id is None else records.source_id,
    )


def _finite(times: FloatArray) -> FloatArray:
    """The times, 0 where the file has no number."""
    return np.where(np.isfinite(times), times, 0.0)


def _or(values: ByteArray | None, n: int) -> ByteArray:
    """The values, or zeros."""
    return np.zeros(n, dtype=np.uint8) if values is None else values


def _honest_returns(records: PointRecords) -> tuple[ByteArray, ByteArray]:
    """Return number and count, at least 1 and the count not below the number: writers leave zeros."""
    ones: ByteArray = np.ones(len(records), dtype=np.uint8)
    number = ones if records.return_number is None else np.maximum(records.return_number, ones)
    count = number if records.return_count is None else np.maximum(records.return_count, number)
    return number, count
