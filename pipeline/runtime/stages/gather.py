"""Gather: the points and the terrain of one candidate, from all its tiles."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.compiler import kernel
from pipeline.export.facts import CandidateFacts
from pipeline.geometry import median_of
from pipeline.io.gps_time import GpsTimeKind, utc_of
from pipeline.kernels.sorting import radix_order
from pipeline.model import BoolArray, Candidate, FloatArray, GivenHeights, GroundSource, Guide, IntArray
from pipeline.quality.roof_returns import MAD_TO_SIGMA
from pipeline.roof.roof_settings import RoofSettings
from pipeline.runtime.scratch.folder import POINT, Scratch
from pipeline.runtime.stages.sites import CandidateSite, PointRange
from pipeline.runtime.stages.window_points import NO_GROUND, NO_POINT, Surroundings, surroundings_of
from pipeline.terrain.lattice import CELL_MM, HALF_DIAGONAL_M, NO_DATA
from pipeline.tiling import MM, TileGrid, Window

Area = TypeVar("Area", Polygon, MultiPolygon, Polygon | MultiPolygon)

# None of these is a setting: they define the terms of the docs, in metres or in cells of the 1 m lattice.
_GROUND_MARGIN_M = 4
"""Terrain within this distance of the roof is sampled."""
_VIEW_M = 14
"""Width of the view around a candidate: reaches all cells that the masks below look at."""
_OUTLINE_CELLS = 2
"""Terrain within these cells of the roof gives the ground elevation."""
_EMPTY_CELLS = 4
"""Half the side of a square without points that counts as the edge of the data."""
_EDGE_CELLS = 5
"""A roof this near to such a square touches the edge of the data."""
_VOID_CELLS = 8
"""Places without points are looked for within these cells of the roof: half of a large house."""
_CROWDED = (1.81, 1.26, 1.13)
"""An empty square of 3, 5 or 7 cells a side is a gap where the cells that hold points hold this many on average.

The squares then hold 12 points on average: points spread at random leave one of 160,000 such squares empty."""
_BESIDE_CELLS = 2
"""Points within these cells of the roof lie beside it."""
_LARGEST_M = 2000
"""Longest side of a block by attributes: what is larger is a district, or a slip."""
_FEWEST_GROUND_CELLS = 30
"""The noise of the ground is known to 15 % from so many cells."""
_OPEN_CELLS = 7
"""Ground is open where so many of nine cells hold some."""
_LEVEL_MM = 200
"""Ground is level where it rises by at most this over 2 m: that adds 0.03 m to the scatter."""
_PER_POINTS, _OF_PLANE = 0.2, 0.9
"""How the scatter of the lowest points of cells follows from that of single points; see `noise_of_ground_m`."""
_FARTHEST_MM = 2**62
"""Beyond all coordinates."""
_HEIGHT_WITHOUT_TERRAIN_MM = 2500
"""Assumed height of the lowest point above ground where no terrain is known."""


@kernel
def _grown(mask: BoolArray, cells: int) -> BoolArray:
    """Dilation by a square of 2 cells + 1: where the box around a cell holds any True."""
    rows, columns = mask.shape
    wide, grown = np.zeros((rows, columns), np.bool_), np.zeros((rows, columns), np.bool_)
    for r in range(rows):
        until = -1
        for c in range(columns + cells):
            if c < columns and mask[r, c]:
                until = c + 2 * cells
            if c >= cells and c <= until:
                wide[r, c - cells] = True
    for c in range(columns):
        until = -1
        for r in range(rows + cells):
            if r < rows and wide[r, c]:
                until = r + 2 * cells
            if r >= cells and r <= until:
                grown[r - cells, c] = True
    return grown


@kernel
def _terrain_by(places_mm: IntArray, around: Surroundings) -> tuple[IntArray, IntArray, BoolArray, bool]:
    """The terrain at the points (n, 2 or 3) of a candidate, or all where there are none.

    Samples (m, 3) of the terrain in millimetres, row after row; the lowest elevation at the outline, (1,) or none; the
    cells that hold the points; whether a square without points begins near one of these.
    """
    rows, columns = around.occupied.shape
    own = np.zeros((rows, columns), np.bool_)
    for i in range(len(places_mm)):
        own[places_mm[i, 1] // CELL_MM - around.row0, places_mm[i, 0] // CELL_MM - around.column0] = True
    # terrain far from all points may lie in a tile without points, which is never made
    points_near = _grown(around.occupied, _EMPTY_CELLS)
    outline, sampled, edge = (
        _grown(own, _OUTLINE_CELLS),
        _grown(own, _GROUND_MARGIN_M),
        _grown(own, _EDGE_CELLS + _EMPTY_CELLS),
    )
    samples, lowest = np.empty((rows * columns, 3), np.int64), np.empty(1, np.int64)
    count, known, touches = 0, 0, False
    for r in range(rows):
        for c in range(columns):
            touches = touches or (edge[r, c] and not points_near[r, c])
            z = around.elevation_mm[r, c]
            if z == NO_DATA or not points_near[r, c]:
                continue
            if outline[r, c] and not own[r, c] and (known == 0 or z < lowest[0]):
                lowest[0], known = z, 1
            if sampled[r, c] or len(places_mm) == 0:
                samples[count, 0] = (c + around.column0) * CELL_MM + CELL_MM // 2
                samples[count, 1] = (r + around.row0) * CELL_MM + CELL_MM // 2
                samples[count, 2] = z
                count += 1
    return samples[:count].copy(), lowest[:known], own, touches


@kernel
def _voids_by(own: BoolArray, occupied: BoolArray, n_points: int) -> BoolArray:
    """Cells near those of a candidate (rows, columns) that belong to squares without a point.

    None where its points are too few to tell such squares from chance.
    """
    reach, per_cell = 0, n_points / max(1, int(np.count_nonzero(own)))
    for k in range(len(_CROWDED) - 1, -1, -1):
        if per_cell >= _CROWDED[k]:
            reach = k + 1
    if reach == 0:
        return np.zeros_like(own)
    near = _grown(own, _VOID_CELLS)
    middles = ~_grown(occupied, reach) & _grown(near, reach)
    if not middles.any():
        return middles
    return _grown(middles, reach) & near


def points_of(scratch: Scratch, site: CandidateSite) -> npt.NDArray[np.void]:
    """A candidate's points in canonical order: X, Y, Z, return, GPS time, source."""
    points = stored_points(scratch, site)
    if _ascends(points):
        return points
    sorted_points: npt.NDArray[np.void] = np.take(points, canonical_order(points))
    return sorted_points


@kernel
def _ascends(points: npt.NDArray[np.void]) -> bool:
    """Whether all points (n,) are in order by X and Y, no two at the same place."""
    for i in range(1, len(points)):
        before, point = points[i - 1], points[i]
        if point.x < before.x or (point.x == before.x and point.y <= before.y):
            return False
    return True


def stored_points(scratch: Scratch, site: CandidateSite) -> npt.NDArray[np.void]:
    """A candidate's points, range after range."""
    pieces = [stored_bytes(scratch, part) for part in site.ranges]
    # as bytes: numpy copies records field by field
    return np.concatenate(pieces).view(POINT) if pieces else np.empty(0, POINT)


def stored_bytes(scratch: Scratch, part: PointRange) -> npt.NDArray[np.uint8]:
    """The bytes of a range of points; raises ValueError if the file ends before them."""
    first, last = part.start * POINT.itemsize, part.stop * POINT.itemsize
    return scratch.rows(f"{part.folder}/{part.tile.key}", "points", first, last)


def canonical_order(points: npt.NDArray[np.void]) -> IntArray:
    """Order of points by X, Y, Z, return, GPS time, source, independent of files and tiles; (n,) int64."""
    if len(points) == 0:
        return np.empty(0, np.int64)
    x, y = (points[name].astype(np.int64) - int(points[name].min()) for name in "xy")
    place = (x << int(y.max()).bit_length()) | y
    # the split sorted one tile's points by x and y: a stable sort would not move them
    is_sorted = bool((place[1:] >= place[:-1]).all())
    order = np.arange(len(points)) if is_sorted else radix_order(place).astype(np.int64)
    ordered = place[order]
    tied = np.flatnonzero(ordered[1:] == ordered[:-1])
    if len(tied):
        rows = np.unique(np.concatenate((tied, tied + 1)))
        among = np.sort(order[rows])
        few = points[among]
        order[rows] = among[
            np.lexsort((few["source"], few["gps_time"], few["return_number"], few["z"], few["y"], few["x"]))
        ]
    return order


class _Columns(NamedTuple):
    """What a candidate takes from its points (n,), of which there is at least one."""

    xyz_mm: IntArray
    """(n, 3)."""
    low_mm: IntArray
    """(3,), the least of each coordinate."""
    high_mm: IntArray
    """(3,), the greatest."""
    strip: npt.NDArray[np.uint16]
    """(n,), flight lines."""
    is_split: BoolArray
    """(n,), the first of several returns."""
    goes_on: int
    """Points whose pulse went on to a later return."""
    first_s: float
    """The earliest GPS time."""
    last_s: float
    """The latest."""


@kernel
def _columns_of(points: npt.NDArray[np.void]) -> _Columns:
    """The columns of points (n,)."""
    n = len(points)
    xyz_mm, strip, is_split = np.empty((n, 3), np.int64), np.empty(n, np.uint16), np.empty(n, np.bool_)
    low_mm, high_mm = np.full(3, _FARTHEST_MM), np.full(3, -_FARTHEST_MM)
    goes_on, first_s, last_s = 0, np.inf, -np.inf
    for i in range(n):
        point = points[i]
        xyz_mm[i, 0], xyz_mm[i, 1], xyz_mm[i, 2] = point.x, point.y, point.z
        strip[i] = point.source
        is_split[i] = point.return_number == 1 and point.return_count > 1
        goes_on += point.return_number < point.return_count
        first_s, last_s = min(first_s, point.gps_time), max(last_s, point.gps_time)
        for k in range(3):
            low_mm[k], high_mm[k] = min(low_mm[k], xyz_mm[i, k]), max(high_mm[k], xyz_mm[i, k])
    return _Columns(xyz_mm, low_mm, high_mm, strip, is_split, goes_on, first_s, last_s)


@kernel
def _in_metres(places_mm: IntArray, origin_mm: IntArray) -> FloatArray:
    """Places (n, 3) about an origin (3,), metres."""
    local_m = np.empty(places_mm.shape)
    for i in range(len(places_mm)):
        for k in range(3):
            local_m[i, k] = (places_mm[i, k] - origin_mm[k]) / MM
    return local_m


def gather(
    scratch: Scratch,
    grid: TileGrid,
    site: CandidateSite,
    gps_kind: GpsTimeKind,
    roof: RoofSettings | None = None,
    guides: Sequence[Guide] = (),
) -> tuple[Candidate, CandidateFacts]:
    """One candidate with the terrain around it, and with those of the guides, in metres of the CRS, that are near.

    `gps_kind` says whether GPS times can be converted to dates, `roof` whether to align strips and whether to add the
    points around and beneath it.
    """
    points = points_of(scratch, site)
    footprint = site.footprint
    own = _columns_of(points)
    xyz_mm, is_split, low, high = own.xyz_mm, own.is_split, own.low_mm, own.high_mm
    x0, y0, x1, y1 = (round(value * MM) for value in (footprint.bounds if footprint is not None else (0, 0, 0, 0)))
    if len(points) == 0:
        low, high = np.array([x0, y0, 0], np.int64), np.array([x1, y1, 0], np.int64)
    origin_mm = low // MM * MM
    view = Window(x0_mm=int(low[0]), y0_mm=int(low[1]), x1_mm=int(high[0]) + 1, y1_mm=int(high[1]) + 1)
    given = site.given if footprint is not None and max(x1 - x0, y1 - y0) <= _LARGEST_M * MM else None
    if given is not None:
        view = Window(
            x0_mm=min(view.x0_mm, x0),
            y0_mm=min(view.y0_mm, y0),
            x1_mm=max(view.x1_mm, x1 + 1),
            y1_mm=max(view.y1_mm, y1 + 1),
        )
    around = surroundings_of(scratch, grid, view.grown(_VIEW_M * MM))
    ground_mm, lowest_mm, cells, touches_data_edge = _terrain_by(xyz_mm, around)
    ground_z, ground_source = _ground_mm(lowest_mm, ground_mm[:, 2], xyz_mm[:, 2], site.given)
    digest = hashlib.sha256(points.tobytes())
    digest.update(ground_mm.tobytes())
    beside_mm = later_mm = np.empty((0, 3), np.int64)
    is_drawn, is_given = site.outline is not None, footprint is not None
    if roof is not None and roof.needs_facades(is_drawn=is_drawn, is_given=is_given):
        from pipeline.runtime.stages.beside import points_beside

        beside_mm, later_mm = points_beside(scratch, grid, xyz_mm, _grown(cells, _BESIDE_CELLS), around)
        digest.update(beside_mm.tobytes())
        digest.update(later_mm.tobytes())
    elsewhere_mm = _elsewhere(footprint, cells, around)
    digest.update(elsewhere_mm.tobytes())
    voids_mm = np.empty((0, 3), np.int64)
    if footprint is None and not touches_data_edge:
        rows, columns = np.nonzero(_voids_by(cells, around.occupied, len(points)))
        voids_mm = np.column_stack((columns + around.column0, rows + around.row0, rows)) * CELL_MM + CELL_MM // 2
        voids_mm[:, 2] = origin_mm[2]
    digest.update(voids_mm.tobytes())
    if site.outline is not None:
        digest.update(np.rint(shapely.get_coordinates(site.outline) * MM).astype(np.int64).tobytes())
    ground_noise_m = noise_of_ground_m(around, len(points) / max(1, int(np.count_nonzero(cells))))
    digest.update(np.float64(ground_noise_m).tobytes())
    strip_offset_m = math.nan
    if roof is not None and (own.strip != own.strip[:1]).any():
        from pipeline.strip_alignment import aligned_mm

        xyz_mm, is_split, strip_offset_m = aligned_mm(xyz_mm, own.strip, is_split, roof.min_strip_offset_m)
    near: tuple[Guide, ...] = ()
    if guides and len(points):
        from pipeline.runtime.stages.beside import guides_near

        near = guides_near(guides, low, high, origin_mm)
    points_m = _in_metres(xyz_mm, origin_mm)
    candidate = Candidate(
        building_id=site.building_id,
        origin=(float(origin_mm[0] // MM), float(origin_mm[1] // MM), float(origin_mm[2] // MM)),
        points=points_m,
        ground=_in_metres(ground_mm, origin_mm),
        split_returns=points_m[is_split],
        ground_z_m=math.nan if ground_z is None else (ground_z - int(origin_mm[2])) / MM,
        ground_source=ground_source,
        footprint=None if footprint is None else _moved(footprint, origin_mm),
        source_id=site.source_id,
        given=None if given is None else _local(given, footprint, around, int(origin_mm[2])),
        outline=None if site.outline is None else _moved(site.outline, origin_mm),
        beside=_in_metres(beside_mm, origin_mm),
        beside_later=_in_metres(later_mm, origin_mm),
        elsewhere=_in_metres(elsewhere_mm, origin_mm),
        voids=_in_metres(voids_mm, origin_mm),
        touches_data_edge=touches_data_edge,
        is_known=is_given or (site.override is not None and site.override.says_building),
        strip_offset_m=strip_offset_m,
        ground_noise_m=ground_noise_m,
        guides=near,
    )
    is_dated = gps_kind is GpsTimeKind.ADJUSTED and len(points) > 0
    facts = CandidateFacts(
        input_hash=digest.hexdigest(),
        acquired_from=utc_of(own.first_s) if is_dated else None,
        acquired_to=utc_of(own.last_s) if is_dated else None,
        through_share=own.goes_on / len(points) if len(points) else math.nan,
    )
    return candidate, facts


def _ground_mm(
    outline_mm: IntArray, terrain_mm: IntArray, points_mm: IntArray, given: GivenHeights | None
) -> tuple[int | None, GroundSource | None]:
    """Ground elevation and its source: lowest of the terrain around the outline, else of all terrain, else given.

    Else it lies below the points; None without any.
    """
    for elevations in (outline_mm, terrain_mm):
        if len(elevations):
            return int(elevations.min()), GroundSource.TERRAIN
    if given is not None and not math.isnan(given.ground_z_m):
        return round(given.ground_z_m * MM), GroundSource.ATTRIBUTE
    if len(points_mm):
        return int(points_mm.min()) - _HEIGHT_WITHOUT_TERRAIN_MM, GroundSource.ASSUMED
    return None, None


@kernel
def _open_ground(off_mm: npt.NDArray[np.int16], elevation_mm: IntArray) -> IntArray:
    """The distances (rows, columns) of cells on level ground of which most neighbours hold ground, too: (n,) int64, mm.

    On a slope the distance to the terrain at the cell's centre depends on where in the cell the point lies. Beneath
    plants few pulses meet the ground, and a terrain through few of them misses the others.
    """
    rows, columns = off_mm.shape
    found, count = np.empty(rows * columns, np.int64), 0
    for r in range(1, rows - 1):
        for c in range(1, columns - 1):
            if off_mm[r, c] == NO_POINT or off_mm[r, c] == NO_GROUND:
                continue
            # a cell with ground has terrain all around
            north, east = (
                elevation_mm[r + 1, c] - elevation_mm[r - 1, c],
                elevation_mm[r, c + 1] - elevation_mm[r, c - 1],
            )
            if north * north + east * east > _LEVEL_MM * _LEVEL_MM:
                continue
            held = 0
            for i in range(r - 1, r + 2):
                for j in range(c - 1, c + 2):
                    held += off_mm[i, j] != NO_POINT and off_mm[i, j] != NO_GROUND
            if held >= _OPEN_CELLS:
                found[count], count = off_mm[r, c], count + 1
    return found[:count].copy()


def noise_of_ground_m(around: Surroundings, points_per_cell: float) -> float:
    """Robust standard deviation of points of open, level ground about the terrain, metres; nan where there are few.

    Cells know their lowest point alone, and the terrain follows it. The lowest of k normal values has about
    k^-1/5 of their standard deviation (.67 for 8, exactly .61; cells differ in k, which brings it nearer), and a plane
    through nine cells leaves .9 of it.
    """
    off = _open_ground(around.off_mm, around.elevation_mm.astype(np.int64))
    lowest_mm = MAD_TO_SIGMA * median_of(np.abs(off - median_of(off))) if len(off) >= _FEWEST_GROUND_CELLS else math.nan
    return float(lowest_mm * max(1.0, points_per_cell) ** _PER_POINTS / _OF_PLANE / MM)


def _elsewhere(footprint: Polygon | MultiPolygon | None, own: BoolArray, around: Surroundings) -> IntArray:
    """Centres (e, 3), mm, of the cells wholly in a footprint that hold points, but none of the building's `own`.

    They lie on the terrain, at 0 where it is unknown.
    """
    if footprint is None:
        return np.empty((0, 3), np.int64)
    rows, columns = np.nonzero(around.occupied & ~own)
    z = around.elevation_mm[rows, columns].astype(np.int64)
    places = np.column_stack((columns + around.column0, rows + around.row0)) * CELL_MM + CELL_MM // 2
    within = shapely.buffer(footprint, -HALF_DIAGONAL_M)  # ground at a wall lies in cells that the wall cuts
    shapely.prepare(within)
    inside = shapely.contains_xy(within, places / MM)
    elsewhere_mm: IntArray = np.column_stack((places, np.where(z == NO_DATA, 0, z)))[inside]
    return elsewhere_mm


def _moved(area: Area, origin_mm: IntArray) -> Area:
    """An area in metres, from the CRS into a local frame."""
    if area.is_empty:
        return area
    shift_m = np.array((*origin_mm[:2] // MM, 0), np.float64)
    moved: Area = shapely.transform(area, lambda xyz: xyz - shift_m[: xyz.shape[1]], include_z=bool(area.has_z))
    return moved


def _local(
    given: GivenHeights, footprint: Polygon | MultiPolygon | None, around: Surroundings, origin_z_mm: int
) -> GivenHeights:
    """Heights by attributes in local elevations, with the terrain at the outline of their footprint."""
    rows, columns = around.occupied.shape
    x = (np.arange(columns, dtype=np.int64) + around.column0) * CELL_MM + CELL_MM // 2
    y = (np.arange(rows, dtype=np.int64) + around.row0) * CELL_MM + CELL_MM // 2
    centres = np.column_stack([axis.ravel() for axis in np.meshgrid(x, y)])
    touched = shapely.buffer(footprint, HALF_DIAGONAL_M)
    inside = shapely.intersects_xy(touched, centres / MM)
    ground_mm, lowest_mm, _, _ = _terrain_by(centres[inside], around)
    terrain_mm, _ = _ground_mm(lowest_mm, ground_mm[:, 2], np.empty(0, np.int64), None)
    return dataclasses.replace(
        given,
        roof_z_m=given.roof_z_m - origin_z_mm / MM,
        ground_z_m=given.ground_z_m - origin_z_mm / MM,
        terrain_z_m=math.nan if terrain_mm is None else (terrain_mm - origin_z_mm) / MM,
    )
