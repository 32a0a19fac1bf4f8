"""The spatial reference of a file, from its header and what the user gives."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pipeline.io.crs import (
    SpatialReference,
    chosen_vertical_unit,
    horizontal_unit_of,
    reference_of,
    same_unit,
    vertical_unit_of,
)

if TYPE_CHECKING:
    import pyproj


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
    if crs is not None or vertical_unit is not None or header_crs is None:
        from pipeline.io.crs_given import reference_given

        return reference_given(
            path, header_crs, header_horizontal_unit_m, header_vertical_unit_m, crs=crs, vertical_unit=vertical_unit
        )
    horizontal_m = horizontal_unit_of(header_crs, path=path)
    own_m = vertical_unit_of(header_crs)
    found_m = header_vertical_unit_m if own_m is None else own_m
    vertical_m, warnings = chosen_vertical_unit(header_crs, horizontal_m, found_m, path=path)
    chosen = header_crs
    if not same_unit(vertical_m, horizontal_m if own_m is None else own_m):
        from pipeline.io.crs_units import with_vertical_unit

        chosen = with_vertical_unit(header_crs, vertical_m)
    return reference_of(chosen, header_crs, (horizontal_m, vertical_m), assumed=found_m is None), tuple(warnings)
