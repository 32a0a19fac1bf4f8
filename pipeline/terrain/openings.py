"""Openings of growing size by octagons, on surfaces with holes.

An opening removes from a surface what is narrower than its structuring element. The elements here are sums of crosses
and squares of three cells in the ratio that makes a regular octagon. Each element is the one before with one more
piece: an erosion continues from the last.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import ByteArray
from pipeline.terrain.lattice import NO_DATA, Elevations

_HIGH = np.int32(2**30)
"""Above and below all elevations in mm, far enough from the ends of int32 for differences."""
_LOW = np.int32(-(2**30))


@kernel(inline="always")
def _is_square(number: int) -> bool:
    """Whether the n-th piece of an octagon is a square: 29 of 70 are, as sqrt(2) - 1 asks; the others are crosses."""
    return number * 29 // 70 > (number - 1) * 29 // 70


@kernel
def _widened(values: Elevations, across: Elevations, is_square: bool, want_low: bool) -> None:
    """Replace values, except their frame of one cell, by the extreme over a square or cross of three cells."""
    rows, columns = values.shape
    row = np.empty(columns, np.int32)
    for r in range(1, rows - 1):
        above, here, below, out = values[r - 1], values[r], values[r + 1], across[r]
        if want_low:
            for c in range(columns):
                v = min(here[c], above[c])
                out[c] = min(below[c], v)
        else:
            for c in range(columns):
                v = max(here[c], above[c])
                out[c] = max(below[c], v)
    for r in range(1, rows - 1):
        # a square takes the neighbours of the column's extremes, a cross those of the row itself
        taken = across[r] if is_square else values[r]
        for c in range(columns):
            row[c] = taken[c]
        west, middle, east, out = row[:-2], across[r, 1:-1], row[2:], values[r, 1:-1]
        if want_low:
            for c in range(columns - 2):
                v = min(middle[c], west[c])
                out[c] = min(east[c], v)
        else:
            for c in range(columns - 2):
                v = max(middle[c], west[c])
                out[c] = max(east[c], v)


@kernel
def framed(surface: Elevations) -> Elevations:
    """The surface in a frame of one cell, for erosion: cells without data are above everything."""
    rows, columns = surface.shape
    out = np.full((rows + 2, columns + 2), _HIGH, np.int32)
    for r in range(rows):
        for c in range(columns):
            if surface[r, c] != NO_DATA:
                out[r + 1, c + 1] = surface[r, c]
    return out


@kernel(inline="always")
def erode_once(eroded: Elevations, scratch: Elevations, radius: int) -> None:
    """From the erosion by the octagon of radius - 1 to that of radius, in place; both arrays are framed."""
    _widened(eroded, scratch, _is_square(radius), True)


@kernel
def dilate_back(surface: Elevations, eroded: Elevations, opened: Elevations, scratch: Elevations, radius: int) -> None:
    """From an erosion to the opening of a surface with NO_DATA in holes, written to the framed array `opened`.

    Elements are centred only on cells with data: beyond the edge of the data an element would see only the roof that
    the edge cuts. `eroded`, the erosion by the octagon of a radius in cells, `opened` and `scratch` are (rows + 2,
    columns + 2).
    """
    rows, columns = surface.shape
    opened[:] = _LOW
    scratch[:] = _LOW
    for r in range(rows):
        for c in range(columns):
            if surface[r, c] != NO_DATA:
                opened[r + 1, c + 1] = eroded[r + 1, c + 1]
    for number in range(radius, 0, -1):
        _widened(opened, scratch, _is_square(number), False)


@kernel
def cut_off(surface: Elevations, base_mm: Elevations, rise_mm: float, largest: int) -> ByteArray:
    """The last radius at which a growing opening removes more from a cell than it may, (rows, columns) uint8.

    0 where no step removes more, and in holes. A planar slope loses nothing to an opening. A hilltop, crest or brow
    loses by each cell of radius no more than its slope rises over a cell; an object loses all of its height at once
    when the element no longer fits into it.

    Parameters
    ----------
    surface : (rows, columns) int32
        Elevations or heights in mm, NO_DATA in holes.
    base_mm : (rows, columns) int32
        Height that a step to any radius may remove from each cell.
    rise_mm : float
        Additional height per cell of the radius.
    largest : int
        Largest radius in cells; every radius from 1 on is tried.
    """
    rows, columns = surface.shape
    found = np.zeros((rows, columns), np.uint8)
    eroded = framed(surface)
    before, after, high, low = eroded.copy(), eroded.copy(), eroded.copy(), eroded.copy()
    for radius in range(1, largest + 1):
        erode_once(eroded, high, radius)
        dilate_back(surface, eroded, after, low, radius)
        for r in range(rows):
            for c in range(columns):
                if surface[r, c] != NO_DATA:
                    taken = before[r + 1, c + 1] - after[r + 1, c + 1]
                    if taken > base_mm[r, c] + rise_mm * radius:
                        found[r, c] = radius
        before, after = after, before
    return found
