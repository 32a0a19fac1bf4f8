"""The coordinate reference system (CRS) of a LAS header's GeoTIFF keys.

A units key states the unit of the coordinates in the file, so it overrides the unit of the CRS whose code stands beside
it: the EPSG registry has most CRS of the United States in metres and in feet, and many writers know only the first.

Source: OGC 19-008r4 (GeoTIFF 1.1), tables of ids; LAS Specification 1.4 R15, "Coordinate Reference System VLRs".
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING

from pipeline.io.crs import INTERNATIONAL_FOOT_M, US_SURVEY_FOOT_M, same_unit, vertical_part
from pipeline.io.crs_units import in_unit, unit_name, with_vertical

if TYPE_CHECKING:
    import laspy
    import pyproj

MODEL_TYPE = 1024
PROJECTED_CRS = 3072
LINEAR_UNITS = 3076
LINEAR_UNIT_SIZE = 3077
VERTICAL_CRS = 4096
VERTICAL_UNITS = 4099
MODEL_PROJECTED = 1
USER_DEFINED = 32767
_IN_KEY, _IN_DOUBLES = 0, 34736
"""Where a key's value is: in the key itself, or in the record of doubles."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class GeoKeys:
    """The keys of a header."""

    codes: Mapping[int, int]
    """Values of the keys that hold a code."""
    sizes: Mapping[int, float]
    """Values of the keys that hold a number."""
    horizontal_unit_m: float | None
    """Metres per unit of easting and northing; None if no key states it."""
    vertical_unit_m: float | None
    """Metres per unit of elevation; None if no key states it."""
    warnings: tuple[str, ...]
    """Units that are not known."""


def keys_of(header: laspy.LasHeader) -> GeoKeys:
    """The keys of a header, all empty where it has none."""
    codes: dict[int, int] = {}
    sizes: dict[int, float] = {}
    doubles = [float(double.value) for vlr in header.vlrs.get("GeoDoubleParamsVlr") for double in vlr.doubles]
    for vlr in header.vlrs.get("GeoKeyDirectoryVlr"):
        for key in vlr.geo_keys:
            # laspy counts padding as keys: id 0
            if key.id and key.tiff_tag_location == _IN_KEY:
                codes[key.id] = key.value_offset
            elif key.tiff_tag_location == _IN_DOUBLES and key.value_offset < len(doubles):
                sizes[key.id] = doubles[key.value_offset]
    units: list[float | None] = []
    warnings: list[str] = []
    for unit_key, size_key in ((LINEAR_UNITS, LINEAR_UNIT_SIZE), (VERTICAL_UNITS, 0)):
        code = codes.get(unit_key)
        found = None if code is None else sizes.get(size_key) if code == USER_DEFINED else _units_m().get(code)
        units.append(found)
        if code is not None and found is None:
            warnings.append(f"the header's units key {unit_key} has {code}, which is not a known unit: it is ignored")
    if units[1] is None and (vertical := _vertical_crs(codes)) is not None:
        units[1] = float(vertical.axis_info[0].unit_conversion_factor)
    return GeoKeys(
        codes=codes, sizes=sizes, horizontal_unit_m=units[0], vertical_unit_m=units[1], warnings=tuple(warnings)
    )


def crs_of_keys(header: laspy.LasHeader, keys: GeoKeys) -> tuple[pyproj.CRS | None, list[str]]:
    """The CRS of the keys in the units of its units keys, and warnings; laspy reads the horizontal one only."""
    import pyproj

    codes = keys.codes
    if codes.get(MODEL_TYPE) == MODEL_PROJECTED and codes.get(PROJECTED_CRS, USER_DEFINED) == USER_DEFINED:
        return None, [*keys.warnings, "the header's GeoTIFF keys describe a user-defined projected CRS without WKT"]
    try:
        crs = header.parse_crs()
    except pyproj.exceptions.CRSError as fault:
        return None, [*keys.warnings, f"the header's GeoTIFF keys are not understood ({str(fault)[:120]})"]
    warnings = list(keys.warnings)
    if crs is None:
        return None, warnings
    if crs.is_projected and not crs.is_compound:
        crs = by_unit_key(crs, keys.horizontal_unit_m, LINEAR_UNITS, warnings)
    vertical = vertical_part(crs) or _vertical_crs(codes)
    code = codes.get(VERTICAL_CRS, 0)
    if vertical is None and 1024 <= code < USER_DEFINED:
        warnings.append(f"the header's vertical CRS key {code} is not known")
    if vertical is not None:
        found = by_unit_key(vertical, keys.vertical_unit_m, VERTICAL_UNITS, warnings)
        if found is not vertical or not crs.is_compound:
            crs = with_vertical(crs, found)
    return crs, warnings


def _vertical_crs(codes: Mapping[int, int]) -> pyproj.CRS | None:
    """The vertical CRS that a key names; None without one, and if the registry does not have it."""
    import pyproj

    code = codes.get(VERTICAL_CRS, 0)
    if not 1024 <= code < USER_DEFINED:
        return None
    try:
        found = pyproj.CRS.from_epsg(code)
    except pyproj.exceptions.CRSError:
        return None
    return found if found.is_vertical else None


def by_unit_key(
    crs: pyproj.CRS, unit_m: float | None, key: int, warnings: list[str], *, is_given: bool = False
) -> pyproj.CRS:
    """A projected or vertical CRS, of the header or given, in the unit of its key; a warning names the CRS with it."""
    own_m = float(crs.axis_info[0].unit_conversion_factor)
    if unit_m is None or same_unit(unit_m, own_m):
        return crs
    found = in_unit(crs, unit_m)
    code = found.to_epsg()
    name = found.name if code is None else f"EPSG:{code} ({found.name})"
    whose, fix = ("the given", "mend the key") if is_given else ("its", "give --crs EPSG:n")
    warnings.append(
        f"the header's units key {key} ({unit_name(unit_m)}) overrides the unit of {whose} CRS {crs.name!r}"
        f" ({unit_name(own_m)}): read as {name}; {fix} if that is wrong"
    )
    return found


@functools.cache
def _units_m() -> Mapping[int, float]:
    """Metres per unit, by the EPSG codes of units of length."""
    import pyproj

    units = pyproj.database.get_units_map(auth_name="EPSG", category="linear", allow_deprecated=True).values()
    found = {int(unit.code): float(unit.conv_factor) for unit in units}
    # the registry rounds the third to 15 digits
    return {**found, 9001: 1.0, 9002: INTERNATIONAL_FOOT_M, 9003: US_SURVEY_FOOT_M}
