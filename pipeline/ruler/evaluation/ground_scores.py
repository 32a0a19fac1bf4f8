"""The ground filter against reference classes: type I, type II and total error, and kappa (Sithole, Vosselman 2003).

Last returns are judged, since ground filters decide on them. Noise and water are left out. If other classes name the
objects, unclassified points are left out too: they may be ground. The found ground comes from a classified file of any
program, or from the ground stage of a run: its filter over the same points, with its settings and its rule for points
near the terrain (`ground_points`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from pipeline.errors import InconsistentInputError
from pipeline.io import ReadOptions, open_source
from pipeline.io.places import file_at
from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.ruler.evaluation.bootstrap import Statistic, Sums, share
from pipeline.ruler.evaluation.measure import Better, Measure, defined
from pipeline.ruler.evaluation.reference import Reference, ReferencePoints
from pipeline.ruler.evaluation.subsets import Columns, Subset, measured_all
from pipeline.scene import GROUND_CLASS
from pipeline.terrain.ground import Terrain, ground_of, ground_points
from pipeline.terrain.lattice import CELL_MM, NO_DATA, Elevations, lowest_per_cell
from pipeline.terrain.outliers import dense_enough
from pipeline.terrain.terrain_settings import OutlierSettings, SceneSettings

NOT_JUDGED = (7, 9, 18)
"""Reference classes that are neither ground nor object: low noise, water, high noise."""
UNCLASSIFIED = (0, 1)
"""Classes that name no object. In the samples of the benchmark, all points that are not ground have one of them."""
BLOCK_M = 50
"""Side of the blocks that are the units of the bootstrap."""
MM = 1000
WINDOW_CELLS = 512
"""Side of the windows in which the terrain is drawn, in cells of 1 m."""
_WHOLE_POINTS = 20_000_000
"""Above this number of points, outliers are searched window by window to bound memory."""
_NO_MORE = 2**62
"""Larger than any key."""

FoundGround = Callable[[ReferencePoints], BoolArray]
"""From the points of a tile to the found ground: (n,) bool, True for ground."""


# ------------------------------------------------------------------------------------------------------------ counts


def ground_blocks(reference: Reference, found: FoundGround) -> Columns:
    """Right and wrong points of every tile by blocks of 50 m, one tile in memory; empty if no ground is known.

    Columns: `tile`, its name; `row` and `column` of the block, 0 at the origin of the CRS, along northing and easting;
    `right`: ground found as ground; `missed`: ground taken for an object; `other`: object found as object; `taken`:
    object taken for ground.
    """
    if not reference.has_ground:
        return {}
    left_out = NOT_JUDGED if reference.unclassified_is_object else (*NOT_JUDGED, *UNCLASSIFIED)
    tiles, parts = [np.zeros(0, object)], [np.zeros((0, 6), np.int64)]
    for points in reference.points():
        labels = found(points)
        judged = points.last & ~np.isin(points.classification, left_out)
        is_ground = points.classification[judged] == GROUND_CLASS
        outcome = np.where(is_ground, 0, 2) + np.where(labels[judged] == is_ground, 0, 1)
        place = np.floor(points.xyz[judged, :2] / BLOCK_M).astype(np.int64)
        west = place[:, 0].min(initial=0)
        width = int(place[:, 0].max(initial=0) - west) + 1
        blocks, unit = np.unique(place[:, 1] * width + (place[:, 0] - west), return_inverse=True)
        counts = np.bincount(4 * unit + outcome, minlength=4 * len(blocks)).reshape(-1, 4)
        parts.append(np.column_stack([blocks // width, west + blocks % width, counts]))
        tiles.append(np.full(len(blocks), points.name, object))
    names = ("row", "column", "right", "missed", "other", "taken")
    return {"tile": np.concatenate(tiles), **dict(zip(names, np.concatenate(parts).T, strict=True))}


def tile_figures(blocks: Columns) -> Columns:
    """The figures of each tile, in the order of the tiles; nan where the tile has no ground, or no object."""
    tiles = list(dict.fromkeys(blocks["tile"].tolist()))
    sums: dict[str, FloatArray] = {}
    for tile in tiles:
        of_tile = _columns({name: column[blocks["tile"] == tile] for name, column in blocks.items()})
        for name, column in of_tile.items():
            sums[name] = np.append(sums.get(name, []), column.sum())
    with np.errstate(divide="ignore", invalid="ignore"):
        figures = {name: statistic(sums) for name, statistic, _ in _STATISTICS}
    counts = {name: sums[name].astype(np.int64) for name in ("ground", "object")}
    return {"tile": np.array(tiles, object), **figures, **counts}


# ---------------------------------------------------------------------------------------------------- found in files


class GroundOfFiles:
    """Ground (class 2) in classified files that another program wrote for the same points.

    CRS and units are read as for the reference; no points are dropped.
    """

    def __init__(self, paths: Sequence[str | Path], options: ReadOptions | None = None) -> None:
        self._options = dataclasses.replace(options or ReadOptions(), keep_withheld=True, drop_classes=())
        self._paths = [file_at(path) for path in paths]
        self._bounds = [open_source(path, self._options).info.bounds_m for path in self._paths]

    def __call__(self, points: ReferencePoints) -> BoolArray:
        """Labels of the points of a tile, matched by coordinates in whole millimetres and return number.

        Raises InconsistentInputError if points of the tile are in none of the files.
        """
        if len(points.xyz) == 0:
            return np.zeros(0, np.bool_)
        low, high = points.xyz.min(axis=0) - 0.001, points.xyz.max(axis=0) + 0.001
        xyz, returns, ground = [np.zeros((0, 3))], [np.zeros(0, np.uint8)], [np.zeros(0, np.bool_)]
        for path, bounds in zip(self._paths, self._bounds, strict=True):
            if bounds[0] > high[0] or bounds[3] < low[0] or bounds[1] > high[1] or bounds[4] < low[1]:
                continue
            for cloud in open_source(path, self._options).chunks():
                inside = ((cloud.xyz[:, :2] >= low[:2]) & (cloud.xyz[:, :2] <= high[:2])).all(axis=1)
                xyz.append(cloud.xyz[inside])
                returns.append(cloud.return_number[inside])
                ground.append(cloud.classification[inside] == GROUND_CLASS)
        numbers = np.concatenate(returns) if points.return_number is not None else None
        match = matched_points(points.xyz, points.return_number, np.concatenate(xyz), numbers)
        missing = int((match < 0).sum())
        if missing:
            at = points.xyz[int(np.flatnonzero(match < 0)[0])]
            raise InconsistentInputError(
                ", ".join(str(path) for path in self._paths) or "(no file)",
                f"{missing} of the {len(match)} points of {points.name} are not in it, the first at"
                f" {at[0]:.3f} {at[1]:.3f} {at[2]:.3f}",
                "Classify the very points of the reference: the same coordinates to 1 mm and the same return numbers",
            )
        found: BoolArray = np.concatenate(ground)[match]
        return found


def matched_points(
    wanted: FloatArray, wanted_return: np.ndarray | None, offered: FloatArray, offered_return: np.ndarray | None
) -> IntArray:
    """The offered point (m, 3) at the same place as each wanted one (n, 3), in metres: (n,) int64, -1 for none.

    Places are compared on whole millimetres; return numbers, (n,) and (m,) or None for both, must agree too. Each
    offered point is used once; equal points pair up in their order.
    """
    a, b = np.rint(wanted * MM).astype(np.int64), np.rint(offered * MM).astype(np.int64)
    r = np.zeros(len(a), np.int64) if wanted_return is None else wanted_return.astype(np.int64)
    s = np.zeros(len(b), np.int64) if offered_return is None else offered_return.astype(np.int64)
    if len(a) == len(b) and (a == b).all() and (r == s).all():
        return np.arange(len(a))
    keys = np.concatenate([np.column_stack([a, r]), np.column_stack([b, s])])
    order = np.lexsort(keys.T[::-1])  # in each group of equal keys the wanted ones come first
    place = np.arange(len(order))
    is_first = np.append(True, (np.diff(keys[order], axis=0) != 0).any(axis=1))[: len(order)]
    start = np.flatnonzero(is_first)[np.cumsum(is_first) - 1]
    is_offered = order >= len(a)
    wanted_before: IntArray = np.cumsum(~is_offered) - ~is_offered
    partner = np.full(len(order), -1, np.int64)
    pair = place - (wanted_before - wanted_before[start])  # the first offered one goes to the first wanted one
    partner[pair[is_offered]] = order[is_offered] - len(a)
    match = np.empty(len(a), np.int64)
    match[order[~is_offered]] = partner[~is_offered]
    return match


# ----------------------------------------------------------------------------------------------------- found by a run


class GroundOfRun:
    """Ground by the ground stage of a run, its filter run again over the points of the reference.

    One pass over the points gives the lowest last return of each cell of 1 m, then the terrain is made window by window
    with the halo of the filter, so it does not depend on the tiles. The classes of the file are never used here, even
    if the run used them. Gross outliers are searched tile by tile.
    """

    def __init__(self, reference: Reference, settings: SceneSettings) -> None:
        self._settings = settings
        self._lowest: dict[tuple[int, int], Elevations] = {}
        for points in reference.points():
            self._add(points)
        self._terrain = {place: self._drawn(*place) for place in sorted(self._lowest)}

    def __call__(self, points: ReferencePoints) -> BoolArray:
        """Ground of a tile: points near the terrain or below it, without outliers."""
        x, y, z = _millimetres(points.xyz)
        found = np.zeros(len(x), np.bool_)
        for (row, column), index in _by_window(x, y):
            terrain = self._terrain[row, column]
            found[index] = ground_points(x[index], y[index], z[index], terrain, self._settings.ground)
        return found & kept_points(x, y, z, self._settings.outliers)

    def _add(self, points: ReferencePoints) -> None:
        """Lower the cells of a tile's last returns."""
        x, y, z = _millimetres(points.xyz)
        usable = points.last & kept_points(x, y, z, self._settings.outliers)
        for (row, column), index in _by_window(x, y):
            corner = column * WINDOW_CELLS, row * WINDOW_CELLS
            lowest = lowest_per_cell(x[index], y[index], z[index], usable[index], *corner, WINDOW_CELLS, WINDOW_CELLS)
            known = self._lowest.get((row, column))
            self._lowest[row, column] = lowest if known is None else np.minimum(known, lowest)

    def _around(self, row: int, column: int, margin: int) -> Elevations:
        """The lowest points of a window, and of a margin of at most one window around it."""
        side = WINDOW_CELLS
        whole = np.full((3 * side, 3 * side), NO_DATA, np.int32)
        for i in range(3):
            for j in range(3):
                known = self._lowest.get((row + i - 1, column + j - 1))
                if known is not None:
                    whole[i * side : (i + 1) * side, j * side : (j + 1) * side] = known
        cut = slice(side - margin, 2 * side + margin)
        return np.ascontiguousarray(whole[cut, cut])

    def _drawn(self, row: int, column: int) -> Terrain:
        """The terrain of a window and of one cell around it, by the run's filter over the lowest points around."""
        settings = self._settings.ground
        margin = math.ceil(settings.support_m) + 1
        if margin > WINDOW_CELLS:
            raise AssertionError(f"the ground looks {margin} m far, farther than a window of {WINDOW_CELLS} m")
        lowest = self._around(row, column, margin)
        corner = column * WINDOW_CELLS - margin, row * WINDOW_CELLS - margin
        rows, columns = np.nonzero(lowest != NO_DATA)
        middle = CELL_MM // 2
        terrain = ground_of(
            (columns + corner[0]) * CELL_MM + middle,
            (rows + corner[1]) * CELL_MM + middle,
            lowest[rows, columns].astype(np.int64),
            np.ones(len(rows), np.bool_),
            (*corner, lowest.shape[1], lowest.shape[0]),
            settings,
            trusted=False,
        )
        inner = slice(margin - 1, 1 - margin)
        return Terrain(
            elevation_mm=np.ascontiguousarray(terrain.elevation_mm[inner, inner]),
            slope_mm=np.ascontiguousarray(terrain.slope_mm[inner, inner]),
            measured=np.ascontiguousarray(terrain.measured[inner, inner]),
            column0=corner[0] + margin - 1,
            row0=corner[1] + margin - 1,
        )


def kept_points(x_mm: IntArray, y_mm: IntArray, z_mm: IntArray, settings: OutlierSettings) -> BoolArray:
    """Mask of the points that are not gross outliers; window by window for many points."""
    if len(x_mm) <= _WHOLE_POINTS:
        return dense_enough(x_mm, y_mm, z_mm, settings)
    kept = np.zeros(len(x_mm), np.bool_)
    reach, side = math.ceil(settings.support_m * MM), WINDOW_CELLS * CELL_MM
    for (row, column), index in _by_window(x_mm, y_mm):
        near = (x_mm >= column * side - reach) & (x_mm < (column + 1) * side + reach)
        near &= (y_mm >= row * side - reach) & (y_mm < (row + 1) * side + reach)
        around = np.flatnonzero(near)
        enough = dense_enough(x_mm[around], y_mm[around], z_mm[around], settings)
        kept[index] = enough[np.searchsorted(around, index)]
    return kept


def _millimetres(xyz: FloatArray) -> tuple[IntArray, IntArray, IntArray]:
    """Coordinates in whole millimetres, as in a run."""
    x, y, z = (np.rint(xyz[:, axis] * MM).astype(np.int64) for axis in range(3))
    return x, y, z


def _by_window(x_mm: IntArray, y_mm: IntArray) -> Iterator[tuple[tuple[int, int], IntArray]]:
    """Row and column of each window with points, and their indices, ascending."""
    side = WINDOW_CELLS * CELL_MM
    row, column = y_mm // side, x_mm // side
    key = (row << 32) + column
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=_NO_MORE))
    for index in np.split(order, starts[1:]) if len(starts) else ():
        yield (int(row[index[0]]), int(column[index[0]])), index


# ---------------------------------------------------------------------------------------------------------- measures


def _kappa(sums: Sums) -> FloatArray:
    """Cohen's kappa: agreement beyond what the margins of the table give by chance."""
    n = sums["all"]
    by_chance = (sums["ground"] * sums["found_ground"] + sums["object"] * (n - sums["found_ground"])) / (n * n)
    agreed = 1.0 - sums["wrong"] / n
    return (agreed - by_chance) / (1.0 - by_chance)


_STATISTICS: tuple[tuple[str, Statistic, str], ...] = (
    ("type_1", share("missed", "ground"), "ground"),
    ("type_2", share("taken", "object"), "object"),
    ("total", share("wrong", "all"), "all"),
    ("kappa", _kappa, "all"),
)

_JUDGED = "last returns without noise and water, nor what is left unclassified beside objects"

DEFINITIONS = tuple(
    defined(f"ground.{name}", label, f"{formula}; {_JUDGED}", better)
    for name, label, better, formula in (
        ("type_1", "type I error", Better.LOWER, "ground taken for object / ground"),
        ("type_2", "type II error", Better.LOWER, "object taken for ground / object"),
        ("total", "total error", Better.LOWER, "points on the wrong side / all points"),
        ("kappa", "kappa", Better.HIGHER, "(agreement - agreement by chance) / (1 - agreement by chance)"),
    )
)
"""The measures."""


def _columns(blocks: Columns) -> dict[str, FloatArray]:
    right, missed, taken, other = (blocks[name].astype(np.float64) for name in ("right", "missed", "taken", "other"))
    return {
        "missed": missed,
        "taken": taken,
        "ground": right + missed,
        "object": taken + other,
        "found_ground": right + taken,
        "wrong": missed + taken,
        "all": right + missed + taken + other,
    }


def ground_measures(blocks: Columns, subset: Subset) -> list[Measure]:
    """The figures over all tiles, blocks of 50 m as units of the bootstrap; only for the subset `all`."""
    if not blocks or not len(blocks["tile"]) or not subset.elsewhere:
        return []
    columns = _columns(blocks)
    figures = ((f"ground.{name}", of, columns[denominator].sum()) for name, of, denominator in _STATISTICS)
    return measured_all(columns, subset, figures)
