"""One building of a job: its record with its planes, its mesh, its city object."""

from __future__ import annotations

import dataclasses
import json
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pipeline.export.folders import POINTS_FOLDER
from pipeline.export.solid_geometry import OVERHANGS
from pipeline.extras.octree.building_points import building_points
from pipeline.extras.octree.point_files import TILESET
from pipeline.extras.publish.obj_parts import lines_of_buildings
from service.errors import NoSuchBuildingError, NoSuchOutputError
from service.outputs.building_index import FEATURES_NAME
from service.outputs.building_pages import GONE, opened_index
from service.outputs.single_glb import cut_glb

ID_PATTERN = "^[a-z2-7]{24}$"
"""Pattern of a building_id."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StoredBuilding:
    """The parts of one building, and where its files are."""

    building_id: str
    """The building."""
    tile: str
    """Its owner tile."""
    mesh_path: str | None
    """Its OBJ or GLB file, relative to the run directory; None without one."""
    feature: dict[str, Any]
    """Its GeoJSON feature."""
    planes: list[dict[str, Any]]
    """Its rows of the planes table without geometry."""
    city_start: int
    """Start of its line in the tile's CityJSONSeq file, in bytes."""
    city_size: int
    """Bytes of the line."""


def stored_building(out_dir: Path, building_id: str, *, native: bool = False) -> StoredBuilding:
    """Look up one building.

    Parameters
    ----------
    out_dir : Path
        The folder of outputs.
    building_id : str
        As a client gave it.
    native : bool
        Whether the feature gets the tiles' own coordinates.

    Raises
    ------
    NoSuchBuildingError
        No building has this id.
    NoSuchOutputError
        The outputs are gone.
    """
    row = None
    if re.fullmatch(ID_PATTERN, building_id):
        with opened_index(out_dir) as connection:
            row = connection.execute(
                "SELECT tile.name, mesh_path, start, size, native, city_start, city_size, planes"
                " FROM key JOIN building USING (place) JOIN tile ON tile.tile = key.tile WHERE key.building_id = ?",
                (building_id,),
            ).fetchone()
    if row is None:
        raise NoSuchBuildingError(f"the results of this job hold no building {building_id[:80]!r}")
    tile, mesh_path, start, size, geometry, city_start, city_size, planes = row
    try:
        with (out_dir / FEATURES_NAME).open("rb") as stream:
            stream.seek(start)
            feature: dict[str, Any] = json.loads(stream.read(size))
    except FileNotFoundError:
        raise NoSuchOutputError(GONE) from None
    if native:
        feature["geometry"] = json.loads(geometry)
    return StoredBuilding(
        building_id=building_id,
        tile=tile,
        mesh_path=mesh_path,
        feature=feature,
        planes=json.loads(zlib.decompress(planes)),
        city_start=city_start,
        city_size=city_size,
    )


def building_decisions(out_dir: Path, building_id: str) -> list[dict[str, Any]]:
    """What was checked and tried for one building, in this order; empty if its process ended before.

    Raises
    ------
    NoSuchBuildingError
        No building has this id.
    NoSuchOutputError
        The outputs are gone, or were made by a version that recorded no decisions.
    """
    with opened_index(out_dir) as connection:
        (recorded,) = connection.execute("SELECT count(*) FROM sqlite_master WHERE name = 'decision'").fetchone()
        if not recorded:
            raise NoSuchOutputError("this job was made by a version that recorded no decisions: submit it again")
        row = connection.execute(
            "SELECT entries FROM key LEFT JOIN decision USING (place) WHERE building_id = ?", (building_id,)
        ).fetchone()
    if row is None:
        raise NoSuchBuildingError(f"the results of this job hold no building {building_id[:80]!r}")
    entries: list[dict[str, Any]] = [] if row[0] is None else json.loads(zlib.decompress(row[0]))
    return entries


def building_obj(run_dir: Path, building: StoredBuilding, lod: str | None = None) -> Iterator[str]:
    """The lines of a building's OBJ, also if one file holds a whole tile; in the record's level of detail or `lod`.

    Raises
    ------
    NoSuchBuildingError
        It has no model, the job was requested without OBJ files or in another level of detail, or its file is gone.
    """
    path = _mesh_file(run_dir, building, "obj", lod)

    def lines() -> Iterator[str]:
        with path.open(encoding="ascii") as stream:
            yield from lines_of_buildings((line.rstrip("\n") for line in stream), [building.building_id])

    return lines()


def building_glb(run_dir: Path, building: StoredBuilding, lod: str | None = None) -> bytes:
    """A building's GLB, cut out of the file of its tile; in the record's level of detail or `lod`.

    Raises
    ------
    NoSuchBuildingError
        It has no model, the job was requested without GLB files or in another level of detail, or its file is gone.
    """
    path = _mesh_file(run_dir, building, "glb", lod)
    content = cut_glb(path, building.building_id)
    if content is None:
        raise NoSuchBuildingError(f"{path.name} holds no building {building.building_id}: submit the job again")
    return content


def _mesh_file(run_dir: Path, building: StoredBuilding, wanted: str, lod: str | None) -> Path:
    """The file of a building's mesh, of one kind and level of detail; the record's for None.

    Raises
    ------
    NoSuchBuildingError
        There is none of this kind or level.
    """
    name, properties = building.building_id, building.feature["properties"]
    own_lod = properties["lod"]
    if building.mesh_path is None:
        if own_lod is None:
            why = properties["reason"]
            raise NoSuchBuildingError(f"building {name} has no model ({why}), so it has no mesh")
        raise NoSuchBuildingError(f"the request left out the meshes: use CityJSON for building {name}")
    kind = building.mesh_path.rpartition(".")[2]
    if kind != wanted:
        problem = f"this job has meshes as {kind.upper()}, not as {wanted.upper()}"
        raise NoSuchBuildingError(f"{problem}: request building {name} with f={kind}")
    path = run_dir / building.mesh_path
    if lod not in {None, own_lod}:
        # named by pipeline.export.tile.mesh_path
        other = path.with_stem(f"{path.stem}-lod{str(lod).replace('.', '')}")
        # the file of a level has the next coarser model of buildings that are not modelled in it
        finest = own_lod if properties.get("overhang_source") is None else OVERHANGS
        if not other.is_file() or str(lod) > finest:
            raise NoSuchBuildingError(f"building {name} has no mesh in LoD{lod}; its own is in LoD{own_lod}")
        return other
    if not path.is_file():
        raise NoSuchBuildingError(f"the mesh of building {name} is no longer in the state folder: submit the job again")
    return path


def points_of_building(run_dir: Path, building: StoredBuilding) -> bytes:
    """The points from which a building was modelled, as a GLB file.

    Raises
    ------
    NoSuchBuildingError
        The job was requested without points, or their files are gone.
    """
    name, folder = building.building_id, run_dir / POINTS_FOLDER
    if not (folder / TILESET).is_file():
        raise NoSuchBuildingError(f"the results hold no points, so none of building {name}: request points")
    try:
        found = building_points(lambda path: (folder / path).read_bytes(), building.tile, name)
    except FileNotFoundError:
        raise NoSuchBuildingError(
            f"points of building {name} are missing in the results: submit the job again"
        ) from None
    if found is None:
        raise NoSuchBuildingError(f"building {name} has no points")
    return found


def cityjson_path(run_dir: Path, tile: str) -> Path:
    """The CityJSONSeq file of a tile."""
    return run_dir / "cityjson" / f"tile={tile}" / "part-0.city.jsonl"


def building_cityjson(run_dir: Path, building: StoredBuilding) -> dict[str, Any]:
    """A complete CityJSON document of one building: its objects, vertices, transform and extent.

    Raises
    ------
    NoSuchBuildingError
        Its file is gone.
    """
    path = cityjson_path(run_dir, building.tile)
    try:
        with path.open("rb") as stream:
            document: dict[str, Any] = json.loads(stream.readline())
            stream.seek(building.city_start)
            feature = json.loads(stream.read(building.city_size))
    except FileNotFoundError:
        raise NoSuchBuildingError(
            f"the model of building {building.building_id} is no longer in the state folder: submit the job again"
        ) from None
    metadata = {**document["metadata"], "title": f"building {building.building_id}"}
    metadata.pop("geographicalExtent", None)
    if feature["vertices"]:
        scale, translate = document["transform"]["scale"], document["transform"]["translate"]
        corners = [
            (extreme(vertex[axis] for vertex in feature["vertices"]) * scale[axis] + translate[axis])
            for extreme in (min, max)
            for axis in range(3)
        ]
        metadata["geographicalExtent"] = [round(corner, 6) for corner in corners]
    return {
        **document,
        "metadata": metadata,
        "CityObjects": feature["CityObjects"],
        "vertices": feature["vertices"],
    }
