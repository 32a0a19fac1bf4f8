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
from typing import Any

import shapely

from pipeline.errors import RunError
from pipeline.export.folders import Put, put_local
from pipeline.terrain.flight_passes import Strip
from pipeline.tiling import MM, Tile, TileGrid

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
