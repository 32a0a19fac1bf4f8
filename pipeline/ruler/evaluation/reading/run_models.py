"""A run directory, or the truth that `simulate` writes: tables for roof faces, CityJSONSeq for solids."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.errors import RunError, UnreadableInputError
from pipeline.export.geoparquet import read_table
from pipeline.export.stored_coordinates import one_unit
from pipeline.io import arrow_at, is_url, place_below, storage_at
from pipeline.io.crs_resolution import resolve_reference
from pipeline.io.places import file_at
from pipeline.model import FaceKind, RoofType, Solid, SolidFace, Status
from pipeline.ruler.evaluation.models import ModelSet, RoofModel, RoofSurface
from pipeline.ruler.evaluation.reading.cityjson_geometry import chosen, parts_of
from pipeline.ruler.evaluation.reading.cityjson_models import features
from pipeline.ruler.evaluation.reading.collected import Collected
from pipeline.ruler.evaluation.reading.model_surfaces import GRID_M
from pipeline.ruler.evaluation.reading.raw import MILLIMETRES_PER_METRE, RawPart
from pipeline.runtime.manifest import NAME, RunStatus
from pipeline.runtime.manifest_reading import city_unit_m, read_manifest

_CONDITIONS = "conditions.parquet"
Solids = dict[str, tuple[tuple[Solid, ...], tuple[float, float, float]]]


def is_run(place: str | Path) -> bool:
    """Whether a folder or URL is a run directory, or laid out like one."""
    if not is_url(place):
        path = Path(place)
        return path.is_dir() and ((path / NAME).is_file() or (path / "buildings").is_dir())
    storage = storage_at(place)
    return storage.has(NAME) or bool(storage.keys("buildings"))


def read_run(place: str | Path) -> ModelSet:
    """The buildings of a run directory, or of the truth that `simulate` writes, in metres.

    Raises RunError if the tables are missing or damaged, and InputError if CityJSONSeq or conditions are damaged.
    """
    into = Collected()
    horizontal_m, vertical_m, city_m = _units_m(place, into)
    units_m = horizontal_m, vertical_m
    filesystem, folder = arrow_at(place)
    rows = read_table(folder, "buildings", filesystem).to_pylist()
    surfaces = _surfaces(place, units_m)
    solids = _solids(place, (horizontal_m, city_m), into)
    for row in rows:
        shapes, origin = solids.get(row["building_id"], ((), (0.0, 0.0, 0.0)))
        into.add(
            RoofModel(
                building_id=row["building_id"],
                footprint=_in_metres(row["geometry"], units_m),
                roof_type=RoofType(row["roof_type"]),
                surfaces=tuple(surfaces.get(row["building_id"], ())),
                touches_data_edge=row["touches_data_edge"],
                source_id=row["source_id"],
                status=Status(row["status"]),
                lod=row["lod"] or "",
                solids=shapes,
                solid_origin=origin,
            )
        )
    methods = sorted({row["method"] for row in rows})
    into.has_footprints = any(row["source_id"] is not None for row in rows)
    return into.finish(name=" and ".join(methods) or _method(place), kind="run", path=str(place))


def _method(place: str | Path) -> str:
    """The method of a run that has no record."""
    return read_manifest(place).method if storage_at(place).has(NAME) else PurePosixPath(place).name


def _units_m(place: str | Path, into: Collected) -> tuple[float, float, float]:
    """Metres per horizontal unit, per vertical unit, and per vertical unit of the solids' CityJSON.

    From run.json, else from the metadata of the tables.
    """
    storage = storage_at(place)
    if storage.has(NAME):
        manifest = read_manifest(place)
        into.note(f"made by gablework {manifest.engine_version} with settings {manifest.settings_hash[:12]}")
        if manifest.status is not RunStatus.FINISHED:
            into.note(f"the run is {manifest.status.value}: not all of its buildings may be there")
        crs: Mapping[str, Any] = manifest.crs or {}
        if crs.get("wkt"):
            into.is_at(f"EPSG:{crs['epsg']}" if crs.get("epsg") else str(crs.get("name")))
        return float(crs.get("horizontal_unit_m", 1.0)), float(crs.get("vertical_unit_m", 1.0)), city_unit_m(crs)
    key = next((key for key in storage.keys("buildings") if key.endswith(".parquet")), None)
    if key is None:
        return 1.0, 1.0, 1.0
    part = place_below(place, key)
    filesystem, file = arrow_at(part)
    try:
        metadata = pq.read_schema(file, filesystem=filesystem).metadata or {}
        projjson = json.loads(metadata.get(b"geo", b"{}")).get("columns", {}).get("geometry", {}).get("crs")
    except (pa.ArrowInvalid, OSError, ValueError) as error:
        raise UnreadableInputError(part, str(error), "Write the folder again") from error
    if projjson is None:
        into.note("no coordinate reference system in the tables: coordinates are taken as metres")
        return 1.0, 1.0, 1.0
    import pyproj

    reference, _ = resolve_reference(path=part, header_crs=pyproj.CRS.from_json_dict(projjson))
    into.is_at(reference.name if reference.epsg is None else f"EPSG:{reference.epsg}")
    return reference.horizontal_unit_m, reference.vertical_unit_m, one_unit(reference).vertical_unit_m


def _in_metres(wkb: bytes | None, units_m: tuple[float, float]) -> Polygon | MultiPolygon:
    """A geometry of the tables in plan, metres; empty without one."""
    if wkb is None:
        return Polygon()
    geometry = shapely.force_2d(shapely.from_wkb(wkb))
    if units_m[0] == 1.0:
        return geometry
    return shapely.transform(geometry, lambda xy: np.round(xy * units_m[0], 3))


def _surfaces(place: str | Path, units_m: tuple[float, float]) -> dict[str, list[RoofSurface]]:
    """Roof faces by building, in the order of their planes. Touching pieces of one plane are one face."""
    horizontal, vertical = units_m
    groups = _groups(place)
    filesystem, folder = arrow_at(place)
    surfaces: dict[str, list[RoofSurface]] = {}
    for row in read_table(folder, "planes", filesystem).to_pylist():
        if not row["geometry"]:
            continue
        normal_x, normal_y, normal_z, offset = row["coefficients"]
        if not (math.isfinite(sum(row["coefficients"])) and normal_z > 0.0):
            raise RunError(
                f"{place}: plane {row['plane_id']} of {row['building_id']} has the coefficients {row['coefficients']}: "
                "a roof plane looks up. Write the run again"
            )
        geometry = _in_metres(row["geometry"], units_m)
        pieces = shapely.get_parts(geometry)
        if len(pieces) > 1:
            pieces = shapely.get_parts(shapely.union_all(pieces, grid_size=GRID_M))
        building, plane_id = row["building_id"], row["plane_id"]
        group = groups.get(building, ())
        for polygon in pieces.tolist():
            surfaces.setdefault(building, []).append(
                RoofSurface(
                    polygon=polygon,
                    coefficients=(
                        -normal_x / normal_z * vertical / horizontal,
                        -normal_y / normal_z * vertical / horizontal,
                        -offset / normal_z * vertical,
                    ),
                    origin=(row["origin_x"] * horizontal, row["origin_y"] * horizontal, row["origin_z"] * vertical),
                    plane_id=plane_id,
                    group=group[plane_id] if plane_id < len(group) else -1,
                )
            )
    return surfaces


def _groups(place: str | Path) -> dict[str, list[int]]:
    """The groups of the planes of each building, from the truth; empty without them."""
    if not storage_at(place).has(_CONDITIONS):
        return {}
    table = place_below(place, _CONDITIONS)
    filesystem, file = arrow_at(table)
    try:
        rows = pq.read_table(file, columns=["building_id", "groups"], filesystem=filesystem).to_pylist()
    except (pa.ArrowInvalid, OSError) as error:
        raise UnreadableInputError(table, str(error), "Simulate the data set again") from error
    return {row["building_id"]: row["groups"] for row in rows}


def _solids(place: str | Path, units_m: tuple[float, float], into: Collected) -> Solids:
    """Solids by building, each with its origin."""
    keys = [key for key in storage_at(place).keys("cityjson") if key.endswith(".city.jsonl")]
    if not keys:
        into.note("no folder cityjson in the run: solids are unknown")
        return {}
    found: Solids = {}
    ignored = Collected()
    for key in keys:
        file = file_at(place_below(place, key))
        for feature, places, where in features(file, ignored, units_m):
            try:
                name = feature["id"]
                objects = feature["CityObjects"].values()
                geometries, _ = chosen((), [entry.get("geometry") or () for entry in objects], places)
                parts = [part for geometry in geometries for part in parts_of(geometry, places) if part.is_solid]
            except (KeyError, TypeError, ValueError, IndexError, AttributeError) as fault:
                raise UnreadableInputError(
                    str(file), f"{where}{fault!r}", "The run directory is damaged: run it again"
                ) from fault
            if parts:
                found[name] = _about_origin(parts)
    return found


def _about_origin(parts: list[RawPart]) -> tuple[tuple[Solid, ...], tuple[float, float, float]]:
    """Solids about an origin in whole metres."""
    low = np.min([part.xyz.min(axis=0) for part in parts], axis=0)
    origin = (float(math.floor(low[0])), float(math.floor(low[1])), float(math.floor(low[2])))
    solids = tuple(
        Solid(
            vertices=np.rint((part.xyz - origin) * MILLIMETRES_PER_METRE) / MILLIMETRES_PER_METRE,
            faces=tuple(
                SolidFace(rings=face.rings, kind=face.kind or FaceKind.WALL, plane=face.plane) for face in part.faces
            ),
        )
        for part in parts
    )
    return solids, origin
