"""What lies beside a candidate: points near the walls of a drawn or given outline, and guides."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely

from pipeline.model import BoolArray, Guide, IntArray
from pipeline.roof.roof_settings import GUIDE_REACH_M
from pipeline.runtime.scratch.folder import POINT, Scratch
from pipeline.runtime.stages.window_points import Surroundings, bucket_paths
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
            if path.stat().st_size == 0:
                continue
            stored = np.memmap(path, POINT, mode="r")
            near = np.array(stored[view.contains(stored["x"], stored["y"])])
            near = near[cells[near["y"] // CELL_MM - around.row0, near["x"] // CELL_MM - around.column0]]
            xyz = np.column_stack((near["x"], near["y"], near["z"].astype(np.int64)))
            single.append(xyz[near["return_count"] <= 1])
            later.append(xyz[(near["return_count"] > 1) & (near["return_number"] >= near["return_count"])])
    return _others(single, len(own_mm)), _others(later, len(own_mm))


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
