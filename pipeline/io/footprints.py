"""Building footprints from GeoPackage, GeoJSON or Shapefile, in metres of the run's CRS."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.errors import CrsError, EmptyInputError, InconsistentInputError, UnreadableInputError
from pipeline.io.crs import SpatialReference, horizontal_part, horizontal_unit_of, parse_crs
from pipeline.io.formats import first_bytes

if TYPE_CHECKING:
    import pyproj

ID_COLUMNS = (
    "building_id",
    "source_id",
    "identificatie",
    "gml_id",
    "bgt_id",
    "bag_id",
    "osm_id",
    "cleabs",
    "id",
    "globalid",
    "uuid",
    "fid",
    "ogc_fid",
    "objectid",
)
"""Columns that hold a building's own id, in this order; one with gaps or repeats is passed over."""

VALID = "Valid are GeoPackage (.gpkg), GeoJSON (.geojson, .json) and Shapefile (.shp with .shx and .dbf)"
DRIVERS = {b"SQLi": "GPKG:", b"\0\0\x27\x0a": ""}
"""How GDAL is told the format, by a file's first bytes; text in braces is GeoJSON. Left to itself GDAL goes by content,
and there are formats that name other files and servers to read. Shapefiles have no such prefix and no such twins."""
ACCURACY_LIMIT_M = 0.5
"""A coarser reprojection is told."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Footprints:
    """Given outlines of buildings. All tuples have one length."""

    ids: tuple[str, ...]
    """The buildings' own ids, each once."""
    polygons: tuple[Polygon | MultiPolygon, ...]
    """2D, valid, in metres of the run's CRS."""
    attributes: tuple[dict[str, Any], ...]
    """All columns by name, plain Python values, dates as ISO 8601; None where empty."""
    warnings: tuple[str, ...] = ()
    """What was repaired, left out or assumed, one sentence each."""

    def __len__(self) -> int:
        """Number of footprints."""
        return len(self.ids)


def read_footprints(
    path: str | Path,
    reference: SpatialReference,
    *,
    layer: str | None = None,
    id_column: str | None = None,
    crs: str | None = None,
) -> Footprints:
    """Footprints of a vector file, reprojected where its CRS is not the run's.

    Parameters
    ----------
    path : str or Path
        GeoPackage, GeoJSON (WGS 84 unless it says otherwise) or Shapefile.
    reference : SpatialReference
        The run's CRS and units.
    layer : str, optional
        The layer; needed where a file has several with polygons.
    id_column : str, optional
        The column of ids; None to look for the common names, then for the file's own feature id.
    crs : str, optional
        Stands above the file's CRS.

    Raises
    ------
    UnreadableInputError
        If the file cannot be read as vector data, or the layer or column is not there.
    InconsistentInputError
        If the ids of a named column are empty or not unique, or coordinates are not finite.
    EmptyInputError
        If it has no polygons.
    CrsError
        If its coordinates are degrees and the run's CRS is unknown, or a CRS is not understood.
    """
    name = str(path)
    told: list[str] = []
    meta, fids, wkb, columns = _read_layer(Path(path), layer)
    geometries = _polygons_only(name, wkb, told)
    kept = np.flatnonzero([geometry is not None for geometry in geometries])
    if len(kept) == 0:
        raise EmptyInputError(name, f"none of the {len(wkb)} features is a polygon", "Give polygons of buildings")
    polygons = shapely.force_2d(geometries[kept])
    polygons = _in_metres(name, polygons, meta["crs"] if crs is None else crs, reference, told)
    polygons = _repaired(polygons, told)
    solid = ~shapely.is_empty(polygons)
    polygons, kept = polygons[solid], kept[solid]
    if len(kept) == 0:
        raise EmptyInputError(name, "no polygon has an area", "Give polygons of buildings")
    fields = [str(field) for field in meta["fields"]]
    table = {field: [_plain(value) for value in column[kept]] for field, column in zip(fields, columns, strict=True)}
    return Footprints(
        ids=_ids(name, table, fids[kept], id_column),
        polygons=tuple(polygons.tolist()),
        attributes=tuple({field: table[field][row] for field in fields} for row in range(len(kept))),
        warnings=tuple(told),
    )


def _read_layer(path: Path, layer: str | None) -> tuple[dict[str, Any], npt.NDArray[Any], npt.NDArray[Any], list[Any]]:
    """Facts, feature ids, WKB and columns of the one layer with polygons, or of the named one."""
    import pyogrio
    from pyogrio.errors import DataLayerError, DataSourceError, FieldError, GeometryError

    source = _told_apart(path)
    try:
        layers = {str(name): kind for name, kind in pyogrio.list_layers(source)}
        if layer is None:
            # The kind is None for tables without geometry and "Unknown" where a layer does not say.
            found = [name for name, kind in layers.items() if kind and ("Polygon" in kind or "Unknown" in kind)]
            found = found or [name for name, kind in layers.items() if kind]
        else:
            found = [name for name in layers if name == layer]
        if len(found) != 1:
            raise UnreadableInputError(
                str(path),
                f"layer {layer!r} is not there" if layer else f"{len(found)} layers could be the footprints",
                f"Name one of the layers {', '.join(sorted(layers)) or '(there are none)'}",
            )
        meta, fids, wkb, columns = pyogrio.raw.read(source, layer=found[0], return_fids=True)
    except (DataSourceError, DataLayerError, FieldError, GeometryError, OSError) as fault:
        raise UnreadableInputError(str(path), f"cannot be read as vector data ({str(fault)[:160]})", VALID) from fault
    return meta, fids, wkb, columns


def _told_apart(path: Path) -> str:
    """The path as GDAL is given it: with the one format that it may be.

    Raises
    ------
    UnreadableInputError
        If it is none of the three.
    """
    head = first_bytes(path)
    where = path.resolve().as_posix()
    if head.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{"):
        return f"GeoJSON:{where}"
    driver = next((name for magic, name in DRIVERS.items() if head.startswith(magic)), None)
    if driver is None:
        raise UnreadableInputError(str(path), f"cannot be read as vector data: it begins with {head[:8]!r}", VALID)
    return f"{driver}{where}"


def _polygons_only(name: str, wkb: npt.NDArray[Any], told: list[str]) -> npt.NDArray[np.object_]:
    """Geometries, None where a feature is no polygon."""
    geometries: npt.NDArray[np.object_] = shapely.from_wkb(wkb)
    kinds = shapely.get_type_id(geometries)
    polygonal = np.isin(kinds, (shapely.GeometryType.POLYGON, shapely.GeometryType.MULTIPOLYGON))
    polygonal &= ~shapely.is_empty(geometries)
    if not polygonal.all():
        told.append(f"{int((~polygonal).sum())} features are no polygons and are left out")
    if not np.isfinite(shapely.bounds(geometries[polygonal])).all():
        raise InconsistentInputError(name, "a footprint has coordinates that are NaN or infinite", "Repair the file")
    geometries[~polygonal] = None
    return geometries


def _in_metres(
    name: str, polygons: npt.NDArray[np.object_], crs: str | None, reference: SpatialReference, told: list[str]
) -> npt.NDArray[np.object_]:
    """The polygons in metres of the run's CRS."""
    own, target = None if crs is None else horizontal_part(parse_crs(crs, path=name)), reference.horizontal_crs
    if own is None:
        told.append("the footprints have no CRS: that of the points is assumed")
    elif target is None:
        # Raises where the footprints are in degrees: metres and degrees cannot meet.
        if not math.isclose(horizontal_unit_of(own, path=name), reference.horizontal_unit_m, rel_tol=1e-9):
            raise CrsError(
                name,
                f"the footprints are in {own.name!r} and the points' CRS is unknown, with another unit",
                "Give --crs for the points",
            )
        told.append(f"the points' CRS is unknown: that of the footprints, {own.name!r}, is assumed to be the same")
    elif not own.equals(target, ignore_axis_order=True):
        polygons = _reprojected(name, polygons, own, target, told)
    if reference.horizontal_unit_m == 1.0:
        return polygons
    scaled: npt.NDArray[np.object_] = shapely.transform(polygons, lambda xy: xy * reference.horizontal_unit_m)
    return scaled


def _reprojected(
    name: str, polygons: npt.NDArray[np.object_], own: pyproj.CRS, target: pyproj.CRS, told: list[str]
) -> npt.NDArray[np.object_]:
    """The polygons in another CRS, with a word on how well that can be done."""
    import pyproj

    transformer = pyproj.Transformer.from_crs(own, target, always_xy=True)

    def project(xy: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.column_stack(transformer.transform(xy[:, 0], xy[:, 1]))

    moved: npt.NDArray[np.object_] = shapely.transform(polygons, project)
    if not np.isfinite(shapely.bounds(moved)).all():
        raise CrsError(
            name,
            f"the footprints cannot be reprojected from {own.name!r} to {target.name!r}: they lie outside its area",
            "Check the CRS of the footprints and that of the points",
        )
    # Of the operations that PROJ weighs, the one that it used for these points.
    accuracy_m = transformer.get_last_used_operation().accuracy
    if accuracy_m is None or not 0.0 <= accuracy_m <= ACCURACY_LIMIT_M:
        good_to = (
            "an unknown accuracy" if accuracy_m is None or accuracy_m < 0.0 else f"an accuracy of {accuracy_m:g} m"
        )
        told.append(f"the footprints are reprojected from {own.name!r} to {target.name!r} with {good_to}")
    else:
        told.append(f"the footprints are reprojected from {own.name!r} to {target.name!r}")
    return moved


def _repaired(polygons: npt.NDArray[np.object_], told: list[str]) -> npt.NDArray[np.object_]:
    """Valid polygons; what a repair leaves of lines and points is left out, and what has no area is empty."""
    invalid = np.flatnonzero(~shapely.is_valid(polygons))
    repaired = polygons.copy()
    for at in invalid.tolist():
        parts = shapely.get_parts(shapely.get_parts(shapely.make_valid(polygons[at])))
        areas = [part for part in parts if isinstance(part, Polygon) and part.area > 0.0]
        repaired[at] = areas[0] if len(areas) == 1 else MultiPolygon(areas)
    if len(invalid):
        n_lost = int(shapely.is_empty(repaired[invalid]).sum())
        told.append(f"{len(invalid)} footprints are invalid: {n_lost} without area are left out, the others repaired")
    return repaired


def _ids(name: str, table: dict[str, list[Any]], fids: npt.NDArray[Any], id_column: str | None) -> tuple[str, ...]:
    """The ids, of a column or the file's own feature ids."""
    if id_column is not None:
        if id_column not in table:
            raise UnreadableInputError(
                name, f"column {id_column!r} is not there", f"Name one of the columns {', '.join(table) or '(none)'}"
            )
        if not _identifies(table[id_column]):
            raise InconsistentInputError(
                name, f"the ids in column {id_column!r} are empty or not unique", "Name another column, or none"
            )
        return tuple(str(value) for value in table[id_column])
    by_lower = {field.lower(): field for field in reversed(list(table))}
    for common in ID_COLUMNS:
        field = by_lower.get(common)
        if field is not None and _identifies(table[field]):
            return tuple(str(value) for value in table[field])
    return tuple(str(int(fid)) for fid in fids)


def _identifies(values: list[Any]) -> bool:
    """Whether values are whole numbers or text, without gaps, each once."""
    return all(isinstance(value, int | str) and value != "" for value in values) and len(set(map(str, values))) == len(
        values
    )


def _plain(value: Any) -> Any:
    """A plain Python value: None for what is empty, ISO 8601 for dates."""
    if isinstance(value, np.datetime64):
        return None if np.isnat(value) else str(value)
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and math.isnan(value):
        return None
    if isinstance(value, np.ndarray):
        return [_plain(item) for item in value]
    return value


def read_area(path: str | Path, reference: SpatialReference) -> Polygon | MultiPolygon:
    """The area of interest that the polygons of a vector file cover together, in the units of the run's CRS.

    Raises
    ------
    InputError
        As `read_footprints`.
    """
    polygons = list(read_footprints(path, reference).polygons)
    united = shapely.union_all(polygons)
    if reference.horizontal_unit_m != 1.0:
        united = shapely.transform(united, lambda xy: xy / reference.horizontal_unit_m)
    assert isinstance(united, Polygon | MultiPolygon)
    return united
