"""The coordinate reference system (CRS) that a user gives, and its units in words."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from pipeline.errors import CrsError
from pipeline.io.crs import (
    INTERNATIONAL_FOOT_M,
    US_SURVEY_FOOT_M,
    SpatialReference,
    chosen_vertical_unit,
    horizontal_part,
    horizontal_unit_of,
    reference_of,
    same_unit,
    vertical_part,
    vertical_unit_of,
)
from pipeline.io.crs_units import unit_name, with_vertical, with_vertical_unit
from pipeline.io.geotiff_keys import LINEAR_UNITS, by_unit_key

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


BARE_CODE = re.compile(r"[0-9]{4,6}(\+[0-9]{4,6})?")
"""An EPSG code alone, or those of a horizontal and a vertical CRS."""


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
        from pipeline.io.library_faults import words_of

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


def reference_given(
    path: str,
    header_crs: pyproj.CRS | None,
    header_horizontal_unit_m: float | None,
    header_vertical_unit_m: float | None,
    *,
    crs: str | None,
    vertical_unit: str | None,
) -> tuple[SpatialReference, tuple[str, ...]]:
    """`resolve_reference` where the user gives a CRS or a unit, or the header has no CRS."""
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
    vertical_m, more = chosen_vertical_unit(chosen, horizontal_m, found_m, path=path)
    warnings.extend(more)
    overrides = given_m is not None or (given is not None and vertical_unit_of(given) is not None)
    if stated_m is not None and overrides:
        warnings.extend(_of_override(vertical_m, stated_m))
    elif given is not None and stated_m is not None:
        warnings.extend(_of_mixture(horizontal_m, vertical_m))
    if not same_unit(vertical_m, horizontal_m if own_m is None else own_m):
        chosen = with_vertical_unit(chosen, vertical_m)
    return reference_of(chosen, named, (horizontal_m, vertical_m), assumed=found_m is None), tuple(warnings)
