"""The manifest of a run, `run.json`: request, inputs, results, durations and memory.

The driver writes it at the start with status `running` and again at the end; `running` means that a run is under way or
was interrupted. Times of day and durations are only here and not in the tables, so a run's content does not depend on
them.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import io
import json
from collections.abc import Iterable, Mapping
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import shapely

from pipeline.errors import RunError
from pipeline.export.putting import Put, put_local
from pipeline.io import arrow_at
from pipeline.terrain.flight_strip import Strip
from pipeline.tiling import MM, Tile, TileGrid

if TYPE_CHECKING:
    import pyarrow.fs as pafs

NAME = "run.json"
"""File name of the manifest in the run directory."""
PAGE = "run.html"
"""File name of the page about the run, which describes the manifest beside it; not every run has one."""
SLOWEST = 50
"""Number of slowest buildings in the manifest."""
FORMAT = 1
"""Version of the run directory's layout; a reader refuses others."""


class RunStatus(StrEnum):
    """How far a run is."""

    RUNNING = "running"
    """Under way, or interrupted."""
    FINISHED = "finished"
    """All tiles are published."""
    INCOMPLETE = "incomplete"
    """Ended, but some tiles failed."""
    FAILED = "failed"
    """Ended with the last error in `warnings`; its results must not be used."""
    CANCELLED = "cancelled"
    """Cancelled, or interrupted from the keyboard; its results must not be used."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PointFileFacts:
    """What is known of a whole file of points, whichever of its points a run took."""

    format: str
    """las, laz, copc, ply or ascii."""
    n_points: int
    """Points in the file."""
    bounds_m: tuple[float, float, float, float]
    """Smallest easting and northing, largest easting and northing in metres; single far points do not widen them."""
    acquired: tuple[dt.datetime, dt.datetime] | None
    """Earliest and latest time of a sample of its points, UTC; None without absolute times."""
    dimensions: Mapping[str, str]
    """What the file has of each point: names, and types as numpy writes them, such as i4."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class InputFile:
    """One input file of a run."""

    path: str
    """As the user gave it, or as it was found in a folder."""
    sha256: str
    """Digest of the whole file, hexadecimal; of the points in the window where only its nodes were fetched."""
    size_bytes: int
    """Its size."""
    n_points: int | None = None
    """Points read from it; None before that, and for files that are not point clouds."""
    bounds_m: tuple[float, float, float, float] | None = None
    """Smallest easting and northing, largest easting and northing of these points in metres; None without points."""
    file: PointFileFacts | None = None
    """The whole file; None for files that are not point clouds, and in runs of older versions."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SlowBuilding:
    """A building that took long."""

    building_id: str
    """Its id."""
    seconds: float
    """Wall-clock seconds to model it, in the run that did so."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunManifest:
    """What `run.json` holds."""

    status: RunStatus
    """How far the run is."""
    engine_version: str
    """Version of this program."""
    method: str
    """Name of the method."""
    settings: Mapping[str, Any]
    """The resolved settings, as plain JSON values."""
    settings_hash: str
    """Digest of those that can change geometry."""
    started_at: dt.datetime
    """With a time zone."""
    finished_at: dt.datetime | None = None
    """With a time zone; None while running."""
    crs: Mapping[str, Any] | None = None
    """epsg, name, wkt, horizontal_unit_m, vertical_unit_m of the outputs; wkt is None where it is unknown. And
    cityjson_vertical_unit_m, the unit of elevations in CityJSON and GLB."""
    inputs: tuple[InputFile, ...] = ()
    """Point clouds and footprints."""
    request: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """How to read the inputs and write the outputs, beside the settings; `gablework rerun` uses it."""
    source_licence: str | None = None
    """Licence of the source data in the user's words; None if unknown."""
    lattice: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """tile_size_m, origin_x_m, origin_y_m: where the tiles lie, in metres."""
    tiles: tuple[str, ...] = ()
    """Keys of the tiles on the lattice, sorted."""
    failed_tiles: tuple[str, ...] = ()
    """Keys of the tiles that could not be published."""
    tiles_without_points: tuple[str, ...] = ()
    """Keys of the tiles whose points were requested and could not be written; the status does not depend on them."""
    tiles_without_terrain: tuple[str, ...] = ()
    """Keys of the tiles whose terrain was requested and could not be written; likewise."""
    counts: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """candidates, ok, doubtful, fallback, failed, rejected, planes, points and the like."""
    timings_s: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """Wall-clock seconds by stage."""
    peak_memory_bytes: Mapping[str, int] = dataclasses.field(default_factory=dict)
    """Largest resident memory by process."""
    slowest: tuple[SlowBuilding, ...] = ()
    """The buildings that took longest, the slowest first."""
    warnings: tuple[str, ...] = ()
    """The warnings of the run."""
    strip_moves_m: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """By how many metres each flight strip (`point_source_id`) was moved up; empty where all strips fit. Strips of one
    id that do not fit are named by GPS times, too, also those that stayed."""
    headline: str = ""
    """The first warning, where it says why the result is empty; else empty."""
    content_sha256: str | None = None
    """`gablework digest` of the finished run; None where it was not computed."""

    def __post_init__(self) -> None:
        """Refuse times without a time zone."""
        for name in ("started_at", "finished_at"):
            value = getattr(self, name)
            if value is not None and value.tzinfo is None:
                raise RunError(f"{name} is {value.isoformat()}: give a time zone")

    @property
    def strip_moves_mm(self) -> dict[Strip, int]:
        """The moves in whole millimetres."""
        return {Strip.of(strip): round(move * MM) for strip, move in self.strip_moves_m.items()}

    def squares(self, keys: Iterable[str]) -> list[Any]:
        """The tiles of some keys as squares in metres, in their order; none where the lattice is unknown."""
        if not self.lattice:
            return []
        grid = TileGrid(
            size_mm=round(self.lattice["tile_size_m"] * MM),
            halo_mm=0,
            origin_x_mm=round(self.lattice["origin_x_m"] * MM),
            origin_y_mm=round(self.lattice["origin_y_m"] * MM),
        )
        cores = (grid.core(Tile.from_key(key)) for key in keys)
        return [shapely.box(core.x0_mm / MM, core.y0_mm / MM, core.x1_mm / MM, core.y1_mm / MM) for core in cores]

    def to_json(self) -> bytes:
        """The manifest as JSON for people and programs, UTF-8; no second copy of it is made, since inputs are many."""
        encoder = json.JSONEncoder(indent=2, ensure_ascii=False, allow_nan=False, default=_plain)
        written = io.BytesIO()
        for piece in encoder.iterencode({"format": FORMAT, **_plain(self)}):
            written.write(piece.encode())
        written.write(b"\n")
        return written.getvalue()

    @classmethod
    def from_json(cls, text: str, source: str = NAME) -> RunManifest:
        """The manifest from JSON text as `to_json` writes it; unknown entries are ignored, messages name `source`.

        Raises RunError if the text is not a manifest, or has another format.
        """
        try:
            found = json.loads(text)
        except json.JSONDecodeError as error:
            raise RunError(f"{source} is no JSON ({error}): the run directory is damaged") from error
        if not isinstance(found, dict) or found.get("format") != FORMAT:
            form = found.get("format") if isinstance(found, dict) else type(found).__name__
            raise RunError(f"{source} has format {form!r}, this version reads {FORMAT}: use the version that wrote it")
        names = {field.name for field in dataclasses.fields(cls)}
        values = {name: value for name, value in found.items() if name in names}
        try:
            values["status"] = RunStatus(values["status"])
            for name in ("started_at", "finished_at"):
                if values.get(name) is not None:
                    values[name] = dt.datetime.fromisoformat(values[name])
            values["inputs"] = tuple(_input_file(entry) for entry in values.get("inputs", ()))
            values["slowest"] = tuple(SlowBuilding(**entry) for entry in values.get("slowest", ()))
            for name in ("tiles", "failed_tiles", "tiles_without_points", "tiles_without_terrain", "warnings"):
                values[name] = tuple(values.get(name, ()))
            return cls(**values)
        except (KeyError, TypeError, ValueError) as error:
            raise RunError(f"{source} is no manifest of a run ({error}): the run directory is damaged") from error


def city_unit_m(crs: Mapping[str, Any] | None) -> float:
    """Metres per vertical unit of a run's CityJSON and GLB, by the entry `crs` of its run.json.

    >>> city_unit_m({"vertical_unit_m": 0.3048}), city_unit_m({"vertical_unit_m": 0.3, "cityjson_vertical_unit_m": 1.0})
    (0.3048, 1.0)
    """
    facts = crs or {}
    # older runs have the unit of the tables there, too
    return float(facts.get("cityjson_vertical_unit_m") or facts.get("vertical_unit_m") or 1.0)


def _input_file(entry: Mapping[str, Any]) -> InputFile:
    """An input as JSON holds it; lists become tuples again."""
    bounds, file = entry.get("bounds_m"), entry.get("file")
    values = {**entry, "bounds_m": None if bounds is None else tuple(bounds)}
    if file is not None:
        times = file["acquired"] and tuple(map(dt.datetime.fromisoformat, file["acquired"]))
        values["file"] = PointFileFacts(**{**file, "bounds_m": tuple(file["bounds_m"]), "acquired": times})
    return InputFile(**values)


def _plain(value: Any) -> Any:
    """A value that JSON does not know: dataclasses become objects, times ISO 8601."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, dt.datetime):
        return value.isoformat()
    raise TypeError(f"a {type(value).__name__} cannot be written as JSON")


def write_manifest(run_dir: str | Path, manifest: RunManifest, put: Put | None = None) -> None:
    """Write `run.json` atomically to a local run directory, or by `put`, which stores a file elsewhere."""
    (put or put_local(run_dir))(NAME, manifest.to_json())


def read_manifest(run_dir: str | Path, filesystem: pafs.FileSystem | None = None) -> RunManifest:
    """Read `run.json`; raises RunError if there is none, or it cannot be read.

    Parameters
    ----------
    run_dir : str or Path
        The run directory: a path or URL, or a path of `filesystem`.
    filesystem : pyarrow.fs.FileSystem, optional
        Where the run lies; by default as `run_dir` says.
    """
    if filesystem is None:
        filesystem, run_dir = arrow_at(run_dir)
    path = f"{str(run_dir).rstrip('/')}/{NAME}"
    try:
        with filesystem.open_input_stream(path) as stream:
            text = stream.read().decode()
    except FileNotFoundError:
        raise RunError(f"{path} does not exist: give the directory that a run wrote") from None
    except (OSError, UnicodeDecodeError) as error:
        raise RunError(f"{path} cannot be read: {error}") from error
    return RunManifest.from_json(text, path)
