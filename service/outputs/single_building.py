"""One building of a job: its record with its planes, its mesh, its city object."""

from __future__ import annotations

import dataclasses
import json
import re
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pipeline.export.folders import POINTS_FOLDER
from pipeline.export.solid_geometry import OVERHANGS
from pipeline.extras.octree.building_points import building_points
from pipeline.extras.octree.point_files import TILESET
from pipeline.extras.publish.obj_parts import lines_of_buildings
from service.errors import NoSuchBuildingError, NoSuchOutputError
from service.features.index import GONE, NAME, RowIndex
from service.features.pages import properties
from service.outputs.single_glb import cut_glb

ID_PATTERN = "^[a-z2-7]{24}$"
"""Pattern of a building_id."""
SO_FAR_CITY = "city.jsonl"
"""The city objects of a run that goes on: for each building its metadata on one line, its feature on the next."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StoredBuilding:
    """The parts of one building, and where its files are."""

    building_id: str
    """The building."""
    position: int
    """Its position in the index."""
    properties: dict[str, Any]
    """Its columns."""
    planes: list[dict[str, Any]]
    """Its rows of the planes table without geometry."""

    @property
    def tile(self) -> str:
        """Its owner tile."""
        return str(self.properties["tile"])

    @property
    def mesh_path(self) -> str | None:
        """Its OBJ or GLB file, relative to the run directory; None without one."""
        found: str | None = self.properties["mesh_path"]
        return found


def stored_building(index: RowIndex, building_id: str) -> StoredBuilding:
    """Look up one building by an id as a client gave it.

    Raises
    ------
    NoSuchBuildingError
        No building has this id.
    NoSuchOutputError
        The index is gone.
    """
    if re.fullmatch(ID_PATTERN, building_id):
        with index.opened() as connection:
            found = _rows(index, connection, "buildings", "id = ?", building_id)
            if found:
                # a dot and a number follow the id of the building
                within = (f"{building_id}.", f"{building_id}/")
                planes = _rows(index, connection, "planes", "id > ? AND id < ?", *within)
                ((position, columns),) = found
                return StoredBuilding(
                    building_id=building_id,
                    position=position,
                    properties=columns,
                    planes=[
                        {name: value for name, value in plane.items() if name not in {"building_id", "tile"}}
                        for _, plane in sorted(planes, key=lambda entry: entry[1]["plane_id"])
                    ],
                )
    raise NoSuchBuildingError(f"the results of this job hold no building {building_id[:80]!r}")


def _rows(
    index: RowIndex, connection: sqlite3.Connection, table: str, where: str, *values: str
) -> list[tuple[int, dict[str, Any]]]:
    """Positions and properties of some rows."""
    kinds = index.kinds(table)
    columns = ", ".join(f'"{name}"' for name in kinds)
    rows = connection.execute(f"SELECT position, {columns} FROM {table} WHERE {where}", values)  # noqa: S608 - our own words
    return [(position, properties(kinds, row)) for position, *row in rows]


def building_decisions(run_dir: Path, building: StoredBuilding) -> list[dict[str, Any]]:
    """What was checked and tried for one building, in this order; empty if its process ended before.

    Raises
    ------
    NoSuchOutputError
        The files are gone, or the job was made by a version that recorded no decisions.
    """
    import pyarrow.parquet as pq

    from pipeline.export.decisions import decisions_path

    path = run_dir / decisions_path(building.tile)
    if not path.is_file():
        raise NoSuchOutputError("this job was made by a version that recorded no decisions: submit it again")
    found = pq.read_table(path, filters=[("building_id", "=", building.building_id)], partitioning=None)
    rows: list[dict[str, Any]] = found.drop_columns(["building_id"]).to_pylist()
    return rows


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
    name, columns = building.building_id, building.properties
    own_lod = columns["lod"]
    if building.mesh_path is None:
        if own_lod is None:
            why = columns["reason"]
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
        finest = own_lod if columns.get("overhang_source") is None else OVERHANGS
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


def building_cityjson(run_dir: Path, building: StoredBuilding) -> dict[str, Any]:
    """A complete CityJSON document of one building of a finished run.

    Raises
    ------
    NoSuchBuildingError
        Its file is gone.
    """
    path = run_dir / "cityjson" / f"tile={building.tile}" / "part-0.city.jsonl"
    wanted = f'"{building.building_id}"'.encode()
    try:
        with path.open("rb") as stream:
            header = stream.readline()
            for line in stream:
                if wanted in line and json.loads(line)["id"] == building.building_id:
                    return city_document(json.loads(header), json.loads(line))
    except FileNotFoundError:
        pass
    raise NoSuchBuildingError(
        f"the model of building {building.building_id} is no longer in the state folder: submit the job again"
    )


def cityjson_so_far(folder: Path, building: StoredBuilding) -> dict[str, Any]:
    """The same of a building of a run that goes on; raises NoSuchOutputError if the files are gone."""
    with RowIndex(folder / NAME).opened() as connection:
        query = "SELECT start, size FROM city WHERE id = ?"
        start, size = connection.execute(query, (building.building_id,)).fetchone()
    try:
        with (folder / SO_FAR_CITY).open("rb") as stream:
            stream.seek(start)
            header, feature = stream.read(size).splitlines()
    except FileNotFoundError:
        raise NoSuchOutputError(GONE) from None
    return city_document(json.loads(header), json.loads(feature))


def city_document(header: dict[str, Any], feature: dict[str, Any]) -> dict[str, Any]:
    """A CityJSON document of one feature of a sequence: its objects, vertices, transform and extent."""
    metadata = {**header["metadata"], "title": f"building {feature['id']}"}
    metadata.pop("geographicalExtent", None)
    if feature["vertices"]:
        scale, translate = header["transform"]["scale"], header["transform"]["translate"]
        corners = [
            (extreme(vertex[axis] for vertex in feature["vertices"]) * scale[axis] + translate[axis])
            for extreme in (min, max)
            for axis in range(3)
        ]
        metadata["geographicalExtent"] = [round(corner, 6) for corner in corners]
    return {**header, "metadata": metadata, "CityObjects": feature["CityObjects"], "vertices": feature["vertices"]}
