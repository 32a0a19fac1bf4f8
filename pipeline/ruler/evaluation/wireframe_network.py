"""Roof edges as a network: each stretch of edge once, and the corners between them.

Truth comes as drawn edges, a model as the rings of its roof faces. Ends that coincide are one vertex, edges are split
where a vertex lies on them, and stretches between two faces of one plane are left out: a roof does not show them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from pipeline.model import BoolArray, FaceKind, FloatArray, IntArray
from pipeline.ruler.evaluation.models import RoofModel
from pipeline.ruler.evaluation.reading.coplanar import DISTANCE_M
from pipeline.ruler.evaluation.reading.wireframe_files import Wireframe

MIN_TURN_DEG = 4.0
"""Two edges that meet at a smaller change of direction are one straight edge."""
WELD_M = 0.002
"""Vertices up to this far apart are one, and vertices this close to an edge lie on it: coordinates of models are whole
millimetres, so a point that was rounded twice is off by up to 1.7 mm."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RoofFace:
    """The plane of a roof face."""

    vertices: FloatArray
    """(v, 3) float64, metres: those of all its rings."""
    middle: FloatArray
    """(3,) float64, their mean."""
    normal: FloatArray
    """(3,) float64, unit normal of the plane through them."""
    width_m: float
    """Spread of the vertices across the long side, which decides how well they define the normal."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Segments:
    """Edges as they were drawn or modelled, before they are joined to a network. Arrays have one length n."""

    ends: FloatArray
    """(n, 2, 3) float64, metres."""
    owner: IntArray
    """(n,) int64, the true building that it is counted for."""
    face: IntArray
    """(n,) int64, index into `faces`; -1 for drawn edges, which have no faces."""
    faces: tuple[RoofFace, ...] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Network:
    """Edges and corners of one or more roofs."""

    edges: FloatArray
    """(e, 2, 3) float64, metres: each stretch of edge once."""
    edge_owner: IntArray
    """(e,) int64, the true building that it is counted for; the smallest of several."""
    corners: FloatArray
    """(c, 3) float64, metres: where an edge turns or ends, or where three or more edges meet."""
    corner_owner: IntArray
    """(c,) int64, the smallest owner of the edges that meet there."""


def drawn_segments(wireframe: Wireframe, owner: int) -> Segments:
    """The edges of a true wireframe."""
    ends = wireframe.vertices[wireframe.edges]
    return Segments(ends=ends, owner=np.full(len(ends), owner), face=np.full(len(ends), -1))


def roof_segments(models: Sequence[RoofModel], owners: Sequence[int]) -> Segments:
    """The rings of all roof faces of some models: those of the solids, else of the planar faces."""
    ends: list[FloatArray] = []
    faces: list[RoofFace] = []
    owner: list[int] = []
    face: list[int] = []
    for model, of_model in zip(models, owners, strict=True):
        for rings in _roof_faces(model):
            for ring in rings:
                ends.append(np.stack([ring, np.roll(ring, -1, axis=0)], axis=1))
                owner += [of_model] * len(ring)
                face += [len(faces)] * len(ring)
            faces.append(_plane_of(np.concatenate(rings)))
    return Segments(
        ends=np.concatenate(ends) if ends else np.zeros((0, 2, 3)),
        owner=np.array(owner, np.int64),
        face=np.array(face, np.int64),
        faces=tuple(faces),
    )


def _plane_of(xyz: FloatArray) -> RoofFace:
    """The plane of a face by its vertices (v, 3)."""
    middle = xyz.mean(axis=0)
    _, sizes, axes = np.linalg.svd(xyz - middle, full_matrices=False)
    return RoofFace(vertices=xyz, middle=middle, normal=axes[-1], width_m=float(sizes[1]))


def joined(parts: Sequence[Segments]) -> Segments:
    """Drawn segments of several buildings together."""
    return Segments(
        ends=np.concatenate([part.ends for part in parts]),
        owner=np.concatenate([part.owner for part in parts]),
        face=np.concatenate([part.face for part in parts]),
    )


def _roof_faces(model: RoofModel) -> Iterator[list[FloatArray]]:
    """The rings of each roof face, (k, 3) absolute metres, without the first vertex again at the end."""
    solids = [(solid.vertices + np.array(model.solid_origin), face) for solid in model.solids for face in solid.faces]
    roofs = [(vertices, face) for vertices, face in solids if face.kind is FaceKind.ROOF]
    for vertices, face in roofs:
        yield [vertices[list(ring)] for ring in face.rings]
    for surface in () if roofs else model.surfaces:
        rings = [shapely.get_coordinates(ring)[:-1] for ring in (surface.polygon.exterior, *surface.polygon.interiors)]
        yield [np.column_stack([ring, surface.elevation(ring[:, 0], ring[:, 1])]) for ring in rings]


def network(segments: Segments) -> Network:
    """Join segments to edges and corners."""
    count = len(segments.ends)
    vertices, ends = welded(segments.ends.reshape(-1, 3))
    pieces, source = split(vertices, ends.reshape(count, 2))
    real = pieces[:, 0] != pieces[:, 1]
    pieces, source = np.sort(pieces[real], axis=1), source[real]
    unique, stretch = np.unique(pieces, axis=0, return_inverse=True)
    order = np.argsort(stretch.ravel(), kind="stable")
    members = np.split(source[order], np.cumsum(np.bincount(stretch.ravel(), minlength=len(unique)))[:-1])
    kept = np.array([not _is_inner(segments, sources) for sources in members if len(unique)], np.bool_)
    owner = np.array([segments.owner[sources].min() for sources in members if len(unique)], np.int64)
    edges, owner = unique[kept], owner[kept]
    corners = np.flatnonzero(_is_corner(vertices, edges))
    owner_of_vertex = np.full(len(vertices), np.iinfo(np.int64).max)
    np.minimum.at(owner_of_vertex, edges, owner[:, None])
    return Network(
        edges=vertices[edges].reshape(-1, 2, 3),
        edge_owner=owner,
        corners=vertices[corners],
        corner_owner=owner_of_vertex[corners],
    )


def welded(xyz: FloatArray) -> tuple[FloatArray, IntArray]:
    """Vertices (v, 3), one for all within `WELD_M` of one another, and the vertex of each point (n,)."""
    pairs = KDTree(xyz).query_pairs(WELD_M, output_type="ndarray") if len(xyz) else np.zeros((0, 2), np.int64)
    graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(xyz), len(xyz)))
    _, label = connected_components(graph, directed=False)
    _, first, place = np.unique(label, return_index=True, return_inverse=True)
    return xyz[first], place.astype(np.int64)


def split(vertices: FloatArray, ends: IntArray) -> tuple[IntArray, IntArray]:
    """Edges (n, 2) cut at the vertices that lie on them: the pieces (p, 2), and the edge of each (p,)."""
    if not len(ends):
        return ends, np.zeros(0, np.int64)
    starts = vertices[ends[:, 0]]
    along = vertices[ends[:, 1]] - starts
    length = np.linalg.norm(along, axis=1)
    near = KDTree(vertices).query_ball_point(starts + along / 2.0, length / 2.0 + WELD_M, return_sorted=True)
    edge = np.repeat(np.arange(len(ends)), [len(found) for found in near])
    vertex = np.concatenate(near).astype(np.int64)
    offset = vertices[vertex] - starts[edge]
    position = (offset * along[edge]).sum(axis=1) / np.maximum(length[edge], WELD_M) ** 2
    away = np.linalg.norm(offset - position[:, None] * along[edge], axis=1)
    on = (away <= WELD_M) & (position > 0.0) & (position < 1.0) & (vertex[:, None] != ends[edge]).all(axis=1)
    # The vertices of each edge in their order along it: its start, those on it, its end.
    every = np.arange(len(ends))
    of_edge = np.concatenate([every, edge[on], every])
    order = np.lexsort((np.concatenate([every * 0.0, position[on], every * 0.0 + 1.0]), of_edge))
    chain = np.concatenate([ends[:, 0], vertex[on], ends[:, 1]])[order]
    of_edge = of_edge[order]
    following = of_edge[1:] == of_edge[:-1]
    return np.column_stack([chain[:-1], chain[1:]])[following], of_edge[:-1][following]


def _is_inner(segments: Segments, sources: IntArray) -> bool:
    """Whether a stretch lies between faces of one plane, all of one building.

    Between two true buildings of a row it counts: each was drawn with all its edges.
    """
    numbers = segments.face[sources]
    if len(sources) < 2 or numbers[0] < 0 or np.ptp(segments.owner[sources]) > 0:
        return False
    faces = [segments.faces[number] for number in np.unique(numbers)]
    widest = max(faces, key=lambda face: face.width_m)
    return all(float(np.abs((face.vertices - widest.middle) @ widest.normal).max()) <= DISTANCE_M for face in faces)


def _is_corner(vertices: FloatArray, edges: IntArray) -> BoolArray:
    """Which vertices, (v,), are corners: one edge ends, two turn, or three meet there."""
    degree = np.bincount(edges.ravel(), minlength=len(vertices))
    corner: BoolArray = (degree == 1) | (degree >= 3)
    # The sum of the unit vectors to both neighbours: zero if they are opposite.
    sums = np.zeros((len(vertices), 3))
    towards = vertices[edges[:, 1]] - vertices[edges[:, 0]]
    towards /= np.linalg.norm(towards, axis=1)[:, None]
    np.add.at(sums, edges[:, 0], towards)
    np.add.at(sums, edges[:, 1], -towards)
    half_turn = 2.0 * math.sin(math.radians(MIN_TURN_DEG) / 2.0)
    corner |= (degree == 2) & (np.linalg.norm(sums, axis=1) > half_turn)
    return corner
