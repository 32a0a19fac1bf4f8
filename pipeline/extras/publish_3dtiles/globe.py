"""From the coordinates of a run to the ellipsoid of WGS 84, as a globe needs them, with what was done to the heights.

Plan and elevation are separate. With a compound CRS whose grid is missing, PROJ (9.5) falls back to a "ballpark" that
drops the shift of the datum too, 100 m in the Netherlands. So ballparks are refused here: either PROJ knows the whole
way, or the horizontal part goes its own way and the elevation gets a correction that is stated.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from pipeline.errors import RunError
from pipeline.io.crs import SpatialReference, vertical_unit_of
from pipeline.model import FloatArray

if TYPE_CHECKING:
    import pyproj

_GEODETIC, _GEOCENTRIC = "EPSG:4979", "EPSG:4978"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Geodesy:
    """A way from metres of a CRS to the ellipsoid of WGS 84; `geodesy` makes it."""

    steps: pyproj.Transformer
    """From the CRS, in its units, to longitude, latitude (and height, if `geoid_height_m` is None)."""
    geocentric: pyproj.Transformer
    """From there to EPSG:4978."""
    units_m: tuple[float, float]
    """Metres in one unit of the plan, and of the elevation."""
    geoid_height_m: float | None
    """Added to elevations in metres; None if the steps convert them."""
    facts: Mapping[str, Any]
    """What was done, for files and people: `transformation`, `accuracy_m`, `heights`, `geoid_height_m`."""

    def __call__(self, xyz_m: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Longitude, latitude (degrees) and ellipsoidal height (m) of places (n, 3), and their EPSG:4978 (n, 3).

        Not finite where a place has none.
        """
        x, y, z = xyz_m.T
        plan, vertical = self.units_m
        if self.geoid_height_m is None:
            found = self.steps.transform(x / plan, y / plan, z / vertical)
        else:
            found = (*self.steps.transform(x / plan, y / plan), z + self.geoid_height_m)
        return np.column_stack(found), np.column_stack(self.geocentric.transform(*found))


def geodesy(reference: SpatialReference, geoid_height_m: float | None = None) -> Geodesy:
    """The way from a CRS to the ellipsoid of WGS 84.

    Heights get, in this order: the geoid height that is given; the geoid of the compound CRS, if PROJ has its grid; the
    CRS's own ellipsoidal heights; else nothing, and `facts` say so. No grid is fetched unless PROJ_NETWORK is set.
    Raises RunError if the CRS is unknown or PROJ knows no way.

    Parameters
    ----------
    reference : SpatialReference
        The CRS and its units.
    geoid_height_m : float, optional
        Height of the geoid above the ellipsoid of WGS 84, about the same in all of the run.
    """
    import pyproj

    crs, plane = reference.crs, reference.horizontal_crs
    if crs is None or plane is None:
        raise RunError("the CRS of the run is unknown, so it has no place on Earth: run it again with --crs EPSG:n")
    whole = None if geoid_height_m is not None or len(crs.axis_info) < 3 else _known_way(crs)
    steps = whole or _known_way(plane)
    if steps is None:
        raise RunError(f"PROJ knows no way from {reference.name} to WGS 84: reproject the input, then run it again")
    if geoid_height_m is not None:
        heights = "elevations plus the given geoid height"
    elif whole is not None:
        heights = "converted by PROJ"
    else:
        heights = "elevations taken as ellipsoidal heights, since PROJ lacks the geoid's grid"
        if len(crs.axis_info) < 3:
            heights = "elevations taken as ellipsoidal heights, since the CRS has no vertical part"
    added = None if whole is not None else (geoid_height_m or 0.0)
    return Geodesy(
        steps=steps,
        geocentric=pyproj.Transformer.from_crs(_GEODETIC, _GEOCENTRIC, always_xy=True),
        units_m=(reference.horizontal_unit_m, vertical_unit_of(crs) or 1.0),
        geoid_height_m=added,
        facts={
            "crs": reference.name,
            "transformation": steps.description,
            "accuracy_m": steps.accuracy if steps.accuracy >= 0.0 else None,
            "heights": heights,
            "geoid_height_m": added,
        },
    )


def _known_way(crs: pyproj.CRS) -> pyproj.Transformer | None:
    """PROJ's best transformation to WGS 84 whose grids are there; None without any. No ballpark."""
    from pyproj.exceptions import ProjError
    from pyproj.transformer import TransformerGroup

    with warnings.catch_warnings():
        # the description of what is used instead goes into the file
        warnings.filterwarnings("ignore", message="Best transformation is not available")
        try:
            found = TransformerGroup(crs, _GEODETIC, always_xy=True, allow_ballpark=False).transformers
        except ProjError:
            return None
    return found[0] if found else None


def to_globe(reference: SpatialReference) -> Callable[[FloatArray], FloatArray] | None:
    """A function from places (n, 3) in metres of the CRS to EPSG:4978, (n, 3) in metres, as `geodesy` has it.

    Places that have none get infinite coordinates. None if the CRS is unknown or PROJ knows no way.
    """
    try:
        way = geodesy(reference)
    except RunError:
        return None
    return lambda xyz_m: way(xyz_m)[1]
