"""What lies beside a candidate: points near the walls of a drawn or given outline, and guides."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import shapely

from pipeline.compiler import kernel
from pipeline.model import BoolArray, Guide, IntArray
from pipeline.roof.roof_settings import GUIDE_REACH_M
from pipeline.runtime.scratch.folder import Scratch
from pipeline.runtime.stages.window_points import Surroundings, bucket, bucket_paths
from pipeline.terrain.lattice import CELL_MM
from pipeline.tiling import MM, TileGrid, Window


def points_beside(
    scratch: Scratch, grid: TileGrid, own_mm: IntArray, cells: BoolArray, around: Surroundings
) -> tuple[IntArray, IntArray]:
    """Points in some cells of the surroundings that do not belong to a candidate: each (n, 3) int64, sorted.

    The first come from pulses with one return; the second are the last of several returns.
    """
    rows, columns = np.nonzero(cells)
    single, later = [own_mm], [own_mm]
    if len(rows):
        view = Window(
            x0_mm=(around.column0 + int(columns.min())) * CELL_MM,
            y0_mm=(around.row0 + int(rows.min())) * CELL_MM,
            x1_mm=(around.column0 + int(columns.max()) + 1) * CELL_MM,
            y1_mm=(around.row0 + int(rows.max()) + 1) * CELL_MM,
        )
        for path in (path for tile in grid.tiles_over(view) for path in bucket_paths(scratch, tile)):
            xyz, is_single = _last_in(bucket(path), cells, around.column0, around.row0)
            single.append(xyz[is_single])
            later.append(xyz[~is_single])
    return _others(single, len(own_mm)), _others(later, len(own_mm))


@kernel
def _last_in(records: npt.NDArray[np.void], cells: BoolArray, column0: int, row0: int) -> tuple[IntArray, BoolArray]:
    """The places (n, 3), mm, of last returns in some cells (rows, columns), and which of them are the only ones."""
    rows, columns = cells.shape
    xyz, is_single = np.empty((records.size, 3), np.int64), np.empty(records.size, np.bool_)
    n = 0
    for i in range(records.size):
        point = records[i]
        r, c = point.y // CELL_MM - row0, point.x // CELL_MM - column0
        is_inside = 0 <= r < rows and 0 <= c < columns
        if is_inside and cells[r, c] and (point.return_count <= 1 or point.return_number >= point.return_count):
            xyz[n, 0], xyz[n, 1], xyz[n, 2] = point.x, point.y, point.z
            is_single[n] = point.return_count <= 1
            n += 1
    return xyz[:n].copy(), is_single[:n].copy()


def guides_near(guides: Sequence[Guide], low_mm: IntArray, high_mm: IntArray, origin_mm: IntArray) -> tuple[Guide, ...]:
    """The guides within reach of the box of a candidate's points, in its frame."""
    reach_mm = round(GUIDE_REACH_M * MM)
    box = shapely.box(*((low_mm[:2] - reach_mm) / MM), *((high_mm[:2] + reach_mm) / MM))
    return tuple(
        Guide(kind=guide.kind, line=shapely.transform(guide.line, lambda xy: np.rint(xy * MM - origin_mm[:2]) / MM))
        for guide in guides
        if box.intersects(guide.line)
    )


def _others(pieces: Sequence[IntArray], own: int) -> IntArray:
    """Places of the pieces, one of each, without those of the first `own` rows: (n, 3) int64, sorted."""
    places, index = np.unique(np.concatenate(pieces), axis=0, return_index=True)
    others: IntArray = places[index >= own]
    return others
