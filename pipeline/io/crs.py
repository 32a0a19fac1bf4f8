"""The coordinate reference system and the units of a file: horizontal and vertical are separate things."""

from __future__ import annotations

import dataclasses
import functools
from typing import TYPE_CHECKING, Any

from pipeline.errors import CrsError
from pipeline.io.library_faults import words_of

if TYPE_CHECKING:
    import pyproj

INTERNATIONAL_FOOT_M = 0.3048
US_SURVEY_FOOT_M = 1200.0 / 3937.0

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

EPSG_UNITS_M = {9001: 1.0, 9002: INTERNATIONAL_FOOT_M, 9003: US_SURVEY_FOOT_M}
"""Metres per unit, by the EPSG codes that GeoTIFF keys use."""


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
    """The CRS that a user names: an EPSG code, WKT, PROJJSON or a PROJ string; raises CrsError if PROJ rejects it."""
    import pyproj

    try:
        return pyproj.CRS.from_user_input(text)
    except (pyproj.exceptions.ProjError, ValueError, RecursionError) as fault:
        detail = str(fault)[:120] if isinstance(fault, pyproj.exceptions.ProjError) else words_of(fault)
        raise CrsError(
            path,
            f"coordinate reference system {text[:80]!r} is not understood ({detail})",
            "Give an EPSG code such as EPSG:28992, or WKT",
        ) from fault


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
    if crs.is_compound:
        for part in crs.sub_crs_list[1:]:
            if part.is_vertical:
                return float(part.axis_info[0].unit_conversion_factor)
        return None
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
            "Give --crs EPSG:n with the right one, or mend the file",
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

    The vertical unit is the user's, else the CRS's, else the header's, else the horizontal one. Raises CrsError if the
    CRS is geographic or not understood, or the unit is not known.

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
    chosen = header_crs
    if crs is not None:
        chosen = parse_crs(crs, path=path)
        if header_crs is not None and not horizontal_part(chosen).equals(
            horizontal_part(header_crs), ignore_axis_order=True
        ):
            warnings.append(f"the given CRS {chosen.name!r} replaces the header's {header_crs.name!r}")
    vertical_m = None if vertical_unit is None else unit_in_metres(vertical_unit, path=path)
    if chosen is None:
        horizontal_m = 1.0 if header_horizontal_unit_m is None else header_horizontal_unit_m
        warnings.append(
            f"no usable CRS in the file: unknown, horizontal unit taken as {horizontal_m:g} m; give --crs EPSG:n"
        )
        if vertical_m is None:
            vertical_m = horizontal_m if header_vertical_unit_m is None else header_vertical_unit_m
        return SpatialReference(horizontal_unit_m=horizontal_m, vertical_unit_m=vertical_m), tuple(warnings)

    horizontal_m = horizontal_unit_of(chosen, path=path)
    if vertical_m is None and (vertical_m := vertical_unit_of(chosen)) is not None:
        vertical_m = _usable_unit(vertical_m, chosen, path)
    if vertical_m is None and crs is None:
        vertical_m = header_vertical_unit_m
    assumed = vertical_m is None
    if vertical_m is None:
        vertical_m = horizontal_m
        if horizontal_m != 1.0:  # elevations in metres are common beside feet, so the user must decide
            warnings.append(
                f"no vertical unit in CRS {chosen.name!r}: taken from the horizontal one ({horizontal_m:g} m); "
                "give --vertical-unit if it differs"
            )
    reference = SpatialReference(
        wkt=chosen.to_wkt("WKT2_2019"),
        name=chosen.name,
        epsg=_epsg_of(chosen.srs),
        horizontal_unit_m=horizontal_m,
        vertical_unit_m=vertical_m,
        vertical_unit_assumed=assumed,
    )
    return reference, tuple(warnings)
