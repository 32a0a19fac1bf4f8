"""The fragments of several tiles as whole surfaces, united by the facets that they share."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pipeline.kernels.union_find import united
from pipeline.model import IntArray
from pipeline.terrain.candidates import NOWHERE, Surfaces
from pipeline.terrain.fragment_sums import N_SUMS
from pipeline.terrain.surfaces import Fragments
from pipeline.tiling import Tile


@dataclasses.dataclass(frozen=True, kw_only=True)
class WholeSplit:
    """All fragments of one tile."""

    tile: Tile
    fragments: Fragments
    starts: npt.NDArray[np.int64]
    """(k + 1,) where each fragment's points start in the tile's sorted points."""
    keys: npt.NDArray[np.int64]
    """(k,) the fragment."""


def _crossing_pairs(splits: Sequence[WholeSplit], offsets: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Pairs of fragments (n, 2) that hold the same facet."""
    keys = np.concatenate([s.fragments.crossing_keys for s in splits])
    owners = np.concatenate([s.fragments.crossing_fragment + offset for s, offset in zip(splits, offsets, strict=True)])
    if len(keys) == 0:
        return np.empty((0, 2), np.int64)
    order = np.lexsort(keys.T[::-1])
    keys, owners = keys[order], owners[order]
    same = np.flatnonzero((keys[1:] == keys[:-1]).all(axis=1))
    pairs = np.column_stack((owners[same], owners[same + 1])).astype(np.int64)
    return np.unique(pairs, axis=0)


def whole_surfaces(splits: Sequence[WholeSplit]) -> tuple[Surfaces, npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """The surfaces of all tiles, whole, with their sums.

    Beside them the surface of every fragment, (f,) int64, tile after tile, and where each tile's fragments start in
    that list, (t + 1,) int64.
    """
    counts = [len(s.fragments.kind) for s in splits]
    offsets = np.concatenate(([0], np.cumsum(counts))).astype(np.int64)
    total = int(offsets[-1])
    described = [s.fragments for s in splits]
    if total == 0:
        empty = np.empty(0, np.int64)
        nothing = Surfaces(
            kind=np.empty(0, np.int8),
            sums=np.empty((0, N_SUMS), np.int64),
            boxes_mm=np.empty((0, 4), np.int64),
            lowest_point_mm=np.empty((0, 3), np.int64),
            along_steps=np.empty((0, 3), np.int64),
        )
        return nothing, empty, offsets
    pairs = _crossing_pairs(splits, offsets[:-1])
    roots = united(total, pairs[:, 0], pairs[:, 1])
    members, surface = np.unique(roots, return_inverse=True)
    k = len(members)
    sums = np.zeros((k, N_SUMS), np.int64)
    np.add.at(sums, surface, np.concatenate([f.sums for f in described]))
    fragment_boxes = np.concatenate([f.boxes_mm for f in described])
    boxes = np.empty((k, 4), np.int64)
    boxes[:, :2], boxes[:, 2:] = NOWHERE, -NOWHERE
    np.minimum.at(boxes[:, :2], surface, fragment_boxes[:, :2])
    np.maximum.at(boxes[:, 2:], surface, fragment_boxes[:, 2:])
    points = np.concatenate([f.lowest_point_mm for f in described])
    order = np.lexsort((points[:, 2], points[:, 1], points[:, 0], surface))
    _, first = np.unique(surface[order], return_index=True)
    starts = zip(described, offsets.tolist(), strict=False)
    along = [f.along_steps + np.array([offset, offset, 0]) for f, offset in starts if len(f.along_steps)]
    pairs = _summed_pairs(np.concatenate(along), surface) if along else np.empty((0, 3), np.int64)
    whole = Surfaces(
        kind=np.concatenate([f.kind for f in described])[members],
        sums=sums,
        boxes_mm=boxes,
        lowest_point_mm=points[order][first],
        along_steps=pairs,
    )
    return whole, surface.astype(np.int64), offsets


def _summed_pairs(along: IntArray, surface: npt.NDArray[np.int64]) -> IntArray:
    """Rows (surface, step, length) with one row a pair of whole surfaces."""
    pairs = np.column_stack((surface[along[:, 0]], surface[along[:, 1]]))
    unique, inverse = np.unique(pairs, axis=0, return_inverse=True)
    lengths = np.zeros(len(unique), np.int64)
    np.add.at(lengths, inverse.ravel(), along[:, 2])
    return np.column_stack((unique, lengths))
