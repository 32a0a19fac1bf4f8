"""Wide objects: halls and blocks too wide for the openings that find smaller objects.

Openings continue to grow on a coarse lattice. A step of one coarse cell removes from a hill no more than it rises over
that cell, but from a flat roof the whole height: a limit in metres per step separates halls from hills.
"""

from __future__ import annotations

import numpy as np

from pipeline.compiler import kernel
from pipeline.model import BoolArray, ByteArray
from pipeline.terrain.lattice import NO_DATA, Elevations
from pipeline.terrain.openings import dilate_back, erode_once, framed
from pipeline.terrain.reach import COARSE, FILL, NARROW, RIM_CELLS

_RIM_STEP_MM = 200
"""A corner lies no deeper than this below the wide cells beside it: it is level with them."""

_RIM_SHARE = 0.9
"""Share of those cells for which this must hold."""


@kernel
def _coarse(lowest: Elevations, column0: int, row0: int) -> Elevations:
    """Lowest elevation of each coarse cell, anchored at the CRS's origin."""
    rows, columns = lowest.shape
    corner_r, corner_c = row0 // COARSE, column0 // COARSE
    shape = ((row0 + rows - 1) // COARSE - corner_r + 1, (column0 + columns - 1) // COARSE - corner_c + 1)
    out = np.full(shape, NO_DATA, np.int32)
    for r in range(rows):
        for c in range(columns):
            i, j = (row0 + r) // COARSE - corner_r, (column0 + c) // COARSE - corner_c
            out[i, j] = min(out[i, j], lowest[r, c])
    return out


@kernel
def _extreme_of_nine(values: Elevations, want_low: bool, into_gaps: bool) -> Elevations:
    """Extreme of the nine cells around each cell with data, or only around each one without."""
    rows, columns = values.shape
    out = values.copy()
    for r in range(rows):
        for c in range(columns):
            if (values[r, c] == NO_DATA) != into_gaps:
                continue
            found = False
            best = np.int32(0)
            for i in range(max(r - 1, 0), min(r + 2, rows)):
                for j in range(max(c - 1, 0), min(c + 2, columns)):
                    v = values[i, j]
                    if v != NO_DATA and (not found or (v < best if want_low else v > best)):
                        best, found = v, True
            if found:
                out[r, c] = best
    return out


@kernel
def _floors(surface: Elevations, first: int, last: int, rise_mm: float) -> Elevations:
    """The opening's level where a step of its growing radius takes more than rise_mm a cell of it, else NO_DATA."""
    rows, columns = surface.shape
    out = np.full((rows, columns), NO_DATA, np.int32)
    eroded = framed(surface)
    before, after = eroded.copy(), eroded.copy()
    for radius in range(1, last + 1):
        erode_once(eroded, radius)
        if radius < first - 1:
            continue
        dilate_back(surface, eroded, after, radius)
        if radius >= first:
            for r in range(rows):
                at, floor, high, low = surface[r], out[r], before[r + 1, 1:-1], after[r + 1, 1:-1]
                for c in range(columns):
                    new, old = low[c], floor[c]
                    floor[c] = new if (at[c] != NO_DATA) & (high[c] - new > rise_mm * radius) else old
        before, after = after, before
    return out


@kernel
def _on_fine(lowest: Elevations, floors: Elevations, column0: int, row0: int, above_mm: int) -> BoolArray:
    """Mask of the cells that are this far above the floor of a coarse cell beside them."""
    rows, columns = lowest.shape
    corner_r, corner_c = row0 // COARSE, column0 // COARSE
    low = np.full_like(floors, NO_DATA)
    for i in range(floors.shape[0]):
        for j in range(floors.shape[1]):
            # the lowest floor decides; NO_DATA is above all
            for a in range(max(i - 1, 0), min(i + 2, floors.shape[0])):
                for b in range(max(j - 1, 0), min(j + 2, floors.shape[1])):
                    low[i, j] = min(low[i, j], floors[a, b])
    out = np.zeros((rows, columns), np.bool_)
    for r in range(rows):
        i = (row0 + r) // COARSE - corner_r
        for c in range(columns):
            floor = low[i, (column0 + c) // COARSE - corner_c]
            out[r, c] = (lowest[r, c] != NO_DATA) & (floor != NO_DATA) & (lowest[r, c] - floor > above_mm)
    return out


def wide_objects(lowest: Elevations, corner: tuple[int, int], narrower: int, radius: int, rise_mm: float) -> BoolArray:
    """Mask of the cells of wide objects; none where there is no data.

    `lowest` is the elevation in mm of the lowest point of each cell, NO_DATA where there is none; `corner` is the
    absolute column and row of the first cell. `narrower` and `radius` are the radii of the first and the last opening,
    in cells. A step may remove `rise_mm` per cell of the radius: wider objects must be higher.
    """
    surface = _coarse(lowest, *corner)
    for _ in range(FILL):  # the higher side wins: an outlier must not grow
        surface = _extreme_of_nine(surface, False, True)
    for want_low in (False, True):
        for _ in range(NARROW):
            surface = _extreme_of_nine(surface, want_low, False)
    floors = _floors(surface, narrower // COARSE, -(-radius // COARSE), rise_mm * COARSE)
    return _on_fine(lowest, floors, *corner, round(rise_mm * narrower / 2))


@kernel
def with_corners(lowest: Elevations, wide: BoolArray, first: ByteArray) -> BoolArray:
    """Wide objects with the corners into which no octagon fits.

    A narrower opening removed the corner of a hall in smaller steps. The corner is level with the hall, and the first
    openings cut it off: `first` is their last radius that did, 0 where none did. Elevations are in mm.
    """
    rows, columns = lowest.shape
    out = wide.copy()
    for r in range(rows):
        for c in range(columns):
            if wide[r, c] or first[r, c] == 0 or lowest[r, c] == NO_DATA:
                continue
            beside, level = 0, 0
            for a in range(max(r - RIM_CELLS, 0), min(r + RIM_CELLS + 1, rows)):
                for b in range(max(c - RIM_CELLS, 0), min(c + RIM_CELLS + 1, columns)):
                    if wide[a, b]:
                        beside += 1
                        if lowest[a, b] - lowest[r, c] <= _RIM_STEP_MM:
                            level += 1
            out[r, c] = level >= 2 and level >= _RIM_SHARE * beside
    return out
