"""Facets that several tiles see: through them the fragments of one surface find each other across tile borders.

A facet is the same in all tiles that see it, so its vertices name it. The name is a hash of 128 bits. Two of n facets
get the same name by chance with a probability below n^2 / 2^129: 10^-22 for the 10^8 facets of ten million buildings.

Most facets need not be named to other tiles. Along a border, far from a third tile, both tiles certainly see the facets
that reach into a strip around it, and connected facets are connected for both. One facet per connected piece therefore
suffices; both tiles choose the one with the smallest name.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipeline.compiler import kernel
from pipeline.kernels.union_find import united
from pipeline.model import BoolArray, IntArray, KindArray
from pipeline.runtime.stages.tile_content import mixed
from pipeline.terrain.facets import FacetKind
from pipeline.terrain.terrain_settings import SurfaceSettings
from pipeline.tiling import Tile, TileGrid

_SLACK_MM = 2
"""Numerical guard in mm: circumradii are compared as floats, so a facet may be this much wider than allowed."""
_OTHER = np.uint64(0xD1B54A32D192ED03)
"""Start of the second word: any number except 0, where the first starts."""


@kernel
def facet_names(keys: IntArray) -> npt.NDArray[np.uint64]:
    """Names of facets (j, 2) uint64, two independent hashes of their keys (j, 6) int64 from `facet_keys`."""
    names = np.empty((keys.shape[0], 2), np.uint64)
    for i in range(keys.shape[0]):
        first, second = np.uint64(0), _OTHER
        for k in range(6):
            word = np.uint64(keys[i, k])
            first = mixed(first, word)
            second = mixed(second, word)
        names[i, 0], names[i, 1] = first, second
    return names


def united_by_name(count: int, names: npt.NDArray[np.uint64], holders: IntArray) -> IntArray:
    """Smallest member (count,) int64 of the set of each element, where elements that share a name are in one set.

    `names` (j, 2) uint64 belong to the elements `holders` (j,).
    """
    order = np.lexsort((names[:, 1], names[:, 0]))
    same = np.flatnonzero((names[order[1:]] == names[order[:-1]]).all(axis=1))
    return united(count, holders[order[same]], holders[order[same + 1]])


def shared_facets(
    keys: IntArray,
    names: npt.NDArray[np.uint64],
    kinds: KindArray,
    tile: Tile,
    grid: TileGrid,
    settings: SurfaceSettings,
) -> tuple[IntArray, BoolArray]:
    """Which tiles may see each facet, and which facets suffice to connect the same fragments.

    Facets have names (j, 2) uint64, and only facets of one `FacetKind` are connected.

    Parameters
    ----------
    keys : (j, 6) int64
        Keys from `facet_keys` of all facets of some kinds that the tile sees and another may see.

    Returns
    -------
    reach : (j, 4) int64
        First column, first row, last column and last row of the tiles that may see the facet.
    named : (j,) bool
        The facet is named to other tiles: all that another tile may see, except that facets connected in a strip which
        exactly two tiles see are represented by the one with the smallest name.
    """
    x, y = keys[:, 0::2], keys[:, 1::2]
    # a tile sees a facet if a vertex is near its core, or in another facet that reaches into the core
    reach_mm = max(settings.far_mm, round(2000 * settings.max_circumradius_m) + _SLACK_MM)
    west, south = grid.columns_rows(x.min(axis=1) - reach_mm, y.min(axis=1) - reach_mm)
    east, north = grid.columns_rows(x.max(axis=1) + reach_mm, y.max(axis=1) + reach_mm)
    reach = np.column_stack((west, south, east, north)).astype(np.int64)
    seen = are_beyond(reach, (tile.column, tile.row, tile.column, tile.row))
    # 0: the strip to the west or east, 1: to the south or north; where four tiles may see, there is no strip
    sure = np.full(len(keys), -1, np.int64)
    for axis, (values, low, high, across_low, across_high, origin) in enumerate(
        ((x, west, east, south, north, grid.origin_x_mm), (y, south, north, west, east, grid.origin_y_mm))
    ):
        border = origin + high * grid.size_mm
        two = (high == low + 1) & (across_low == across_high)
        both = (values.min(axis=1) < border + settings.far_mm) & (values.max(axis=1) >= border - settings.far_mm)
        # both borders of a tile along one axis: two strips
        sure[two & both] = 2 * axis + (high == (tile.column, tile.row)[axis])[two & both]
    named = seen.copy()
    strip = np.flatnonzero(seen & (sure >= 0))
    piece = _connected(keys[strip], sure[strip] * len(FacetKind) + kinds[strip])
    order = np.lexsort((names[strip, 1], names[strip, 0], piece))
    named[strip] = False
    _, first = np.unique(piece[order], return_index=True)
    named[strip[order[first]]] = True
    return reach, named


def are_beyond(reach: IntArray, area: tuple[int, int, int, int]) -> BoolArray:
    """Which of some reaches (j, 4) leave an area of tiles; both are first column, first row, last column, last row."""
    first_column, first_row, last_column, last_row = area
    beyond: BoolArray = (reach[:, 0] < first_column) | (reach[:, 1] < first_row)
    return beyond | (reach[:, 2] > last_column) | (reach[:, 3] > last_row)


def _connected(keys: IntArray, layer: IntArray) -> IntArray:
    """Smallest member (j,) of the set of each facet, where facets of one layer that share an edge are in one set."""
    if len(keys) == 0:
        return np.empty(0, np.int64)
    x, y = keys[:, 0::2].ravel(), keys[:, 1::2].ravel()
    # vertices are few and near each other: both coordinates fit into one integer, and so do the numbers of two vertices
    _, vertex = np.unique(((x - x.min()) << 32) | (y - y.min()), return_inverse=True)
    a = vertex.reshape(-1, 3).astype(np.int64)
    b = np.roll(a, -1, axis=1)
    count = int(a.max()) + 1
    edge = ((layer[:, None] * count + np.minimum(a, b)) * count + np.maximum(a, b)).ravel()
    order = np.argsort(edge, kind="stable")
    same = np.flatnonzero(edge[order[1:]] == edge[order[:-1]])
    return united(len(keys), order[same] // 3, order[same + 1] // 3)
