"""Splits and joins of faces: connected components of true faces and model faces that lie on one another."""

from __future__ import annotations

import dataclasses
from enum import StrEnum

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipeline.model import BoolArray, FloatArray, IntArray
from pipeline.ruler.evaluation.matching import MIN_SHARE

_ROUNDING = 1e-9


class Topology(StrEnum):
    """A component by its numbers of true faces and model faces."""

    ONE_TO_ONE = "1:1"
    SPLIT = "1:N"
    """One true face in several model faces."""
    JOINED = "N:1"
    """Several true faces in one model face."""
    TANGLED = "N:M"
    MISSED = "1:0"
    """A true face without a model face."""
    EXTRA = "0:1"
    """A model face without a true face."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class FaceComponent:
    """Linked faces: one overlaps another by at least half of either."""

    kind: Topology
    """By the numbers."""
    building: int
    """Reference building of its first true face, else the one under most of the model face; -1 for none."""
    model: int
    """Model of its first model face; -1 without any."""
    true_faces: int
    """Number of true faces."""
    model_faces: int
    """Number of model faces."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TopologyInput:
    """True faces (units u), model faces m, and pairs p that share area."""

    unit: IntArray
    """(p,) true face; a pair of a group and a model face may come in several pieces."""
    face: IntArray
    """(p,) model face."""
    common_m2: FloatArray
    """(p,) common area in plan."""
    unit_m2: FloatArray
    """(u,) area in plan."""
    face_m2: FloatArray
    """(m,) area in plan."""
    unit_counts: BoolArray
    """(u,) whether it takes part."""
    face_counts: BoolArray
    """(m,) whether it takes part."""
    unit_building: IntArray
    """(u,) reference building."""
    face_building: IntArray
    """(m,) reference building that it lies on; -1 for none."""
    face_model: IntArray
    """(m,) its model."""
    face_group: IntArray
    """(m,) a group of true faces of which it matches a piece, -1 for none: faces of one count as one."""


Components = tuple[tuple[FaceComponent, ...], list[Topology | None], list[Topology | None]]


def face_components(given: TopologyInput) -> Components:
    """The connected components, and the kind of component of every unit and model face (None: takes no part)."""
    units, faces = len(given.unit_m2), len(given.face_m2)
    key, place = np.unique(given.unit * np.int64(max(faces, 1)) + given.face, return_inverse=True)
    common = np.bincount(place, weights=given.common_m2, minlength=len(key))
    unit, face = key // max(faces, 1), key % max(faces, 1)
    least = np.minimum(given.unit_m2[unit], given.face_m2[face]) if len(key) else np.zeros(0)
    linked = (common >= (MIN_SHARE - _ROUNDING) * least) & given.unit_counts[unit] & given.face_counts[face]
    # Faces that match pieces of one group are one node: the first of them.
    node = np.arange(faces)
    grouped = np.flatnonzero((given.face_group >= 0) & given.face_counts)
    _, first, member = np.unique(given.face_group[grouped], return_index=True, return_inverse=True)
    node[grouped] = grouped[first[member]]
    edges = unit[linked], units + node[face[linked]]
    graph = coo_array((np.ones(len(edges[0])), edges), shape=(units + faces, units + faces))
    _, label = connected_components(graph, directed=False)
    of_unit, of_face = label[:units], label[units + node] if faces else np.zeros(0, label.dtype)

    some_units = np.flatnonzero(given.unit_counts)
    some_nodes = np.flatnonzero(given.face_counts & (node == np.arange(faces)))
    count = int(label.max()) + 1 if len(label) else 0
    n_units = np.bincount(of_unit[some_units], minlength=count)
    n_faces = np.bincount(of_face[some_nodes], minlength=count)
    first_unit, first_face = np.full(count, -1), np.full(count, -1)
    first_unit[of_unit[some_units[::-1]]] = some_units[::-1]
    first_face[of_face[some_nodes[::-1]]] = some_nodes[::-1]
    kinds: list[Topology | None] = [None] * count
    components = []
    for k in np.flatnonzero(n_units + n_faces).tolist():
        u, f = int(first_unit[k]), int(first_face[k])
        kinds[k] = _kind(int(n_units[k]), int(n_faces[k]))
        components.append(
            FaceComponent(
                kind=_kind(int(n_units[k]), int(n_faces[k])),
                building=int(given.unit_building[u] if u >= 0 else given.face_building[f]),
                model=int(given.face_model[f]) if f >= 0 else -1,
                true_faces=int(n_units[k]),
                model_faces=int(n_faces[k]),
            )
        )
    return (
        tuple(components),
        [kinds[k] if counts else None for k, counts in zip(of_unit, given.unit_counts, strict=True)],
        [kinds[k] if counts else None for k, counts in zip(of_face, given.face_counts, strict=True)],
    )


def _kind(true_faces: int, model_faces: int) -> Topology:
    if model_faces == 0:
        return Topology.MISSED
    if true_faces == 0:
        return Topology.EXTRA
    if true_faces == 1:
        return Topology.ONE_TO_ONE if model_faces == 1 else Topology.SPLIT
    return Topology.JOINED if model_faces == 1 else Topology.TANGLED
