"""Openings of growing size by octagons, on surfaces with holes.

An opening removes all parts of a surface that are narrower than its structuring element. The elements here are sums of
crosses and squares of three cells in the ratio that makes a regular octagon. Each element is the one before with one
more piece: an erosion continues from the last.
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
def _widen_sideways(taken: Elevations, middle: Elevations, out: Elevations, want_low: bool) -> None:
    """Write the extremes of a row `middle` and of the cells to both sides of each of its cells in `taken`."""
    west, east = taken[:-2], taken[2:]
    if want_low:
        for c in range(out.size):
            v = min(middle[c], west[c])
            out[c] = min(east[c], v)
    else:
        for c in range(out.size):
            v = max(middle[c], west[c])
            out[c] = max(east[c], v)


@kernel
def _widen_row(values: Elevations, r: int, above: Elevations, across: Elevations, kind: tuple[bool, bool]) -> None:
    """Replace row r of values, except its ends, by the extreme over a square or cross of three cells.

    `above` is the row before r as it was, and becomes row r as it was; `across` is scratch. `kind` says whether the
    element is a square, and whether the extreme is the lowest.
    """
    is_square, want_low = kind
    here, below, out = values[r], values[r + 1], values[r, 1:-1]
    if want_low:
        for c in range(here.size):
            v = min(here[c], above[c])
            across[c] = min(below[c], v)
            above[c] = here[c]
    else:
        for c in range(here.size):
            v = max(here[c], above[c])
            across[c] = max(below[c], v)
            above[c] = here[c]
    # a square takes the neighbours of the column's extremes, a cross those of the row itself
    if is_square:
        _widen_sideways(across, across[1:-1], out, want_low)
    else:
        _widen_sideways(above, across[1:-1], out, want_low)


@kernel
def _widened(values: Elevations, first: int, last: int, want_low: bool) -> None:
    """Replace values, except their frame of one cell, by the extremes over the first to the last piece of an octagon.

    Each piece follows the one before a row behind it, so that the rows at work stay in the processor's cache.
    """
    rows, columns = values.shape
    pieces = last - first + 1
    above = np.empty((pieces, columns), np.int32)
    above[:] = values[0]
    across = np.empty(columns, np.int32)
    for step in range(1, rows - 2 + pieces):
        for piece in range(max(step - rows + 2, 0), min(pieces, step)):
            _widen_row(values, step - piece, above[piece], across, (_is_square(first + piece), want_low))


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
def erode_once(eroded: Elevations, radius: int) -> None:
    """From the erosion by the octagon of radius - 1 to that of radius, in place; the array is framed."""
    _widened(eroded, radius, radius, True)


@kernel
def dilate_back(surface: Elevations, eroded: Elevations, opened: Elevations, radius: int) -> None:
    """From an erosion to the opening of a surface with NO_DATA in holes, written to the framed array `opened`.

    Elements are centred only on cells with data: beyond the edge of the data an element would see only the roof that
    the edge cuts. `eroded`, the erosion by the octagon of a radius in cells, and `opened` are (rows + 2, columns + 2).
    """
    opened[:] = _LOW
    for r in range(surface.shape[0]):
        at, low, out = surface[r], eroded[r + 1, 1:-1], opened[r + 1, 1:-1]
        for c in range(at.size):
            v = low[c]
            out[c] = v if at[c] != NO_DATA else _LOW
    _widened(opened, 1, radius, False)


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
    before, after = eroded.copy(), eroded.copy()
    for radius in range(1, largest + 1):
        erode_once(eroded, radius)
        dilate_back(surface, eroded, after, radius)
        last = np.uint8(radius)
        for r in range(rows):
            at, base, out = surface[r], base_mm[r], found[r]
            high, low = before[r + 1, 1:-1], after[r + 1, 1:-1]
            for c in range(columns):
                is_cut = (high[c] - low[c] > base[c] + rise_mm * radius) & (at[c] != NO_DATA)
                before_it = out[c]
                out[c] = last if is_cut else before_it
        before, after = after, before
    return found
