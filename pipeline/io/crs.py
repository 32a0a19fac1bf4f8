"""The coordinate reference system and the units of a file: horizontal and vertical are separate things."""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pipeline.errors import CrsError
from pipeline.io.crs_units import (
    INTERNATIONAL_FOOT_M,
    US_SURVEY_FOOT_M,
    same_unit,
    unit_name,
    vertical_part,
    with_vertical,
    with_vertical_unit,
)
from pipeline.io.geotiff_keys import LINEAR_UNITS, by_unit_key
from pipeline.io.library_faults import words_of

if TYPE_CHECKING:
    import pyproj

UNITS_M = {
    "m": 1.0,
    "metre": 1.0,
    "meter": 1.0,
    "ft": INTERNATIONAL_FOOT_M,
    "foot": INTERNATIONAL_FOOT_M,
    "us-ft": US_SURVEY_FOOT_M,
    "ftus": US_SURVEY_FOOT_M,
    "us_survey_foot": US_SURVEY_FOOT_M,
    "cm": 0.01,
    "mm": 0.001,
    "km": 1000.0,
}
"""Metres per unit, by the words that `--vertical-unit` understands."""

SMALLEST_UNIT_M, LARGEST_UNIT_M = 1e-4, 1e4
"""Units that a CRS can have: from a tenth of a millimetre to ten kilometres."""
LARGEST_COORDINATE = 1e12
"""Bound of coordinates, far beyond every CRS; keeps differences finite."""
BARE_CODE = re.compile(r"[0-9]{4,6}(\+[0-9]{4,6})?")
"""An EPSG code alone, or those of a horizontal and a vertical CRS."""


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


def unit_in_metres(word: str, *, path: str) -> float:
    """Metres per unit, from a word of `UNITS_M` such as m, ft or us-ft; raises CrsError for any other."""
    try:
        return UNITS_M[word.strip().lower()]
    except KeyError:
        raise CrsError(path, f"unit {word!r} is not known", f"Use one of {', '.join(UNITS_M)}") from None


def parse_crs(text: str, *, path: str) -> pyproj.CRS:
    """The CRS that a user names: an EPSG code (with or without `EPSG:`), WKT, PROJJSON or a PROJ string.

    Raises CrsError if PROJ rejects it.
    """
    import pyproj

    try:
        return pyproj.CRS.from_user_input(with_authority(text))
    except (pyproj.exceptions.ProjError, ValueError, RecursionError) as fault:
        detail = str(fault)[:120] if isinstance(fault, pyproj.exceptions.ProjError) else words_of(fault)
        raise CrsError(
            path,
            f"coordinate reference system {text[:80]!r} is not understood ({detail})",
            "Give an EPSG code such as EPSG:28992, or WKT",
        ) from fault


def with_authority(text: str) -> str:
    """The name of a CRS as PROJ takes it: a bare code is EPSG's.

    >>> with_authority(" 28992 "), with_authority("28992+5709"), with_authority("ESRI:102748")
    ('EPSG:28992', 'EPSG:28992+5709', 'ESRI:102748')
    """
    text = text.strip()
    return f"EPSG:{text}" if BARE_CODE.fullmatch(text) else text


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


def resolve_reference(
    *,
    path: str,
    header_crs: pyproj.CRS | None = None,
    header_horizontal_unit_m: float | None = None,
    header_vertical_unit_m: float | None = None,
    crs: str | None = None,
    vertical_unit: str | None = None,
) -> tuple[SpatialReference, tuple[str, ...]]:
    """The reference of a file from its header and the user's overrides, and warnings of one sentence each.

    An override replaces what it states: a horizontal `crs` keeps the vertical CRS, or the unit, of the header. A
    horizontal unit that the header states without a CRS is that of its coordinates, and stays, too. The vertical unit
    is the user's, else the CRS's, else the header's, else the horizontal one. The CRS that comes back has a vertical
    part if its elevations are not in its horizontal unit. Raises CrsError if the CRS is geographic or not understood,
    or the unit is not known.

    Parameters
    ----------
    header_horizontal_unit_m, header_vertical_unit_m : float, optional
        Metres per unit, if the header has a unit beside the CRS (GeoTIFF keys).
    crs : str, optional
        The user's CRS; overrides the header's.
    vertical_unit : str, optional
        The user's vertical unit, a word of `UNITS_M`; overrides everything else.
    """
    warnings: list[str] = []
    given = None if crs is None else parse_crs(crs, path=path)
    if given is not None and header_crs is None:
        given = _in_unit_of_header(given, header_horizontal_unit_m, path, warnings)
    given_m = None if vertical_unit is None else unit_in_metres(vertical_unit, path=path)
    named = header_crs if given is None else given
    if named is None:
        return _unknown_reference(header_horizontal_unit_m, header_vertical_unit_m, given_m)
    if given is not None and header_crs is not None and _differ(given, header_crs):
        warnings.append(f"the given CRS {given.name!r} replaces the header's {horizontal_part(header_crs).name!r}")
    horizontal_m = horizontal_unit_of(named, path=path)
    chosen = named if given is None else _with_vertical_of(given, header_crs)
    own_m = vertical_unit_of(chosen)
    stated_m = (None if header_crs is None else vertical_unit_of(header_crs)) or header_vertical_unit_m
    found_m = next((unit_m for unit_m in (given_m, own_m, stated_m) if unit_m is not None), None)
    vertical_m = horizontal_m if found_m is None else _usable_unit(found_m, chosen, path)
    if found_m is None and horizontal_m != 1.0:  # elevations in metres are common beside feet: the user must decide
        warnings.append(
            f"no vertical unit in CRS {chosen.name!r}: taken from the horizontal one ({horizontal_m:g} m); "
            "give --vertical-unit if it differs"
        )
    overrides = given_m is not None or (given is not None and vertical_unit_of(given) is not None)
    if stated_m is not None and overrides:
        warnings.extend(_of_override(vertical_m, stated_m))
    elif given is not None and stated_m is not None:
        warnings.extend(_of_mixture(horizontal_m, vertical_m))
    if not same_unit(vertical_m, horizontal_m if own_m is None else own_m):
        chosen = with_vertical_unit(chosen, vertical_m)
    reference = SpatialReference(
        wkt=chosen.to_wkt("WKT2_2019"),
        name=chosen.name,
        epsg=_epsg_of(chosen.srs),
        horizontal_unit_m=horizontal_m,
        vertical_unit_m=vertical_m,
        vertical_unit_assumed=found_m is None,
        named=named.name if (code := _epsg_of(named.srs)) is None else f"EPSG:{code}",
    )
    return reference, tuple(warnings)


def with_one_vertical(references: Sequence[SpatialReference]) -> list[SpatialReference]:
    """References of one given horizontal CRS; where some headers add one vertical CRS and others none, all have it.

    Those with another vertical unit stay as they are, and all do where headers add several.
    """
    stated = {one.wkt: one for one in references if (crs := one.crs) is not None and vertical_part(crs) is not None}
    if len(stated) != 1:
        return list(references)
    (whole,) = stated.values()
    return [whole if same_unit(one.vertical_unit_m, whole.vertical_unit_m) else one for one in references]


def _unknown_reference(
    header_horizontal_unit_m: float | None, header_vertical_unit_m: float | None, given_m: float | None
) -> tuple[SpatialReference, tuple[str, ...]]:
    """The reference of a file without a usable CRS, whose units may be known."""
    horizontal_m = 1.0 if header_horizontal_unit_m is None else header_horizontal_unit_m
    vertical_m = next((unit_m for unit_m in (given_m, header_vertical_unit_m) if unit_m is not None), horizontal_m)
    warnings = [f"no usable CRS in the file: unknown, horizontal unit taken as {horizontal_m:g} m; give --crs EPSG:n"]
    if given_m is not None and header_vertical_unit_m is not None:
        warnings.extend(_of_override(given_m, header_vertical_unit_m))
    return SpatialReference(horizontal_unit_m=horizontal_m, vertical_unit_m=vertical_m), tuple(warnings)


def _differ(one: pyproj.CRS, other: pyproj.CRS) -> bool:
    """Whether the horizontal parts of two CRS differ, also of 3D ones."""
    return not horizontal_part(one).to_2d().equals(horizontal_part(other).to_2d(), ignore_axis_order=True)


def _in_unit_of_header(given: pyproj.CRS, unit_m: float | None, path: str, warnings: list[str]) -> pyproj.CRS:
    """The user's CRS in the unit that a header without a CRS states for its coordinates, with a warning."""
    if unit_m is None or same_unit(unit_m, horizontal_unit_of(given, path=path)):
        return given
    plane = by_unit_key(horizontal_part(given).to_2d(), unit_m, LINEAR_UNITS, warnings, is_given=True)
    vertical, vertical_m = vertical_part(given), vertical_unit_of(given)
    if vertical is not None:
        return with_vertical(plane, vertical)
    return plane if vertical_m is None else with_vertical_unit(plane, vertical_m)


def _with_vertical_of(given: pyproj.CRS, header_crs: pyproj.CRS | None) -> pyproj.CRS:
    """The user's CRS, with the vertical part of the header's where it has none of its own."""
    if header_crs is None or vertical_unit_of(given) is not None:
        return given
    vertical = vertical_part(header_crs)
    return given if vertical is None else with_vertical(given, vertical)


def _of_override(vertical_m: float, stated_m: float) -> list[str]:
    """A warning if a given vertical unit is not that of the header."""
    if same_unit(vertical_m, stated_m):
        return []
    return [f"the given vertical unit, {unit_name(vertical_m)}, replaces the header's {unit_name(stated_m)}"]


def _of_mixture(horizontal_m: float, vertical_m: float) -> list[str]:
    """A warning if the header's vertical unit, which stays, is not that of the given horizontal CRS."""
    if same_unit(vertical_m, horizontal_m):
        return []
    mixed = f"units are mixed: elevations stay in the header's {unit_name(vertical_m)} ({vertical_m:.6g} m) beside"
    return [f"{mixed} coordinates in units of {horizontal_m:.6g} m; give --vertical-unit if that is wrong"]
