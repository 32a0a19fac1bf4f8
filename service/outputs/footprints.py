"""Footprints as GeoJSON: the transformation to WGS 84, and one feature per building."""

from __future__ import annotations

import dataclasses
import datetime as dt
import json
from collections.abc import Mapping, Sequence
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
import pyproj
import shapely

from pipeline.export.solid_geometry import SHAPE_COLUMNS
from pipeline.io.crs import to_degrees
from service.outputs.catalogue import ResultsCrs

DECIMALS = 9
"""Decimals of degrees: a tenth of a millimetre."""

_NOT_PROPERTIES = frozenset({"geometry", "bbox", *SHAPE_COLUMNS})
_UNKNOWN = (
    "The coordinate reference system of the tiles is unknown or local: these coordinates are theirs, not WGS 84. "
    "Give `crs` with the job to get degrees."
)

FloatArray = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Wgs84Transformation:
    """The transformation from the CRS of a run to WGS 84."""

    crs: ResultsCrs
    """Its description for clients."""
    transformer: pyproj.Transformer | None
    """None if the CRS is unknown, or has no place on Earth."""
    projjson: Mapping[str, Any] | None
    """The CRS as PROJJSON; None if it is unknown."""

    @classmethod
    def of_run(cls, crs: Mapping[str, Any] | None) -> Wgs84Transformation:
        """The transformation for the `crs` entry of a run.json.

        A compound CRS is reduced to its horizontal part: footprints have no elevation.
        """
        unit_m = None if crs is None else crs.get("vertical_unit_m")
        if crs is None or crs.get("wkt") is None:
            unknown = ResultsCrs(name=None, uri=None, to_wgs84=None, accuracy_m=None, vertical_unit_m=unit_m)
            return cls(crs=unknown, transformer=None, projjson=None)
        whole = pyproj.CRS.from_wkt(crs["wkt"])
        flat = (whole.sub_crs_list[0] if whole.is_compound else whole).to_2d()
        code = flat.to_epsg()
        transformer = to_degrees(flat)
        accuracy_m = None if transformer is None else transformer.accuracy
        results_crs = ResultsCrs(
            name=whole.name,
            uri=None if code is None else f"http://www.opengis.net/def/crs/EPSG/0/{code}",
            to_wgs84=None if transformer is None else transformer.description,
            accuracy_m=None if accuracy_m is None or accuracy_m < 0 else float(accuracy_m),
            vertical_unit_m=unit_m,
        )
        return cls(crs=results_crs, transformer=transformer, projjson=whole.to_json_dict())

    def degrees(self, geometries: npt.NDArray[np.object_]) -> npt.NDArray[np.object_]:
        """Geometries in longitude and latitude, exterior rings counter-clockwise; unchanged if the CRS is unknown.

        A geometry without coordinates in WGS 84 becomes None.
        """
        if self.transformer is None:
            return geometries

        def moved(xy: FloatArray) -> FloatArray:
            assert self.transformer is not None
            return np.round(np.column_stack(self.transformer.transform(xy[:, 0], xy[:, 1])), DECIMALS) + 0.0

        turned = shapely.orient_polygons(shapely.transform(geometries, moved))
        lost = ~shapely.is_missing(turned) & ~np.isfinite(shapely.bounds(turned)).all(axis=-1)
        turned[lost] = None
        return np.asarray(turned, dtype=object)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FeatureText:
    """The feature of one building, with the values for the index of buildings."""

    building_id: str
    record: Mapping[str, Any]
    """The row without geometries and bbox."""
    text: bytes
    """The GeoJSON feature."""
    geometry_start: int
    """First byte of the geometry in `text`."""
    geometry_size: int
    """Bytes of the geometry."""
    native: bytes
    """The geometry in the coordinates of the tiles."""
    bounds: tuple[float, float, float, float] | None
    """Bounds in the coordinates of the tiles; None without a geometry."""
    bounds_deg: tuple[float, float, float, float] | None
    """West, south, east, north; equal to `bounds` if the CRS is unknown."""


def feature_texts(rows: Sequence[Mapping[str, Any]], to_wgs84: Wgs84Transformation) -> list[FeatureText]:
    """The features of the rows of a buildings table.

    Parameters
    ----------
    rows : sequence of mapping
        With `geometry` as ISO WKB or None, and `bbox`.
    to_wgs84 : Wgs84Transformation
        From the CRS of the rows.
    """
    if not rows:
        return []
    own = np.asarray(shapely.from_wkb(np.array([row["geometry"] for row in rows], dtype=object)), dtype=object)
    degrees = to_wgs84.degrees(own)
    texts = []
    for row, mine, turned, bounds, bounds_deg in zip(
        rows, own, degrees, shapely.bounds(own), shapely.bounds(degrees), strict=True
    ):
        record = {name: _plain(value) for name, value in row.items() if name not in _NOT_PROPERTIES}
        geometry = _geojson(turned)
        head = b'{"type":"Feature","id":' + _json(row["building_id"]) + b',"geometry":'
        texts.append(
            FeatureText(
                building_id=row["building_id"],
                record=record,
                text=head + geometry + b',"properties":' + _json(record) + b"}",
                geometry_start=len(head),
                geometry_size=len(geometry),
                native=_geojson(mine),
                bounds=_bounds(bounds),
                bounds_deg=_bounds(bounds_deg),
            )
        )
    return texts


def _plain(value: Any) -> Any:
    return value.isoformat() if isinstance(value, dt.datetime) else value


def _json(value: Any) -> bytes:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()


def _geojson(geometry: shapely.Geometry | None) -> bytes:
    return b"null" if geometry is None else str(shapely.to_geojson(geometry)).encode()


def _bounds(values: FloatArray) -> tuple[float, float, float, float] | None:
    if not np.isfinite(values).all():
        return None
    west, south, east, north = (float(v) for v in values)
    return west, south, east, north


class FeatureCollectionFile:
    """Writes features, one per line, as a GeoJSON feature collection; returns the position of each.

    Parameters
    ----------
    stream : binary file
        To be written.
    crs : ResultsCrs
        The CRS of the results; an unknown one gets a note.
    """

    def __init__(self, stream: BinaryIO, crs: ResultsCrs) -> None:
        self._stream = stream
        self._position = 0
        self._put(b'{"type":"FeatureCollection",')
        if not crs.is_known:
            self._put(b'"coordRefSys":null,"note":' + _json(_UNKNOWN) + b",")
        if crs.vertical_unit_m is not None:
            self._put(b'"verticalUnitM":' + _json(crs.vertical_unit_m) + b",")
        self._put(b'"features":[')
        self._first = True

    def add(self, feature: FeatureText) -> int:
        """Append a feature; returns its first byte."""
        self._put(b"\n" if self._first else b",\n")
        self._first = False
        start = self._position
        self._put(feature.text)
        return start

    def close(self) -> None:
        """Write the end."""
        self._put(b"\n]}\n")

    def _put(self, data: bytes) -> None:
        self._stream.write(data)
        self._position += len(data)
