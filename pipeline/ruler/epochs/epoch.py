"""One of the two runs: its manifest, an index of all its buildings, and the records of some of them.

Only the index of the whole run is in memory, some 50 bytes per building; geometry is read for a part of the plan at a
time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as pads
import shapely

from pipeline.errors import RunError
from pipeline.export.geoparquet import table_dataset
from pipeline.io import arrow_at
from pipeline.io.crs import SpatialReference
from pipeline.model import FloatArray, IntArray
from pipeline.ruler.epochs.coverage import Coverage, coverage_of
from pipeline.ruler.epochs.roof_raster import RoofFaces
from pipeline.ruler.evaluation.building_matching import sound_polygons
from pipeline.runtime.manifest import RunManifest, RunStatus
from pipeline.runtime.manifest_reading import read_manifest

COLUMNS = (
    *("building_id", "source_id", "status", "roof_type", "geometry", "ground_z", "ridge_z", "height_m"),
    *("volume_m3", "rmse_m", "point_spacing_m", "noise_m", "ridge_z_sigma_m", "unexplained_m2"),
    *("touches_data_edge", "acquired_from", "acquired_to"),
)
"""Columns of a building that is compared."""
ROUGH_TIMES = 2.5
"""Points that scatter about a face by this many times the noise of its building come from a tree or from small things
on a roof. It decides a doubt only, never a class."""
_PLANES = ("building_id", "geometry", "origin_x", "origin_y", "origin_z", "coefficients", "rmse_m")
_BOX = ("xmin", "ymin", "xmax", "ymax")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rejected:
    """Objects that an epoch rejected as buildings, all arrays of length k."""

    boxes: FloatArray
    """(k, 4) float64, bounds in metres: west, south, east, north; nan without geometry."""
    area_m2: FloatArray
    """(k,) float64, plan area; nan if it was not measured."""
    height_m: FloatArray
    """(k,) float64, height above ground; nan if it was not measured."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Buildings:
    """Some buildings of an epoch."""

    rows: IntArray
    """(n,) int64, their places in the epoch's index, ascending."""
    table: pa.Table
    """The columns `COLUMNS` of these buildings in this order."""
    footprints: Any
    """(n,) array of shapely geometries in metres, valid; None without one."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Epoch:
    """A run that is compared."""

    name: str
    """OLD or NEW, for messages."""
    run_dir: str
    manifest: RunManifest
    reference: SpatialReference
    coverage: Coverage
    boxes: FloatArray
    """(n, 4) float64, bounds of all footprints in metres: west, south, east, north; nan without geometry."""
    files: IntArray
    """(n,) int64, the file of each building."""
    places: IntArray
    """(n,) int64, its row there."""
    rejected: Rejected
    """Objects that it rejected as buildings."""
    fragments: Sequence[Any]
    """The files of the table of buildings by their number."""
    planes: dict[str, list[Any]]
    """The files of the table of planes by tile."""
    schemas: tuple[pa.Schema, pa.Schema]
    """Schemas of the tables of buildings and of planes."""
    table: pads.Dataset

    def __len__(self) -> int:
        """Number of buildings."""
        return len(self.boxes)

    def buildings(self, rows: IntArray, columns: Sequence[str] = COLUMNS) -> Buildings:
        """The records of some buildings; `rows` in any order, each once."""
        rows = np.sort(rows)
        parts = []
        for number in np.unique(self.files[rows]).tolist():
            wanted = rows[self.files[rows] == number]
            table = _read(self.fragments[number], list(columns), self.schemas[0])
            parts.append((wanted, table.take(pa.array(self.places[wanted]))))
        table = pa.concat_tables([part for _, part in parts]) if parts else _empty(self.schemas[0], columns)
        order = np.argsort(np.concatenate([part for part, _ in parts])) if parts else np.empty(0, np.int64)
        table = table.take(pa.array(order)).combine_chunks()
        unit_m = self.reference.horizontal_unit_m
        return Buildings(rows=rows, table=table, footprints=_footprints(table["geometry"], unit_m))

    def roofs(self, buildings: Buildings) -> tuple[RoofFaces, IntArray]:
        """The roof faces of some buildings, and for each face the place of its building among them, ascending."""
        identities = buildings.table["building_id"].combine_chunks()
        parts = []
        for number in np.unique(self.files[buildings.rows]).tolist():
            for fragment in self.planes.get(_tile(self.fragments[number]), ()):
                table = _read(fragment, list(_PLANES), self.schemas[1])
                owner = pc.index_in(table["building_id"], value_set=identities)
                kept = pc.and_(pc.is_valid(owner), pc.is_valid(table["geometry"]))
                parts.append(table.append_column("owner", owner).filter(kept))
        if not parts:
            return _faces(_empty(self.schemas[1], _PLANES), np.empty(0), self.reference), np.empty(0, np.int64)
        table = pa.concat_tables(parts)
        owners = table["owner"].to_numpy().astype(np.int64)
        order = np.argsort(owners, kind="stable")
        noise_m = floats(buildings.table["noise_m"])[owners[order]]
        return _faces(table.take(pa.array(order)), noise_m, self.reference), owners[order]


def open_epoch(name: str, run_dir: str) -> Epoch:
    """Open a run for a comparison; `name` is OLD or NEW. RunError if there is no run that ended, or it is damaged."""
    manifest = read_manifest(run_dir)
    if manifest.status not in {RunStatus.FINISHED, RunStatus.INCOMPLETE}:
        raise RunError(f"{name}, the run in {run_dir}, is {manifest.status.value}: compare runs that ended")
    reference = SpatialReference.of_facts(manifest.crs)
    filesystem, path = arrow_at(run_dir)
    buildings = table_dataset(path, "buildings", filesystem)
    planes = table_dataset(path, "planes", filesystem)
    fragments = sorted(buildings.get_fragments(), key=lambda fragment: str(fragment.path))
    planes_of: dict[str, list[Any]] = {}
    for fragment in sorted(planes.get_fragments(), key=lambda fragment: str(fragment.path)):
        planes_of.setdefault(_tile(fragment), []).append(fragment)
    tables = [_read(fragment, ["bbox"], buildings.schema) for fragment in fragments]
    counts = np.array([table.num_rows for table in tables], np.int64)
    return Epoch(
        name=name,
        run_dir=run_dir,
        manifest=manifest,
        reference=reference,
        coverage=coverage_of(manifest, reference),
        boxes=_boxes(tables, reference.horizontal_unit_m),
        files=np.repeat(np.arange(len(tables)), counts),
        places=np.concatenate([np.arange(count) for count in counts]) if len(counts) else np.empty(0, np.int64),
        rejected=_rejected(table_dataset(path, "rejected", filesystem), reference.horizontal_unit_m),
        fragments=fragments,
        planes=planes_of,
        schemas=(buildings.schema, planes.schema),
        table=buildings,
    )


def _tile(fragment: Any) -> str:
    """The tile that a file belongs to."""
    return str(pads.get_partition_keys(fragment.partition_expression).get("tile"))


def _read(fragment: Any, columns: list[str], schema: pa.Schema) -> pa.Table:
    """Some columns of a file."""
    try:
        return fragment.to_table(columns=columns, schema=schema)
    except (pa.ArrowInvalid, OSError) as error:
        raise RunError(f"{fragment.path} cannot be read as Parquet: {error}") from error


def _empty(schema: pa.Schema, columns: Sequence[str]) -> pa.Table:
    return pa.schema([schema.field(name) for name in columns]).empty_table()


def _boxes(tables: Sequence[pa.Table], unit_m: float) -> FloatArray:
    """Bounds (n, 4) in metres of the column `bbox`, nan for null."""
    parts = [np.empty((0, 4))]
    for table in tables:
        column = table["bbox"].combine_chunks()
        if table.num_rows:
            parts.append(np.column_stack([floats(pc.struct_field(column, name)) for name in _BOX]))
    boxes: FloatArray = np.concatenate(parts) * unit_m
    return boxes


def floats(column: Any) -> FloatArray:
    """A column of numbers as float64, nan for null."""
    values: FloatArray = (
        column.cast(pa.float64()).to_numpy(zero_copy_only=False)
        if isinstance(column, pa.Array)
        else column.cast(pa.float64()).to_numpy()
    )
    return np.array(values, dtype=np.float64)


def _footprints(column: Any, unit_m: float) -> Any:
    """Geometries in metres; invalid ones are repaired."""
    found = shapely.from_wkb(np.array(column.to_pylist(), dtype=object))
    if unit_m != 1.0:
        found = shapely.transform(found, lambda xy: xy * unit_m)
    known = ~shapely.is_missing(found)
    found[known] = sound_polygons(found[known])
    return found


def _rejected(dataset: pads.Dataset, unit_m: float) -> Rejected:
    try:
        table = dataset.to_table(columns=["bbox", "area_m2", "height_m"])
    except (pa.ArrowInvalid, OSError) as error:
        raise RunError(f"rejected cannot be read as Parquet: {error}") from error
    return Rejected(boxes=_boxes([table], unit_m), area_m2=floats(table["area_m2"]), height_m=floats(table["height_m"]))


def _faces(table: pa.Table, noise_m: FloatArray, reference: SpatialReference) -> RoofFaces:
    """Rows of the table of planes as faces in metres; `noise_m` (f,) is that of their buildings, nan if unknown."""
    horizontal, vertical = reference.horizontal_unit_m, reference.vertical_unit_m
    geometries = shapely.force_2d(shapely.from_wkb(np.array(table["geometry"].to_pylist(), dtype=object)))
    polygons, face_of = shapely.get_parts(geometries, return_index=True)
    rings, polygon_of = shapely.get_rings(polygons, return_index=True)
    xy, ring_of = shapely.get_coordinates(rings, return_index=True)
    coefficients = table["coefficients"].combine_chunks().flatten().to_numpy(zero_copy_only=False).reshape(-1, 4)
    rise_x, rise_y, up, offset = coefficients.T
    planes = np.column_stack(
        [
            floats(table["origin_x"]) * horizontal,
            floats(table["origin_y"]) * horizontal,
            (floats(table["origin_z"]) - offset / up) * vertical,
            -rise_x / up * vertical / horizontal,
            -rise_y / up * vertical / horizontal,
        ]
    )
    return RoofFaces(
        xy=xy * horizontal,
        rings=_starts(ring_of, len(rings)),
        faces=_starts(face_of[polygon_of], table.num_rows),
        planes=planes,
        is_rough=floats(table["rmse_m"]) > ROUGH_TIMES * noise_m,
    )


def _starts(index: IntArray, count: int) -> IntArray:
    """Start of each of `count` in an ascending index, and the end: (count + 1,)."""
    starts: IntArray = np.searchsorted(index, np.arange(count + 1)).astype(np.int64)
    return starts
