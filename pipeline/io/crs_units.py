"""A coordinate reference system (CRS) in other units: what a units key or an option states beside it.

Conversions of projected CRS state the units of their own parameters, so only the axes change.
"""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, Any

from pipeline.io.crs import INTERNATIONAL_FOOT_M, US_SURVEY_FOOT_M, same_unit, vertical_part

if TYPE_CHECKING:
    import pyproj


_UNIT_NAMES = {1.0: "metre", INTERNATIONAL_FOOT_M: "foot", US_SURVEY_FOOT_M: "US survey foot"}
_UNKNOWN = "unknown"
"""Name of a vertical datum that nothing states."""
_SAME_PLACE_M = 0.01
"""False eastings are rounded in one of the units: North Carolina's differ by 0.8 mm."""


def unit_name(unit_m: float) -> str:
    """The name of a unit in the EPSG registry.

    >>> unit_name(0.3048), unit_name(0.25)
    ('foot', 'unit of 0.25 m')
    """
    found = next((name for known, name in _UNIT_NAMES.items() if same_unit(known, unit_m)), None)
    return found or f"unit of {unit_m:.12g} m"


def in_unit(crs: pyproj.CRS, unit_m: float) -> pyproj.CRS:
    """A projected or vertical CRS with its axes in another unit; the one of the EPSG registry if it has it."""
    return _in_unit(crs.to_wkt("WKT2_2019"), unit_m)


def with_vertical(crs: pyproj.CRS, vertical: pyproj.CRS) -> pyproj.CRS:
    """A CRS with another vertical part, or its first."""
    import pyproj

    plane = crs.sub_crs_list[0] if crs.is_compound else crs.to_2d() if len(crs.axis_info) > 2 else crs
    return pyproj.crs.CompoundCRS(f"{plane.name} + {vertical.name}", [plane, vertical])


def with_vertical_unit(crs: pyproj.CRS, unit_m: float) -> pyproj.CRS:
    """A CRS whose elevations are in a unit: in its own vertical datum, or in an unknown one."""
    known = vertical_part(crs)
    return with_vertical(crs, _unknown_height(unit_m) if known is None else in_unit(known, unit_m))


def states_unit_alone(vertical: pyproj.CRS) -> bool:
    """Whether a vertical CRS is that of `with_vertical_unit`, whose datum is unknown."""
    return _datum_name(vertical) == _UNKNOWN


def _unit(unit_m: float) -> dict[str, Any]:
    """A unit of length as PROJJSON."""
    return {"type": "LinearUnit", "name": unit_name(unit_m), "conversion_factor": unit_m}


def _unknown_height(unit_m: float) -> pyproj.CRS:
    """A vertical CRS of which only the unit is known."""
    import pyproj

    axis = {"name": "Gravity-related height", "abbreviation": "H", "direction": "up", "unit": _unit(unit_m)}
    return pyproj.CRS.from_json_dict(
        {
            "type": "VerticalCRS",
            "name": f"unknown height ({unit_name(unit_m)})",
            "datum": {"type": "VerticalReferenceFrame", "name": _UNKNOWN},
            "coordinate_system": {"subtype": "vertical", "axis": [axis]},
        }
    )


@functools.lru_cache(maxsize=64)
def _in_unit(wkt: str, unit_m: float) -> pyproj.CRS:
    """`in_unit`, by WKT: a look at the registry takes a fifth of a second, and tiles agree."""
    import pyproj

    facts = pyproj.CRS.from_wkt(wkt).to_json_dict()
    stem = _stem(facts["name"])
    facts["name"] = f"{stem} ({unit_name(unit_m)})"
    facts.pop("id", None)
    for axis in facts["coordinate_system"]["axis"]:
        axis["unit"] = _unit(unit_m)
    changed = pyproj.CRS.from_json_dict(facts)
    kind = pyproj.enums.PJType.VERTICAL_CRS if changed.is_vertical else pyproj.enums.PJType.PROJECTED_CRS
    codes = [info.code for info in pyproj.database.query_crs_info("EPSG", kind) if _stem(info.name) == stem]
    codes += [match.code for match in changed.list_authority("EPSG") if match.auth_name == "EPSG"]
    for code in dict.fromkeys(codes):
        known = pyproj.CRS.from_epsg(int(code))
        if _is_same(known, changed):
            return known
    return changed


def _stem(name: str) -> str:
    """The name of a CRS without what the registry adds for the unit.

    >>> _stem("NAD83(2011) / Pennsylvania North (ftUS)")
    'NAD83(2011) / Pennsylvania North'
    """
    return name[: name.rindex(" (")] if name.endswith(")") and " (" in name else name


def _is_same(one: pyproj.CRS, other: pyproj.CRS) -> bool:
    """Whether two CRS have the same datum, units and directions of axes, and coordinates but for rounding."""
    import pyproj

    axes = [[(axis.direction, axis.unit_conversion_factor) for axis in crs.axis_info] for crs in (one, other)]
    if len(axes[0]) != len(axes[1]) or not all(
        a == b and same_unit(m, n) for (a, m), (b, n) in zip(sorted(axes[0]), sorted(axes[1]), strict=True)
    ):
        return False
    if one.is_vertical:
        return _datum_name(one) == _datum_name(other)
    area = one.area_of_use
    if area is None or one.geodetic_crs != other.geodetic_crs:
        return False
    ways = [pyproj.Transformer.from_crs(crs.geodetic_crs, crs, always_xy=True) for crs in (one, other)]
    corners = [(x, y) for x in (area.west, area.east) for y in (area.south, area.north)]
    unit_m = axes[0][0][1]
    return all(
        math.dist(ways[0].transform(*corner), ways[1].transform(*corner)) * unit_m <= _SAME_PLACE_M
        for corner in corners
    )


def _datum_name(vertical: pyproj.CRS) -> str:
    """The name of the datum, or of the ensemble of datums, of a vertical CRS."""
    facts = vertical.to_json_dict()
    return str((facts.get("datum") or facts["datum_ensemble"])["name"])
