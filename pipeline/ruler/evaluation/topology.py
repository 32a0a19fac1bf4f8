"""Splits and joins of faces: connected components of true faces and model faces that lie on one another."""

from __future__ import annotations

from enum import StrEnum

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipeline.model import BoolArray, IntArray
from pipeline.ruler.evaluation.building_matching import MIN_SHARE, summed
from pipeline.ruler.evaluation.face_matching import FaceMatch
from pipeline.ruler.evaluation.subsets import Columns

Labels = npt.NDArray[np.object_]
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


def face_components(
    match: FaceMatch,
    unit_counts: BoolArray,
    face_counts: BoolArray,
    unit_building: IntArray,
    face_building: IntArray,
) -> tuple[Columns, Labels, Labels]:
    """The connected components of linked faces: one overlaps another by at least half of either.

    True faces are the units (u,) of a match. Those, and those of the model faces (m,), that count take part; `building`
    is the reference building of each unit, and the one that most of each model face lies on, -1 for none.

    Returns columns of the components: `kind`; `building` of the first true face, else of the model face; `model` of the
    first model face, -1 without any; numbers of `true_faces` and `model_faces`. Then the kind of component of every
    unit and of every model face, (u,) and (m,); None where it takes no part.
    """
    units, faces = len(match.pieces), len(match.made.owner)
    unit_m2 = summed(match.unit, match.true.plan_m2, units)
    key, place = np.unique(
        match.unit[match.pairs.overlaps.first] * np.int64(max(faces, 1)) + match.pairs.overlaps.second,
        return_inverse=True,
    )
    common = np.bincount(place, weights=match.pairs.overlaps.common_m2, minlength=len(key))
    unit, face = key // max(faces, 1), key % max(faces, 1)
    least = np.minimum(unit_m2[unit], match.made.plan_m2[face]) if len(key) else np.zeros(0)
    linked = (common >= (MIN_SHARE - _ROUNDING) * least) & unit_counts[unit] & face_counts[face]
    # Model faces that match pieces of one group are one node: the first of them.
    node, of_piece = np.arange(faces), match.matched_unit
    grouped = np.flatnonzero((of_piece >= 0) & (np.append(match.pieces, 0)[of_piece] > 1) & face_counts)
    _, first, member = np.unique(of_piece[grouped], return_index=True, return_inverse=True)
    node[grouped] = grouped[first[member]]
    edges = unit[linked], units + node[face[linked]]
    graph = coo_array((np.ones(len(edges[0])), edges), shape=(units + faces, units + faces))
    _, label = connected_components(graph, directed=False)
    of_unit, of_face = label[:units], label[units + node] if faces else np.zeros(0, label.dtype)

    some_units = np.flatnonzero(unit_counts)
    some_nodes = np.flatnonzero(face_counts & (node == np.arange(faces)))
    count = int(label.max()) + 1 if len(label) else 0
    n_units = np.bincount(of_unit[some_units], minlength=count)
    n_faces = np.bincount(of_face[some_nodes], minlength=count)
    first_unit, first_face = np.full(count, -1), np.full(count, -1)
    first_unit[of_unit[some_units[::-1]]] = some_units[::-1]
    first_face[of_face[some_nodes[::-1]]] = some_nodes[::-1]
    kinds = np.select(
        [n_faces == 0, n_units == 0, (n_units == 1) & (n_faces == 1), n_units == 1, n_faces == 1],
        [Topology.MISSED, Topology.EXTRA, Topology.ONE_TO_ONE, Topology.SPLIT, Topology.JOINED],
        Topology.TANGLED,
    ).astype(object)
    held = np.flatnonzero(n_units + n_faces)
    u, f = first_unit[held], first_face[held]
    components = {
        "kind": kinds[held],
        "building": np.where(u >= 0, np.append(unit_building, -1)[u], np.append(face_building, -1)[f]),
        "model": np.append(match.made.owner, -1)[f],
        "true_faces": n_units[held],
        "model_faces": n_faces[held],
    }
    of_unit_kind, of_face_kind = kinds[of_unit], kinds[of_face]
    of_unit_kind[~unit_counts], of_face_kind[~face_counts] = None, None
    return components, of_unit_kind, of_face_kind
