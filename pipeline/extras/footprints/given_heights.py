"""Given heights: the attributes of a footprint replace missing points by a labelled block."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from pipeline.errors import BuildingError
from pipeline.model import Candidate, GivenHeights, GroundSource, HeightSource, Plane
from pipeline.roof.roof_settings import FootprintSettings


class _Range(NamedTuple):
    """Values that a building can have."""

    least: float
    most: float
    unit: str


# None of these is a setting: what lies outside is not a building of this earth, but a code for "unknown", or a slip.
_HEIGHTS = _Range(0.1, 1000.0, "m")
_ELEVATIONS = _Range(-500.0, 9000.0, "m")
_RANGES: Mapping[str, _Range] = {
    "height": _HEIGHTS,
    "roof_elevation": _ELEVATIONS,
    "storeys": _Range(0.1, 300.0, "storeys"),
    "ground_elevation": _ELEVATIONS,
}


def given_heights(
    attributes: Mapping[str, Any], settings: FootprintSettings, vertical_unit_m: float
) -> tuple[GivenHeights | None, list[str]]:
    """The heights of a footprint in metres, and what is wrong with its values, a sentence each.

    Numbers may be texts, such as "3". A value at fault counts as missing, as an empty one does. None without any value.
    """
    faults: list[str] = []
    found: dict[str, float] = {}
    for setting, column in settings.columns.items():
        unit_m = 1.0 if setting == "storeys" else vertical_unit_m
        value, fault = _metres(attributes.get(column), unit_m, _RANGES[setting])
        if fault:
            faults.append(f"its {column} is {fault}")
        if value is not None:
            found[setting] = value
    if not found:
        return None, faults
    return GivenHeights(
        height_m=found.get("height", math.nan),
        roof_z_m=found.get("roof_elevation", math.nan),
        storeys_m=found.get("storeys", math.nan) * settings.storey_height_m,
        ground_z_m=found.get("ground_elevation", math.nan),
    ), faults


def _metres(value: Any, unit_m: float, allowed: _Range) -> tuple[float | None, str]:
    """A value in metres or storeys, None if it is empty or at fault, and the fault."""
    if value is None or (isinstance(value, str) and not value.strip()):
        return None, ""
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        return None, f"{str(value)[:40]!r}: not a number"
    number *= unit_m
    if not allowed.least <= number <= allowed.most:
        said = f"{number:g} {allowed.unit}" if unit_m == 1.0 else f"{str(value)[:40]} ({number:g} {allowed.unit})"
        return None, f"{said}: a building has {allowed.least:g} to {allowed.most:g} {allowed.unit}"
    return number, ""


class GivenBlock(NamedTuple):
    """A block by attributes, in a candidate's local metres."""

    plane: Plane
    """Its roof, horizontal; no point supports it."""
    ground_z_m: float
    """Where its walls end."""
    height_source: HeightSource
    """The attribute of the height."""
    ground_source: GroundSource
    """Where the ground comes from."""

    @property
    def words(self) -> str:
        """Its height and where that comes from."""
        return f"height {self.plane.c - self.ground_z_m:.2f} m by the attribute {self.height_source}"


def given_block(candidate: Candidate, lack: BuildingError) -> GivenBlock:
    """The block of a candidate that has no model by points.

    The ground is the lowest terrain at the outline of the footprint, else the attribute. The height is the first of
    height, roof elevation and storeys that is known and lies above the ground. Elevations are rounded to 1 mm.
    Raises `lack` with the reason in its detail if the attributes do not suffice.
    """
    given = candidate.given
    if given is None or candidate.footprint is None:
        raise lack
    ground, source = given.terrain_z_m, GroundSource.TERRAIN
    if math.isnan(ground):
        ground, source = given.ground_z_m, GroundSource.ATTRIBUTE
    if math.isnan(ground):
        raise BuildingError(lack.reason, f"{lack.detail}; its ground is neither among the points nor an attribute")
    ground = round(ground, 3)
    roofs = {
        HeightSource.HEIGHT: ground + given.height_m,
        HeightSource.ROOF_ELEVATION: given.roof_z_m,
        HeightSource.STOREYS: ground + given.storeys_m,
    }
    known = {name: round(z, 3) for name, z in roofs.items() if not math.isnan(z)}
    if not known:
        raise BuildingError(lack.reason, f"{lack.detail}; no attribute gives its height")
    for name, z in known.items():
        if _HEIGHTS.least - 1e-6 <= z - ground <= _HEIGHTS.most + 1e-6:
            roof = Plane(a=0.0, b=0.0, c=z, n_points=0, rmse_m=math.nan)
            return GivenBlock(plane=roof, ground_z_m=ground, height_source=name, ground_source=source)
    above = ", ".join(f"{name} {z - ground:.1f} m" for name, z in known.items())
    raise BuildingError(lack.reason, f"{lack.detail}; its attributes do not fit its ground, above it: {above}")
