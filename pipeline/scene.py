"""One tile's points to surface fragments, end to end, without I/O.

Ground, heights, a TIN of thinned points, wall facets, fragments: the front half of the science (`reconstruct` is the
other). Every step declares how far it looks (`SceneSettings`); with a halo at least that wide the result does not
depend on the tiles.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pipeline.model import BoolArray, ByteArray, IntArray, KindArray, LabelArray
from pipeline.terrain.facets import OnRoof, SceneVertices, VertexKind
from pipeline.terrain.glass import glass_of
from pipeline.terrain.ground import Terrain, ground_points
from pipeline.terrain.lattice import CELL_MM, NO_DATA, height_above
from pipeline.terrain.needed_ground import needed_vertices
from pipeline.terrain.point_assignment import Allowed, ScenePoints
from pipeline.terrain.surfaces import Fragments, fragments_of
from pipeline.terrain.terrain_settings import ClassCodeSettings, ClassesInUse, SceneSettings
from pipeline.terrain.thin_objects import are_thin
from pipeline.terrain.thinning import highest_per_cell, lowest_below
from pipeline.terrain.vegetation import crowns, planarity
from pipeline.tiling import Window
from pipeline.tin.delaunay import triangulate

GROUND_CLASS = 2
BUILDING_CLASS = 6
VEGETATION_CLASSES = (3, 4, 5)
"""Low, medium and high vegetation."""
OTHER_CLASSES = ClassCodeSettings().other
"""Classes of what is neither ground, nor building, nor vegetation: water, roads, wires, bridges."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class WindowPoints:
    """All points of a tile's window, without exact duplicates; arrays of one length n."""

    x_mm: IntArray
    y_mm: IntArray
    z_mm: IntArray
    return_number: ByteArray
    return_count: ByteArray
    classification: ByteArray

    def __len__(self) -> int:
        """Number of points."""
        return len(self.x_mm)

    def take(self, index: IntArray) -> WindowPoints:
        """The points of an index array."""
        return WindowPoints(**{f.name: getattr(self, f.name)[index] for f in dataclasses.fields(self)})


@dataclasses.dataclass(frozen=True, kw_only=True)
class SplitTile:
    """Result of the split of one tile."""

    fragments: Fragments
    """Descriptors for the join."""
    core_index: IntArray
    """(n,) int64, indices into the window's points of those that the core owns."""
    point_fragment: LabelArray
    """(n,) int32, their fragments; -1 where none."""


def never_roof(codes: ByteArray, classes: ClassesInUse) -> BoolArray:
    """Which points (n,) are never part of a building, by their class codes, where these are believed."""
    if not (classes.building or classes.vegetation):
        return np.zeros(len(codes), np.bool_)
    excluded: BoolArray = np.isin(codes, (*VEGETATION_CLASSES, *OTHER_CLASSES))
    return excluded


def lattice_of(window: Window) -> tuple[int, int, int, int]:
    """column0, row0, columns, rows of the terrain lattice that covers a window."""
    column0, row0 = window.x0_mm // CELL_MM, window.y0_mm // CELL_MM
    columns = -((-window.x1_mm) // CELL_MM) - column0
    rows = -((-window.y1_mm) // CELL_MM) - row0
    return column0, row0, columns, rows


def usable_as_ground(points: WindowPoints, kept: BoolArray, classes: ClassesInUse) -> BoolArray:
    """(n,) which points may be ground: of class 2 where it is believed, else last returns, no roofs; no outliers."""
    usable: BoolArray = kept & (points.classification == GROUND_CLASS if classes.ground else _is_last(points))
    if classes.roofs:
        usable &= points.classification != BUILDING_CLASS
    return usable


def _is_last(points: WindowPoints) -> BoolArray:
    """(n,) the last returns of their pulses."""
    last: BoolArray = points.return_number >= points.return_count
    return last


def _vertices(
    points: WindowPoints,
    core: Window,
    height_mm: IntArray,
    terrain: Terrain,
    building: BoolArray,
    excluded: BoolArray,
    settings: SceneSettings,
    classes: ClassesInUse,
) -> tuple[SceneVertices, BoolArray]:
    """The vertices of a core's TIN: thinned points with what is known of them; and the points (n,) under glass."""
    used = (height_mm != NO_DATA) & (_is_last(points) | building)
    # equal coordinates of different classes must not be decided by the order of the points
    preferred = np.zeros(len(points), np.int8)
    if classes.building or classes.ground:
        preferred = np.where(building, 3, np.where(points.classification == GROUND_CLASS, 1, 2)).astype(np.int8)
        preferred[excluded] = 0
    several = points.return_count > 1
    chosen, cell = highest_per_cell(
        points.x_mm,
        points.y_mm,
        points.z_mm,
        preferred,
        used,
        settings.surfaces.thinning_m,
        several.view(np.int8),
    )
    x, y, z = points.x_mm[chosen], points.y_mm[chosen], points.z_mm[chosen]
    kind = np.full(len(chosen), VertexKind.OBJECT, np.int8)
    kind[excluded[chosen]] = VertexKind.EXCLUDED
    kind[ground_points(x, y, z, terrain, settings.ground)] = VertexKind.GROUND
    if classes.ground:
        kind[points.classification[chosen] == GROUND_CLASS] = VertexKind.GROUND
    kind[building[chosen]] = VertexKind.BUILDING
    # farther points are evidence only
    facets_m, crowns_m = settings.surfaces.support_m, settings.vegetation.crowns_support_m
    judged = core.grown(round(1000 * (facets_m + crowns_m))).contains(x, y)
    planar = planarity(x, y, z, judged & (kind == VertexKind.OBJECT), settings.vegetation)
    stands = used & (height_mm >= round(1000 * settings.ground.tolerance_m))
    floor = lowest_below(points.x_mm, points.y_mm, points.z_mm, stands, chosen, cell, settings.vegetation.level_m)
    planar[_has_floor(points, height_mm, floor, planar == 0, settings)] = 1
    inner = core.grown(round(1000 * facets_m)).contains(x, y)
    on_roof = _on_roofs((x, y, z), kind, inner, settings)
    kind[crowns(x, y, z, planar, several[chosen], settings.vegetation)] = VertexKind.CROWN
    kind[(on_roof == OnRoof.YES) & (kind == VertexKind.OBJECT)] = VertexKind.JOINED
    vertices = SceneVertices(x_mm=x, y_mm=y, z_mm=z, height_mm=height_mm[chosen], kind=kind, planar=planar)
    least_mm = round(1000 * settings.candidates.min_height_m)
    over_plants = _planar_over_plants(vertices, least_mm, settings)
    limits_mm = round(1000 * settings.ground.tolerance_m), least_mm
    glass = glass_of(vertices, over_plants, (points.x_mm, points.y_mm), height_mm, used, limits_mm)
    planar[glass.roof] = over_plants[glass.roof]
    inner &= ~glass.under
    near = np.flatnonzero(inner & ((on_roof != OnRoof.BESIDE) | (kind != VertexKind.OBJECT)))
    surfaces = settings.surfaces
    far_mm = max(surfaces.far_mm, round(1000 * surfaces.thin_m))
    near = near[needed_vertices(x[near], y[near], kind[near], 1000.0 * surfaces.max_circumradius_m, far_mm)]
    entering = SceneVertices(
        x_mm=x[near],
        y_mm=y[near],
        z_mm=z[near],
        height_mm=vertices.height_mm[near],
        kind=kind[near],
        planar=planar[near],
    )
    return entering, glass.seen_through


def _on_roofs(
    places_mm: tuple[IntArray, IntArray, IntArray], kind: KindArray, inner: BoolArray, settings: SceneSettings
) -> KindArray:
    """`OnRoof` of the inner vertices (v,) of which neither class nor height says what they are."""
    undecided, building = kind == VertexKind.OBJECT, kind == VertexKind.BUILDING
    wanted = undecided & inner
    if not building.any() or not wanted.any():
        return np.full(len(kind), OnRoof.NO, np.int8)
    from pipeline.terrain.incomplete_classes import undecided_on_roofs  # most files have no class 6 with gaps

    reach_m = settings.surfaces.reach_m
    return undecided_on_roofs(places_mm, building, undecided | building, wanted, settings.vegetation, reach_m)


def _has_floor(
    points: WindowPoints,
    height_mm: IntArray,
    floor: IntArray,
    rough: BoolArray,
    settings: SceneSettings,
) -> BoolArray:
    """Which rough vertices (m,) stand on an even floor, as railings, plants and furniture on a roof do.

    `floor` (m,) are the lowest points above the ground in the vertices' cells. A floor is as even as a scanner
    measures; the lowest points in a crown are as rough as the highest. Floors of beds and hedges lie lower than roofs.
    """
    vegetation = settings.vegetation
    x, y, z = points.x_mm, points.y_mm, points.z_mm
    wanted = rough & (height_mm[floor] >= round(1000 * settings.candidates.min_height_m))
    even: BoolArray = planarity(x[floor], y[floor], z[floor], wanted, vegetation, vegetation.smooth_m) > 0
    return even


def _planar_over_plants(vertices: SceneVertices, least_mm: int, settings: SceneSettings) -> KindArray:
    """How planar the surroundings of each vertex are if nothing below the height of roofs counts.

    Plants that are seen through a low roof of glass lie on the level of its vertices.
    """
    x, y, z, height, _, planar = vertices
    vegetation = settings.vegetation
    wanted = (planar == 0) & (height >= least_mm) & (height < least_mm + round(1000 * vegetation.level_m))
    high = np.flatnonzero(height >= least_mm)
    found = planar.copy()
    found[high] = np.maximum(planar[high], planarity(x[high], y[high], z[high], wanted[high], vegetation))
    return found


def _thin(points: WindowPoints, height_mm: IntArray, vertices: SceneVertices, settings: SceneSettings) -> BoolArray:
    """Which points (n,) are low and thin between ground on both sides: garden walls, fences and hedges."""
    low_mm = round(1000 * settings.candidates.min_height_m)
    low = (height_mm >= round(1000 * settings.ground.tolerance_m)) & (height_mm < low_mm)
    return are_thin(points.x_mm, points.y_mm, low, vertices, low_mm, round(1000 * settings.surfaces.thin_m))


def split_tile(
    points: WindowPoints, core: Window, terrain: Terrain, settings: SceneSettings, classes: ClassesInUse
) -> SplitTile:
    """Split the core of one tile into surface fragments, and assign its points.

    Parameters
    ----------
    points : WindowPoints
        Those of the core and of `split_support_m` around it, without outliers; farther ones do not matter.
    core : Window
        What the tile owns.
    terrain : Terrain
        The ground wherever these points lie.
    settings, classes
        As for the run.
    """
    near = core.grown(round(1000 * settings.split_support_m(footprints=False)))
    near_index = np.flatnonzero(near.contains(points.x_mm, points.y_mm))
    points = points if len(near_index) == len(points) else points.take(near_index)
    height = height_above(points.x_mm, points.y_mm, points.z_mm, terrain.elevation_mm, terrain.column0, terrain.row0)
    building = (points.classification == BUILDING_CLASS) & classes.building
    excluded = never_roof(points.classification, classes)
    vertices, seen_through = _vertices(points, core, height, terrain, building, excluded, settings, classes)
    core_index = np.flatnonzero(core.contains(points.x_mm, points.y_mm) & (height != NO_DATA))
    owned = points.take(core_index)
    allowed = np.where(_thin(owned, height[core_index], vertices, settings), Allowed.EVIDENCE, Allowed.ANY)
    allowed = allowed.astype(np.int8)
    allowed[excluded[core_index]] = Allowed.NEVER
    allowed[building[core_index]] = Allowed.BUILDING
    if classes.ground:
        allowed[owned.classification == GROUND_CLASS] = Allowed.NEVER
    allowed[seen_through[core_index] & ~building[core_index]] = Allowed.UNDER_GLASS
    fragments, point_fragment = fragments_of(
        triangulate(np.column_stack((vertices.x_mm, vertices.y_mm))),
        vertices,
        ScenePoints(
            x_mm=owned.x_mm,
            y_mm=owned.y_mm,
            z_mm=owned.z_mm,
            height_mm=height[core_index],
            last=_is_last(owned),
            several=owned.return_count > 1,
            allowed=allowed,
        ),
        (core.x0_mm, core.y0_mm, core.x1_mm, core.y1_mm),
        settings.surfaces,
        canopy_m=settings.vegetation.canopy_m,
        ground_m=settings.ground.tolerance_m,
    )
    return SplitTile(fragments=fragments, core_index=near_index[core_index], point_fragment=point_fragment)
