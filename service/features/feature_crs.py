"""The coordinate reference systems (CRS) of a collection: Part 2 of OGC API - Features."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import threading
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import pyproj
import shapely

from pipeline.io.crs import to_degrees
from service.errors import RequestError
from service.features.index import CRS84, Box

_EPSG = "http://www.opengis.net/def/crs/EPSG/0/"
_ALWAYS = {CRS84: "OGC:CRS84", f"{_EPSG}4326": "EPSG:4326", f"{_EPSG}3857": "EPSG:3857"}
_DECIMALS_DEG, _DECIMALS = 9, 3
_EDGE_POINTS = 21
"""Points on each edge of a window whose image in another CRS is enclosed."""


Geometries = npt.NDArray[np.object_]


@dataclasses.dataclass(frozen=True, kw_only=True)
class NamedCrs:
    """A CRS that clients may name."""

    uri: str
    """Its URI."""
    crs: pyproj.CRS
    """The CRS, two-dimensional."""

    @functools.cached_property
    def is_northing_first(self) -> bool:
        """Whether its first axis points north, as in EPSG:4326."""
        if self.uri == CRS84:
            return False
        return self.crs.axis_info[0].direction.lower() in {"north", "south"}

    @property
    def decimals(self) -> int:
        """Decimals of its coordinates."""
        return _DECIMALS_DEG if self.crs.is_geographic else _DECIMALS


class RunCrs:
    """The CRS of a run and those into which its features are transformed.

    A compound CRS is reduced to its horizontal part. Third coordinates become metres; in the run's own CRS they are in
    its horizontal unit.

    Parameters
    ----------
    crs : mapping, optional
        The `crs` entry of a run.json; None or without `wkt` if it is unknown.
    """

    def __init__(self, crs: Mapping[str, Any] | None) -> None:
        facts = crs or {}
        self.vertical_unit_m: float | None = facts.get("vertical_unit_m")
        """Metres per unit of elevations that are properties; None if unknown."""
        self.horizontal_unit_m = float(facts.get("horizontal_unit_m") or 1.0)
        """Metres per unit of coordinates that are properties."""
        self.whole = None if facts.get("wkt") is None else pyproj.CRS.from_wkt(facts["wkt"])
        """The CRS with its vertical part; None if it is unknown."""
        self.name = None if self.whole is None else self.whole.name
        """Its name."""
        self.storage_uri: str | None = None
        """URI of its horizontal part; None without an EPSG code."""
        self.to_degrees: pyproj.Transformer | None = None
        """The transformation to longitude and latitude; None without one, as in a local CRS."""
        self._known = dict(_ALWAYS)
        if self.whole is not None:
            own = (self.whole.sub_crs_list[0] if self.whole.is_compound else self.whole).to_2d()
            self.to_degrees = to_degrees(own)
            self._wkt = own.to_wkt()
            code = own.to_epsg()
            if code is not None:
                self.storage_uri = f"{_EPSG}{code}"
                self._known.setdefault(self.storage_uri, f"EPSG:{code}")

    @classmethod
    def of_run(cls, crs: Mapping[str, Any] | None) -> RunCrs:
        """The CRS of an entry of a run.json; the same object for the same entry."""
        return _of_run(json.dumps(crs, sort_keys=True))

    @property
    def is_known(self) -> bool:
        """Whether its features have a place on the globe."""
        return self.to_degrees is not None

    @property
    def uris(self) -> list[str]:
        """The CRS that clients may name, the default first."""
        return list(self._known)

    def named(self, uri: str | None, parameter: str) -> NamedCrs:
        """The CRS of a query parameter.

        Raises
        ------
        RequestError
            The collection does not have it.
        """
        wanted = CRS84 if uri is None else uri.strip("[]")
        if wanted not in self._known:
            raise RequestError([f"query {parameter} is {wanted[:80]!r}: use one of {', '.join(self._known)}"])
        return NamedCrs(uri=wanted, crs=_crs(self._known[wanted]))

    def _transformer(self, target: NamedCrs) -> pyproj.Transformer | None:
        """From the run's CRS, easting first; None if they are the same."""
        if target.uri == self.storage_uri:
            return None
        return _own_transformer(self._wkt, self._known[target.uri], threading.get_ident())

    def moved(self, geometries: Geometries, target: NamedCrs) -> Geometries:
        """Geometries in another CRS, easting first, not rounded."""
        transformer = self._transformer(target)
        if transformer is None:
            return geometries

        def move(xy: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
            return np.column_stack([*transformer.transform(xy[:, 0], xy[:, 1]), *xy[:, 2:].T])

        return np.asarray(_transformed(geometries, move), dtype=object)

    def written(self, geometries: Geometries, target: NamedCrs) -> Geometries:
        """Geometries in another CRS as answers have them.

        Rounded, exterior rings counter-clockwise with the easting first, axes in the order of the CRS. One without
        coordinates there becomes None.
        """
        moved = self._with_heights(self.moved(geometries, target), target)
        if moved is not geometries:
            moved = np.asarray(_transformed(moved, lambda xyz: np.round(xyz, target.decimals) + 0.0), dtype=object)
        moved = np.asarray(shapely.orient_polygons(moved), dtype=object)
        moved[~shapely.is_missing(moved) & ~np.isfinite(shapely.bounds(moved)).all(axis=-1)] = None
        if target.is_northing_first:
            moved = np.asarray(_transformed(moved, _swapped), dtype=object)
        return moved

    def _with_heights(self, geometries: Geometries, target: NamedCrs) -> Geometries:
        """Geometries with the third coordinate in the unit that the target has."""
        unit_m = self.horizontal_unit_m if target.uri == self.storage_uri else 1.0
        factor = (self.vertical_unit_m or 1.0) / unit_m
        if math.isclose(factor, 1.0, rel_tol=1e-9) or not shapely.has_z(geometries).any():
            return geometries
        return np.asarray(_transformed(geometries, lambda xyz: xyz * [1.0, 1.0, factor]), dtype=object)

    def window(self, box: Box, source: NamedCrs) -> Box | None:
        """A box of another CRS, easting first, enclosed in the run's own; None if it cannot be."""
        transformer = self._transformer(source)
        if transformer is None:
            return box
        inverse = pyproj.enums.TransformDirection.INVERSE
        west, south, east, north = transformer.transform_bounds(*box, densify_pts=_EDGE_POINTS, direction=inverse)
        if not np.isfinite([west, south, east, north]).all() or west > east:
            return None
        # edges bulge between the points
        margin = 1e-3 * max(east - west, north - south) + 1e-6
        return west - margin, south - margin, east + margin, north + margin

    def outside(self, bounds: Box, target: NamedCrs) -> Box | None:
        """Bounds of the run's CRS enclosed in another, easting first; None if they cannot be."""
        transformer = self._transformer(target)
        if transformer is None:
            return bounds
        found = transformer.transform_bounds(*bounds, densify_pts=_EDGE_POINTS)
        return found if np.isfinite(found).all() and found[0] <= found[2] else None


def _transformed(geometries: Geometries, move: Any) -> Any:
    return shapely.transform(geometries, move, include_z=bool(shapely.has_z(geometries).any()))


def _swapped(xyz: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    return np.column_stack([xyz[:, 1], xyz[:, 0], *xyz[:, 2:].T])


@functools.lru_cache(maxsize=64)
def _of_run(text: str) -> RunCrs:
    return RunCrs(json.loads(text))


@functools.lru_cache(maxsize=64)
def _crs(name: str) -> pyproj.CRS:
    return pyproj.CRS.from_user_input(name)


@functools.lru_cache(maxsize=256)
def _own_transformer(source: str, target: str, thread: int) -> pyproj.Transformer:
    """Of one thread: a transformer must not be used by two at once."""
    del thread
    return pyproj.Transformer.from_crs(source, target, always_xy=True)


def in_easting_order(geometry: shapely.Geometry, crs: NamedCrs) -> shapely.Geometry:
    """A client's geometry with its easting first."""
    return shapely.transform(geometry, _swapped) if crs.is_northing_first else geometry
