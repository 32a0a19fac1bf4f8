"""The arrangement with guides that the points do not contradict.

All guides take part at first, and the faces are compared with the faces without guides. A guide is dropped if the
points beside it misfit more than without guides, or if it opens a step between planes that meet near it: the crossing
of two planes is more certain than a guide. The rest is arranged again, until no guide is dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import shapely

from pipeline.model import BoolArray, FloatArray, Plane
from pipeline.roof.arrangement.guide_lines import Guides, line_through
from pipeline.roof.partition import RoofPartition

_MAX_GAP_M = 0.25
"""Wider gaps between planes are steps, as in `joined_planes`."""
_NEAR = 2.0
"""Planes meet near a guide if they do so within this many times the distance that lines may have from it."""
_BESIDE_M = 0.1
"""How far from a guide the faces beside it are looked up: beyond what rounding moves."""
MAX_MISFIT = 0.5
"""Points that may misfit more beside a guide than without guides; chosen on development scenes."""


def guided_faces(
    arranged: Callable[[Guides], RoofPartition],
    free: RoofPartition,
    points: FloatArray,
    guides: Guides,
    may_step: BoolArray,
    beside_m: float,
    cap_m: float,
) -> RoofPartition:
    """The faces that `arranged` draws by the guides that points (n, 3) bear out; `free` if none is left.

    `may_step` (g,) are the pieces that are known as steps. Points within `beside_m` of a guide judge it: one that is
    `cap_m` from its face misfits as a whole, one that is nearer in proportion.
    """
    lines = shapely.linestrings(guides.pieces.reshape(-1, 2, 2))
    beside = [shapely.dwithin(line, shapely.points(points[:, :2]), beside_m) for line in lines]
    before = misfits_of(points, free, cap_m)
    kept = np.arange(len(guides.pieces))
    while len(kept):
        drawn = arranged(Guides(guides.pieces[kept], guides.distance_m))
        more = misfits_of(points, drawn, cap_m) - before
        worse = np.array(
            [
                float(more[beside[k]].sum()) > MAX_MISFIT
                or (not may_step[k] and _opens_a_crossing(drawn, guides.pieces[k], guides.distance_m))
                for k in kept
            ]
        )
        if not worse.any():
            return drawn
        kept = kept[~worse]
    return free


def _opens_a_crossing(partition: RoofPartition, piece: FloatArray, distance_m: float) -> bool:
    """Whether the planes beside the middle of a piece do not meet there, though their crossing is near."""
    nx, ny, _, _ = line_through(piece)
    x, y = 0.5 * (piece[0] + piece[2]), 0.5 * (piece[1] + piece[3])
    sides = []
    for side in (_BESIDE_M, -_BESIDE_M):
        place = shapely.Point(1e3 * (x + side * nx), 1e3 * (y + side * ny))
        over = [k for k, face in enumerate(partition.polygons) if face.intersects(place)]
        sides.append(int(partition.labels[over[0]]) if over else -1)
    if min(sides) < 0 or sides[0] == sides[1] or partition.planes is None:
        return False
    one, other = (partition.planes[label] for label in sides)
    gap_m = abs((one.a - other.a) * x + (one.b - other.b) * y + one.c - other.c)
    turn = abs((one.a - other.a) * nx + (one.b - other.b) * ny)
    return bool(_MAX_GAP_M < gap_m < _NEAR * distance_m * turn)


def misfits_of(points: FloatArray, partition: RoofPartition, cap_m: float) -> FloatArray:
    """How far each point (n, 3) is from its face, as a share of `cap_m`, at most 1; (n,). Off all faces it is 1."""
    misfits = np.ones(len(points))
    planes: Sequence[Plane] = partition.planes or ()
    x_mm, y_mm = points[:, 0] * 1e3, points[:, 1] * 1e3
    for polygon, label in zip(partition.polygons, partition.labels.tolist(), strict=True):
        shapely.prepare(polygon)
        over = shapely.intersects_xy(polygon, x_mm, y_mm)
        plane = planes[label]
        off = np.abs(points[over, 2] - plane.a * points[over, 0] - plane.b * points[over, 1] - plane.c)
        misfits[over] = np.minimum(misfits[over], off / cap_m)
    return misfits
