"""LoD1.2, LoD1.3 and LoD2.0 from the roof faces of LoD2.2, over the same outline.

LoD1.3 unites roof faces with no step, or a low one, between them, and gives each level part the height at a percentile
of its points; LoD1.2 is one such part (Biljecki, Ledoux and Stoter 2016, An improved LOD specification for 3D building
models). LoD2.0 is the main roof alone. Every part consists of existing roof faces: nothing is cut again.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
import shapely
from shapely import MultiPolygon

from pipeline.errors import BuildingError
from pipeline.extras.lods.main_roof import main_planes
from pipeline.methods import MAIN_ROOF
from pipeline.model import FloatArray, Plane, RoofFace, Solid
from pipeline.roof.block import block_plane
from pipeline.roof.footprint import polygons_of
from pipeline.roof.partition import RoofPartition
from pipeline.roof.roof_settings import RoofSettings
from pipeline.roof.simplification import without_idle_vertices
from pipeline.roof.solid import LodParts, SolidPart, solid_parts

XY = tuple[int, int]

_MAX_FORMS = 8
"""Most ways to draw the levels of a part: bounds the work. Then the part becomes one level."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class LevelPart:
    """One separate part of a building in levels."""

    solid_part: SolidPart
    """Closed; not yet judged."""
    planes: tuple[Plane, ...]
    """Horizontal planes that the part's faces number."""


def lower_lods(
    detailed: LodParts,
    points: FloatArray,
    ground_z_m: float,
    settings: RoofSettings,
    lods: Sequence[str],
    is_sound: Callable[[Solid], bool],
    outline_mm: MultiPolygon | None = None,
) -> list[LodParts]:
    """A building's model in LoD2.2 at the requested levels of detail, the finest first.

    All have the same parts in the same order. A level is left out where no form of it is sound.

    Parameters
    ----------
    points : (n, 3) float64
        Its roof points, local metres; at least one.
    ground_z_m : float
        Elevation of the floor, local metres.
    lods : sequence of str
        Some of 1.2, 1.3, 2.0 and 2.2.
    outline_mm : MultiPolygon, optional
        What the models stay within.
    """
    whole = block_plane(points, ground_z_m, settings.block_height_percentile)
    forms: Mapping[str, Callable[[SolidPart], Iterator[LevelPart]]] = {
        MAIN_ROOF: lambda part: main_roof_forms(part, detailed.planes, ground_z_m, outline_mm),
        "1.3": lambda part: level_forms(part, points, whole, ground_z_m, settings, outline_mm),
        "1.2": lambda part: block_forms(part, whole, ground_z_m, outline_mm),
    }
    models = [detailed] if detailed.lod in lods else []
    for lod, drawn in forms.items():
        if lod not in lods:
            continue
        sound = [
            next((form for form in drawn(part) if is_sound(form.solid_part.solid)), None) for part in detailed.parts
        ]
        found = [form for form in sound if form is not None]
        if len(found) == len(detailed.parts) and lod == MAIN_ROOF:
            models.append(LodParts(lod=lod, parts=[form.solid_part for form in found], planes=detailed.planes))
        elif len(found) == len(detailed.parts):
            models.append(_numbered_through(lod, found))
    return models


def _numbered_through(lod: str, levels: Sequence[LevelPart]) -> LodParts:
    """Parts with planes of their own as one building."""
    parts: list[SolidPart] = []
    planes: list[Plane] = []
    for level in levels:
        part, first = level.solid_part, len(planes)
        faces = tuple(
            dataclasses.replace(face, plane=face.plane + first) if face.plane >= 0 else face
            for face in part.solid.faces
        )
        parts.append(
            dataclasses.replace(
                part,
                solid=dataclasses.replace(part.solid, faces=faces),
                faces=tuple(dataclasses.replace(face, plane=face.plane + first) for face in part.faces),
            )
        )
        planes += level.planes
    return LodParts(lod=lod, parts=parts, planes=planes)


def main_roof_forms(
    part: SolidPart, planes: Sequence[Plane], ground_z_m: float, outline_mm: MultiPolygon | None = None
) -> Iterator[LevelPart]:
    """Ways to draw one part of a building, with its roof faces of LoD2.2, without what stands on them (LoD2.0)."""
    borders = {pair: border.length_mm for pair, border in _borders(part.faces).items()}
    numbers = main_planes(part.faces, planes, borders)
    if numbers == [face.plane for face in part.faces]:
        yield LevelPart(solid_part=part, planes=tuple(planes))
        return
    regions: list[list[shapely.Polygon]] = [[] for _ in planes]
    for number, face in zip(numbers, part.faces, strict=True):
        regions[number].append(_polygon_mm(face))
    yield from _drawn(regions, planes, ground_z_m, outline_mm)


def block_forms(
    part: SolidPart, level: Plane, ground_z_m: float, outline_mm: MultiPolygon | None = None
) -> Iterator[LevelPart]:
    """Ways to draw one part of a building, with its roof faces of LoD2.2, as a block (LoD1.2); fewer vertices first."""
    polygons = [_polygon_mm(face) for face in part.faces]
    yield from _drawn([polygons], [level], ground_z_m, outline_mm)


def level_forms(
    part: SolidPart,
    points: FloatArray,
    level: Plane,
    ground_z_m: float,
    settings: RoofSettings,
    outline_mm: MultiPolygon | None = None,
) -> Iterator[LevelPart]:
    """Ways to draw one part of a building in levels (LoD1.3), the best first.

    Roof faces whose common border has a mean step below `level_step_m` belong to one level part, transitively; then
    neighbouring parts whose heights differ by less are united, those that differ least first. So neighbours differ by
    that step at least. Parts without points, and those smaller than `min_part_area_m2`, join the neighbour that
    differs least. In the further forms more and more neighbours are joined, up to one level.

    Parameters
    ----------
    part : SolidPart
        With roof faces, as for LoD2.2.
    points : (n, 3) float64
        Roof points of the whole building, local metres.
    level : Plane
        The horizontal roof where none of the points lies over the part.
    ground_z_m : float
        Elevation of the floor, local metres.
    outline_mm : MultiPolygon, optional
        What the part stays within.
    """
    polygons = [_polygon_mm(face) for face in part.faces]
    borders = _borders(part.faces)
    heights = _heights_over(polygons, points)
    if not any(len(z) for z in heights):
        yield from _drawn([polygons], [level], ground_z_m, outline_mm)
        return
    regions = _Regions(polygons, heights, borders, settings.block_height_percentile)
    regions.unite_without_step(settings.level_step_m)
    while regions.unite_closest(settings.level_step_m, settings.min_part_area_m2):
        pass
    for form in itertools.count(1):
        planes = [block_plane(z, ground_z_m, settings.block_height_percentile) for z in regions.points()]
        yield from _drawn(regions.polygons(), planes, ground_z_m, outline_mm)
        if not regions.unite_closest(math.inf, 0.0):
            return
        while form >= _MAX_FORMS and regions.unite_closest(math.inf, 0.0):
            pass


def _polygon_mm(face: RoofFace) -> shapely.Polygon:
    """A roof face in plan, integer millimetres."""
    polygon: shapely.Polygon = shapely.transform(shapely.force_2d(face.polygon), lambda xy: np.rint(xy * 1e3))
    return polygon


@dataclasses.dataclass
class _Border:
    """What two roof faces have in common."""

    length_mm: float = 0.0
    step_area_mm2: float = 0.0
    """Area of the wall between them."""


def _borders(faces: Sequence[RoofFace]) -> dict[tuple[int, int], _Border]:
    """The borders between roof faces by their numbers, the lower first."""
    edges: dict[tuple[XY, XY], tuple[int, float, float]] = {}
    for number, face in enumerate(faces):
        polygon = shapely.orient_polygons(face.polygon)
        for line in (polygon.exterior, *polygon.interiors):
            ring = np.rint(shapely.get_coordinates(line, include_z=True) * 1e3).astype(np.int64).tolist()
            for (xa, ya, za), (xb, yb, zb) in itertools.pairwise(ring):
                edges[(xa, ya), (xb, yb)] = number, za, zb
    borders: dict[tuple[int, int], _Border] = {}
    for (a, b), (left, left_a, left_b) in edges.items():
        right, right_b, right_a = edges.get((b, a), (-1, 0.0, 0.0))
        if a > b or right < 0 or right == left:
            continue
        border = borders.setdefault((min(left, right), max(left, right)), _Border())
        length_mm = math.hypot(b[0] - a[0], b[1] - a[1])
        border.length_mm += length_mm
        border.step_area_mm2 += 0.5 * length_mm * (abs(left_a - right_a) + abs(left_b - right_b))
    return borders


def _heights_over(polygons: Sequence[shapely.Polygon], points: FloatArray) -> list[FloatArray]:
    """The points over each polygon, (k, 3); one on a common border counts for the first."""
    left = np.arange(len(points))
    x, y = points[:, 0] * 1e3, points[:, 1] * 1e3
    over = []
    for polygon in polygons:
        x_min, y_min, x_max, y_max = polygon.bounds
        near = (x[left] >= x_min) & (x[left] <= x_max) & (y[left] >= y_min) & (y[left] <= y_max)
        shapely.prepare(polygon)
        inside = np.zeros(len(left), np.bool_)
        inside[near] = shapely.intersects_xy(polygon, x[left[near]], y[left[near]])
        over.append(points[left[inside]])
        left = left[~inside]
    return over


class _Regions:
    """Groups of roof faces that will be level parts; the number of each is that of its lowest face."""

    def __init__(
        self,
        polygons: Sequence[shapely.Polygon],
        points: Sequence[FloatArray],
        borders: dict[tuple[int, int], _Border],
        percentile: float,
    ) -> None:
        self._polygons = polygons
        self._borders = borders
        self._percentile = percentile
        self._members = {face: [face] for face in range(len(polygons))}
        self._points = dict(enumerate(points))
        self._pairs = set(borders)
        self._level = {face: self._height(face) for face in self._members}
        self._area_m2 = {face: polygon.area * 1e-6 for face, polygon in enumerate(polygons)}

    def unite_without_step(self, step_m: float) -> None:
        """Unite faces whose common border has a lower mean step."""
        low = [pair for pair, border in self._borders.items() if border.step_area_mm2 < 1e3 * step_m * border.length_mm]
        region = {face: face for face in self._members}
        for a, b in sorted(low):
            into, gone = sorted((region[a], region[b]))
            if into != gone:
                self._unite(into, gone)
                for face in self._members[into]:
                    region[face] = into

    def unite_closest(self, step_m: float, min_area_m2: float) -> bool:
        """Unite the two neighbours that differ least, small ones first; False if none differ by less than the step."""
        best: tuple[bool, float, int, int] | None = None
        for a, b in self._pairs:
            difference = abs(self._level[a] - self._level[b])
            is_poor = min(self._area_m2[a], self._area_m2[b]) < min_area_m2
            if math.isnan(difference):
                difference, is_poor = 0.0, True
            if is_poor or difference < step_m:
                best = min(best, (not is_poor, difference, a, b)) if best else (not is_poor, difference, a, b)
        if best is None:
            return False
        self._unite(best[2], best[3])
        return True

    def _unite(self, into: int, gone: int) -> None:
        """Make one region of two."""
        self._members[into] += self._members.pop(gone)
        self._points[into] = np.concatenate((self._points[into], self._points.pop(gone)))
        self._area_m2[into] += self._area_m2.pop(gone)
        self._level.pop(gone)
        self._level[into] = self._height(into)
        moved = ((into if a == gone else a, into if b == gone else b) for a, b in self._pairs)
        self._pairs = {(min(pair), max(pair)) for pair in moved if pair[0] != pair[1]}

    def _height(self, region: int) -> float:
        """Level of a region, local metres; nan without points."""
        points = self._points[region]
        return block_plane(points, -math.inf, self._percentile).c if len(points) else math.nan

    def polygons(self) -> list[list[shapely.Polygon]]:
        """The faces of each region."""
        return [[self._polygons[face] for face in sorted(members)] for _, members in sorted(self._members.items())]

    def points(self) -> list[FloatArray]:
        """The points of each region."""
        return [points for _, points in sorted(self._points.items())]


def _drawn(
    regions: Sequence[Sequence[shapely.Polygon]],
    planes: Sequence[Plane],
    ground_z_m: float,
    outline_mm: MultiPolygon | None,
) -> Iterator[LevelPart]:
    """Level parts as one closed solid: without idle vertices, then with all."""
    polygons: list[shapely.Polygon] = []
    labels: list[int] = []
    for label, faces in enumerate(regions):
        pieces = polygons_of(shapely.coverage_union_all(list(faces)))
        polygons += pieces
        labels += [label] * len(pieces)
    for drawn in (without_idle_vertices(polygons), polygons):
        partition = RoofPartition(polygons=tuple(drawn), labels=np.array(labels, np.int32))
        try:
            parts = solid_parts(partition, planes, ground_z_m, outline_mm)
        except BuildingError:
            continue
        if len(parts) == 1:
            yield LevelPart(solid_part=parts[0], planes=tuple(planes))
