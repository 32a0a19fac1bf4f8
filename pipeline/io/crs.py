"""The coordinate reference system and the units of a file: horizontal and vertical are separate things."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pipeline.errors import CrsError

if TYPE_CHECKING:
    import pyproj


SMALLEST_UNIT_M, LARGEST_UNIT_M = 1e-4, 1e4
"""Units that a CRS can have: from a tenth of a millimetre to ten kilometres."""
LARGEST_COORDINATE = 1e12
"""Bound of coordinates, far beyond every CRS; keeps differences finite."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SpatialReference:
    """Where coordinates live and in which units."""

    wkt: str | None = None
    """WKT2:2019 of the CRS, compound if it is; None if unknown."""
    name: str = "unknown"
    """The CRS's own name."""
    epsg: int | None = None
    """EPSG code of the whole CRS, compound where it is; None if it has none."""
    horizontal_unit_m: float = 1.0
    """Metres per unit of easting and northing."""
    vertical_unit_m: float = 1.0
    """Metres per unit of elevation."""
    vertical_unit_assumed: bool = dataclasses.field(default=False, compare=False)
    """True if nothing states the vertical unit and it is taken from the horizontal one."""
    named: str = dataclasses.field(default="unknown", compare=False)
    """EPSG:n, or the name, of the CRS as user or header name it, before a vertical part was added; part of ids."""

    @classmethod
    def of_facts(cls, facts: Mapping[str, Any] | None) -> SpatialReference:
        """The reference in the entry `crs` of a run.json, of this version or an older one; unknown without one."""
        names = {field.name for field in dataclasses.fields(cls)}
        return cls(**{name: value for name, value in (facts or {}).items() if name in names and value is not None})

    @property
    def crs(self) -> pyproj.CRS | None:
        """The CRS as a pyproj object; None if unknown."""
        if self.wkt is None:
            return None
        import pyproj

        return pyproj.CRS.from_wkt(self.wkt)

    @property
    def projjson(self) -> dict[str, Any] | None:
        """PROJJSON of the whole CRS, compound if it is; None if unknown (GeoParquet's `crs: null`)."""
        crs = self.crs
        return None if crs is None else dict(crs.to_json_dict())

    @property
    def horizontal_crs(self) -> pyproj.CRS | None:
        """The horizontal part as a pyproj object; None if unknown."""
        crs = self.crs
        return None if crs is None else horizontal_part(crs)

    @property
    def to_degrees(self) -> pyproj.Transformer | None:
        """`to_degrees` of its horizontal part; None also if the CRS is unknown."""
        crs = self.horizontal_crs
        return None if crs is None else to_degrees(crs)


UNKNOWN_REFERENCE = SpatialReference()
"""No CRS: metres are assumed."""


def horizontal_part(crs: pyproj.CRS) -> pyproj.CRS:
    """The horizontal CRS of a compound, bound or 3D CRS; the CRS itself where it is none of these."""
    if crs.is_bound and crs.source_crs is not None:
        return horizontal_part(crs.source_crs)
    if crs.is_compound:
        return horizontal_part(crs.sub_crs_list[0])
    return crs


def to_degrees(crs: pyproj.CRS) -> pyproj.Transformer | None:
    """The transformation of a horizontal CRS to longitude and latitude, x first; None for a CRS without place on Earth.

    Local and engineering CRS have none, and some that PROJ reads but cannot compute.
    """
    import pyproj

    try:
        return pyproj.Transformer.from_crs(crs, "OGC:CRS84", always_xy=True)
    except pyproj.exceptions.ProjError:
        return None


def vertical_unit_of(crs: pyproj.CRS) -> float | None:
    """Metres a unit of the vertical axis; None where the CRS has no vertical axis."""
    if crs.is_bound and crs.source_crs is not None:
        return vertical_unit_of(crs.source_crs)
    vertical = vertical_part(crs)
    if vertical is not None:
        return float(vertical.axis_info[0].unit_conversion_factor)
    if len(crs.axis_info) == 3:
        return float(crs.axis_info[2].unit_conversion_factor)
    return None


def horizontal_unit_of(crs: pyproj.CRS, *, path: str) -> float:
    """Metres per unit of the horizontal axes.

    Raises CrsError if the CRS is geographic, geocentric or vertical only, or its two axes differ in unit.
    """
    plane = horizontal_part(crs)
    reproject = "Reproject the file to a projected CRS, or give --crs EPSG:n where the header is wrong"
    if plane.is_geographic:
        raise CrsError(path, f"CRS {crs.name!r} is geographic: its coordinates are degrees, not lengths", reproject)
    if plane.is_geocentric:
        raise CrsError(path, f"CRS {crs.name!r} is geocentric: it has no plan and elevation", reproject)
    if plane.is_vertical or len(plane.axis_info) < 2:
        raise CrsError(path, f"CRS {crs.name!r} has no horizontal axes", "Give --crs EPSG:n with a horizontal CRS")
    units = {float(axis.unit_conversion_factor) for axis in plane.axis_info[:2]}
    if len(units) != 1:
        raise CrsError(path, f"CRS {crs.name!r} has axes in different units, {sorted(units)} m", reproject)
    return _usable_unit(units.pop(), crs, path)


def _usable_unit(unit_m: float, crs: pyproj.CRS, path: str) -> float:
    """A unit of a CRS, in metres; raises CrsError for one that no coordinates are in, such as 0."""
    if not SMALLEST_UNIT_M <= unit_m <= LARGEST_UNIT_M:
        raise CrsError(
            path,
            f"CRS {crs.name!r} has a unit of {unit_m:g} m",
            "Give --crs EPSG:n with the right one, or --vertical-unit, or mend the file",
        )
    return unit_m


@functools.lru_cache(maxsize=64)
def _epsg_of(text: str) -> int | None:
    """The EPSG code of a CRS that is written somehow; looking for it takes milliseconds, and tiles agree."""
    import pyproj

    code: int | None = pyproj.CRS.from_user_input(text).to_epsg()
    return code


def with_one_vertical(references: Sequence[SpatialReference]) -> list[SpatialReference]:
    """References of one given horizontal CRS; where some headers add one vertical CRS and others none, all have it.

    Those with another vertical unit stay as they are, and all do where headers add several.
    """
    stated = {one.wkt: one for one in references if (crs := one.crs) is not None and vertical_part(crs) is not None}
    if len(stated) != 1:
        return list(references)
    (whole,) = stated.values()
    return [whole if same_unit(one.vertical_unit_m, whole.vertical_unit_m) else one for one in references]


INTERNATIONAL_FOOT_M = 0.3048


US_SURVEY_FOOT_M = 1200.0 / 3937.0


_EQUAL = 1e-9
"""Relative difference of one unit written twice; the two feet differ by 2e-6."""


def same_unit(one_m: float, other_m: float) -> bool:
    """Whether two units, in metres, are the same but for rounding.

    >>> same_unit(0.304800609601, 1200.0 / 3937.0), same_unit(0.3048, 1200.0 / 3937.0)
    (True, False)
    """
    return math.isclose(one_m, other_m, rel_tol=_EQUAL)


def vertical_part(crs: pyproj.CRS) -> pyproj.CRS | None:
    """The vertical CRS of a compound one, or a CRS that is vertical itself; None if there is none."""
    if crs.is_bound and crs.source_crs is not None:
        return vertical_part(crs.source_crs)
    if crs.is_compound:
        return next((part for part in crs.sub_crs_list[1:] if part.is_vertical), None)
    return crs if crs.is_vertical else None


def chosen_vertical_unit(
    crs: pyproj.CRS, horizontal_m: float, found_m: float | None, *, path: str
) -> tuple[float, list[str]]:
    """The vertical unit of a file in metres: the one found, else the horizontal one, with a warning where that is odd.

    Raises CrsError for a unit that no coordinates are in.
    """
    if found_m is not None:
        return _usable_unit(found_m, crs, path), []
    if horizontal_m == 1.0:
        return horizontal_m, []
    # elevations in metres are common beside feet: the user must decide
    warning = (
        f"no vertical unit in CRS {crs.name!r}: taken from the horizontal one ({horizontal_m:g} m); "
        "give --vertical-unit if it differs"
    )
    return horizontal_m, [warning]


def reference_of(
    crs: pyproj.CRS, named: pyproj.CRS, units_m: tuple[float, float], *, assumed: bool
) -> SpatialReference:
    """The reference by a CRS, its horizontal and vertical unit; `named` is the CRS as user or header name it."""
    return SpatialReference(
        wkt=crs.to_wkt("WKT2_2019"),
        name=crs.name,
        epsg=_epsg_of(crs.srs),
        horizontal_unit_m=units_m[0],
        vertical_unit_m=units_m[1],
        vertical_unit_assumed=assumed,
        named=named.name if (code := _epsg_of(named.srs)) is None else f"EPSG:{code}",
    )
