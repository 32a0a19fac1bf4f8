"""A STAC catalogue of a run: a Collection for the run and an Item per tile, since a run's files are per tile.

Below it is a Collection of the points that the models were made from, with an Item per input file. STAC 1.1 with the
extensions projection, processing, file, table and pointcloud. Places are in longitude and latitude.
"""

from __future__ import annotations

import dataclasses
import datetime as dt
import functools
import hashlib
import json
import os
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import quote

import numpy as np
import shapely

from pipeline.errors import RunError
from pipeline.export.columns import COLUMNS, kind_of
from pipeline.export.folders import TERRAIN_FOLDER
from pipeline.export.geoparquet import table_batches
from pipeline.export.projection import Project, projection_to
from pipeline.extras.publish.finished_run import (
    ROWS,
    FinishedRun,
    Published,
    disk_at,
    new_files,
    path_outside,
    sequences_of,
    states_of,
)
from pipeline.io import LocalStorage, arrow_at, is_url, storage_at
from pipeline.io.formats import ENCODINGS
from pipeline.methods import LODS, OVERHANGS
from pipeline.runtime.manifest import InputFile, RunManifest
from pipeline.runtime.monitoring.progress import Event, Listener, ignore

VERSION = "1.1.0"
"""Version of STAC."""
CRS = "OGC:CRS84"
"""The CRS of places in STAC."""
COLLECTION = "collection.json"
"""File name of the Collection."""
POINTS = "points"
"""Folder of the Collection of points and its Items."""
_POINTS_COLLECTION = f"{POINTS}/{COLLECTION}"
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
    **{
        f"mesh-lod{lod.replace('.', '')}": ("", "data", f"the meshes of all buildings in LoD{lod}")
        for lod in (*LODS[:-1], OVERHANGS)
    },
}
"""Media type, role and title of the assets of an Item; meshes have the type of their ending."""
_MESHES = {".glb": "model/gltf-binary", ".obj": "model/obj"}
DOCUMENTS: Mapping[str, tuple[str, str, str, str]] = {
    "run.json": ("run", "application/json", "metadata", "settings, version, inputs, counts and warnings of the run"),
    "run.html": ("page", "text/html", "overview", "page about the run"),
    "points/tileset.json": ("points", "application/json", "visual", "3D Tiles: the points over the models"),
}
"""Name, media type, role and title of the assets of a Collection, by their files in the run directory."""
_KINDS = {"i": "signed", "u": "unsigned", "f": "floating"}
_DEGREE_DIGITS = 7
"""Decimals of degrees: about a centimetre."""
_STEM = 64
"""Longest beginning of a file's name in an id."""
_SPDX = re.compile(r"[A-Za-z0-9.+-]+")
"""What an SPDX identifier may be."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """What all objects of a catalogue say about their run."""

    name: str
    """Name of the run: the id of the Collection."""
    manifest: RunManifest
    """Its manifest."""
    project: Project
    """From the run's horizontal CRS to `CRS`."""

    @functools.cached_property
    def points(self) -> dict[str, InputFile]:
        """The input files that gave points, by the ids of their Items; none in a run of an older version."""
        inputs = self.manifest.inputs
        return {points_key(one): one for one in inputs if one.file is not None and one.bounds_m is not None}

    @property
    def licence(self) -> str:
        """The licence as an SPDX identifier; `other` if it is unknown or in other words."""
        stated = self.manifest.source_licence
        return stated if stated and _SPDX.fullmatch(stated) else "other"

    @property
    def lineage(self) -> str:
        """How the models came to be, in a sentence."""
        made_by = f"gablework {self.manifest.engine_version}, method {self.manifest.method}"
        return f"LoD2 building models from airborne laser scanning by {made_by}"

    @property
    def made(self) -> str:
        """When the models were made."""
        return _zulu(self.manifest.finished_at or self.manifest.started_at)

    def in_units(self, bounds_m: Sequence[float]) -> list[float]:
        """Bounds in metres in the units of the CRS."""
        unit_m = (self.manifest.crs or {}).get("horizontal_unit_m", 1.0)
        return [value / unit_m for value in bounds_m]


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


def publish_stac(
    run_dir: str,
    out: str,
    *,
    overwrite: bool = False,
    name: str | None = None,
    documents: Collection[str] = tuple(DOCUMENTS),
    on_event: Listener = ignore,
) -> Published:
    """Write a STAC catalogue of a finished run; other parameters and errors as in `publishing.Form`.

    Its files refer to those of the run. The Collection is placed last. Raises RunError if the folder holds another
    catalogue, if the CRS is unknown, or if no tile has files.

    Parameters
    ----------
    name : str, optional
        Id of the Collection; the name of the run directory by default.
    documents : collection of str
        Files about the whole run to list, of `DOCUMENTS`, if they exist.
    """
    target = path_outside(run_dir, out)
    manifest, storage = FinishedRun.at(run_dir, ()).manifest, storage_at(run_dir)
    name = name or PurePosixPath(run_dir.rstrip("/") if is_url(run_dir) else Path(run_dir).resolve().as_posix()).name
    run = Run(name=name, manifest=manifest, project=projection_to(manifest.crs, CRS))
    files = {state["tile"]: listed(state["files"], state["tile"]) for state in states_of(run_dir) if state["files"]}
    for tile, key in sequences_of(run_dir, TERRAIN_FOLDER).items():
        files.setdefault(tile, {})[key] = hashlib.sha256(storage.get(key)).hexdigest()
    finished = FinishedRun(place=run_dir, manifest=manifest, stated=[key for held in files.values() for key in held])
    points = run.points
    names = [
        *(points_name(key) for key in points),
        *([_POINTS_COLLECTION] if points else []),
        *(item_name(tile) for tile in files),
        COLLECTION,
    ]
    href = run_dir.rstrip("/") + "/" if is_url(run_dir) else _relative(Path(run_dir).resolve(), target)
    with disk_at(target):
        _refuse_other(target / COLLECTION, href)
    with new_files(target, overwrite, names, lambda: _catalogue_files(target)) as made:
        facts = []
        for done, (tile, held) in enumerate(files.items(), start=1):
            facts.append(_tile_facts(run_dir, tile, held, manifest))
            on_event(Event(kind="progress", stage="items", done=done, total=len(files)))
        if not facts:
            raise RunError(f"the run in {run_dir} has no tile with files, so there is nothing to list")
        below, size = _put_items(made, points_name, (points_item(one, run) for one in points.values()))
        if below:
            size += _put(made, _POINTS_COLLECTION, points_collection(run, below))
        taken = shapely.STRtree([shapely.box(*run.in_units(one.bounds_m or ())) for one in points.values()])
        place = href if is_url(href) else f"../{href}"
        items, more = _put_items(made, item_name, (_item_of(one, run, place, taken) for one in dated(facts)))
        there = [document for document in documents if storage.has(document)]
        size += more + _put(made, COLLECTION, collection(run, items, there, href))
        finished.check({"buildings": sum(tile.rows["buildings"] for tile in facts)})
    return Published(place=str(target), size_bytes=size, rows={"items": len(items), "points": len(below)})


def _tile_facts(run_dir: str, tile: str, files: Mapping[str, str], manifest: RunManifest) -> TileFacts:
    """Where and when the objects of a tile are; if it has none, its square on the lattice."""
    filesystem, place = arrow_at(run_dir)
    boxes, times, rows = [], [], {}
    for table, columns in (("buildings", ["acquired_from", "acquired_to", "bbox"]), ("rejected", ["bbox"])):
        rows[table] = 0
        if not any(name.startswith(f"{table}/") for name in files):  # nothing but terrain
            continue
        for batch in table_batches(place, table, columns, filesystem, [tile], ROWS):
            rows[table] += batch.num_rows
            boxes += [tuple(box.values()) for box in batch.column("bbox").to_pylist() if box]
            for name in columns[:-1]:
                times += [at for at in batch.column(name).to_pylist() if at]
    unit_m = (manifest.crs or {}).get("horizontal_unit_m", 1.0)
    boxes = boxes or [tuple(v / unit_m for v in square.bounds) for square in manifest.squares([tile])]
    if not boxes:
        raise RunError(f"the place of tile {tile} of the run in {run_dir} is unknown: run it again")
    low, high = np.min(boxes, axis=0), np.max(boxes, axis=0)
    return TileFacts(
        key=tile,
        files=files,
        bounds=(float(low[0]), float(low[1]), float(high[2]), float(high[3])),
        acquired=(min(times), max(times)) if times else None,
        rows=rows,
    )


def _catalogue_files(target: Path) -> list[Path]:
    """Files in a folder that a catalogue may have written."""
    items = [path for path in target.glob("*/*.json") if path.stem == path.parent.name]
    return [*items, *target.glob(f"{POINTS}/*.json"), *target.glob(COLLECTION)]


def _refuse_other(place: Path, href: str) -> None:
    """Refuse a folder with a Collection that is not of the run at `href`; raises RunError."""
    if not place.is_file():
        return
    try:
        held = json.loads(place.read_text(encoding="utf-8"))["assets"]["run"]["href"]
    except (ValueError, KeyError, TypeError):
        held = "something else"
    if held != f"{href}run.json":
        raise RunError(f"{place} is of another run or catalogue ({str(held)[:160]}): give another --out")


def _relative(run: Path, target: Path) -> str:
    """The run directory as seen from a folder, percent-encoded and ending in a slash."""
    return quote(Path(os.path.relpath(run, target)).as_posix()) + "/"


def _item_of(tile: TileFacts, run: Run, href: str, taken: shapely.STRtree) -> dict[str, Any]:
    """The Item of a tile; its sources are the inputs whose points, those that the run took, reach into its bounds."""
    keys = list(run.points) if len(taken) else []
    return item(tile, run, href, [keys[k] for k in sorted(taken.query(shapely.box(*tile.bounds)).tolist())])


def _put_items(
    storage: LocalStorage, name_of: Callable[[str], str], items: Iterable[Mapping[str, Any]]
) -> tuple[list[dict[str, Any]], int]:
    """Write Items; what their Collection needs of them, and their size in bytes."""
    kept, size = [], 0
    for one in items:
        size += _put(storage, name_of(one["id"]), one)
        kept.append({name: one[name] for name in ("id", "bbox", "properties")})
    return kept, size


def _put(storage: LocalStorage, name: str, document: Mapping[str, Any]) -> int:
    """Write a document; returns its size in bytes."""
    content = json.dumps(document, indent=1, ensure_ascii=False, allow_nan=False).encode() + b"\n"
    storage.put(name, content)
    return len(content)


def moved_collection(content: bytes, folder: str) -> bytes:
    """A Collection for a place above its folder."""
    document = json.loads(content)
    for link in document["links"]:
        if link["href"].startswith("./"):
            link["href"] = f"{folder}/{link['href'].removeprefix('./')}"
    return json.dumps(document, separators=(",", ":"), ensure_ascii=False).encode()


def points_key(points: InputFile) -> str:
    """The id of the Item of an input file: its name, and the beginning of its digest."""
    stem = re.sub(r"[^A-Za-z0-9]+", "_", PurePosixPath(points.path).stem)[:_STEM]
    return f"{stem}-{points.sha256[:8]}"


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


def item(tile: TileFacts, run: Run, href: str, sources: Sequence[str] = ()) -> dict[str, Any]:
    """The Item of a tile.

    Parameters
    ----------
    tile : TileFacts
        The tile.
    run : Run
        Its run.
    href : str
        The run directory as seen from the Item, ending in a slash.
    sources : sequence of str
        Ids of the Items of the input files that gave points where it is.
    """
    return _item(
        tile.key,
        run,
        tile.bounds,
        extensions=[PROJECTION, PROCESSING, FILE, TABLE],
        collection=run.name,
        properties={
            "title": f"Buildings of tile {tile.key}",
            **_times(tile.acquired, run),
            **_projection(tile.bounds, run),
            "processing:software": {"gablework": run.manifest.engine_version},
            "processing:datetime": run.made,
            "processing:lineage": run.lineage,
            "license": run.licence,
        },
        links=[
            *(_link(rel, f"../{COLLECTION}") for rel in ("root", "parent", "collection")),
            *(_link("derived_from", f"../{points_name(key)}", _GEOJSON) for key in sources),
        ],
        assets={
            name: _asset(name, path, digest, href) | _row_count(tile.rows.get(name))
            for path, digest in sorted(tile.files.items())
            if (name := asset_name(path, tile.key))
        },
    )


def points_item(points: InputFile, run: Run) -> dict[str, Any]:
    """The Item of an input file: the whole file, whichever of its points the run took; an asset if it has a URL."""
    file = points.file
    assert file is not None
    address, name = is_url(points.path), PurePosixPath(points.path).name
    bounds = run.in_units(file.bounds_m)
    x0, y0, x1, y1 = file.bounds_m
    area_m2 = (x1 - x0) * (y1 - y0)
    encoding, kind = ENCODINGS[file.format]
    is_digest_of_file = not (address and file.format == "copc")  # a window of it has another digest
    checksum = {"file:checksum": f"1220{points.sha256}"} if is_digest_of_file else {}
    asset = {"href": points.path, **_described((kind, "data", f"the points, {encoding}"))}
    return _item(
        points_key(points),
        run,
        bounds,
        extensions=[PROJECTION, POINTCLOUD, *([FILE] if address else [])],
        collection=_points_id(run),
        properties={
            "title": f"Points of {name}",
            "description": f"The file {name}, {points.size_bytes} bytes"
            + (f", sha256 {points.sha256}" if is_digest_of_file else ""),
            **_times(file.acquired, run),
            **_projection(bounds, run),
            "license": run.licence,
            "pc:count": file.n_points,
            "pc:type": "lidar",
            "pc:encoding": encoding,
            "pc:schemas": [
                {"name": name, "size": int(code[1:]), "type": _KINDS[code[0]]} for name, code in file.dimensions.items()
            ],
            **({"pc:density": round(file.n_points / area_m2, 3)} if area_m2 > 0.0 else {}),
        },
        links=[
            _link("root", f"../{COLLECTION}"),
            *(_link(rel, f"./{COLLECTION}") for rel in ("parent", "collection")),
        ],
        assets={"points": {**asset, "file:size": points.size_bytes, **checksum}} if address else {},
    )


def points_collection(run: Run, items: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The Collection of the points that a run read, of at least one Item."""
    return _collection(
        _points_id(run),
        run,
        items,
        extensions=[],
        title=f"Points of the building models {run.name}",
        description="The files of points from which the models were made, as they were before the run left out any "
        f"point. Licence: {run.manifest.source_licence or 'unknown'}.",
        links=[
            *(_link(rel, f"../{COLLECTION}") for rel in ("root", "parent")),
            *(_link("item", f"./{one['id']}.json", _GEOJSON) for one in items),
        ],
    )


def collection(run: Run, items: Sequence[Mapping[str, Any]], documents: Sequence[str], href: str) -> dict[str, Any]:
    """The Collection of a run.

    Parameters
    ----------
    run : Run
        The run.
    items : sequence of mapping
        `id`, `bbox` and `properties` of its Items, at least one.
    documents : sequence of str
        Files of the run as a whole that exist, by their paths in it.
    href : str
        The run directory as seen from the Collection, ending in a slash.
    """
    licence = run.manifest.source_licence
    return _collection(
        run.name,
        run,
        items,
        extensions=[TABLE],
        title=f"Building models {run.name}",
        description=f"{run.lineage}. Licence of the source data: {licence or 'unknown'}.",
        item_assets={
            name: {**_described(ASSETS[name]), "table:columns": _columns(name)} for name in ASSETS if name in COLUMNS
        },
        links=[
            _link("root", f"./{COLLECTION}"),
            *([_link("license", licence, "text/html")] if (licence or "").startswith(("https://", "http://")) else []),
            *([_link("child", f"./{_POINTS_COLLECTION}")] if run.points else []),
            *(_link("item", f"./{item_name(one['id'])}", _GEOJSON) for one in items),
        ],
        assets={
            name: {"href": href + path, **_described(words)}
            for path, (name, *words) in DOCUMENTS.items()
            if path in documents
        },
    )


def _item(key: str, run: Run, bounds: Sequence[float], *, extensions: list[str], **more: Any) -> dict[str, Any]:
    """An Item at a place in the CRS; `more` are its collection, properties, links and assets."""
    geometry, bbox = _place(bounds, run.project)
    return {
        "type": "Feature",
        "stac_version": VERSION,
        "stac_extensions": extensions,
        "id": key,
        "collection": more.pop("collection"),
        "bbox": bbox,
        "geometry": shapely.geometry.mapping(geometry),
        **more,
    }


def _collection(
    key: str, run: Run, items: Sequence[Mapping[str, Any]], *, extensions: list[str], title: str, **more: Any
) -> dict[str, Any]:
    """A Collection of Items; `more` are its description, links, and what else it has."""
    first, last = (
        order(
            (one["properties"].get(name) or one["properties"]["datetime"] for one in items),
            key=dt.datetime.fromisoformat,
        )
        for order, name in ((min, "start_datetime"), (max, "end_datetime"))
    )
    return {
        "type": "Collection",
        "stac_version": VERSION,
        "stac_extensions": extensions,
        "id": key,
        "title": title,
        "description": more.pop("description"),
        "license": run.licence,
        "extent": {
            "spatial": {"bbox": [_around([one["bbox"] for one in items])]},
            "temporal": {"interval": [[first, last]]},
        },
        **more,
    }


def _points_id(run: Run) -> str:
    """The id of the Collection of points."""
    return f"{run.name}-{POINTS}"


def _projection(bounds: Sequence[float], run: Run) -> dict[str, Any]:
    """The CRS and a place in it."""
    crs = run.manifest.crs or {}
    return {
        "proj:code": None if crs.get("epsg") is None else f"EPSG:{crs['epsg']}",
        "proj:wkt2": crs["wkt"],
        "proj:bbox": list(bounds),
    }


def _times(acquired: tuple[dt.datetime, dt.datetime] | None, run: Run) -> dict[str, str | None]:
    """When the points were measured; if that is unknown, when the models were made."""
    if acquired is None:
        return {"datetime": run.made}
    return {"datetime": None, "start_datetime": _zulu(acquired[0]), "end_datetime": _zulu(acquired[1])}


def _zulu(at: dt.datetime) -> str:
    """A time as STAC writes it: UTC, with a Z."""
    return at.astimezone(dt.UTC).isoformat().replace("+00:00", "Z")


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
