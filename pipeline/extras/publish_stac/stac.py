"""A STAC catalogue of a run: a Collection for the run and an Item per tile, since a run's files are per tile.

Below it is a Collection of the points that the models were made from, with an Item per input file. STAC 1.1 with the
extensions projection, processing, file, table and pointcloud. Places are in longitude and latitude.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import re
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

import numpy as np
import shapely

from pipeline.export.columns import COLUMNS, kind_of
from pipeline.export.projection import Project

VERSION = "1.1.0"
"""Version of STAC."""
CRS = "OGC:CRS84"
"""The CRS of places in STAC."""
COLLECTION = "collection.json"
"""File name of the Collection."""
POINTS = "points"
"""Folder of the Collection of points and its Items."""
_EXTENSIONS = "https://stac-extensions.github.io"
PROJECTION = f"{_EXTENSIONS}/projection/v2.0.0/schema.json"
PROCESSING = f"{_EXTENSIONS}/processing/v1.2.0/schema.json"
FILE = f"{_EXTENSIONS}/file/v2.1.0/schema.json"
TABLE = f"{_EXTENSIONS}/table/v1.2.0/schema.json"
POINTCLOUD = f"{_EXTENSIONS}/pointcloud/v1.0.0/schema.json"

_GEOJSON = "application/geo+json"
_PARQUET = "application/vnd.apache.parquet"
ASSETS: Mapping[str, tuple[str, str, str]] = {
    "buildings": (_PARQUET, "data", "GeoParquet: one row per candidate, footprint and solids"),
    "planes": (_PARQUET, "data", "GeoParquet: one row per roof plane"),
    "rejected": (_PARQUET, "metadata", "GeoParquet: objects that are not buildings, with the reason"),
    "decisions": (_PARQUET, "metadata", "Parquet: what was checked and tried for each building"),
    "cityjson": ("application/city+json-seq", "data", "CityJSONSeq 2.0: solids with semantic surfaces"),
    "terrain": ("application/city+json-seq", "data", "CityJSONSeq 2.0: the terrain as triangles"),
    "mesh": ("", "data", "the meshes of all buildings"),
    "mesh-lod12": ("", "data", "the meshes of all buildings in LoD1.2"),
    "mesh-lod13": ("", "data", "the meshes of all buildings in LoD1.3"),
}
"""Media type, role and title of the assets of an Item; meshes have the type of their ending."""
_MESHES = {".glb": "model/gltf-binary", ".obj": "model/obj"}
DOCUMENTS: Mapping[str, tuple[str, str, str, str]] = {
    "run.json": ("run", "application/json", "metadata", "settings, version, inputs, counts and warnings of the run"),
    "run.html": ("page", "text/html", "overview", "page about the run"),
    "points/tileset.json": ("points", "application/json", "visual", "3D Tiles: the points over the models"),
}
"""Name, media type, role and title of the assets of a Collection, by their files in the run directory."""
ENCODINGS: Mapping[str, tuple[str, str]] = {
    "las": ("LAS", "application/vnd.las"),
    "laz": ("LASzip", "application/vnd.laszip"),
    "copc": ("COPC", "application/vnd.laszip+copc"),
    "ply": ("PLY", "application/octet-stream"),
    "ascii": ("text", "text/plain"),
}
"""`pc:encoding` and media type of the formats of points."""
_KINDS = {"i": "signed", "u": "unsigned", "f": "floating"}
_DEGREE_DIGITS = 7
"""Decimals of degrees: about a centimetre."""
_STEM = 64
"""Longest beginning of a file's name in an id."""
_SPDX = re.compile(r"[A-Za-z0-9.+-]+")
"""What an SPDX identifier may be."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """What Collection and Items say about a run."""

    name: str
    """Name of the run: the id of the Collection."""
    version: str
    """Version of the program."""
    method: str
    """Name of the method."""
    finished_at: dt.datetime
    """When the models were made."""
    licence: str | None
    """Licence of the source data in the user's words; None if unknown."""
    crs: Mapping[str, Any]
    """The CRS, as a manifest holds it."""

    @property
    def lineage(self) -> str:
        """How the models came to be, in a sentence."""
        return f"LoD2 building models from airborne laser scanning by gablework {self.version}, method {self.method}"


@dataclasses.dataclass(frozen=True, kw_only=True)
class TileFacts:
    """What an Item says about a tile."""

    key: str
    """Key of the tile: the id of the Item."""
    files: Mapping[str, str]
    """The sha256 of its files by their paths in the run directory, from `listed`."""
    bounds: tuple[float, float, float, float]
    """Smallest x and y, largest x and y of its buildings and rejected objects, in CRS units."""
    acquired: tuple[dt.datetime, dt.datetime] | None
    """First and last acquisition of its buildings; None if unknown."""
    rows: Mapping[str, int]
    """Rows of its tables."""
    points: Sequence[str] = ()
    """Keys of the input files that gave points where it is."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PointFacts:
    """What an Item says about an input file of points: the whole file, whichever of its points the run took."""

    name: str
    """Name of the file, without its folder."""
    address: str | None
    """Its URL; None for a file of the machine that made the run."""
    size_bytes: int
    """Its size."""
    sha256: str
    """Digest of the file; of what was read of it, if that was less."""
    is_digest_of_file: bool
    """Whether `sha256` is that of the file."""
    format: str
    """A key of `ENCODINGS`."""
    count: int
    """Points in the file."""
    bounds: tuple[float, float, float, float]
    """Smallest x and y, largest x and y of its points, in CRS units."""
    taken: tuple[float, float, float, float]
    """The same of those points that the run took."""
    density_per_m2: float | None
    """Points per square metre of the bounds; None if these have no area."""
    acquired: tuple[dt.datetime, dt.datetime] | None
    """First and last acquisition of a sample of its points; None if unknown."""
    dimensions: Mapping[str, str]
    """What it has of each point: names, and types as numpy writes them, such as i4."""

    @property
    def key(self) -> str:
        """The id of the Item: the name of the file, and the beginning of its digest."""
        stem = re.sub(r"[^A-Za-z0-9]+", "_", PurePosixPath(self.name).stem)[:_STEM]
        return f"{stem}-{self.sha256[:8]}"


def points_name(key: str) -> str:
    """The file of an input's Item in the catalogue.

    >>> points_name("tile-ab12cd34")
    'points/tile-ab12cd34.json'
    """
    return f"{POINTS}/{key}.json"


def item_name(tile: str) -> str:
    """The file of a tile's Item in the catalogue.

    >>> item_name("x85_y447")
    'x85_y447/x85_y447.json'
    """
    return f"{tile}/{tile}.json"


def asset_name(path: str, tile: str) -> str | None:
    """The asset that a file of a tile is; None for the meshes of single buildings, which are too many to list.

    >>> asset_name("planes/tile=t1/part-0.parquet", "t1"), asset_name("meshes/t1/t1-lod12.glb", "t1")
    ('planes', 'mesh-lod12')
    >>> asset_name("meshes/t1/abc.obj", "t1") is None
    True
    """
    folder, stem = path.partition("/")[0], PurePosixPath(path).stem
    name = stem.replace(tile, "mesh", 1) if folder == "meshes" and stem.startswith(tile) else folder
    return name if name in ASSETS else None


def listed(files: Mapping[str, str], tile: str) -> dict[str, str]:
    """Those of a tile's files that become assets, with their sha256.

    >>> listed({"meshes/t1/abc.obj": "00", "planes/tile=t1/part-0.parquet": "01"}, "t1")
    {'planes/tile=t1/part-0.parquet': '01'}
    """
    return {path: digest for path, digest in files.items() if asset_name(path, tile) is not None}


def dated(tiles: Sequence[TileFacts]) -> list[TileFacts]:
    """Give tiles without a time, such as those without buildings, the first and the last one of all."""
    times = [at for tile in tiles if tile.acquired is not None for at in tile.acquired]
    if not times:
        return list(tiles)
    span = min(times), max(times)
    return [dataclasses.replace(tile, acquired=tile.acquired or span) for tile in tiles]


def item(tile: TileFacts, run: Run, project: Project, href: str) -> dict[str, Any]:
    """The Item of a tile.

    Parameters
    ----------
    tile : TileFacts
        The tile.
    run : Run
        Its run.
    project : callable
        From the run's horizontal CRS to `CRS`.
    href : str
        The run directory as seen from the Item, ending in a slash.
    """
    geometry, bbox = _place(tile.bounds, project)
    return {
        "type": "Feature",
        "stac_version": VERSION,
        "stac_extensions": [PROJECTION, PROCESSING, FILE, TABLE],
        "id": tile.key,
        "collection": run.name,
        "bbox": bbox,
        "geometry": shapely.geometry.mapping(geometry),
        "properties": {
            "title": f"Buildings of tile {tile.key}",
            **_times(tile.acquired, run),
            **_projection(tile.bounds, run),
            "processing:software": {"gablework": run.version},
            "processing:datetime": _zulu(run.finished_at),
            "processing:lineage": run.lineage,
            "license": _licence(run),
        },
        "links": [
            *(_link(rel, f"../{COLLECTION}") for rel in ("root", "parent", "collection")),
            *(_link("derived_from", f"../{points_name(key)}", _GEOJSON) for key in tile.points),
        ],
        "assets": {
            name: _asset(name, path, digest, href) | _row_count(tile.rows.get(name))
            for path, digest in sorted(tile.files.items())
            if (name := asset_name(path, tile.key))
        },
    }


def points_item(points: PointFacts, run: Run, project: Project) -> dict[str, Any]:
    """The Item of an input file of points; the file is an asset only if it has an address.

    Parameters
    ----------
    points : PointFacts
        The file.
    run : Run
        The run that read it.
    project : callable
        From the run's horizontal CRS to `CRS`.
    """
    geometry, bbox = _place(points.bounds, project)
    encoding, kind = ENCODINGS[points.format]
    digest = f", sha256 {points.sha256}" if points.is_digest_of_file else ""
    return {
        "type": "Feature",
        "stac_version": VERSION,
        "stac_extensions": [PROJECTION, POINTCLOUD, *([] if points.address is None else [FILE])],
        "id": points.key,
        "collection": _points_id(run),
        "bbox": bbox,
        "geometry": shapely.geometry.mapping(geometry),
        "properties": {
            "title": f"Points of {points.name}",
            "description": f"The file {points.name}, {points.size_bytes} bytes{digest}",
            **_times(points.acquired, run),
            **_projection(points.bounds, run),
            "license": _licence(run),
            "pc:count": points.count,
            "pc:type": "lidar",
            "pc:encoding": encoding,
            "pc:schemas": [
                {"name": name, "size": int(code[1:]), "type": _KINDS[code[0]]}
                for name, code in points.dimensions.items()
            ],
            **({} if points.density_per_m2 is None else {"pc:density": round(points.density_per_m2, 3)}),
        },
        "links": [
            _link("root", f"../{COLLECTION}"),
            *(_link(rel, f"./{COLLECTION}") for rel in ("parent", "collection")),
        ],
        "assets": {}
        if points.address is None
        else {
            "points": {
                "href": points.address,
                **_described((kind, "data", f"the points, {encoding}")),
                "file:size": points.size_bytes,
                **({"file:checksum": f"1220{points.sha256}"} if points.is_digest_of_file else {}),
            }
        },
    }


def points_collection(run: Run, items: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The Collection of the points that a run read, of at least one Item; `items` as in `collection`."""
    return {
        "type": "Collection",
        "stac_version": VERSION,
        "stac_extensions": [],
        "id": _points_id(run),
        "title": f"Points of the building models {run.name}",
        "description": "The files of points from which the models were made, as they were before the run left out any "
        f"point. Licence: {run.licence or 'unknown'}.",
        "license": _licence(run),
        "extent": _extent(items),
        "links": [
            *(_link(rel, f"../{COLLECTION}") for rel in ("root", "parent")),
            *(_link("item", f"./{one['id']}.json", _GEOJSON) for one in items),
        ],
    }


def collection(
    run: Run, items: Sequence[Mapping[str, Any]], documents: Sequence[str], href: str, *, has_points: bool = False
) -> dict[str, Any]:
    """The Collection of a run.

    Parameters
    ----------
    run : Run
        The run.
    items : sequence of mapping
        `id`, `bbox` and times of its Items, at least one.
    documents : sequence of str
        Files of the run as a whole that exist, by their paths in it.
    href : str
        The run directory as seen from the Collection, ending in a slash.
    has_points : bool
        Whether there is a Collection of its points, too.
    """
    return {
        "type": "Collection",
        "stac_version": VERSION,
        "stac_extensions": [TABLE],
        "id": run.name,
        "title": f"Building models {run.name}",
        "description": f"{run.lineage}. Licence of the source data: {run.licence or 'unknown'}.",
        "license": _licence(run),
        "extent": _extent(items),
        "item_assets": {
            name: {**_described(ASSETS[name]), "table:columns": _columns(name)} for name in ASSETS if name in COLUMNS
        },
        "links": [
            _link("root", f"./{COLLECTION}"),
            *([_link("license", run.licence, "text/html")] if _is_url(run.licence) else []),
            *([_link("child", f"./{POINTS}/{COLLECTION}")] if has_points else []),
            *(_link("item", f"./{item_name(one['id'])}", _GEOJSON) for one in items),
        ],
        "assets": {
            name: {"href": href + path, **_described(words)}
            for path, (name, *words) in DOCUMENTS.items()
            if path in documents
        },
    }


def _points_id(run: Run) -> str:
    """The id of the Collection of points."""
    return f"{run.name}-{POINTS}"


def _extent(items: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The extent of the Items of a Collection in space and time."""
    first, last = (
        order(
            (one["properties"].get(name) or one["properties"]["datetime"] for one in items),
            key=dt.datetime.fromisoformat,
        )
        for order, name in ((min, "start_datetime"), (max, "end_datetime"))
    )
    return {
        "spatial": {"bbox": [_around([one["bbox"] for one in items])]},
        "temporal": {"interval": [[first, last]]},
    }


def _projection(bounds: Sequence[float], run: Run) -> dict[str, Any]:
    """The CRS and a place in it."""
    return {
        "proj:code": None if run.crs.get("epsg") is None else f"EPSG:{run.crs['epsg']}",
        "proj:wkt2": run.crs["wkt"],
        "proj:bbox": list(bounds),
    }


def _times(acquired: tuple[dt.datetime, dt.datetime] | None, run: Run) -> dict[str, str | None]:
    """When the points were measured; if that is unknown, when the models were made."""
    if acquired is None:
        return {"datetime": _zulu(run.finished_at)}
    return {"datetime": None, "start_datetime": _zulu(acquired[0]), "end_datetime": _zulu(acquired[1])}


def _zulu(at: dt.datetime) -> str:
    """A time as STAC writes it: UTC, with a Z."""
    return at.astimezone(dt.UTC).isoformat().replace("+00:00", "Z")


def _licence(run: Run) -> str:
    """The licence as an SPDX identifier; `other` if it is unknown or in other words."""
    return run.licence if run.licence and _SPDX.fullmatch(run.licence) else "other"


def _is_url(licence: str | None) -> bool:
    """Whether the licence is the address of its text."""
    return bool(licence and licence.startswith(("https://", "http://")))


def _link(rel: str, href: str | None, kind: str = "application/json") -> dict[str, Any]:
    """A link of an object."""
    return {"rel": rel, "href": href, "type": kind}


def _described(words: Sequence[str]) -> dict[str, Any]:
    """Type, roles and title of an asset."""
    return {"type": words[0], "roles": [words[1]], "title": words[2]}


def _asset(name: str, path: str, digest: str, href: str) -> dict[str, Any]:
    """A file as an asset, with its sha256 as a multihash."""
    kind, role, title = ASSETS[name]
    words = (kind or _MESHES[PurePosixPath(path).suffix], role, title)
    return {"href": href + path, **_described(words), "file:checksum": f"1220{digest}"}


def _row_count(rows: int | None) -> dict[str, int]:
    """The number of rows of a table."""
    return {} if rows is None else {"table:row_count": rows}


def _columns(table: str) -> list[dict[str, str]]:
    """The columns of a table with their meanings."""
    return [{"name": one.name, "type": kind_of(one.kind), "description": one.comment} for one in COLUMNS[table]]


def _place(bounds: Sequence[float], project: Project) -> tuple[Any, list[float]]:
    """A box of the CRS in degrees, to about a centimetre, and its `bbox`; across 180 deg, split as RFC 7946 asks."""
    corners = np.round(project(shapely.get_coordinates(shapely.box(*bounds))), _DEGREE_DIGITS)
    if np.ptp(corners[:, 0]) > 180.0:
        corners[:, 0] %= 360.0
    place = shapely.Polygon(corners)
    if not place.is_valid:  # without an area
        low, high = corners.min(axis=0) - 10.0**-_DEGREE_DIGITS, corners.max(axis=0) + 10.0**-_DEGREE_DIGITS
        place = shapely.box(*np.round([*low, *high], _DEGREE_DIGITS).tolist())
    bbox = _around([list(place.bounds)])
    if bbox[0] > bbox[2]:
        east = place.intersection(shapely.box(180, -90, 360, 90))
        east = shapely.transform(east, lambda xy: np.round(xy - (360.0, 0.0), _DEGREE_DIGITS))
        west = place.intersection(shapely.box(0, -90, 180, 90))
        place = shapely.MultiPolygon([part for part in (west, east) if part.area > 0.0])
    return shapely.orient_polygons(place), bbox


def _around(boxes: Sequence[Sequence[float]]) -> list[float]:
    """The `bbox` of several; across 180 deg, its west is greater than its east."""
    west, south, east, north = np.array(boxes).T
    if (west > east).any() or np.max(east) - np.min(west) > 180.0:
        west, east = west % 360.0, east % 360.0
    ends = [degrees - 360.0 if degrees > 180.0 else degrees for degrees in (np.min(west), np.max(east))]
    return [round(float(v), _DEGREE_DIGITS) for v in (ends[0], np.min(south), ends[1], np.max(north))]
