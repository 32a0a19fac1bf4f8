"""From polygons of any file to roof faces, a footprint and solids.

1. Normals classify the faces that the file does not name, once the part as a whole faces outward: roofs look up and
   have no other roof above them.
2. Roof faces that share edges and lie in one plane become one: a triangulated model counts as the polygons that it was
   cut from.
3. Each gets the least-squares plane of its vertices; the footprint is the union of all of them in plan.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import shapely
from shapely import MultiPolygon, Polygon

from pipeline.model import BoolArray, FaceKind, FloatArray, IntArray, Solid, SolidFace
from pipeline.ruler.evaluation.models import RoofSurface
from pipeline.ruler.evaluation.reading.coplanar import DISTANCE_M, area_vector, coplanar_regions
from pipeline.ruler.evaluation.reading.raw import MILLIMETRES_PER_METRE, RawPart
from pipeline.segmentation.facet_geometry import fit_plane_coefficients

GRID_M = 0.001
"""Coordinates in plan are whole multiples of it."""
MIN_UP = 0.1
"""A face whose unit normal has a larger z looks up, one with a smaller -z down; the rest are walls."""

_MIN_AREA_M2 = 1e-6
"""Numerical guard: smaller areas are empty."""
_SLIVER_M = 0.004
"""A hole in a footprint that is narrower on average comes from rounding."""
_COVERED_SHARE = 0.5
"""A doubtful face with more of its area under other roofs is not a roof."""

Coefficients = tuple[float, float, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Assembled:
    """Roof faces, footprint and solids of a building."""

    surfaces: tuple[RoofSurface, ...]
    """Roof faces; empty if no face looks like a roof."""
    footprint: Polygon | MultiPolygon
    """Union of the roof faces, else of the ground faces; empty without either."""
    solids: tuple[Solid, ...]
    """The parts that are meant to be solids."""
    solid_origin: tuple[float, float, float]
    """Origin of the solids: whole metres."""


class _Soup:
    """All faces of a building, about an origin in whole metres."""

    def __init__(self, parts: Sequence[RawPart]) -> None:
        xyz = np.vstack([part.xyz for part in parts])
        self.origin = np.floor(xyz.min(axis=0))
        self.local = np.ascontiguousarray(xyz - self.origin)
        self.millimetres = np.rint(self.local * MILLIMETRES_PER_METRE).astype(np.int64)
        self.first_vertex = np.concatenate([[0], np.cumsum([len(part.xyz) for part in parts])])
        self.faces = [face for part in parts for face in part.faces]
        self.part = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
        firsts = self.first_vertex[self.part].tolist()
        self.rings = [
            [[k + first for k in ring] for ring in face.rings] for face, first in zip(self.faces, firsts, strict=True)
        ]
        self.xyz = self.local.tolist()
        self.vectors = np.array([area_vector(self.xyz, rings) for rings in self.rings])
        places: dict[tuple[int, ...], int] = {}
        at = [places.setdefault(tuple(key), k) for k, key in enumerate(self.millimetres.tolist())]
        self.welded = [[[at[k] for k in ring] for ring in rings] for rings in self.rings]

    def corners_of(self, *faces: int) -> list[int]:
        """Vertices of all rings of some faces, one for all in the same place."""
        return [corner for face in faces for ring in self.welded[face] for corner in ring]

    def plan(self, faces: IntArray) -> list[Polygon | MultiPolygon]:
        """The faces in plan, metres about the origin, on the grid, valid; empty where they have no area."""
        xy = self.millimetres[:, :2] / MILLIMETRES_PER_METRE
        polygons = []
        for face in faces:
            rings = [xy[ring] for ring in self.rings[face] if len(ring) >= 3]
            polygons.append(Polygon(rings[0], rings[1:]) if rings else Polygon())
        for k in np.flatnonzero(~shapely.is_valid(polygons)):
            polygons[k] = _areas_of(shapely.make_valid(polygons[k]))
        return polygons


def _areas_of(geometry: shapely.Geometry) -> Polygon | MultiPolygon:
    """The polygons of a geometry."""
    if isinstance(geometry, Polygon | MultiPolygon):
        return geometry
    pieces = [piece for piece in shapely.get_parts(geometry) if isinstance(piece, Polygon | MultiPolygon)]
    polygons = shapely.get_parts(pieces)
    return polygons[0] if len(polygons) == 1 else MultiPolygon(list(polygons))


def assemble(parts: Sequence[RawPart]) -> Assembled | None:
    """Roof faces, footprint and solids of a building from all its geometries; None without any face."""
    parts = [part for part in parts if part.faces and len(part.xyz)]
    if not parts:
        return None
    soup = _Soup(parts)
    kinds, polygons = _kinds(soup)
    roofs = np.array(sorted(polygons), np.int64)
    planes = np.array([face.plane for face in soup.faces], np.int64)
    surfaces: list[RoofSurface] = []
    numbers = np.full(len(soup.faces), -1)
    if len(roofs):
        regions = _regions(soup, roofs, planes[roofs])
        for number, region in enumerate(regions):
            plane_id = int(planes[region[0]]) if planes[region[0]] >= 0 else number
            numbers[region] = plane_id
            surfaces.extend(_surfaces(soup, region, [polygons[int(face)] for face in region], plane_id))
    footprint = _united([surface.polygon for surface in surfaces])
    if not surfaces:
        ground = np.flatnonzero([kind is FaceKind.GROUND for kind in kinds])
        footprint = _united(soup.plan(ground))
    absolute = _moved([*(surface.polygon for surface in surfaces), footprint], soup.origin)
    origin = (float(soup.origin[0]), float(soup.origin[1]), float(soup.origin[2]))
    return Assembled(
        surfaces=tuple(
            dataclasses.replace(surface, polygon=polygon, origin=origin)
            for surface, polygon in zip(surfaces, absolute[:-1], strict=True)
        ),
        footprint=absolute[-1],
        solids=_solids(parts, soup, kinds, numbers),
        solid_origin=origin,
    )


def _moved(polygons: list[Polygon | MultiPolygon], origin: FloatArray) -> list[Polygon | MultiPolygon]:
    """Polygons in absolute coordinates, whole millimetres."""
    return list(shapely.transform(np.array(polygons, object), lambda xy: np.round(xy + origin[:2], 3)))


def _united(polygons: Sequence[Polygon | MultiPolygon]) -> Polygon | MultiPolygon:
    """The union on the grid, without holes that are only slivers."""
    if len(polygons) == 1 and isinstance(polygons[0], Polygon):
        return polygons[0]
    union = _areas_of(shapely.union_all(polygons, grid_size=GRID_M))
    pieces = []
    for piece in shapely.get_parts(union).tolist():
        holes = [hole for hole in piece.interiors if Polygon(hole).area > _SLIVER_M * 0.5 * hole.length]
        pieces.append(piece if len(holes) == len(piece.interiors) else Polygon(piece.exterior, holes))
    return pieces[0] if len(pieces) == 1 else MultiPolygon(pieces)


# ------------------------------------------------------------------------------------------------------------ kinds


def _kinds(soup: _Soup) -> tuple[list[FaceKind], dict[int, Polygon | MultiPolygon]]:
    """The kind of every face, and the plan of the roof faces that have an area in plan, by face.

    Roof faces without a name, and named ones that look down (undersides of eaves in some files), are roofs only if no
    other roof is above them.
    """
    unnamed = [face.kind is None for face in soup.faces]
    by_normal = _kinds_by_normal(soup) if any(unnamed) else []
    kinds = [face.kind or by_normal[number] for number, face in enumerate(soup.faces)]
    roofs = np.flatnonzero([kind is FaceKind.ROOF for kind in kinds])
    plans = soup.plan(roofs)
    areas = shapely.area(plans)
    kept = [(int(face), plan) for face, plan, area in zip(roofs, plans, areas, strict=True) if area > _MIN_AREA_M2]
    doubtful = np.array([unnamed[face] or soup.vectors[face, 2] < 0.0 for face, _ in kept], np.bool_)
    if doubtful.any():
        covered = _covered(soup, kept, doubtful)
        for (face, _), is_covered in zip(kept, covered, strict=True):
            if is_covered:
                kinds[face] = FaceKind.GROUND
        kept = [entry for entry, is_covered in zip(kept, covered, strict=True) if not is_covered]
    return kinds, dict(kept)


def _kinds_by_normal(soup: _Soup) -> list[FaceKind]:
    """The kinds of faces by their normals; those of a part that faces inward as a whole are turned round.

    The sum of (area in plan) times (height) over the faces is the volume of a closed part. It is also positive for an
    open one whose faces look outward.
    """
    lengths = np.linalg.norm(soup.vectors, axis=1)
    counts = [sum(map(len, rings)) for rings in soup.rings]
    owner = np.repeat(np.arange(len(soup.faces)), counts)
    z = soup.local[[corner for rings in soup.rings for ring in rings for corner in ring], 2]
    heights = np.bincount(owner, z, len(soup.faces)) / np.maximum(counts, 1)
    low = np.full(soup.part[-1] + 1, np.inf)
    np.minimum.at(low, soup.part[owner], z)
    low[~np.isfinite(low)] = 0.0
    volumes = np.bincount(soup.part, soup.vectors[:, 2] * (heights - low[soup.part]), len(low))
    flat = np.bincount(soup.part, soup.vectors[:, 2], len(low))
    inward = np.where(volumes == 0.0, flat, volumes) < 0.0
    upward = np.where(inward, -1.0, 1.0)[soup.part]
    up = np.divide(soup.vectors[:, 2] * upward, lengths, out=np.zeros(len(lengths)), where=lengths > 0.0)
    return [FaceKind.ROOF if z > MIN_UP else FaceKind.GROUND if z < -MIN_UP else FaceKind.WALL for z in up]


def _covered(soup: _Soup, roofs: list[tuple[int, Polygon | MultiPolygon]], doubtful: BoolArray) -> BoolArray:
    """Which doubtful faces have most of their area under other roof faces."""
    plans = np.array([plan for _, plan in roofs], object)
    covered = np.zeros(len(roofs), np.bool_)
    if shapely.area(plans).sum() - shapely.union_all(plans, grid_size=GRID_M).area < _MIN_AREA_M2 * len(plans):
        return covered
    lower, upper = shapely.STRtree(plans).query(plans, predicate="intersects")
    pairs = (lower != upper) & doubtful[lower]
    lower, upper = lower[pairs], upper[pairs]
    common = shapely.intersection(plans[lower], plans[upper])
    met = shapely.area(common) > _MIN_AREA_M2
    pieces: dict[int, list[shapely.Geometry]] = {}
    for low, high, piece in zip(lower[met].tolist(), upper[met].tolist(), common[met], strict=True):
        x, y = shapely.get_coordinates(shapely.centroid(piece))[0]
        if _height(soup, roofs[high][0], x, y) > _height(soup, roofs[low][0], x, y) + DISTANCE_M:
            pieces.setdefault(low, []).append(piece)
    for low, above in pieces.items():
        covered[low] = shapely.union_all(above).area > _COVERED_SHARE * plans[low].area
    return covered


def _height(soup: _Soup, face: int, x: float, y: float) -> float:
    """Height of the plane of a face that is not vertical at a place in plan."""
    normal = soup.vectors[face]
    corners = soup.local[soup.corners_of(face)].mean(axis=0)
    return float(corners[2] - (normal[0] * (x - corners[0]) + normal[1] * (y - corners[1])) / normal[2])


# ----------------------------------------------------------------------------------------------------------- planes


def _regions(soup: _Soup, roofs: IntArray, planes: IntArray) -> list[IntArray]:
    """Roof faces gathered by plane, each sorted, in the order of their first faces."""
    regions: dict[int, list[int]] = {}
    own = [soup.welded[face] for face in roofs]
    labels = coplanar_regions(soup.xyz, own, soup.vectors[roofs].tolist(), planes.tolist())
    for face, label in zip(roofs.tolist(), labels, strict=True):
        regions.setdefault(label, []).append(face)
    merged: list[list[int]] = []
    of_plane: dict[int, int] = {}
    for region in regions.values():
        plane = soup.faces[region[0]].plane
        if plane >= 0 and plane in of_plane and _in_one_plane(soup, merged[of_plane[plane]], region):
            merged[of_plane[plane]].extend(region)
            continue
        of_plane.setdefault(plane, len(merged))
        merged.append(region)
    return [np.array(sorted(region), np.int64) for region in merged]


def _in_one_plane(soup: _Soup, faces: Sequence[int], others: Sequence[int]) -> bool:
    """Whether the vertices of other faces lie in the plane of some faces."""
    a, b, c = _fitted(soup, faces)
    xyz = soup.local[soup.corners_of(*others)]
    distance = np.abs(xyz[:, 2] - a * xyz[:, 0] - b * xyz[:, 1] - c) / np.sqrt(1.0 + a * a + b * b)
    return bool(distance.max() <= DISTANCE_M)


def _fitted(soup: _Soup, faces: Sequence[int] | IntArray) -> Coefficients:
    """The least-squares plane of the vertices of some faces, each place once."""
    a, b, c, _ = fit_plane_coefficients(soup.local, np.unique(soup.corners_of(*faces)).astype(np.int32))
    return a, b, c


def _surfaces(
    soup: _Soup, region: IntArray, plans: Sequence[Polygon | MultiPolygon], plane_id: int
) -> list[RoofSurface]:
    """The roof faces of one plane, one per connected piece, relative to the origin."""
    union = _united(plans)
    pieces = [union] if isinstance(union, Polygon) else list(union.geoms)
    coefficients = _fitted(soup, region)
    return [
        RoofSurface(polygon=piece, coefficients=coefficients, plane_id=plane_id)
        for piece in pieces
        if piece.area > _MIN_AREA_M2
    ]


def _solids(parts: Sequence[RawPart], soup: _Soup, kinds: Sequence[FaceKind], numbers: IntArray) -> tuple[Solid, ...]:
    """The parts that are meant to be solids, vertices in whole millimetres."""
    solids = []
    first = 0
    for number, part in enumerate(parts):
        if part.is_solid:
            vertices = soup.millimetres[soup.first_vertex[number] : soup.first_vertex[number + 1]]
            faces = tuple(
                SolidFace(rings=face.rings, kind=kinds[first + k], plane=int(numbers[first + k]))
                for k, face in enumerate(part.faces)
            )
            solids.append(Solid(vertices=vertices / MILLIMETRES_PER_METRE, faces=faces))
        first += len(part.faces)
    return tuple(solids)
